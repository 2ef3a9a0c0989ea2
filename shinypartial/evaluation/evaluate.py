"""Folders in, scores out: a prediction is compared with its dataset under named protocols, whatever method wrote it.

Reads only the two folders; writes PREDICTION/scores.json and the pictures in PREDICTION/evaluation. The definitions
are in docs/reference/metrics.md.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.camera import ray_directions_world, reflect
from shinypartial.core.color import linear_to_srgb
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset, read_environment, read_inverse_distance, read_view, require_normals
from shinypartial.dataset.schema import ENVIRONMENT_LATLONG, Dataset, Frame
from shinypartial.evaluation.masks import environment_mask
from shinypartial.evaluation.pictures import (
    ENVIRONMENT_ERROR,
    ENVIRONMENT_ERROR_MAP,
    ENVIRONMENT_EXPOSED,
    ENVIRONMENT_PREDICTION,
    ENVIRONMENT_TRUTH,
    OBSERVED_MAP,
    VISIBILITY,
    VISIBILITY_MAP,
    observed_picture,
    radiance_picture,
    scalar_picture,
    write_view_pictures,
)
from shinypartial.evaluation.scores import (
    PROTOCOL,
    EnvironmentScores,
    LeftOut,
    PerceptualScores,
    Scores,
    SurroundingsScores,
    require_oracle_baseline,
    write_scores,
)
from shinypartial.evaluation.turning import TURNING, write_turning
from shinypartial.evaluation.view_scores import (
    ViewResult,
    count_all,
    frames_to_score,
    pool_environment_normals,
    pool_normals,
    pool_renders,
    read_prediction,
    score_view,
)
from shinypartial.io.files import copy_or_link
from shinypartial.io.images import write_png
from shinypartial.io.progress import Progress
from shinypartial.io.threads import in_threads
from shinypartial.metrics import coverage as coverage_metrics
from shinypartial.metrics import environment as environment_metrics
from shinypartial.metrics import perceptual
from shinypartial.metrics.balls import ball_scores
from shinypartial.metrics.calibration import CalibrationScores, calibration_scores
from shinypartial.metrics.paper import (
    PAPER_PROTOCOL,
    PaperEnvironment,
    PaperScores,
    paper_environment,
    pool_paper,
    reinhard_picture,
)
from shinypartial.prediction.format import (
    ENVIRONMENT,
    EVALUATION,
    SCORES,
    PredictionInfo,
    dataset_hash,
    read_environment_map,
    read_info,
    read_visibility,
)
from shinypartial.prediction.format import VISIBILITY as VISIBILITY_FILE
from shinypartial.prediction.format import read_inverse_distance as read_predicted_inverse_distance

#: Test views that are shown in the report, spread evenly over the split.
PICTURED_VIEWS = 4
#: Test views whose normals determine the errors of the surface, spread likewise.
SURFACE_VIEWS = 16

#: What to score: the benchmark's own protocol, with or without the one that serves comparison with published tables.
Protocols = Literal["both", "linear-v1"]
Mask = Bool[np.ndarray, "H W"]
Latlong = Float[np.ndarray, "_H _W 3"]


@dataclass(frozen=True)
class _Networks:
    """LPIPS functions where weights and torch are there."""

    alex: perceptual.Lpips | None
    vgg: perceptual.Lpips | None


@dataclass(frozen=True)
class _Observed:
    """Directions that the training views see, at the protocol's size, and the solid-angle shares; None: unknown."""

    masks: environment_metrics.RegionMasks
    coverage: float | None
    resolved_coverage: float | None


@dataclass(frozen=True)
class _MapScores:
    """What the environment and visibility maps of a prediction score; None for what could not be scored."""

    environment: EnvironmentScores | None
    calibration: CalibrationScores | None
    paper: PaperEnvironment | None


