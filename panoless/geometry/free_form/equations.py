"""What a level set is asked for, linearized: rows of derivatives with their residuals and weights."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from panoless.geometry.free_form.beside import BlockRows, outline_pose_rows
from panoless.geometry.free_form.observations import PixelRays
from panoless.geometry.free_form.options import FreeFormOptions
from panoless.geometry.free_form.surface import LEAST_SLOPE, LevelSet
from panoless.kernels.level_set import add_rows, add_squares, apply_rows, evaluate
from panoless.numeric.robust import bounded_error, robust_weight


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
    outlines: PixelRays,
    missed: PixelRays,
    outline_weight: float,
    miss_weight: float,
    options: FreeFormOptions,
) -> tuple[Rows, BlockRows]:
    """Outlines, along whose rays the least φ should be zero, and pixels on the object that miss it, for which it
    should be negative.

    The residual is φ/(‖∇φ‖ a t) where φ is least, in pixels, with a the pixel's angle and t the distance. It
    changes with the pose of its view, too.
    """
    parts = []
    for rays, weight, scale in (
        (outlines, outline_weight, options.outline_scale_px),
        (missed, miss_weight * options.miss_weight, options.miss_scale_px),
    ):
        near = surface.nearest(rays.origins, rays.directions)
        slope = np.maximum(np.linalg.norm(near.derivatives[:, 1:4], axis=1), LEAST_SLOPE)
        by_value = near.met / (slope * rays.size * np.where(near.met, near.distance / surface.spacing, 1.0))
        residual = near.derivatives[:, 0] * by_value
        weights = weight * near.met * robust_weight(residual, scale)
        cost = weight * scale**2 * float(np.where(near.met, bounded_error(residual, scale), 1.0).sum())
        distance = np.where(near.met, near.distance, 0.0) / surface.spacing
        by_pose = outline_pose_rows(near.derivatives[:, 1:4], rays.directions, distance, by_value)
        by_pose[..., 3:] /= surface.spacing
        parts.append((near.places, by_value, residual, weights, rays.view, by_pose, cost))
    places, by_value, residual, weights, view, by_pose = (np.concatenate([part[k] for part in parts]) for k in range(6))
    rows = np.zeros((len(places), 1, 4))
    rows[:, 0, 0] = by_value
    cost = sum(part[6] for part in parts) / 2
    return Rows(places, rows, residual[:, None], weights, cost), BlockRows(view, by_pose, weights)


def gauge_rows(surface: LevelSet, near: Bool[np.ndarray, "A B C"], weight: float) -> Rows:
    """‖∇φ‖ − 1 at nodes near the surface: φ is a distance there, to first order."""
    inside = near.copy()
    for axis in range(3):
        np.moveaxis(inside, axis, 0)[[0, -1]] = False
    places = surface.nodes()[inside]
    gradient = evaluate(surface.coefficients, places)[:, 1:4]
    length = np.linalg.norm(gradient, axis=1)
    rows = np.zeros((len(places), 1, 4))
    rows[:, 0, 1:] = gradient / np.maximum(length, 1e-9)[:, None]
    residual = length[:, None] - 1
    return Rows(places, rows, residual, np.full(len(places), weight), weight * float((residual**2).sum()) / 2)
