"""Linear light ⇄ sRGB (IEC 61966-2-1), as a tested inverse pair."""

import numpy as np
from jaxtyping import Float, UInt8

LINEAR_THRESHOLD = 0.0031308
SRGB_THRESHOLD = 12.92 * LINEAR_THRESHOLD


def linear_to_srgb(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Encode linear light for display: 12.92 x below 0.0031308, 1.055 x^(1/2.4) − 0.055 above.

    Domain [0, ∞); negative values are encoded by the linear branch. No clipping happens here.
    """
    curved = 1.055 * np.maximum(linear, LINEAR_THRESHOLD) ** (1 / 2.4) - 0.055
    return np.where(linear <= LINEAR_THRESHOLD, 12.92 * linear, curved).astype(linear.dtype)


def srgb_to_linear(srgb: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Inverse of `linear_to_srgb`."""
    curved = ((np.maximum(srgb, SRGB_THRESHOLD) + 0.055) / 1.055) ** 2.4
    return np.where(srgb <= SRGB_THRESHOLD, srgb / 12.92, curved).astype(srgb.dtype)


def to_display(linear: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """8-bit sRGB of linear light clipped to [0, 1]: the only place where radiance becomes a picture."""
    return np.rint(linear_to_srgb(np.clip(np.nan_to_num(linear), 0.0, 1.0)) * 255.0).astype(np.uint8)


LINEAR_OF_CODES = srgb_to_linear(np.arange(256, dtype=np.float32) / 255)
"""Linear light of the 256 codes of 8-bit sRGB, to look up: `srgb_to_linear` of a picture takes ten times as long."""
CODES_OF_LINEAR = to_display(np.arange(65536) / 65535)
"""`to_display` of i/65535, to look up: off by a code where light is within 2⁻¹⁷ of where codes change."""
