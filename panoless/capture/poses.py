"""Cameras that are not quite where they are said to be: a turn and a shift of each view.

What all cameras share is no error of theirs: no photograph of a far world tells it, so it can be found and taken back.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from panoless.capture.rays import pose_of
from panoless.capture.views import TrainView, Views


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
    def turn_deg(self) -> float:
        """The median turn, in degrees."""
        return float(np.degrees(np.median(np.linalg.norm(self.turns, axis=1)))) if len(self.turns) else 0.0

    @property
    def stacked(self) -> Float[np.ndarray, "V 6"]:
        """Turns, then shifts."""
        return np.concatenate([self.turns, self.shifts], 1)

    def after(self, change: Float[np.ndarray, "V 6"]) -> "Poses":
        """Turned and shifted once more."""
        turns = Rotation.from_rotvec(change[:, :3]) * Rotation.from_rotvec(self.turns)
        return Poses(turns.as_rotvec(), self.shifts + change[:, 3:])

    def without_common(
        self, centers: Float[np.ndarray, "V 3"], prior: Float[np.ndarray, "6"]
    ) -> tuple[Similarity, "Poses"]:
        """What turns, shifts and scales all cameras alike, by least squares under the weights of the prior, and the
        poses in a world from which that was taken back.

        For cameras at o these are (θ, θ × o), (0, t) and (0, σ o). No photograph of a far world tells them.
        """
        axes, count = np.eye(3), len(centers)
        turned = np.concatenate([np.tile(axes, (count, 1, 1)), np.cross(axes, centers[:, None])], 2)
        shifted = np.concatenate([np.zeros((count, 3, 3)), np.tile(axes, (count, 1, 1))], 2)
        scaled = np.concatenate([np.zeros((count, 1, 3)), centers[:, None]], 2)
        basis = (np.concatenate([turned, shifted, scaled], 1) * np.sqrt(prior)).transpose(0, 2, 1).reshape(-1, 7)
        found = np.linalg.lstsq(basis, (self.stacked * np.sqrt(prior)).ravel(), rcond=None)[0]
        common = Similarity(1 + float(found[6]), Rotation.from_rotvec(found[:3]).as_matrix(), found[3:6])
        turns = Rotation.from_matrix(common.rotation.T) * Rotation.from_rotvec(self.turns)
        return common, Poses(turns.as_rotvec(), common.undone(centers + self.shifts) - centers)

    def moved(self, views: Views) -> Views:
        """The views with their cameras there."""
        turns = Rotation.from_rotvec(self.turns).as_matrix()
        moved = [
            moved_view(view, turn, shift) for view, turn, shift in zip(views.train, turns, self.shifts, strict=True)
        ]
        return replace(views, train=tuple(moved))


def moved_view(view: TrainView, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> TrainView:
    """A view with its camera turned by a rotation of the world's axes and shifted."""
    rotation, center = pose_of(view.camera)
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = rotation @ turn.T
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ (center + shift)
    like = view.camera.world_to_camera
    matrix = torch.from_numpy(world_to_camera).to(like.device, like.dtype)
    return replace(view, camera=replace(view.camera, world_to_camera=matrix))
