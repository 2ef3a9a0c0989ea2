"""The oracle baseline of a dataset: the map that its training views give when the normals are known.

Written as a prediction folder, so that the evaluator scores it like any method: a score means little without it.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.camera import ray_directions_world, reflect
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import pixel_footprint_sr, sample_latlong
from shinypartial.dataset.read import open_dataset, read_environment, read_view, require_normals
from shinypartial.dataset.schema import ENVIRONMENT_LATLONG, Dataset, Frame, View
from shinypartial.evaluation.masks import environment_mask
from shinypartial.io.files import folder_lock
from shinypartial.io.progress import Progress
from shinypartial.io.system import peak_memory_bytes
from shinypartial.io.threads import in_threads
from shinypartial.metrics.coverage import cells_of_view, cells_to_latlong
from shinypartial.metrics.environment import PROTOCOL_HEIGHT, RegionMasks, region_scores
from shinypartial.oracle.latlong_solver import ROBUST_SCALES, Rays, SolvedMap, solve_latlong
from shinypartial.prediction.format import (
    PredictionInfo,
    begin_prediction,
    dataset_hash,
    write_environment_map,
    write_info,
    write_test_view,
    write_visibility,
)

METHOD = "oracle"
#: Heights of maps that are tried, finest first: no finer than what the protocol compares.
HEIGHTS = tuple(PROTOCOL_HEIGHT >> step for step in range(4))
#: A map is tried when there are this many rays a texel; with ENOUGH_RAYS no coarser one is.
FEWEST_RAYS, ENOUGH_RAYS = 2.0, 16.0

Mask = Bool[np.ndarray, "H W"]


@dataclass(frozen=True)
class Candidate:
    """One way to estimate the map, and its linear PSNR over observed directions (None without a truth)."""

    estimate: str
    height: int
    radiance: Float[np.ndarray, "H W 3"]
    evidence: Float[np.ndarray, "H W"]
    psnr_linear: float | None


@dataclass(frozen=True)
class Oracle:
    """The written folder, the candidate that was taken, and all that were tried."""

    root: Path
    chosen: Candidate
    candidates: tuple[Candidate, ...]
    rays: int
    seconds: dict[str, float]


def make_oracle(dataset: Path, output: Path) -> Oracle:
    """Solve the environment of a dataset from its training views and ground-truth normals; write it to `output`.

    Of the plain average and the robust least squares, on grids as fine as the rays allow, the one with the smallest
    error against the ground truth over observed directions is taken: this makes the baseline as good as they can be.
    Raises InputError when the dataset has no normals, and when `output` holds something else than a prediction or is in
    use.
    """
    data = open_dataset(dataset)
    _require_normals(data)
    with folder_lock(output):
        begin_prediction(output)
        oracle = _solve(data, output)
        write_info(output, _info(oracle, data))
    return oracle


def _solve(data: Dataset, output: Path) -> Oracle:
    """Write the maps and the test views."""
    start = time.monotonic()
    solves = len(HEIGHTS) * len(ROBUST_SCALES)
    progress = Progress("oracle", total=len(data.train) + solves + len(data.test))
    rays = _read_rays(data, progress)
    after_reading = time.monotonic()
    candidates = _candidates(rays, data, progress)
    known = [candidate for candidate in candidates if candidate.psnr_linear is not None]
    chosen = max(known, key=lambda candidate: candidate.psnr_linear or 0.0) if known else candidates[1]
    write_environment_map(output, chosen.radiance)
    write_visibility(output, chosen.evidence / (1 + chosen.evidence))
    after_solving = time.monotonic()
    for _ in in_threads(lambda frame: _render(output, frame, chosen.radiance), data.test):
        progress.advance("test views")
    times = (start, after_reading, after_solving, time.monotonic())
    seconds = {
        name: round(times[i + 1] - times[i], 2) for i, name in enumerate(("read views", "solve", "write test views"))
    }
    return Oracle(output, chosen, candidates, len(rays.directions), seconds)


def _require_normals(data: Dataset) -> None:
    if read_view(data.train[0]).normals_world is None:
        raise InputError(
            expected=f"ground-truth normals in the training views of {data.root}",
            found="none",
            remedy="Oracle baselines exist for rendered datasets only: make one with `shinypartial generate`.",
        )


def _read_rays(data: Dataset, progress: Progress) -> Rays:
    parts = []
    for part in in_threads(rays_of_view, data.train):
        parts.append(part)
        progress.advance("rays")
    rays = Rays(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))
    if not len(rays.directions):
        raise InputError(
            expected=f"pixels of {data.root} that lie wholly on the object",
            found="none in any training view",
            remedy="Render it larger: `shinypartial generate --resolution`.",
        )
    return rays


def rays_of_view(frame: Frame) -> Rays:
    """What the pixels of one training view see by mirror reflection at the ground-truth normal.

    Pixels on the silhouette and, where the dataset knows them, pixels that see the object itself are left out.
    """
    view = read_view(frame)
    normals = require_normals(frame, view)
    mask = environment_mask(view)
    directions = reflect(ray_directions_world(frame.camera), normals.astype(np.float64))
    footprint = pixel_footprint_sr(directions, mask)[mask]
    return Rays(directions[mask].astype(np.float32), view.radiance[mask].astype(np.float32), footprint)


def heights_to_try(rays: int) -> tuple[int, ...]:
    """From the finest map with at least two rays a texel to the first with plenty; the coarsest if there are none."""
    tried: list[int] = []
    for height in HEIGHTS:
        density = rays / (2 * height**2)
        if density >= FEWEST_RAYS or height == HEIGHTS[-1]:
            tried.append(height)
        if density >= ENOUGH_RAYS:
            break
    return tuple(tried)


def _candidates(rays: Rays, data: Dataset, progress: Progress) -> tuple[Candidate, ...]:
    truth = read_environment(data) if (data.root / ENVIRONMENT_LATLONG).exists() else None
    found: list[Candidate] = []
    observed = cells_to_latlong(cells_of_view(rays.directions).observed, PROTOCOL_HEIGHT)
    heights = heights_to_try(len(rays.directions))
    progress.advance(steps=(len(HEIGHTS) - len(heights)) * len(ROBUST_SCALES))
    for height in heights:
        solved = solve_latlong(rays, height, lambda: progress.advance("environment"))
        found += [_candidate(name, getattr(solved, name), solved, truth, observed) for name in ("averaged", "robust")]
    return tuple(found)


def _candidate(
    estimate: str,
    radiance: Float[np.ndarray, "H W 3"],
    solved: SolvedMap,
    truth: Float[np.ndarray, "_H _W 3"] | None,
    observed: Bool[np.ndarray, "h w"],
) -> Candidate:
    psnr = None
    if truth is not None:
        scores = region_scores(radiance, truth, RegionMasks(observed, None))
        psnr = (scores.observed or scores.full).psnr_linear
    return Candidate(estimate, radiance.shape[0], radiance, solved.evidence, psnr)


def _render(output: Path, frame: Frame, environment: Float[np.ndarray, "H W 3"]) -> None:
    """A test view as the map shows it in a perfect mirror with the ground-truth normals."""
    truth = read_view(frame)
    normals = require_normals(frame, truth)
    radiance = np.zeros_like(truth.radiance)
    mask = (truth.alpha > 0) & (np.linalg.norm(normals, axis=-1) > 0.5)
    directions = reflect(ray_directions_world(frame.camera)[mask], normals[mask])
    radiance[mask] = sample_latlong(environment, directions) * truth.alpha[mask][:, None]
    depth = np.zeros_like(truth.alpha) if truth.depth is None else truth.depth  # Plain datasets have none.
    write_test_view(output, frame, View(radiance, truth.alpha, normals, depth, True))


def _info(oracle: Oracle, data: Dataset) -> PredictionInfo:
    chosen = oracle.chosen
    config = {
        "estimate": chosen.estimate,
        "height": chosen.height,
        "rays": oracle.rays,
        "candidates_psnr_linear": {f"{one.estimate}_{one.height}": one.psnr_linear for one in oracle.candidates},
    }
    return PredictionInfo(
        method=METHOD,
        dataset=str(data.root),
        dataset_hash=dataset_hash(data),
        config=config,
        seconds=oracle.seconds,
        hardware={"device": "cpu"},
        parameter_counts={"environment": int(chosen.radiance.size)},
        peak_memory_bytes=peak_memory_bytes(),
    )
