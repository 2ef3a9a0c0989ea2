"""Differences of two images: PSNR, L1 and SSIM, with an explicit data range and optional weights."""

import math

import numpy as np
from jaxtyping import Float

from shinypartial.metrics.registry import PSNR_CEILING_DB

SSIM_SIGMA = 1.5
#: Radius of the Gaussian window: scikit-image truncates at 3.5 σ, which makes the 11×11 window of Wang et al. 2004.
SSIM_RADIUS = 5

Image = Float[np.ndarray, "H W C"]
Weights = Float[np.ndarray, "H W"]


def _require_same_shape(prediction: np.ndarray, truth: np.ndarray) -> None:
    if prediction.shape != truth.shape:
        raise ValueError(f"expected two arrays of one shape, got {prediction.shape} and {truth.shape}")


def weighted_mean(values: Float[np.ndarray, "H W *C"], weights: Weights | None) -> float:
    """Mean over channels and pixels; pixels are weighted. Raises ValueError when no weight is positive."""
    per_pixel = values.mean(-1, dtype=np.float64) if values.ndim == 3 else values
    if weights is None:
        return float(per_pixel.mean(dtype=np.float64))
    total = float(weights.sum(dtype=np.float64))
    if not total > 0:
        raise ValueError("expected a positive sum of weights")
    return float((per_pixel * weights).sum(dtype=np.float64) / total)


def psnr(prediction: Image, truth: Image, *, data_range: float, weights: Weights | None = None) -> float:
    """Peak signal-to-noise ratio 10 log₁₀(R² / MSE) in dB, at most PSNR_CEILING_DB.

    MSE is the (weighted) mean over pixels and channels; nothing is clipped here. Raises ValueError for other shapes.
    """
    _require_same_shape(prediction, truth)
    difference = (prediction.astype(np.float64) - truth) / data_range
    mean_square = weighted_mean(difference**2, weights)
    floor = 10 ** (-PSNR_CEILING_DB / 10)
    return -10 * math.log10(max(mean_square, floor))


def l1(prediction: Image, truth: Image, *, weights: Weights | None = None) -> float:
    """Mean absolute difference over pixels (weighted) and channels."""
    _require_same_shape(prediction, truth)
    return weighted_mean(np.abs(prediction.astype(np.float64) - truth), weights)


def ssim_map(prediction: Image, truth: Image) -> Image:
    """Structural similarity of every pixel and channel: Gaussian window, σ = 1.5, data range 1 (Wang et al. 2004)."""
    from skimage.metrics import structural_similarity

    _require_same_shape(prediction, truth)
    _, similarity = structural_similarity(
        truth.astype(np.float64),
        prediction.astype(np.float64),
        gaussian_weights=True,
        sigma=SSIM_SIGMA,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    return similarity


def ssim(prediction: Image, truth: Image) -> float:
    """Mean structural similarity of two images in [0, 1], equal to scikit-image's, which leaves out a border of 5 px.

    Where all pixels of a window agree the similarity is exactly 1, so windows are evaluated only around pixels that
    differ: objects on a common background cost what the object covers. Images are at least 11×11.
    """
    _require_same_shape(prediction, truth)
    height, width, channels = truth.shape
    if min(height, width) <= 2 * SSIM_RADIUS:
        raise ValueError(f"SSIM needs images larger than {2 * SSIM_RADIUS} px, got {width}×{height}")
    interior = (height - 2 * SSIM_RADIUS) * (width - 2 * SSIM_RADIUS)
    different = (prediction != truth).any(-1)
    if not different.any():
        return 1.0
    rows, columns = (_crop(different.any(axis)) for axis in (1, 0))
    similarity = ssim_map(prediction[rows, columns], truth[rows, columns])
    inner = slice(SSIM_RADIUS, -SSIM_RADIUS)
    measured = similarity[inner, inner]
    outside = interior - measured.shape[0] * measured.shape[1]
    return float((measured.sum() + outside * channels) / (interior * channels))


def _crop(occupied: np.ndarray) -> slice:
    """Range of the occupied indices, grown by twice the window radius: for its reach and the filter border.

    Without its outermost SSIM_RADIUS indices it covers every window that touches an occupied index.
    """
    indices = np.flatnonzero(occupied)
    margin = 2 * SSIM_RADIUS
    return slice(max(int(indices[0]) - margin, 0), min(int(indices[-1]) + 1 + margin, len(occupied)))
