"""Cameras that are not quite where they are said to be: a turn and a shift of each view, unknown beside the surface.

A camera with the turn ω (rad) and the shift τ (normalized frame) sends the ray o + t d of a pixel as
(o + τ) + t exp([ω]) d. Where it meets the surface at distance t the point moves, to first order, by τ + t ω × d, and
then along the ray until it is on the surface again.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from panoless.capture.rays import pose_of
from panoless.capture.views import TrainView, Views
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


@dataclass(frozen=True)
class Similarity:
    """x → s R x + t."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    def __call__(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Where points go."""
        return self.scale * points @ self.rotation.T + self.shift

    def undone(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """The inverse."""
        return (points - self.shift) @ self.rotation / self.scale


@dataclass(frozen=True)
class Poses:
    """How much each camera is turned (rad, world axes) and shifted (normalized frame) against what is said of it."""

    turns: Float[np.ndarray, "V 3"]
    shifts: Float[np.ndarray, "V 3"]

    @classmethod
    def none(cls, views: int) -> "Poses":
        """Cameras as they are said to be."""
        return cls(np.zeros((views, 3)), np.zeros((views, 3)))

    @property
    def stacked(self) -> Float[np.ndarray, "V 6"]:
        """Turns, then shifts."""
        return np.concatenate([self.turns, self.shifts], 1)

    def after(self, change: Float[np.ndarray, "V 6"]) -> "Poses":
        """Turned and shifted once more."""
        turns = Rotation.from_rotvec(change[:, :3]) * Rotation.from_rotvec(self.turns)
        return Poses(turns.as_rotvec(), self.shifts + change[:, 3:])

    def common(self, centers: Float[np.ndarray, "V 3"], prior: Float[np.ndarray, "6"]) -> Similarity:
        """What turns, shifts and scales all cameras alike, by least squares under the weights of the prior.

        For cameras at o these are (θ, θ × o), (0, t) and (0, σ o). No photograph of a far world tells them.
        """
        axes, count = np.eye(3), len(centers)
        turned = np.concatenate([np.tile(axes, (count, 1, 1)), np.cross(axes, centers[:, None])], 2)
        shifted = np.concatenate([np.zeros((count, 3, 3)), np.tile(axes, (count, 1, 1))], 2)
        scaled = np.concatenate([np.zeros((count, 1, 3)), centers[:, None]], 2)
        basis = (np.concatenate([turned, shifted, scaled], 1) * np.sqrt(prior)).transpose(0, 2, 1).reshape(-1, 7)
        found = np.linalg.lstsq(basis, (self.stacked * np.sqrt(prior)).ravel(), rcond=None)[0]
        return Similarity(1 + float(found[6]), Rotation.from_rotvec(found[:3]).as_matrix(), found[3:6])

    def without(self, common: Similarity, centers: Float[np.ndarray, "V 3"]) -> "Poses":
        """The poses in a world from which that was taken back."""
        turns = Rotation.from_matrix(common.rotation.T) * Rotation.from_rotvec(self.turns)
        return Poses(turns.as_rotvec(), common.undone(centers + self.shifts) - centers)

    def moved(self, views: Views) -> Views:
        """The views with their cameras there."""
        turns = Rotation.from_rotvec(self.turns).as_matrix()
        moved = [_moved(view, turn, shift) for view, turn, shift in zip(views.train, turns, self.shifts, strict=True)]
        return replace(views, train=tuple(moved))


def _moved(view: TrainView, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> TrainView:
    rotation, center = pose_of(view.camera)
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = rotation @ turn.T
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ (center + shift)
    like = view.camera.world_to_camera
    matrix = torch.from_numpy(world_to_camera).to(like.device, like.dtype)
    return replace(view, camera=replace(view.camera, world_to_camera=matrix))
