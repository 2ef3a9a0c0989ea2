"""How residuals of a level set change with the poses of the cameras, which may be unknown beside the surface.

A camera with the turn ω (rad) and the shift τ (normalized frame) sends the ray o + t d of a pixel as
(o + τ) + t exp([ω]) d. Where it meets the surface at distance t the point moves, to first order, by τ + t ω × d, and
then along the ray until it is on the surface again.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from panoless.kernels.constants import LEAST_SLANT


@dataclass(frozen=True)
class PoseRows:
    """Residuals that change by row·(ω, τ) of their view, and their weights."""

    view: Int[np.ndarray, "P"]
    rows: Float[np.ndarray, "P K 6"]
    weights: Float[np.ndarray, "P"]

    def forward(self, change: Float[np.ndarray, "V 6"]) -> Float[np.ndarray, "P K"]:
        """J x; zero where the weight is not positive."""
        moved: np.ndarray = np.matmul(self.rows, change[self.view][..., None])[..., 0]
        return moved * (self.weights > 0)[:, None]

    def backward(self, residual: Float[np.ndarray, "P K"], views: int) -> Float[np.ndarray, "V 6"]:
        """Jᵀ W e."""
        pulled = np.matmul((self.weights[:, None] * residual)[:, None], self.rows)[:, 0]
        return np.stack([np.bincount(self.view, column, views) for column in pulled.T], 1)

    def blocks(self, views: int) -> Float[np.ndarray, "V 6 6"]:
        """The diagonal blocks of Jᵀ W J."""
        squares = np.matmul((self.weights[:, None, None] * self.rows).transpose(0, 2, 1), self.rows)
        sums = [np.bincount(self.view, column, views) for column in squares.reshape(-1, 36).T]
        return np.stack(sums, 1).reshape(views, 6, 6)


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
