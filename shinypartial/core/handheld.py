"""A camera that a hand carries along a path: it sways, looks a little beside the object, leans and trembles."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import look_at
from shinypartial.core.trajectory import (
    AROUND,
    CameraPath,
    Seed,
    check_hemisphere,
    hemisphere_axis,
    limits,
    path_offsets,
)

DegreesOfHand = Annotated[float, limits(0.0, 20.0)]


@dataclass(frozen=True)
class Hand:
    """How unsteady the hand is: root mean squares of smooth random motions, and of a tremor on top."""

    sway: Annotated[float, limits(0.0, 0.2)] = 0.02
    """Of the position along each axis, as a share of the distance from the target."""
    aim_deg: DegreesOfHand = 1.0
    """Of the direction of view, to either side and up and down."""
    lean_deg: DegreesOfHand = 2.0
    """Of the angle about the direction of view."""
    tremor_deg: Annotated[float, limits(0.0, 5.0)] = 0.05
    """Of the direction of view from one frame to the next."""
    smooth_frames: Annotated[float, limits(1.0, 1000.0)] = 6.0
    """How slow the smooth motions are: standard deviation of the window that averages them, in frames."""
    seed: Seed = 0
    """Determines all of them."""


def handheld_poses(path: CameraPath, hand: Hand, count: int) -> Float[np.ndarray, "V 4 4"]:
    """OpenCV camera-to-world poses of `count` frames along a path, in the order in which they are taken.

    Raises InputError where the path, with the sway, leaves its open hemisphere.
    """
    random = np.random.default_rng(hand.seed)
    sway, aim = _smooth(random, count, hand.smooth_frames), _smooth(random, count, hand.smooth_frames)
    target = np.array(path.target)
    offsets = path_offsets(path, count) + hand.sway * path.radius * sway
    if path.path != AROUND:
        check_hemisphere(offsets, hemisphere_axis(path))
    angles = np.radians(aim * [hand.aim_deg, hand.aim_deg, hand.lean_deg])
    angles[:, :2] += np.radians(hand.tremor_deg) * random.normal(size=(count, 2))
    poses = np.stack([look_at(target + offset, target) for offset in offsets])
    poses[:, :3, :3] = poses[:, :3, :3] @ _turns(angles)
    return poses


def _smooth(random: np.random.Generator, count: int, window: float) -> Float[np.ndarray, "V 3"]:
    """White noise that is averaged over a window in time, of unit variance at every moment."""
    reach = int(4 * window) + 1
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / window) ** 2)
    kernel /= np.sqrt(np.sum(kernel**2))
    noise = random.normal(size=(count + 2 * reach, 3))
    return np.stack([np.convolve(each, kernel, mode="valid") for each in noise.T], -1)


def _turns(angles: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3 3"]:
    """Rotations by rotation vectors."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(angles).as_matrix()
