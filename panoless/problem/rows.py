"""Residuals linearized in blocks of unknowns, one a view or one of all views."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from panoless.capture.poses import StatedCameras
from panoless.problem.blocks import Block
from panoless.problem.rays import PixelRays

CHI_MEDIAN = 1.538
"""Median length of a vector of three normal numbers, in their standard deviation."""
CONTOUR_SIGMA_PX = 0.05
"""Standard deviation of a contour point (px): less than its error, because errors of the map are common to all rays of
a texel."""
CORRELATED = 16.0
"""Pixels that err alike under a map that is too coarse, or a surface that is wrong: patches of 4 × 4."""


@dataclass(frozen=True)
class BlockRows:
    """Residuals that change by row·x of their block of unknowns, and their weights; those of a block in few runs."""

    block: Int[np.ndarray, "P"]
    rows: Float[np.ndarray, "P K M"]
    weights: Float[np.ndarray, "P"]

    @cached_property
    def _runs(self) -> list[tuple[int, slice]]:
        """Blocks, and the residuals that change with them."""
        ends = np.flatnonzero(np.diff(self.block)) + 1
        bounds = [0, *ends.tolist(), len(self.block)] if len(self.block) else []
        return [(int(self.block[first]), slice(first, last)) for first, last in pairwise(bounds)]

    def forward(self, change: Float[np.ndarray, "B M"]) -> Float[np.ndarray, "P K"]:
        """J x; zero where the weight is not positive."""
        count, channels, size = self.rows.shape
        moved = np.empty((count, channels))
        for block, run in self._runs:
            moved[run] = (self.rows[run].reshape(-1, size) @ change[block]).reshape(-1, channels)
        return moved * (self.weights > 0)[:, None]

    def backward(self, residual: Float[np.ndarray, "P K"], blocks: int) -> Float[np.ndarray, "B M"]:
        """Jᵀ W e."""
        weighted, size = self.weights[:, None] * residual, self.rows.shape[2]
        found = np.zeros((blocks, size))
        for block, run in self._runs:
            found[block] += weighted[run].ravel() @ self.rows[run].reshape(-1, size)
        return found

    def blocks(self, blocks: int) -> Float[np.ndarray, "B M M"]:
        """The diagonal blocks of Jᵀ W J."""
        size = self.rows.shape[2]
        found = np.zeros((blocks, size, size))
        for block, run in self._runs:
            weighted = self.weights[run, None, None] * self.rows[run]
            found[block] += weighted.reshape(-1, size).T @ self.rows[run].reshape(-1, size)
        return found


@dataclass(frozen=True)
class Linearized:
    """Blocks of equal size, linearized: the rows of photographs and silhouettes, and a normal prior."""

    photographs: BlockRows
    silhouettes: BlockRows
    value: Float[np.ndarray, "B M"]
    """Deviation from the mean of the prior."""
    precision: Float[np.ndarray, "B M M"]
    """Inverse covariances of the prior."""
    matrix: Float[np.ndarray, "B M M"]
    """Diagonal blocks of the Gauss–Newton matrix, with the prior: the preconditioner."""

    def backward(
        self, seen: Float[np.ndarray, "P 3"], of_silhouettes: Float[np.ndarray, "S 1"], value: Float[np.ndarray, "B M"]
    ) -> Float[np.ndarray, "B M"]:
        """Jᵀ W e of both terms, and P times a value."""
        count = len(value)
        pulled = self.photographs.backward(seen, count) + self.silhouettes.backward(of_silhouettes, count)
        return pulled + np.matmul(self.precision, value[..., None])[..., 0]


def rows_of(
    block: Block,
    rays: PixelRays,
    cameras: StatedCameras,
    by_motion: Float[np.ndarray, "P C 6"],
    light: Float[np.ndarray, "P C"] | None = None,
) -> Float[np.ndarray, "P C M"]:
    """Derivatives by the unknowns of a block: of photographs that show a `light`, or of silhouettes.

    c/g is compared with E, so that ∂e/∂log g = c/g, for which the prediction E stands: it has no noise.
    """
    motions = block.motions(rays, cameras.rotations[rays.view, 2])
    rows = np.zeros((*by_motion.shape[:2], block.size)) if motions is None else np.matmul(by_motion, motions)
    by_gain = block.gain_rows()
    if light is None:
        return rows - 1.0 if block.moves_silhouettes else rows
    return rows if by_gain is None else rows + light[..., None] * by_gain
