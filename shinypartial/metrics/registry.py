"""Every metric, defined once: reports, tables and gates read names, units, directions and formats from here."""

from dataclasses import dataclass
from enum import Enum

#: PSNR is bounded here: a root mean square error of 1e-5 of the data range is finer than half-float storage.
PSNR_CEILING_DB = 100.0

WANG = "Wang et al., Image quality assessment, IEEE TIP 2004, doi:10.1109/TIP.2003.819861"
ZHANG = "Zhang et al., The unreasonable effectiveness of deep features, CVPR 2018, arXiv:1801.03924"
FOUHEY = "Fouhey et al., Data-driven 3D primitives, ICCV 2013 (thresholds 11.25°, 22.5°)"
REINHARD = "Reinhard et al., Photographic tone reproduction, SIGGRAPH 2002, doi:10.1145/566654.566575"
ILG = "Ilg et al., Uncertainty estimates for optical flow, ECCV 2018, arXiv:1802.07095"
HANLEY = "Hanley and McNeil, Radiology 143, 1982, doi:10.1148/radiology.143.1.7063747"
SPEARMAN = "Spearman, American Journal of Psychology 15, 1904, doi:10.2307/1412159"
GARDNER = "Gardner et al., Deep parametric indoor lighting estimation, ICCV 2019, arXiv:1910.08812"
LEGENDRE = "LeGendre et al., DeepLight, CVPR 2019, arXiv:1904.01175"
DEFINED_HERE = "docs/reference/metrics.md"


class Direction(Enum):
    """Which values are better; a description has no better side."""

    HIGHER = "↑"
    LOWER = "↓"
    DESCRIPTION = "·"


@dataclass(frozen=True)
class Metric:
    """What a number is called, how it is printed and which way it improves; `format_spec` is Python's."""

    name: str
    title: str
    unit: str
    direction: Direction
    format_spec: str
    reference: str

    def text(self, value: float | None) -> str:
        """The value with its unit; a dash for a metric that was left out."""
        if value is None:
            return "–"
        if self.unit == "dB" and value >= PSNR_CEILING_DB:
            return f"≥ {PSNR_CEILING_DB:.0f} dB"
        return f"{value:{self.format_spec}}{'' if self.unit in ('', '°') else ' '}{self.unit}"


_HIGHER, _LOWER, _DESCRIPTION = Direction.HIGHER, Direction.LOWER, Direction.DESCRIPTION

