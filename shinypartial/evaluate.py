"""Folders in, scores out: a prediction is compared with its dataset under protocol linear-v1, whatever method wrote it.

Reads only the two folders; writes PREDICTION/scores.json and the pictures in PREDICTION/evaluation. The definitions
are in docs/metrics.md.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.camera import ray_directions_world, reflect
from shinypartial.color import linear_to_srgb
from shinypartial.conventions import SOLID_ALPHA
from shinypartial.dataset.read import open_dataset, read_environment, read_view
from shinypartial.dataset.schema import ENVIRONMENT_LATLONG, Dataset, Frame, View
from shinypartial.errors import InputError
from shinypartial.images import write_png
from shinypartial.metrics import coverage as coverage_metrics
from shinypartial.metrics import environment as environment_metrics
from shinypartial.metrics import perceptual
from shinypartial.metrics.angular import AngularStatistics, angular_statistics, normal_errors_deg
from shinypartial.metrics.calibration import CalibrationScores, calibration_scores
from shinypartial.metrics.image import SSIM_RADIUS, l1, psnr, ssim
from shinypartial.pictures import (
    ENVIRONMENT_ERROR,
    ENVIRONMENT_ERROR_MAP,
    ENVIRONMENT_EXPOSED,
    ENVIRONMENT_PREDICTION,
    ENVIRONMENT_TRUTH,
    EVALUATION,
    OBSERVED_MAP,
    VISIBILITY,
    VISIBILITY_MAP,
    observed_picture,
    radiance_picture,
    scalar_picture,
    solid_mask,
    write_view_pictures,
)
from shinypartial.prediction import (
    ENVIRONMENT,
    PredictionInfo,
    dataset_hash,
    prediction_frame,
    read_environment_map,
    read_info,
    read_visibility,
)
from shinypartial.prediction import (
    VISIBILITY as VISIBILITY_FILE,
)
from shinypartial.progress import Progress
from shinypartial.scores import (
    PROTOCOL,
    Counts,
    EnvironmentScores,
    LeftOut,
    PerceptualScores,
    RenderScores,
    Scores,
    ViewScores,
    write_scores,
)

#: Test views that are shown in the report, spread evenly over the split.
PICTURED_VIEWS = 4
MAX_WORKERS = 8
#: Slack for values that 16-bit storage rounds beyond [0, 1].
VISIBILITY_TOLERANCE = 1e-3

Result = TypeVar("Result")
Mask = Bool[np.ndarray, "H W"]
Latlong = Float[np.ndarray, "_H _W 3"]


@dataclass(frozen=True)
class _Networks:
    """LPIPS functions where weights and torch are there."""

    alex: perceptual.Lpips | None
    vgg: perceptual.Lpips | None


@dataclass(frozen=True)
class _ViewResult:
    """What one test view adds; `normal_errors` holds one value per mask pixel, NaN for a hole."""

    scores: ViewScores
    psnr_foreground: float | None
    l1: float
    intersection: int
    union: int
    lpips_alex: float | None
    normal_errors: Float[np.ndarray, "P"] | None


@dataclass(frozen=True)
class _Observed:
    """Directions that the training views see, at the protocol's size, and the solid-angle shares; None: unknown."""

    masks: environment_metrics.RegionMasks
    coverage: float | None
    resolved_coverage: float | None


def evaluate(prediction: Path, dataset: Path | None = None, lpips_weights: Path | None = None) -> Scores:
    """Score a prediction folder against its dataset and write scores.json and pictures into it.

    `dataset` defaults to the path in prediction.json; `lpips_weights` to the places that `metrics.perceptual` names.
    What can't be computed is left out by name. Raises InputError for files that are missing, broken or misshapen.
    """
    info = read_info(prediction)
    data = _open_dataset(info, dataset, prediction)
    left_out: list[LeftOut] = []
    networks = _load_networks(lpips_weights, left_out)
    for old in (prediction / EVALUATION).glob("*.png"):
        old.unlink()
    progress = Progress("evaluate", total=len(data.train) + len(data.test) + 1)
    observed = _observed_directions(data, left_out, progress)
    environment, calibration = _score_environment(prediction, data, observed, networks, left_out)
    progress.advance("environment")
    results = list(_score_views(prediction, data, networks, progress))
    scores = Scores(
        protocol=PROTOCOL,
        dataset=data.name,
        dataset_hash=dataset_hash(data),
        dataset_hash_matches=dataset_hash(data) == info.dataset_hash,
        coverage=observed.coverage,
        resolved_coverage=observed.resolved_coverage,
        environment=environment,
        normals=_pool_normals(results, left_out),
        render=_pool_renders(results, networks, left_out),
        calibration=calibration,
        views=tuple(result.scores for result in results),
        left_out=tuple(left_out),
        counts=_counts(data, results),
    )
    write_scores(prediction, scores)
    return scores


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