def evaluate(
    prediction: Path | str,
    dataset: Path | str | None = None,
    lpips_weights: Path | None = None,
    protocol: Protocols = "both",
    oracle: Path | str | None = None,
) -> Scores:
    """Score a prediction folder against its dataset; write scores.json and pictures into it and return the scores.

    Like the command `shinypartial evaluate`, which also prints a summary: `evaluate("predictions/vase-400-default")`.
    `dataset` defaults to the path in prediction.json; `lpips_weights` to the places that `metrics.perceptual` names;
    `oracle`, a folder with the scores of the dataset's oracle baseline, to the sibling DATASET-oracle where there is
    one. What can't be computed is None and named in `Scores.left_out`. Views and maps are scored in threads, with the
    same results as one after the other. Raises InputError for files that are missing, broken or misshapen.
    """
    prediction = Path(prediction)
    info = read_info(prediction)
    data = _open_dataset(info, None if dataset is None else Path(dataset), prediction)
    data_hash = dataset_hash(data)
    if oracle is not None:
        require_oracle_baseline(Path(oracle), prediction, data.name, data_hash)
    left_out: list[LeftOut] = []
    networks = _load_networks(lpips_weights, left_out)
    frames = frames_to_score(prediction, data)
    progress = Progress("evaluate", total=len(data.train) + len(frames) + 1)
    observed = _observed_directions(data, left_out, progress)
    with_paper = protocol == "both"
    _import_metrics()
    with TemporaryDirectory() as folder:
        pictures = Path(folder)
        with ThreadPoolExecutor(1) as beside:
            scoring = beside.submit(_score_maps, prediction, pictures, data, observed, networks, left_out, with_paper)
            results = list(_score_views(prediction, pictures, frames, networks, progress, with_paper))
            maps = scoring.result()
        _picture_surface(prediction, pictures, data, left_out)
        progress.advance("environment")
        if not with_paper:
            left_out.append(LeftOut(PAPER_PROTOCOL, "not requested (--protocol both)"))
        scores = Scores(
            protocol=PROTOCOL,
            dataset=data.name,
            split=data.scene_split,
            dataset_hash=data_hash,
            dataset_hash_matches=data_hash == info.dataset_hash,
            coverage=observed.coverage,
            resolved_coverage=observed.resolved_coverage,
            environment=maps.environment,
            normals=pool_normals(results, left_out),
            normals_environment=pool_environment_normals(results, left_out),
            render=pool_renders(results, networks.alex, left_out, own_masks=info.masks is None),
            calibration=maps.calibration,
            paper=_pool_paper(maps, results) if with_paper else None,
            oracle=None if oracle is None else str(Path(oracle).resolve()),
            views=tuple(result.scores for result in results),
            counts=count_all(data, results),
            surroundings=_score_surroundings(prediction, data, observed, left_out),
            left_out=tuple(left_out),  # Last: the others add to it.
        )
        _replace(prediction, scores, pictures)
    return scores


def _replace(prediction: Path, scores: Scores, pictures: Path) -> None:
    """Put scores and pictures in the place of those of an earlier evaluation, which stay together if one fails."""
    folder = prediction / EVALUATION
    for old in (prediction / SCORES, *folder.glob("*.png"), folder / TURNING):
        old.unlink(missing_ok=True)
    for new in pictures.iterdir():
        copy_or_link(new, folder / new.name, link=False)
    write_scores(prediction, scores)


