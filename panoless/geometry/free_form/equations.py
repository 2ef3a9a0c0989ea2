"""The terms of a level set's cost, linearized: rows of derivatives with their residuals and weights."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from panoless.geometry.free_form.motions import silhouette_motion_rows
from panoless.geometry.free_form.surface import LEAST_SLOPE, LevelSet
from panoless.kernels.level_set import add_rows, add_squares, apply_rows, evaluate
from panoless.numeric.robust import bounded_error, robust_weight
from panoless.problem.nuisance import Nuisance
from panoless.problem.rays import PixelRays

SILHOUETTE_SCALE_PX = 2.0
"""Robust scale of silhouettes."""
MISS_WEIGHT = 3.0
"""Weight of a pixel on the object that misses the surface, against a silhouette's point of gain one."""
MISS_SCALE_PX = 20.0
"""Its robust scale."""
GAUGE = 10.0
"""Weight of (‖∇φ‖ − 1)² at a node near the surface…"""
GAUGE_CELLS = 2.0
"""…that is within so many cells of it."""


@dataclass(frozen=True)
class Rows:
    """Residuals e that change by row·(δφ, ∇δφ) at a place, and their weights; `cost` is half their robust squares."""

    places: Float[np.ndarray, "P 3"]
    rows: Float[np.ndarray, "P K 4"]
    residual: Float[np.ndarray, "P K"]
    weights: Float[np.ndarray, "P"]
    cost: float = 0.0

    def forward(self, change: Float[np.ndarray, "A B C"]) -> Float[np.ndarray, "P K"]:
        """J c."""
        return apply_rows(change, self.places, self.rows, self.weights)

    def backward(self, residual: Float[np.ndarray, "P K"], shape: tuple[int, int, int]) -> Float[np.ndarray, "A B C"]:
        """Jᵀ W e."""
        return add_rows(residual, self.places, self.rows, self.weights, shape)

    def squares(self, shape: tuple[int, int, int]) -> Float[np.ndarray, "A B C"]:
        """The diagonal of Jᵀ W J."""
        return add_squares(self.places, self.rows, self.weights, shape)


def joined_rows(one: Rows, other: Rows) -> Rows:
    """The rows of both, as many a place."""
    places, rows, residual, weights = (
        np.concatenate([getattr(part, name) for part in (one, other)])
        for name in ("places", "rows", "residual", "weights")
    )
    return Rows(places, rows, residual, weights, one.cost + other.cost)


def silhouette_rows(
    surface: LevelSet,
    silhouettes: PixelRays,
    missed: PixelRays,
    surplus: PixelRays,
    silhouette_weight: float,
    miss_weight: float,
    nuisance: Nuisance,
) -> tuple[Rows, Float[np.ndarray, "S 1 6"]]:
    """Silhouettes, along whose rays the least φ should be δ, pixels on the object that miss it, for which it should be
    no more, and pixels beside it that do not, for which it should be no less; and how all change with (ω, τ).

    The residual is φ/(‖∇φ‖ a t) − δ where φ is least, in pixels, with a the pixel's angle, t the distance and δ the
    offset of the view's mask.
    """
    parts = []
    for rays, weight, scale, side in (
        (silhouettes, silhouette_weight, SILHOUETTE_SCALE_PX, 0),
        (missed, miss_weight * MISS_WEIGHT, MISS_SCALE_PX, 1),
        (surplus, miss_weight * MISS_WEIGHT, MISS_SCALE_PX, -1),
    ):
        near = surface.nearest(rays.origins, rays.directions)
        slope = np.maximum(np.linalg.norm(near.derivatives[:, 1:4], axis=1), LEAST_SLOPE)
        by_value = near.met / (slope * rays.size * np.where(near.met, near.distance / surface.spacing, 1.0))
        residual = near.derivatives[:, 0] * by_value - near.met * nuisance.offsets_px(rays.view)
        counted = near.met & (side * residual >= 0)
        residual = residual * counted
        weights = weight * counted * robust_weight(residual, scale)
        cost = weight * scale**2 * float(np.where(near.met, bounded_error(residual, scale), 1.0).sum())
        distance = np.where(near.met, near.distance, 0.0) / surface.spacing
        by_motion = silhouette_motion_rows(near.derivatives[:, 1:4], rays.directions, distance, by_value)
        by_motion[..., 3:] /= surface.spacing
        parts.append((near.places, by_value, residual, weights, by_motion, cost))
    places, by_value, residual, weights, by_motion = (np.concatenate([part[k] for part in parts]) for k in range(5))
    rows = np.zeros((len(places), 1, 4))
    rows[:, 0, 0] = by_value
    return Rows(places, rows, residual[:, None], weights, sum(part[5] for part in parts) / 2), by_motion


def gauge_rows(surface: LevelSet, values: Float[np.ndarray, "A B C"]) -> Rows:
    """‖∇φ‖ − 1 at nodes near the surface, where φ is a distance to first order, by its values at all nodes."""
    inside = np.abs(values) < GAUGE_CELLS
    for axis in range(3):
        np.moveaxis(inside, axis, 0)[[0, -1]] = False
    places = surface.nodes()[inside]
    gradient = evaluate(surface.coefficients, places)[:, 1:4]
    length = np.linalg.norm(gradient, axis=1)
    rows = np.zeros((len(places), 1, 4))
    rows[:, 0, 1:] = gradient / np.maximum(length, 1e-9)[:, None]
    residual = length[:, None] - 1
    return Rows(places, rows, residual, np.full(len(places), GAUGE), GAUGE * float((residual**2).sum()) / 2)
