"""One test view against its ground truth, and the pooling of all views."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.color import linear_to_srgb
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import read_view
from shinypartial.dataset.schema import Dataset, Frame, View
from shinypartial.evaluation.masks import environment_mask, solid_mask
from shinypartial.evaluation.scores import Counts, LeftOut, RenderScores, ViewScores
from shinypartial.metrics import perceptual
from shinypartial.metrics.angular import AngularStatistics, angular_statistics, normal_errors_deg
from shinypartial.metrics.image import SSIM_RADIUS, l1, psnr, ssim
from shinypartial.metrics.paper import PaperView, claimed_mask, paper_render
from shinypartial.prediction.format import TEST_VIEWS, prediction_frame

NO_VIEWS = "the dataset or the prediction has no test views"


@dataclass(frozen=True)
class ViewResult:
    """What one test view adds; `normal_errors` holds one value per mask pixel, NaN for a hole.

    `sees_environment` determines which of these pixels do; None where the dataset doesn't know.
    """

    scores: ViewScores
    psnr_foreground: float | None
    l1: float
    intersection: int
    union: int
    lpips_alex: float | None
    normal_errors: Float[np.ndarray, "P"] | None
    sees_environment: Bool[np.ndarray, "P"] | None
    paper: PaperView | None


def frames_to_score(prediction: Path, data: Dataset) -> tuple[Frame, ...]:
    """The dataset's test views, or none of them where the prediction holds maps alone."""
    return data.test if (prediction / TEST_VIEWS).is_dir() else ()


def read_prediction(prediction: Path, frame: Frame) -> View:
    """The prediction of a test view; InputError, with the file's name, when it is missing or misshapen."""
    predicted = prediction_frame(prediction, frame)
    remedy = "Export every test view of the prediction again: see docs/reference/prediction-format.md."
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


def score_view(
    frame: Frame, predicted: View, truth: View, lpips: perceptual.Lpips | None, *, with_paper: bool
) -> ViewResult:
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
    errors = _normal_errors(predicted, truth)
    claimed = _normal_errors(predicted, truth, claimed=True)
    paper = PaperView(paper_render(image, target), claimed) if with_paper else None
    large_enough = min(truth.alpha.shape) >= perceptual.SMALLEST_SIDE
    return ViewResult(
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
        sees_environment=None if truth.self_reflection is None else environment_mask(truth)[solid_mask(truth)],
        paper=paper,
    )


def _normal_errors(predicted: View, truth: View, *, claimed: bool = False) -> Float[np.ndarray, "P"] | None:
    """Of solid pixels, or of those that both claim to be on the object; None where one of them has no normals."""
    if truth.normals_world is None or predicted.normals_world is None:
        return None
    mask = solid_mask(truth)
    if claimed:
        mask = claimed_mask(predicted.alpha, predicted.normals_world, truth.normals_world)
    return normal_errors_deg(predicted.normals_world[mask], truth.normals_world[mask])


def pool_normals(results: Sequence[ViewResult], left_out: list[LeftOut]) -> AngularStatistics | None:
    """Statistics over all pixels of all views; raises InputError when only some views have normals."""
    errors = [result.normal_errors for result in results if result.normal_errors is not None]
    if results and 0 < len(errors) < len(results):
        lacking = next(result.scores.name for result in results if result.normal_errors is None)
        raise InputError(
            expected="normals in every test view, or in none",
            found=f"{len(errors)} of {len(results)} views with normals; {lacking} has none",
            remedy="Export the test views again with channels normal.X, normal.Y and normal.Z.",
        )
    if not errors or not sum(error.size for error in errors):
        reason = "dataset or prediction has no normals" if results else NO_VIEWS
        left_out.append(LeftOut("normals", reason))
        return None
    return angular_statistics(np.concatenate(errors))


def pool_environment_normals(results: Sequence[ViewResult], left_out: list[LeftOut]) -> AngularStatistics | None:
    """The same over those pixels alone that see the environment: the others' normals reflect the object itself."""
    pairs = [
        (result.normal_errors, result.sees_environment)
        for result in results
        if result.normal_errors is not None and result.sees_environment is not None
    ]
    errors = np.concatenate([error[sees] for error, sees in pairs] or [np.zeros(0)])
    if errors.size:
        return angular_statistics(errors)
    known = any(result.sees_environment is not None for result in results)
    reason = "no normals to score" if known else "the dataset doesn't mark pixels that see the object itself"
    left_out.append(LeftOut("normals_environment", reason if results else NO_VIEWS))
    return None


def pool_renders(
    results: Sequence[ViewResult], lpips: perceptual.Lpips | None, left_out: list[LeftOut], *, own_masks: bool = True
) -> RenderScores | None:
    """Means over views, and the pooled intersection over union, if the masks are the method's own."""
    if not results:
        left_out.append(LeftOut("render", NO_VIEWS))
        return None
    if not own_masks:
        left_out.append(LeftOut("render.alpha_iou", "the dataset's masks cut out the test views, not the method's own"))
    if lpips is not None and all(result.lpips_alex is None for result in results):
        left_out.append(LeftOut("render.lpips_alex", f"test views are smaller than {perceptual.SMALLEST_SIDE} px"))
    union = sum(result.union for result in results)
    return RenderScores(
        psnr=float(np.mean([result.scores.psnr for result in results])),
        psnr_foreground=_mean_or_none([result.psnr_foreground for result in results]),
        ssim=float(np.mean([result.scores.ssim for result in results])),
        l1=float(np.mean([result.l1 for result in results])),
        alpha_iou=(sum(result.intersection for result in results) / union if union else 1.0) if own_masks else None,
        lpips_alex=_mean_or_none([result.lpips_alex for result in results]),
    )


def _mean_or_none(values: Sequence[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if present else None


def count_all(data: Dataset, results: Sequence[ViewResult]) -> Counts:
    """How many views and normals were compared."""
    errors = [result.normal_errors for result in results if result.normal_errors is not None]
    return Counts(
        train_views=len(data.train),
        test_views=len(results),
        normal_pixels=sum(error.size for error in errors),
        normal_holes=sum(int(np.isnan(error).sum()) for error in errors),
    )