def _in_threads(function: Callable[[Frame], Result], frames: Sequence[Frame]) -> Iterator[Result]:
    """Results in the order of the frames; the first failure cancels what has not begun."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_WORKERS)) as executor:
        try:
            yield from executor.map(function, frames)
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise


def _observed_directions(data: Dataset, left_out: list[LeftOut], progress: Progress) -> _Observed:
    if read_view(data.train[0]).normals_world is None:
        names = ("coverage", "resolved_coverage", "environment observed", "environment resolved")
        left_out += [LeftOut(name, "the dataset's training views have no normals") for name in names]
        progress.advance(steps=len(data.train))
        return _Observed(environment_metrics.RegionMasks(None, None), None, None)
    seen = coverage_metrics.nothing_observed()
    for cells in _in_threads(_cells_of_view, data.train):
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
    if view.normals_world is None:
        raise InputError(
            expected=f"normals in {frame.name}, as in the first training view",
            found="none",
            remedy="Generate the dataset again.",
        )
    mask = solid_mask(view)
    return coverage_metrics.cells_of_view(reflect(ray_directions_world(frame.camera)[mask], view.normals_world[mask]))


def _score_environment(
    prediction: Path, data: Dataset, observed: _Observed, networks: _Networks, left_out: list[LeftOut]
) -> tuple[EnvironmentScores | None, CalibrationScores | None]:
    missing = None
    if not (data.root / ENVIRONMENT_LATLONG).exists():
        missing = f"the dataset has no ground-truth environment ({ENVIRONMENT_LATLONG})"
    elif not (prediction / ENVIRONMENT).exists():
        missing = f"the prediction has no {ENVIRONMENT}"
    if missing:
        left_out += [LeftOut(name, missing) for name in ("environment", "calibration")]
        return None, None
    truth, predicted = read_environment(data), read_environment_map(prediction)
    stops = environment_metrics.best_exposure_stops(predicted, truth)
    exposed = predicted * np.float32(2.0**stops)
    error = environment_metrics.absolute_error_srgb(predicted, truth)
    _write_environment_pictures(prediction / EVALUATION, (predicted, exposed, truth), error, observed)
    srgb = [linear_to_srgb(environment_metrics.clipped_map(radiance)) for radiance in (predicted, truth)]
    scores = EnvironmentScores(
        as_predicted=environment_metrics.region_scores(predicted, truth, observed.masks),
        exposure_stops=stops,
        best_exposure=environment_metrics.region_scores(exposed, truth, observed.masks),
        unweighted=environment_metrics.unweighted_scores(predicted, truth),
        perceptual=PerceptualScores(
            networks.alex(*srgb) if networks.alex else None, networks.vgg(*srgb) if networks.vgg else None
        ),
    )
    return scores, _score_calibration(prediction, error, left_out)


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


def _score_calibration(
    prediction: Path, error: Float[np.ndarray, "H W"], left_out: list[LeftOut]
) -> CalibrationScores | None:
    visibility = read_visibility(prediction)
    if visibility is None:
        left_out.append(LeftOut("calibration", f"the prediction has no {VISIBILITY_FILE}"))
        return None
    _require_visibility(visibility, prediction / VISIBILITY_FILE)
    resized = environment_metrics.to_protocol_size(np.clip(visibility, 0, 1)[..., None])[..., 0]
    write_png(prediction / EVALUATION / VISIBILITY_MAP, scalar_picture(resized, VISIBILITY))
    weights = environment_metrics.direction_weights()
    scores = calibration_scores(resized.ravel(), error.ravel(), weights.ravel())
    undefined = "undefined: visibility or error is the same everywhere, or no direction is wrong"
    left_out += [LeftOut(name, undefined) for name, value in vars(scores).items() if value is None]
    return scores


def _require_visibility(visibility: Float[np.ndarray, "H W"], path: Path) -> None:
    height, width = visibility.shape
    bounds = float(visibility.min()), float(visibility.max())
    if width == 2 * height and bounds[0] >= -VISIBILITY_TOLERANCE and bounds[1] <= 1 + VISIBILITY_TOLERANCE:
        return
    raise InputError(
        expected=f"finite visibility in [0, 1], twice as wide as high, in {path}",
        found=f"{width}×{height} with values from {bounds[0]:.4g} to {bounds[1]:.4g}",
        remedy="Export the visibility again: see docs/prediction-format.md.",
    )


def _score_views(prediction: Path, data: Dataset, networks: _Networks, progress: Progress) -> Iterator[_ViewResult]:
    spread = np.linspace(0, len(data.test) - 1, min(PICTURED_VIEWS, len(data.test)))
    pictured = {data.test[round(index)].name for index in spread}

    def score(frame: Frame) -> _ViewResult:
        truth, predicted = read_view(frame), _read_prediction(prediction, frame)
        if frame.name in pictured:
            write_view_pictures(prediction / EVALUATION, frame.stem.name, predicted, truth)
        return _score_view(frame, predicted, truth, networks.alex)

    for result in _in_threads(score, data.test):
        yield result
        progress.advance("test views")


def _read_prediction(prediction: Path, frame: Frame) -> View:
    predicted = prediction_frame(prediction, frame)
    remedy = "Export every test view of the prediction again: see docs/prediction-format.md."
    if not predicted.exr.exists() and not predicted.png.exists():
        raise InputError(
            expected=f"the prediction of {frame.name} at {predicted.exr}",
            found="neither that file nor a PNG beside it",
            remedy=remedy,
        )
    try:
        return read_view(predicted)
    except InputError as error:
        raise InputError(
            expected=f"{error.expected} (prediction {predicted.stem})", found=error.found, remedy=remedy
        ) from None


def _score_view(frame: Frame, predicted: View, truth: View, lpips: perceptual.Lpips | None) -> _ViewResult:
    """Compare one view; colors are sRGB of premultiplied linear light clipped to [0, 1], that is, on black."""
    if min(truth.alpha.shape) <= 2 * SSIM_RADIUS:
        raise InputError(
            expected=f"test views larger than {2 * SSIM_RADIUS} px",
            found=f"{frame.name} of {frame.camera.width}×{frame.camera.height}",
            remedy="Generate the dataset with a higher resolution.",
        )
    image, target = (linear_to_srgb(np.clip(view.radiance, 0, 1)) for view in (predicted, truth))
    solid = truth.alpha > SOLID_ALPHA
    covered, target_covered = predicted.alpha > 0.5, truth.alpha > 0.5
    errors = _normal_errors(frame, predicted, truth)
    large_enough = min(truth.alpha.shape) >= perceptual.SMALLEST_SIDE
    return _ViewResult(
        scores=ViewScores(
            name=frame.name,
            psnr=psnr(image, target, data_range=1.0),
            ssim=ssim(image, target),
            mean_angular_error_deg=(
                angular_statistics(errors).mean_angular_error_deg if errors is not None and errors.size else None
            ),
        ),
        psnr_foreground=psnr(image, target, data_range=1.0, weights=solid.astype(np.float32)) if solid.any() else None,
        l1=l1(image, target),
        intersection=int((covered & target_covered).sum()),
        union=int((covered | target_covered).sum()),
        lpips_alex=lpips(image, target) if lpips is not None and large_enough else None,
        normal_errors=errors,
    )


def _normal_errors(frame: Frame, predicted: View, truth: View) -> Float[np.ndarray, "P"] | None:
    if truth.normals_world is None or predicted.normals_world is None:
        return None
    mask = solid_mask(truth)
    return normal_errors_deg(predicted.normals_world[mask], truth.normals_world[mask])


def _pool_normals(results: Sequence[_ViewResult], left_out: list[LeftOut]) -> AngularStatistics | None:
    errors = [result.normal_errors for result in results if result.normal_errors is not None]
    if results and 0 < len(errors) < len(results):
        lacking = next(result.scores.name for result in results if result.normal_errors is None)
        raise InputError(
            expected="normals in every test view, or in none",
            found=f"{len(errors)} of {len(results)} views with normals; {lacking} has none",
            remedy="Export the test views again with channels normal.X, normal.Y and normal.Z.",
        )
    if not errors or not sum(error.size for error in errors):
        reason = "dataset or prediction has no normals" if results else "the dataset has no test views"
        left_out.append(LeftOut("normals", reason))
        return None
    return angular_statistics(np.concatenate(errors))


def _pool_renders(results: Sequence[_ViewResult], networks: _Networks, left_out: list[LeftOut]) -> RenderScores | None:
    if not results:
        left_out.append(LeftOut("render", "the dataset has no test views"))
        return None
    if networks.alex is not None and all(result.lpips_alex is None for result in results):
        left_out.append(LeftOut("render.lpips_alex", f"test views are smaller than {perceptual.SMALLEST_SIDE} px"))
    union = sum(result.union for result in results)
    return RenderScores(
        psnr=float(np.mean([result.scores.psnr for result in results])),
        psnr_foreground=_mean_or_none([result.psnr_foreground for result in results]),
        ssim=float(np.mean([result.scores.ssim for result in results])),
        l1=float(np.mean([result.l1 for result in results])),
        alpha_iou=sum(result.intersection for result in results) / union if union else 1.0,
        lpips_alex=_mean_or_none([result.lpips_alex for result in results]),
    )


def _mean_or_none(values: Sequence[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if present else None


def _counts(data: Dataset, results: Sequence[_ViewResult]) -> Counts:
    errors = [result.normal_errors for result in results if result.normal_errors is not None]
    return Counts(
        train_views=len(data.train),
        test_views=len(data.test),
        normal_pixels=sum(error.size for error in errors),
        normal_holes=sum(int(np.isnan(error).sum()) for error in errors),
    )
