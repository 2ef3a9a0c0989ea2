"""Trust in pixels, by where on the surface they lie."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.geometry.free_form.surface import LevelSet
from panoless.numeric.robust import robust_weight

CELLS = 40
"""Cells along the longest side in which trust is measured."""
SCALE = 2.0
"""Robust scale of trust, in medians of the residuals…"""
LEAST_SCALE = 0.02
"""…but at least this (linear radiance)."""
PRIOR = 1e-5
"""Share of all rays that the prior of each cell counts as…"""
FLOOR = 0.1
"""…of this trust, in means."""
POWER = 2.0
"""Trust is raised to this power."""


@dataclass(frozen=True)
class Trust:
    """Trust in [0, 1] on a grid of cubes over the box of a surface, in the normalized frame."""

    low: Float[np.ndarray, "3"]
    cell: float
    values: Float[np.ndarray, "A B C"]

    def at(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """Trust of points; those beyond the grid have that of its border."""
        return self.values.ravel()[self._index(points)]

    def scaled(self, factor: float) -> "Trust":
        """Of the surface that is so many times as large."""
        return Trust(self.low * factor, self.cell * factor, self.values)

    def _index(self, points: Float[np.ndarray, "P 3"]) -> Int[np.ndarray, "P"]:
        place = np.floor((points - self.low) / self.cell).astype(np.int64)
        return np.ravel_multi_index(tuple(np.clip(place, 0, np.array(self.values.shape) - 1).T), self.values.shape)

    def measured(
        self,
        points: Float[np.ndarray, "P 3"],
        residual: Float[np.ndarray, "P 3"],
        weights: Float[np.ndarray, "P"],
        clear: Bool[np.ndarray, "P"],
    ) -> "Trust":
        """(Σ w ρ/Σ w over its mean)^p of the rays around each cube, with ρ their robust weights.

        Sums are over 3³ cubes, of which the middle one counts thrice. Rays that are not `clear` are left out.
        """
        from scipy.ndimage import uniform_filter

        size = np.linalg.norm(residual, axis=1)
        scale = SCALE * float(np.median(size[clear])) if clear.any() else 0.0
        agreed = robust_weight(residual, max(scale, LEAST_SCALE))
        index, count = self._index(points), self.values.size

        def gathered(values: Float[np.ndarray, "P"]) -> Float[np.ndarray, "A B C"]:
            total = np.bincount(index, values * clear, count).reshape(self.values.shape)
            around: np.ndarray = uniform_filter(total, 3, mode="constant") * 27 + 2 * total
            return around

        beside = PRIOR * len(points)
        total = gathered(weights)
        share = (gathered(weights * agreed) + FLOOR * beside) / (total + beside)
        mean = float((share * total).sum() / max(total.sum(), 1e-12))
        return Trust(self.low, self.cell, np.clip(share / max(mean, 1e-12), 0, 1) ** POWER)


def full_trust(surface: LevelSet, cells: int = CELLS) -> Trust:
    """Trust of one everywhere."""
    cell = float(surface.extent.max()) / cells
    return Trust(surface.low, cell, np.ones(np.ceil(surface.extent / cell - 1e-9).astype(int)))
