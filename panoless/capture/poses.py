"""Cameras that are not quite where they are said to be: a turn and a shift of each view.

What all cameras share is no error of theirs: no photograph of a far world determines it, so it can be found and taken
back.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from panoless.capture.rays import pose_of
from panoless.capture.views import TrainView, Views
from panoless.numeric.factorize import regularize
from shinypartial.core.camera import Similarity

#: A principal point is taken for wrong where what turns and shifts leave to it and to common motions together is less
#: than this share of what they leave to common motions alone. Of single cameras' errors it is 0.99.
LENS_SHARE = 0.5


@dataclass(frozen=True)
class StatedCameras:
    """Where cameras are said to be: centers (normalized frame) and rotations from the world to a camera's axes."""

    centers: Float[np.ndarray, "V 3"]
    rotations: Float[np.ndarray, "V 3 3"]
    covariances: tuple[Float[np.ndarray, "6 6"] | None, ...]
    """Of turns and shifts, as far as the dataset states them."""

    @classmethod
    def of(cls, views: Views) -> "StatedCameras":
        """Those of the views."""
        rotations, centers = zip(*(pose_of(view.camera) for view in views.train), strict=True)
        return cls(np.array(centers), np.array(rotations), tuple(view.pose_covariance for view in views.train))

    def prior(self, turn_rad: float, shift: float, floor: float) -> Float[np.ndarray, "V 6 6"]:
        """Inverse covariance of each camera's turn and shift: of these standard deviations; where a covariance is
        stated, of that and of `floor` times these together.
        """
        usual = np.diag(np.repeat([turn_rad, shift], 3) ** 2.0)
        known = [usual if each is None else each + floor**2 * usual for each in self.covariances]
        return np.linalg.inv(regularize(np.array(known), "the poses"))


@dataclass(frozen=True)
class Poses:
    """How much each camera is turned (rad, world axes) and shifted (normalized frame) against what is said of it."""

    turns: Float[np.ndarray, "V 3"]
    shifts: Float[np.ndarray, "V 3"]
    sigmas: Float[np.ndarray, "V 6"] | None = None
    """Standard deviations of both, where a fit determined them."""

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

    def without_common(self, cameras: "StatedCameras", prior: Float[np.ndarray, "V 6 6"]) -> tuple[Similarity, "Poses"]:
        """What turns, shifts and scales all cameras alike, by least squares under the weights of the prior, and the
        poses in a world from which that was taken back.

        For cameras at o these are (θ, θ × o), (0, t) and (0, σ o). No photograph of a far world determines them. A
        principal point that is wrong in all views looks like turns by the same angles about the axes of each camera. On
        an arc of views these are nearly a common turn: where they explain most of what common motions leave, they stay
        in the poses.
        """
        found = self._alike(cameras, prior)[0]
        common = Similarity(1 + float(found[6]), Rotation.from_rotvec(found[:3]).as_matrix(), found[3:6])
        turns = Rotation.from_matrix(common.rotation.T) * Rotation.from_rotvec(self.turns)
        return common, Poses(turns.as_rotvec(), common.undone(cameras.centers + self.shifts) - cameras.centers)

    def lens_turn(self, cameras: "StatedCameras", prior: Float[np.ndarray, "V 6 6"]) -> Float[np.ndarray, "2"] | None:
        """By how much every camera is turned about its own x and y axis (rad), as by a wrong principal point.

        None where that explains little.
        """
        return self._alike(cameras, prior)[1]

    def principal_point_px(self, views: Views, prior: Float[np.ndarray, "V 6 6"]) -> tuple[float, float] | None:
        """By how much the principal point lies to the right and below of where it is said to be, in all views alike;
        None where that is not determined.
        """
        turn = self.lens_turn(StatedCameras.of(views), prior)
        if turn is None:
            return None
        fx, fy = (float(np.median([getattr(view.camera, name) for view in views.train])) for name in ("fx", "fy"))
        return -fx * math.tan(turn[1]), fy * math.tan(turn[0])

    def _alike(
        self, cameras: "StatedCameras", prior: Float[np.ndarray, "V 6 6"]
    ) -> tuple[Float[np.ndarray, "7"], Float[np.ndarray, "2"] | None]:
        """θ, t and σ, and the turns about own axes if these leave less than `LENS_SHARE` of the squares."""
        axes, centers, count = np.eye(3), cameras.centers, len(cameras.centers)
        turned = np.concatenate([np.tile(axes, (count, 1, 1)), np.cross(axes, centers[:, None])], 2)
        shifted = np.concatenate([np.zeros((count, 3, 3)), np.tile(axes, (count, 1, 1))], 2)
        scaled = np.concatenate([np.zeros((count, 1, 3)), centers[:, None]], 2)
        own = np.concatenate([cameras.rotations[:, :2], np.zeros((count, 2, 3))], 2)
        roots = np.linalg.cholesky(regularize(prior, "the poses"))
        basis = (np.concatenate([turned, shifted, scaled, own], 1) @ roots).transpose(0, 2, 1).reshape(-1, 9)
        stacked = np.matmul(self.stacked[:, None], roots).ravel()
        return common_and_lens(basis[:, :7], basis[:, 7:], stacked)

    def moved(self, views: Views) -> Views:
        """The views with their cameras there."""
        turns = Rotation.from_rotvec(self.turns).as_matrix()
        moved = [
            moved_view(view, turn, shift) for view, turn, shift in zip(views.train, turns, self.shifts, strict=True)
        ]
        return replace(views, train=tuple(moved))


def common_and_lens(
    common: Float[np.ndarray, "P C"], lens: Float[np.ndarray, "P L"], stacked: Float[np.ndarray, "P"]
) -> tuple[Float[np.ndarray, "C"], Float[np.ndarray, "L"] | None]:
    """Coefficients of common motions in stacked poses, by least squares, and of a wrong principal point beside them if
    both together leave less than `LENS_SHARE` of the squares.
    """
    bases = common, np.concatenate([common, lens], 1)
    fits = [np.linalg.lstsq(basis, stacked, rcond=None)[0] for basis in bases]
    left = [float(((stacked - basis @ fit) ** 2).sum()) for basis, fit in zip(bases, fits, strict=True)]
    if left[1] < LENS_SHARE * left[0]:
        return fits[1][: common.shape[1]], fits[1][common.shape[1] :]
    return fits[0], None


def moved_view(view: TrainView, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> TrainView:
    """A view with its camera turned by a rotation of the world's axes and shifted."""
    rotation, center = pose_of(view.camera)
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = rotation @ turn.T
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ (center + shift)
    like = view.camera.world_to_camera
    matrix = torch.from_numpy(world_to_camera).to(like.device, like.dtype)
    return replace(view, camera=replace(view.camera, world_to_camera=matrix))
