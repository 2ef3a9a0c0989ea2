"""Environment maps under protocol linear-v1: linear radiance in [0, 1] and its sRGB image at 256 × 512.

Both maps are clipped to [0, 1] in linear light and brought to one size: by area averaging when larger, by bilinear
lookup when smaller. Texels are weighted by solid angle, over all directions and over those that training views see.
"""

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.color import linear_to_srgb
from shinypartial.core.sphere import latlong_directions, latlong_solid_angles, sample_latlong
from shinypartial.metrics.image import SSIM_RADIUS, l1, psnr, ssim, ssim_map, weighted_mean

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

PROTOCOL_HEIGHT = 256
#: Added to radiance before the logarithm, so that black texels do not decide the HDR error.
LOG_FLOOR = 1e-3
#: Range and spacing of the coarse search for the best exposure, in stops; a bounded search refines it.
EXPOSURE_RANGE_STOPS = 6.0
EXPOSURE_STEP_STOPS = 0.5

#: Prediction and truth may differ in size, so these axes are not compared.
Latlong = Float[np.ndarray, "_H _W 3"]
TexelWeights = Float[np.ndarray, "H W"]
Mask = Bool[np.ndarray, "H W"]


@dataclass(frozen=True)
class RegionScores:
    """Solid-angle weighted scores over one set of directions."""

    psnr_srgb: float
    psnr_linear: float
    ssim_srgb: float
    l1_srgb: float
    l1_linear: float
    log_rmse_stops: float


@dataclass(frozen=True)
class UnweightedScores:
    """The same maps compared as plain pictures: every texel counts alike, so the poles weigh most."""

    psnr_srgb_unweighted: float
    psnr_linear_unweighted: float
    ssim_srgb_unweighted: float
    l1_srgb_unweighted: float


@dataclass(frozen=True)
class RegionMasks:
    """Directions that training views see at all, and with the protocol's resolution; None: unknown or none."""

    observed: Mask | None
    resolved: Mask | None


@dataclass(frozen=True)
class Regions:
    """Scores over all directions and over those that training views see; None where a mask is None."""

    full: RegionScores
    observed: RegionScores | None
    resolved: RegionScores | None


def to_protocol_size(latlong: Float[np.ndarray, "H W C"], height: int = PROTOCOL_HEIGHT) -> Float[np.ndarray, "h w C"]:
    """Resample a lat-long map to height × 2·height: area averaging when larger, bilinear when smaller."""
    if latlong.shape[0] == height:
        return latlong
    if latlong.shape[0] < height:
        return sample_latlong(latlong, latlong_directions(height)).astype(latlong.dtype)
    source_height, source_width, channels = latlong.shape
    rows = _area_weights(source_height, height) @ latlong.reshape(source_height, -1)
    across = rows.reshape(height, source_width, channels).swapaxes(0, 1).reshape(source_width, -1)
    resized = (_area_weights(source_width, 2 * height) @ across).reshape(2 * height, height, channels)
    return resized.swapaxes(0, 1).astype(latlong.dtype)


@functools.lru_cache(maxsize=8)
def _area_weights(source: int, target: int) -> "csr_matrix":
    """Share of every source interval in every target interval, (target, source) and sparse; rows sum to one."""
    from scipy.sparse import csr_matrix

    edges = np.arange(target + 1)[:, None] * (source / target)
    lower, upper = edges[:-1], edges[1:]
    start = np.arange(source)[None]
    overlap = np.clip(np.minimum(upper, start + 1) - np.maximum(lower, start), 0, None)
    return csr_matrix(overlap / overlap.sum(1, keepdims=True))


def clipped_map(radiance: Latlong) -> Latlong:
    """Linear radiance clipped to [0, 1], at the size of the protocol."""
    return to_protocol_size(np.clip(radiance, 0.0, 1.0))


def absolute_error_srgb(prediction: Latlong, truth: Latlong) -> TexelWeights:
    """Mean over channels of the absolute sRGB difference at every texel of the protocol's size, in [0, 1]."""
    difference = linear_to_srgb(clipped_map(prediction)) - linear_to_srgb(clipped_map(truth))
    return np.abs(difference).mean(-1)


