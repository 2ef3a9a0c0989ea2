"""Unknowns beside the coefficients of a level set: how residuals change with the poses of the cameras, with what all
views share, and with both and the surface together.

A camera with the turn ω (rad) and the shift τ (normalized frame) sends the ray o + t d of a pixel as
(o + τ) + t exp([ω]) d. Where it meets the surface at distance t the point moves, to first order, by τ + t ω × d, and
then along the ray until it is on the surface again.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from panoless.kernels.constants import LEAST_SLANT


@dataclass(frozen=True)
class BlockRows:
    """Residuals that change by row·x of their block of unknowns, and their weights: poses have a block a view, what all
    views share has one.
    """

    block: Int[np.ndarray, "P"]
    rows: Float[np.ndarray, "P K M"]
    weights: Float[np.ndarray, "P"]

    def forward(self, change: Float[np.ndarray, "B M"]) -> Float[np.ndarray, "P K"]:
        """J x; zero where the weight is not positive."""
        moved: np.ndarray = np.matmul(self.rows, change[self.block][..., None])[..., 0]
        return moved * (self.weights > 0)[:, None]

    def backward(self, residual: Float[np.ndarray, "P K"], blocks: int) -> Float[np.ndarray, "B M"]:
        """Jᵀ W e."""
        pulled = np.matmul((self.weights[:, None] * residual)[:, None], self.rows)[:, 0]
        return np.stack([np.bincount(self.block, column, blocks) for column in pulled.T], 1)

    def blocks(self, blocks: int) -> Float[np.ndarray, "B M M"]:
        """The diagonal blocks of Jᵀ W J."""
        size = self.rows.shape[2]
        squares = np.matmul((self.weights[:, None, None] * self.rows).transpose(0, 2, 1), self.rows)
        sums = [np.bincount(self.block, column, blocks) for column in squares.reshape(-1, size**2).T]
        return np.stack(sums, 1).reshape(blocks, size, size)


@dataclass(frozen=True)
class Beside:
    """Unknowns in blocks of equal size, linearized: what photographs and silhouettes change by, and a prior."""

    photographs: BlockRows
    silhouettes: BlockRows
    value: Float[np.ndarray, "B M"]
    """By how much they are off what the prior expects."""
    precision: Float[np.ndarray, "B M M"]
    """Inverse covariances of the prior."""
    blocks: Float[np.ndarray, "B M M"]
    """Of the Gauss–Newton matrix, with the prior: what preconditions."""

    def backward(
        self, seen: Float[np.ndarray, "P 3"], outlined: Float[np.ndarray, "S 1"], value: Float[np.ndarray, "B M"]
    ) -> Float[np.ndarray, "B M"]:
        """Jᵀ W e of both, and the prior's part of a value."""
        count = len(value)
        pulled = self.photographs.backward(seen, count) + self.silhouettes.backward(outlined, count)
        return pulled + np.matmul(self.precision, value[..., None])[..., 0]


def pixel_pose_rows(
    derivatives: Float[np.ndarray, "P 10"],
    directions: Float[np.ndarray, "P 3"],
    distance: Float[np.ndarray, "P"],
    slopes: Float[np.ndarray, "P 3 3"],
    by_gradient: Float[np.ndarray, "P 3 3"],
) -> Float[np.ndarray, "P 3 6"]:
    """What three channels of the mirrored light change by with the pose, the surface being still.

    With a channel's slope a by r = d − 2 (d·n) n, w = a − 2 (a·n) n, u = `by_gradient` (see `mirror_rows`) and
    q = (1 − n dᵀ/(d·n)) H u, it is w·(ω × d) + q·(τ + t ω × d). Distances and H are in cells, τ is so, too.
    """
    length = np.maximum(np.linalg.norm(derivatives[:, 1:4], axis=1), 1e-30)
    normals = derivatives[:, 1:4] / length[:, None]
    facing = np.minimum((directions * normals).sum(1), -LEAST_SLANT)
    bend = np.matmul(by_gradient, derivatives[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(-1, 3, 3))
    along = np.matmul(bend, directions[..., None])[..., 0] / facing[:, None]
    by_shift = bend - along[..., None] * normals[:, None]
    straight = slopes - 2 * np.matmul(slopes, normals[..., None]) * normals[:, None]
    by_turn = np.cross(directions[:, None], straight + distance[:, None, None] * by_shift)
    return np.concatenate([by_turn, by_shift], 2)


def outline_pose_rows(
    gradient: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    distance: Float[np.ndarray, "P"],
    by_value: Float[np.ndarray, "P"],
) -> Float[np.ndarray, "P 1 6"]:
    """What an outline's residual changes by with the pose: by_value ∇φ·(τ + t ω × d), where φ is least on the ray."""
    by_shift = by_value[:, None] * gradient
    by_turn = np.cross(directions, distance[:, None] * by_shift)
    return np.concatenate([by_turn, by_shift], 1)[:, None]
