"""Least squares of what rays see under a map that follows whatever else moves them.

A step at a fixed map gets nowhere where the map can follow: turning a mirror and turning the map after it changes
little. So the part Π e of the residuals e that a change of the map takes over is left out, and only the rest moves
other unknowns (variable projection, Golub and Pereyra 1973):

½ Σ w ‖(1 − Π) e‖², g = Jᵀ W (1 − Π) e, H = Jᵀ W (1 − Π) J, Π = B Bᵀ W.

The map's changes B are a constant for each texel and a slope for each block of 2 × 2 texels, orthonormal under W. With
constants alone, what varies within a texel would be left to the other unknowns, which then move too little.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from panoless.numeric.gauss_newton import jacobian_of_rows, normal_equations
from shinypartial.core.sphere import directions_to_cube, texels_at

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

CHANGES_AT_ONCE = 4096
"""For memory."""
SLOPE_WEIGHT = 1.0
"""Pull of a slope to zero: that of a ray so many texels (root mean square) beside the middle."""


@dataclass(frozen=True)
class VariableProjection:
    """What rays count, and how a map that follows can change what they see."""

    weights: Float[np.ndarray, "P"]
    basis: "csr_matrix"
    """B, a row for each ray. Rays without weight require nothing."""

    @classmethod
    def of(
        cls, directions: Float[np.ndarray, "P 3"], weights: Float[np.ndarray, "P"], resolution: int
    ) -> "VariableProjection":
        """Of rays into a map of so many texels along a face side."""
        from scipy.sparse import hstack

        face, st = directions_to_cube(directions)
        texels, side = texels_at(face, st, resolution), -(-resolution // 2)
        _, row, column = np.unravel_index(texels, (6, resolution, resolution))
        blocks = np.ravel_multi_index((face, row // 2, column // 2), (6, side, side))
        constants = _constants(_numbered(texels), weights)
        slopes = _slopes((st + 1) * resolution / 2, constants, _numbered(blocks), weights)
        return cls(weights, hstack([constants, slopes]).tocsr())

    def cost(self, residual: Float[np.ndarray, "P C"]) -> float:
        """½ Σ w ‖(1 − Π) e‖²."""
        return float((self.weights @ residual**2).sum() - ((self._gather @ residual) ** 2).sum()) / 2

    def beyond(self, values: Float[np.ndarray, "P K"]) -> Float[np.ndarray, "P K"]:
        """(1 − Π) v of each column."""
        return np.asarray(values - self.basis @ (self._gather @ values))

    def equations(
        self, rows: Float[np.ndarray, "P C D"], residual: Float[np.ndarray, "P C"]
    ) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
        """Gradient and matrix over few unknowns, on which all rays depend by their rows."""
        gradient, matrix = np.zeros(rows.shape[2]), np.zeros((rows.shape[2], rows.shape[2]))
        for channel, error in enumerate(residual.T):
            weighted = self.beyond(rows[:, channel]).T * self.weights
            gradient += weighted @ error
            matrix += weighted @ rows[:, channel]
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
        for channel, error in enumerate(residual.T):
            jacobian = jacobian_of_rows(rows[:, channel], columns, unknowns)
            by_rays, of_rays = normal_equations(jacobian, error, self.weights)
            gradient, matrix = gradient + by_rays, matrix + of_rays
            for means, wanted in self._taken(jacobian, error):
                gradient -= means.T @ wanted
                matrix -= means.T @ means
        return gradient, matrix

    def _taken(
        self, jacobian: "csr_matrix", residual: Float[np.ndarray, "P"]
    ) -> Iterator[tuple[Float[np.ndarray, "T D"], Float[np.ndarray, "T"]]]:
        """Bᵀ W J and Bᵀ W e, some of the map's changes at a time."""
        taken, wanted = self._gather @ jacobian, self._gather @ residual
        for first in range(0, len(wanted), CHANGES_AT_ONCE):
            part = slice(first, first + CHANGES_AT_ONCE)
            yield taken[part].toarray(), wanted[part]

    @cached_property
    def _gather(self) -> "csr_matrix":
        """Bᵀ W."""
        return self.basis.multiply(self.weights[:, None]).T.tocsr()


def _numbered(groups: Int[np.ndarray, "P"]) -> Int[np.ndarray, "P"]:
    """Groups numbered from zero: only those that are seen."""
    return np.unique(groups, return_inverse=True)[1].reshape(-1)


def _constants(texels: Int[np.ndarray, "P"], weights: Float[np.ndarray, "P"]) -> "csr_matrix":
    """A constant for each texel."""
    from scipy.sparse import csr_matrix

    length = np.sqrt(np.maximum(np.bincount(texels, weights), 1e-12))
    return csr_matrix((1 / length[texels], (np.arange(len(texels)), texels)), (len(texels), len(length)))


def _slopes(
    places: Float[np.ndarray, "P 2"],
    constants: "csr_matrix",
    blocks: Int[np.ndarray, "P"],
    weights: Float[np.ndarray, "P"],
) -> "csr_matrix":
    """Two slopes for each block (texels), beside the constants."""
    from scipy.sparse import csr_matrix

    within = places - constants @ (constants.T @ (weights[:, None] * places))
    pull = SLOPE_WEIGHT * np.median(weights)
    products = ((i, j, np.bincount(blocks, weights * within[:, i] * within[:, j])) for i, j in ((0, 0), (0, 1), (1, 1)))
    gram = np.zeros((blocks.max(initial=-1) + 1, 2, 2))
    for i, j, product in products:
        gram[:, i, j] = gram[:, j, i] = product + pull * (i == j)
    # (Gram)⁻¹ = L⁻ᵀ L⁻¹ with the Cholesky factor L.
    across = np.linalg.inv(np.linalg.cholesky(gram)).transpose(0, 2, 1)
    values = np.matmul(within[:, None], across[blocks])[:, 0]
    columns = 2 * blocks[:, None] + np.arange(2)
    starts = 2 * np.arange(len(blocks) + 1)
    return csr_matrix((values.ravel(), columns.ravel(), starts), (len(blocks), 2 * len(gram)))