def region_scores(prediction: Latlong, truth: Latlong, masks: RegionMasks) -> Regions:
    """Compare two maps of unbounded linear radiance over all directions and over the masked ones."""
    linear, true_linear = clipped_map(prediction), clipped_map(truth)
    srgb, true_srgb = linear_to_srgb(linear), linear_to_srgb(true_linear)
    logs, true_logs = (np.log2(np.maximum(to_protocol_size(image), 0) + LOG_FLOOR) for image in (prediction, truth))
    similarity, squared_logs = _wrapped_ssim_map(srgb, true_srgb), (logs.astype(np.float64) - true_logs) ** 2

    def score(mask: Mask | None) -> RegionScores:
        weights = direction_weights(mask)
        return RegionScores(
            psnr_srgb=psnr(srgb, true_srgb, data_range=1.0, weights=weights),
            psnr_linear=psnr(linear, true_linear, data_range=1.0, weights=weights),
            ssim_srgb=weighted_mean(similarity, weights),
            l1_srgb=l1(srgb, true_srgb, weights=weights),
            l1_linear=l1(linear, true_linear, weights=weights),
            log_rmse_stops=float(np.sqrt(weighted_mean(squared_logs, weights))),
        )

    observed, resolved = (None if mask is None else score(mask) for mask in (masks.observed, masks.resolved))
    return Regions(score(None), observed, resolved)


def _wrapped_ssim_map(prediction: Latlong, truth: Latlong) -> Latlong:
    """SSIM of every texel; windows wrap around in azimuth, so the score does not depend on where the map is cut."""
    padding = ((0, 0), (SSIM_RADIUS, SSIM_RADIUS), (0, 0))
    wrapped = [np.pad(image, padding, mode="wrap") for image in (prediction, truth)]
    return ssim_map(*wrapped)[:, SSIM_RADIUS:-SSIM_RADIUS]


def unweighted_scores(prediction: Latlong, truth: Latlong) -> UnweightedScores:
    """Compare the two maps as plain pictures."""
    linear, true_linear = clipped_map(prediction), clipped_map(truth)
    srgb, true_srgb = linear_to_srgb(linear), linear_to_srgb(true_linear)
    return UnweightedScores(
        psnr_srgb_unweighted=psnr(srgb, true_srgb, data_range=1.0),
        psnr_linear_unweighted=psnr(linear, true_linear, data_range=1.0),
        ssim_srgb_unweighted=ssim(srgb, true_srgb),
        l1_srgb_unweighted=l1(srgb, true_srgb),
    )


def direction_weights(mask: Mask | None = None) -> TexelWeights:
    """Solid angle of every texel of the protocol's size, zero outside the mask."""
    weights = latlong_solid_angles(PROTOCOL_HEIGHT)
    return weights if mask is None else weights * mask


def inverse_distance_error(
    prediction: Float[np.ndarray, "_H _W"] | None, truth: Float[np.ndarray, "_H _W"], radius: float, mask: Mask
) -> float:
    """Mean of a |1/D − 1/D'| over the masked directions, a the object's radius; without a prediction 1/D is 0."""
    true = to_protocol_size(truth[..., None])[..., 0]
    found = np.zeros_like(true) if prediction is None else to_protocol_size(prediction[..., None])[..., 0]
    return radius * weighted_mean(np.abs(found - true), direction_weights(mask))


def best_exposure_stops(prediction: Latlong, truth: Latlong) -> float:
    """The exposure e that minimizes the weighted squared error of clip(2ᵉ · prediction) against the clipped truth.

    Clipping makes the error non-convex, so a coarse search over ±6 stops finds the valley and a bounded one its floor.
    """
    from scipy.optimize import minimize_scalar

    positive, target = np.maximum(prediction, 0), clipped_map(truth)
    weights = direction_weights()

    def error(stops: float) -> float:
        return weighted_mean((clipped_map(positive * np.float32(2.0**stops)) - target) ** 2, weights)

    coarse = np.arange(-EXPOSURE_RANGE_STOPS, EXPOSURE_RANGE_STOPS + EXPOSURE_STEP_STOPS / 2, EXPOSURE_STEP_STOPS)
    # Of equal errors the exposure nearest to none is taken: a black prediction stays as it is.
    start = min(coarse, key=lambda stops: (error(stops), abs(stops)))
    bounds = (start - EXPOSURE_STEP_STOPS, start + EXPOSURE_STEP_STOPS)
    refined = minimize_scalar(error, bounds=bounds, method="bounded", options={"xatol": 1e-4})
    return float(refined.x if refined.fun < error(start) else start)
