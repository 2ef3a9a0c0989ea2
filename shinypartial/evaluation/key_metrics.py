"""The most important metrics: the one list of paths that summary, report, ranking, comparison and charts show."""

from dataclasses import dataclass
from typing import Literal

from shinypartial.metrics.registry import Metric, metric

Place = Literal["summary", "report", "ranking", "comparison", "chart"]


@dataclass(frozen=True)
class KeyMetric:
    """Where a number lies in the scores, its title, and the places that show it; a chart knows it by `name`."""

    path: str
    title: str
    places: tuple[Place, ...]
    name: str = ""

    @property
    def metric(self) -> Metric:
        """Its definition."""
        return path_metric(self.path)

    @property
    def group(self) -> str:
        """The path without the name of the metric."""
        return self.path.rpartition(".")[0]


def path_metric(path: str) -> Metric:
    """The definition of the metric at a path such as `render.psnr`."""
    return metric(path.rpartition(".")[2])


_FULL, _OBSERVED, _RESOLVED = (f"environment.as_predicted.{region}" for region in ("full", "observed", "resolved"))

KEY_METRICS = (
    KeyMetric(
        f"{_FULL}.psnr_srgb",
        "Environment PSNR, all directions",
        ("summary", "report", "ranking", "comparison", "chart"),
        "environment_psnr",
    ),
    KeyMetric(f"{_FULL}.psnr_linear", "Environment PSNR, linear, all directions", ("summary", "comparison")),
    KeyMetric(f"{_OBSERVED}.psnr_srgb", "Environment PSNR, seen directions", ("report", "ranking")),
    KeyMetric(f"{_RESOLVED}.psnr_srgb", "Environment PSNR, resolved directions", ("summary", "ranking", "comparison")),
    KeyMetric(f"{_RESOLVED}.psnr_linear", "Environment PSNR, linear, resolved directions", ("summary",)),
    KeyMetric(f"{_FULL}.ssim_srgb", "Environment SSIM, all directions", ("summary", "report", "ranking", "comparison")),
    KeyMetric(f"{_RESOLVED}.ssim_srgb", "Environment SSIM, resolved directions", ("summary",)),
    KeyMetric(f"{_FULL}.log_rmse_stops", "Environment, error in stops, all directions", ("summary",)),
    KeyMetric(f"{_RESOLVED}.log_rmse_stops", "Environment, error in stops, resolved directions", ("summary",)),
    KeyMetric("environment.perceptual.lpips_alex", "Environment LPIPS", ("summary", "report")),
    KeyMetric(
        "surroundings.inverse_distance_error", "Error of 1/distance times object radius", ("summary", "comparison")
    ),
    KeyMetric(
        "normals.median_angular_error_deg",
        "Median normal error",
        ("summary", "ranking", "comparison", "chart"),
        "median_normal_error",
    ),
    KeyMetric(
        "normals.mean_angular_error_deg",
        "Mean normal error",
        ("summary", "report", "ranking", "comparison", "chart"),
        "mean_normal_error",
    ),
    KeyMetric("normals.normal_coverage", "Pixels with a normal", ("summary",)),
    KeyMetric("render.psnr", "PSNR of test views", ("summary", "report", "ranking", "comparison")),
    KeyMetric("render.ssim", "SSIM of test views", ("summary", "comparison")),
    KeyMetric("render.alpha_iou", "Overlap of the masks", ("summary",)),
    KeyMetric("render.lpips_alex", "LPIPS of test views", ("summary",)),
    KeyMetric(
        "calibration.visibility_error_auroc",
        "AUROC: low visibility announces error",
        ("summary", "report", "ranking", "comparison"),
    ),
    KeyMetric("calibration.visibility_error_spearman", "Rank correlation of visibility and error", ("summary",)),
    KeyMetric("calibration.sparsification_area", "Sparsification area", ("ranking",)),
    KeyMetric("resolved_coverage", "Share of the sphere that training views resolve", ("report",)),
)


def key_metrics(place: Place) -> tuple[KeyMetric, ...]:
    """Those that a place shows, in its order."""
    return tuple(one for one in KEY_METRICS if place in one.places)
