"""Least squares of what rays see under a map that follows whatever else moves them.

A step at a fixed map gets nowhere where the map can follow: turning a mirror and turning the map after it changes
little. So each texel takes the weighted mean Π e of what its rays ask for, and only the rest moves other unknowns
(variable projection, Golub and Pereyra 1973):

½ Σ w ‖(1 − Π) e‖², g = Jᵀ W (1 − Π) e, H = Jᵀ W (1 − Π) J.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from panoless.environment.cubemap import flat_texels
from panoless.numeric.gauss_newton import jacobian_of_rows, normal_equations

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

TEXELS_AT_ONCE = 4096
"""For memory."""


@dataclass(frozen=True)
class FollowingMap:
    """Which texel each ray falls into, and how much it counts there. Rays without weight ask for nothing."""

    weights: Float[np.ndarray, "P"]
    texels: Int[np.ndarray, "P"]
    """Numbered from zero: only those that are seen."""

    @classmethod
    def of(
        cls, directions: Float[np.ndarray, "P 3"], weights: Float[np.ndarray, "P"], resolution: int
    ) -> "FollowingMap":
        """Of rays into a map of so many texels along a face side."""
        return cls(weights, np.unique(flat_texels(directions, resolution), return_inverse=True)[1].reshape(-1))

    @property
    def count(self) -> int:
        """How many texels are seen."""
        return int(self.texels.max(initial=-1)) + 1

    def cost(self, residual: Float[np.ndarray, "P C"]) -> float:
        """½ Σ w ‖(1 − Π) e‖²."""
        return float((self.weights @ residual**2).sum() - ((self._gather @ residual) ** 2).sum()) / 2

    def beyond(self, values: Float[np.ndarray, "P K"]) -> Float[np.ndarray, "P K"]:
        """(1 − Π) v of each column."""
        means = np.stack([np.bincount(self.texels, self.weights * column) for column in values.T], 1)
        return values - (means / self._totals[:, None])[self.texels]

    def equations(
        self, rows: Float[np.ndarray, "P C D"], residual: Float[np.ndarray, "P C"]
    ) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
        """Gradient and matrix over few unknowns, on which all rays depend by their rows."""
        gradient, matrix = np.zeros(rows.shape[2]), np.zeros((rows.shape[2], rows.shape[2]))
        for channel, asked in enumerate(residual.T):
            left = self.beyond(rows[:, channel])
            weighted = left.T * self.weights
            gradient += weighted @ asked
            matrix += weighted @ left
        return gradient, matrix

    def sparse_equations(
        self,
        rows: Float[np.ndarray, "P C K"],
        columns: Int[np.ndarray, "P K"],
        unknowns: int,
        residual: Float[np.ndarray, "P C"],
    ) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
        """The same over many unknowns, of which each ray depends on those in its columns."""
        gradient, matrix = np.zeros(unknowns), np.zeros((unknowns, unknowns))
        for channel, asked in enumerate(residual.T):
            jacobian = jacobian_of_rows(rows[:, channel], columns, unknowns)
            by_rays, of_rays = normal_equations(jacobian, asked, self.weights)
            gradient, matrix = gradient + by_rays, matrix + of_rays
            for means, wanted in self._means(jacobian, asked):
                gradient -= means.T @ wanted
                matrix -= means.T @ means
        return gradient, matrix

    def _means(
        self, jacobian: "csr_matrix", residual: Float[np.ndarray, "P"]
    ) -> Iterator[tuple[Float[np.ndarray, "T D"], Float[np.ndarray, "T"]]]:
        """Σ w J/√Σw and Σ w e/√Σw over texels, some of them at a time."""
        means, wanted = self._gather @ jacobian, self._gather @ residual
        for first in range(0, len(wanted), TEXELS_AT_ONCE):
            part = slice(first, first + TEXELS_AT_ONCE)
            yield means[part].toarray(), wanted[part]

    @cached_property
    def _totals(self) -> Float[np.ndarray, "T"]:
        return np.maximum(np.bincount(self.texels, self.weights), 1e-12)

    @cached_property
    def _gather(self) -> "csr_matrix":
        """G with ‖G v‖² = Σ (Σ w v)²/Σ w, sums over a texel: what the map takes over of Σ w v²."""
        from scipy.sparse import csr_matrix

        entries = self.weights / np.sqrt(self._totals)[self.texels], (self.texels, np.arange(len(self.texels)))
        return csr_matrix(entries, (len(self._totals), len(self.texels)))
