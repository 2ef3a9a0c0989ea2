"""The circular cone that rays from one point lie on: m·r = 1 for all unit rays r, with m = a/cos α."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from panoless.numeric.factorize import regularize
from panoless.numeric.robust import robust_scale, robust_weight


@dataclass(frozen=True)
class FittedCone:
    """A cone, and how far the rays that it was fitted to are from it."""

    axis: Float[np.ndarray, "3"]
    """a, unit."""
    cosine: float
    """Of α, half the opening angle."""
    off_px: Float[np.ndarray, "P"]
    """β − α of each ray, β being its angle from the axis: positive outside."""
    weights: Float[np.ndarray, "P"]
    """Robust weights by that distance."""

    @property
    def sine(self) -> float:
        """Of α."""
        return float(np.sqrt(1 - self.cosine**2))


def nearest_cone(
    rays: Float[np.ndarray, "P 3"],
    pixels_per_rad: Float[np.ndarray, "P"] | float,
    *,
    rounds: int,
    scale_px: float,
    medians: float,
    widest_cosine: float,
) -> FittedCone:
    """By robust linear least squares in rounds, with a scale of so many pixels or medians, whichever is more.

    α is no less than the angle whose cosine is `widest_cosine`.
    """
    weights = np.ones(len(rays))
    for _ in range(rounds):
        weighted = rays * weights[:, None]
        moment = weighted.T @ rays + 1e-12 * np.eye(3)
        m = np.linalg.solve(regularize(moment, "a cone"), weighted.sum(0))
        cosine = min(1 / float(np.linalg.norm(m)), widest_cosine)
        # m·r = cos β/cos α, and the angle β − α is what the pixels are off by.
        off_px = (np.arccos(np.clip(rays @ m * cosine, -1, 1)) - np.arccos(cosine)) * pixels_per_rad
        weights = robust_weight(off_px, robust_scale(off_px, scale_px, medians))
    return FittedCone(m / np.linalg.norm(m), cosine, off_px, weights)