def _picture_surface(prediction: Path, pictures: Path, data: Dataset, left_out: list[LeftOut]) -> None:
    """The surface as a picture; one that can't be read is left out, for no score is made of it."""
    frames = data.test[:: -(-len(data.test) // SURFACE_VIEWS) or 1]
    try:
        write_turning(pictures / TURNING, prediction, ((frame.camera, read_view(frame)) for frame in frames))
    except InputError as error:
        left_out.append(LeftOut("picture of the surface", f"expected {error.expected}; found {error.found}"))


def _pool_paper(maps: _MapScores, results: list[ViewResult]) -> PaperScores:
    return pool_paper(maps.paper, [result.paper for result in results if result.paper is not None])


def _import_metrics() -> None:
    """Load what metrics import when they are called: two threads that import one package at once can both fail."""
    for name in ("scipy.optimize", "scipy.sparse", "scipy.stats", "skimage.metrics._structural_similarity"):
        import_module(name)


def _open_dataset(info: PredictionInfo, dataset: Path | None, prediction: Path) -> Dataset:
    root = dataset or Path(info.dataset)
    if dataset is None and not root.is_dir():
        raise InputError(
            expected=f"the dataset of the prediction at {root}, as {prediction / 'prediction.json'} says",
            found="no such folder",
            remedy="Name it: `shinypartial evaluate --dataset FOLDER`.",
        )
    return open_dataset(root)


def _load_networks(folder: Path | None, left_out: list[LeftOut]) -> _Networks:
    loaded: list[perceptual.Lpips | None] = []
    for network in ("alex", "vgg"):
        path = perceptual.find_weights(network, folder)
        if path is not None and perceptual.has_torch():
            loaded.append(perceptual.load_lpips(network, path))
            continue
        reason = perceptual.HOW_TO_GET if path is None else perceptual.NO_TORCH
        left_out.append(LeftOut(f"lpips_{network}", reason))
        loaded.append(None)
    return _Networks(*loaded)


def _observed_directions(data: Dataset, left_out: list[LeftOut], progress: Progress) -> _Observed:
    if read_view(data.train[0]).normals_world is None:
        names = ("coverage", "resolved_coverage", "environment observed", "environment resolved")
        left_out += [LeftOut(name, "the dataset's training views have no normals") for name in names]
        progress.advance(steps=len(data.train))
        return _Observed(environment_metrics.RegionMasks(None, None), None, None)
    seen = coverage_metrics.nothing_observed()
    for cells in in_threads(_cells_of_view, data.train):
        seen = seen.union(cells)
        progress.advance("coverage")
    masks: list[Mask | None] = []
    for name, region in (("observed", seen.observed), ("resolved", seen.resolved)):
        masks.append(coverage_metrics.cells_to_latlong(region, environment_metrics.PROTOCOL_HEIGHT))
        if not region.any():
            left_out.append(LeftOut(f"environment {name}", f"no direction is {name} by the training views"))
            masks[-1] = None
    shares = (coverage_metrics.coverage(region) for region in (seen.observed, seen.resolved))
    return _Observed(environment_metrics.RegionMasks(*masks), *shares)


def _cells_of_view(frame: Frame) -> coverage_metrics.ObservedCells:
    view = read_view(frame)
    normals = require_normals(frame, view)
    mask = environment_mask(view)
    return coverage_metrics.cells_of_view(reflect(ray_directions_world(frame.camera)[mask], normals[mask]))


def _score_maps(
    prediction: Path,
    pictures: Path,
    data: Dataset,
    observed: _Observed,
    networks: _Networks,
    left_out: list[LeftOut],
    with_paper: bool,
) -> _MapScores:
    missing = None
    if not (data.root / ENVIRONMENT_LATLONG).exists():
        missing = f"the dataset has no ground-truth environment ({ENVIRONMENT_LATLONG})"
    elif not (prediction / ENVIRONMENT).exists():
        missing = f"the prediction has no {ENVIRONMENT}"
    if missing:
        left_out += [LeftOut(name, missing) for name in ("environment", "calibration")]
        return _MapScores(None, None, None)
    truth, predicted = read_environment(data), read_environment_map(prediction)
    stops = environment_metrics.best_exposure_stops(predicted, truth)
    exposed = predicted * np.float32(2.0**stops)
    error = environment_metrics.absolute_error_srgb(predicted, truth)
    _write_environment_pictures(pictures, (predicted, exposed, truth), error, observed)
    srgb = [linear_to_srgb(environment_metrics.clipped_map(radiance)) for radiance in (predicted, truth)]
    scores = EnvironmentScores(
        as_predicted=environment_metrics.region_scores(predicted, truth, observed.masks),
        exposure_stops=stops,
        best_exposure=environment_metrics.region_scores(exposed, truth, observed.masks),
        unweighted=environment_metrics.unweighted_scores(predicted, truth),
        perceptual=PerceptualScores(
            networks.alex(*srgb) if networks.alex else None, networks.vgg(*srgb) if networks.vgg else None
        ),
        balls=ball_scores(predicted, truth, np.mean([each.camera.camera_to_world[:3, 2] for each in data.train], 0)),
    )
    paper = _score_paper(predicted, truth, networks) if with_paper else None
    return _MapScores(scores, _score_calibration(prediction, pictures, error, left_out), paper)


def _score_paper(predicted: Latlong, truth: Latlong, networks: _Networks) -> PaperEnvironment:
    picture, target = reinhard_picture(predicted), reinhard_picture(truth)
    return paper_environment(picture, target, networks.alex(picture, target) if networks.alex else None)


def _write_environment_pictures(
    folder: Path, radiances: tuple[Latlong, Latlong, Latlong], error: Float[np.ndarray, "H W"], observed: _Observed
) -> None:
    """Radiances are the prediction, the prediction at its best exposure and the truth."""
    names = (ENVIRONMENT_PREDICTION, ENVIRONMENT_EXPOSED, ENVIRONMENT_TRUTH)
    for name, radiance in zip(names, radiances, strict=True):
        write_png(folder / name, radiance_picture(environment_metrics.clipped_map(radiance)))
    write_png(folder / ENVIRONMENT_ERROR_MAP, scalar_picture(error, ENVIRONMENT_ERROR))
    masks = observed.masks
    if masks.observed is not None:
        resolved = np.zeros_like(masks.observed) if masks.resolved is None else masks.resolved
        write_png(folder / OBSERVED_MAP, observed_picture(masks.observed, resolved))


def _score_surroundings(
    prediction: Path, data: Dataset, observed: _Observed, left_out: list[LeftOut]
) -> SurroundingsScores | None:
    truth, radius, mask = read_inverse_distance(data), data.object_radius, observed.masks.observed
    predicted = read_predicted_inverse_distance(prediction)
    if truth is None or radius is None:
        return None
    if mask is None:
        left_out.append(LeftOut("surroundings", "no direction is known to be observed by the training views"))
        return SurroundingsScores(None)
    return SurroundingsScores(environment_metrics.inverse_distance_error(predicted, truth, radius, mask))


def _score_calibration(
    prediction: Path, pictures: Path, error: Float[np.ndarray, "H W"], left_out: list[LeftOut]
) -> CalibrationScores | None:
    visibility = read_visibility(prediction)
    if visibility is None:
        left_out.append(LeftOut("calibration", f"the prediction has no {VISIBILITY_FILE}"))
        return None
    resized = environment_metrics.to_protocol_size(visibility[..., None])[..., 0]
    write_png(pictures / VISIBILITY_MAP, scalar_picture(resized, VISIBILITY))
    weights = environment_metrics.direction_weights()
    scores = calibration_scores(resized.ravel(), error.ravel(), weights.ravel())
    undefined = "undefined: visibility or error is the same everywhere, or no direction is wrong"
    left_out += [LeftOut(name, undefined) for name, value in vars(scores).items() if value is None]
    return scores


def _score_views(
    prediction: Path,
    pictures: Path,
    frames: tuple[Frame, ...],
    networks: _Networks,
    progress: Progress,
    with_paper: bool,
) -> Iterator[ViewResult]:
    spread = np.linspace(0, len(frames) - 1, min(PICTURED_VIEWS, len(frames)))
    pictured = {frames[round(index)].name for index in spread}

    def score(frame: Frame) -> ViewResult:
        truth, predicted = read_view(frame), read_prediction(prediction, frame)
        if frame.name in pictured:
            write_view_pictures(pictures, frame.stem.name, predicted, truth)
        return score_view(frame, predicted, truth, networks.alex, with_paper=with_paper)

    for result in in_threads(score, frames):
        yield result
        progress.advance("test views")