METRICS = (
    Metric("psnr_srgb", "PSNR of the sRGB map", "dB", _HIGHER, ".2f", DEFINED_HERE),
    Metric("psnr_linear", "PSNR of linear radiance in [0, 1]", "dB", _HIGHER, ".2f", DEFINED_HERE),
    Metric("ssim_srgb", "SSIM of the sRGB map", "", _HIGHER, ".4f", WANG),
    Metric("l1_srgb", "Mean absolute difference of the sRGB map", "", _LOWER, ".4f", DEFINED_HERE),
    Metric("l1_linear", "Mean absolute difference of linear radiance in [0, 1]", "", _LOWER, ".4f", DEFINED_HERE),
    Metric("log_rmse_stops", "RMSE of log₂ radiance, unclipped", "stops", _LOWER, ".3f", DEFINED_HERE),
    Metric("psnr_srgb_unweighted", "PSNR of the sRGB map, every texel equal", "dB", _HIGHER, ".2f", DEFINED_HERE),
    Metric("psnr_linear_unweighted", "PSNR of linear radiance, every texel equal", "dB", _HIGHER, ".2f", DEFINED_HERE),
    Metric("ssim_srgb_unweighted", "SSIM of the sRGB map, every texel equal", "", _HIGHER, ".4f", WANG),
    Metric("l1_srgb_unweighted", "Mean absolute difference, sRGB, every texel equal", "", _LOWER, ".4f", DEFINED_HERE),
    Metric("si_rmse", "RMSE after the best factor", "", _LOWER, ".3f", GARDNER),
    Metric("color_error_deg", "Mean angle between colors", "°", _LOWER, ".2f", LEGENDRE),
    Metric("normalized_rmse", "RMSE between percentiles 0.1 and 99.9", "", _LOWER, ".3f", DEFINED_HERE),
    Metric("peak_error_deg", "Brightest light off by", "°", _LOWER, ".1f", DEFINED_HERE),
    Metric("psnr_reinhard", "PSNR of the tone-mapped 8-bit map, every texel equal", "dB", _HIGHER, ".2f", REINHARD),
    Metric("ssim_reinhard", "SSIM of the tone-mapped 8-bit map, every texel equal", "", _HIGHER, ".4f", WANG),
    Metric("l1_reinhard", "Mean absolute difference, tone-mapped 8-bit", "", _LOWER, ".4f", REINHARD),
    Metric("exposure_stops", "Best global exposure of the prediction", "stops", _DESCRIPTION, "+.2f", DEFINED_HERE),
    Metric(
        "coverage", "Solid-angle share of the sphere that training views see", "", _DESCRIPTION, ".1%", DEFINED_HERE
    ),
    Metric("resolved_coverage", "Share that a view samples at 0.7° or finer", "", _DESCRIPTION, ".1%", DEFINED_HERE),
    Metric("inverse_distance_error", "Object radius times error of 1/distance", "", _LOWER, ".4f", DEFINED_HERE),
    Metric("mean_angular_error_deg", "Mean angular error", "°", _LOWER, ".2f", DEFINED_HERE),
    Metric("median_angular_error_deg", "Median angular error", "°", _LOWER, ".2f", DEFINED_HERE),
    Metric("rmse_angular_error_deg", "Root mean square angular error", "°", _LOWER, ".2f", DEFINED_HERE),
    Metric("fraction_within_5deg", "Pixels within 5°", "", _HIGHER, ".1%", DEFINED_HERE),
    Metric("fraction_within_11_25deg", "Pixels within 11.25°", "", _HIGHER, ".1%", FOUHEY),
    Metric("fraction_within_22_5deg", "Pixels within 22.5°", "", _HIGHER, ".1%", FOUHEY),
    Metric("normal_coverage", "Mask pixels with a predicted normal", "", _HIGHER, ".2%", DEFINED_HERE),
    Metric("psnr", "PSNR, sRGB on black, mean over views", "dB", _HIGHER, ".2f", DEFINED_HERE),
    Metric("psnr_foreground", "PSNR over the object's mask, mean over views", "dB", _HIGHER, ".2f", DEFINED_HERE),
    Metric("ssim", "SSIM, sRGB on black, mean over views", "", _HIGHER, ".4f", WANG),
    Metric("l1", "Mean absolute difference, sRGB on black", "", _LOWER, ".4f", DEFINED_HERE),
    Metric("alpha_iou", "Intersection over union of the masks", "", _HIGHER, ".4f", DEFINED_HERE),
    Metric("lpips_alex", "LPIPS v0.1, AlexNet", "", _LOWER, ".4f", ZHANG),
    Metric("lpips_vgg", "LPIPS v0.1, VGG-16", "", _LOWER, ".4f", ZHANG),
    Metric("visibility_error_spearman", "Rank correlation of visibility and error", "", _LOWER, "+.3f", SPEARMAN),
    Metric("visibility_error_auroc", "AUROC of low visibility for error > 0.1", "", _HIGHER, ".3f", HANLEY),
    Metric("direct_correlation", "Correlation with direct views, in a band", "", _HIGHER, ".3f", DEFINED_HERE),
    Metric("direct_correlation_unfiltered", "Correlation with direct views", "", _HIGHER, ".3f", DEFINED_HERE),
    Metric("direct_offset_deg", "Median angle by which features are off", "°", _LOWER, ".2f", DEFINED_HERE),
    Metric("direct_across_deg", "Its part that no distance changes", "°", _LOWER, ".2f", DEFINED_HERE),
    Metric("lamp_error_deg", "Brightest lamp off by", "°", _LOWER, ".2f", DEFINED_HERE),
    Metric("sparsification_area", "Area between sparsification curve and perfect order", "", _LOWER, ".3f", ILG),
)

_BY_NAME = {metric.name: metric for metric in METRICS}


def metric(name: str) -> Metric:
    """The metric of that name; KeyError for one that isn't registered."""
    return _BY_NAME[name]
