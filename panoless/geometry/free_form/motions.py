"""How what is seen of a level set changes with a motion of the ray.

A turn ω (rad) and a shift τ (normalized frame) send the ray o + t d to (o + τ) + t exp([ω]) d. Where it meets the
surface at distance t the point moves, to first order, by τ + t ω × d, and then along the ray until it is on the surface
again.
"""

import numpy as np
from jaxtyping import Float

from panoless.kernels.constants import LEAST_SLANT
from panoless.problem.parametric import motion_rows


def pixel_motion_rows(
    derivatives: Float[np.ndarray, "P 10"],
    directions: Float[np.ndarray, "P 3"],
    distance: Float[np.ndarray, "P"],
    slopes: Float[np.ndarray, "P 3 3"],
    by_gradient: Float[np.ndarray, "P 3 3"],
) -> Float[np.ndarray, "P 3 6"]:
    """What three channels of the mirrored light change by with the motion of its ray, the surface being still.

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


def silhouette_motion_rows(
    gradient: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    distance: Float[np.ndarray, "P"],
    by_value: Float[np.ndarray, "P"],
) -> Float[np.ndarray, "P 1 6"]:
    """by_value ∇φ·(τ + t ω × d): a silhouette's residual by the motion of its ray, where φ is least on it."""
    return motion_rows(by_value[:, None] * gradient, directions, distance)[:, None]
