"""What the stage of poses finds, whatever found it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from panoless.photographs.certainty import SeenPoints, pose_covariances
from panoless.photographs.frames import Frames, Photograph
from panoless.photographs.lens import Lens
from panoless.photographs.options import LEAST_VIEWS
from shinypartial.core.camera import Camera
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import GroundPlane

LEAST_POSED = 0.5
"""Share of the frames that must get a pose: with fewer, those that do are likely to be wrong."""
GROUND_THICKNESS = 0.005
"""Points so near to a plane lie on it, as a share of the distance of the cameras."""
GROUND_POINTS = 0.3
"""Share of the points of structure from motion that make a plane the ground."""

Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class PosedView:
    """A frame with its lens and its pose, OpenCV axes."""

    name: str
    lens: Lens
    camera_to_world: Rows
    error_px: float | None = None
    """Root mean square of what the pose leaves of the points that it was found from; None where it was given."""
    covariance: Rows | None = None
    """Of the camera's turn (rad, world axes) and shift (units of the world), by the points that it was found from; None
    where these are not known."""

    @property
    def pose_covariance(self) -> Float[np.ndarray, "6 6"] | None:
        """The same as an array."""
        return None if self.covariance is None else np.array(self.covariance)

    @property
    def camera(self) -> Camera:
        """That of the undistorted picture."""
        return self.lens.pinhole(np.array(self.camera_to_world))


LEVEL = GroundPlane((0.0, 0.0, 1.0), 0.0)
"""The ground of a world that stands on it: z = 0."""
PLANES_TRIED = 1000
LEAST_UPWARD = 0.2
"""Cosine of the angle between the ground's normal and the cameras' mean upward direction. Not tuned, nor is the number
above."""


@dataclass(frozen=True)
class Poses:
    """Poses of the frames, and of which there are none."""

    origin: str
    """What they were found by."""
    unit: str
    """Of the world: `m`, or `unknown`."""
    views: tuple[PosedView, ...]
    left_out: tuple[str, ...] = ()
    """Frames without a pose."""
    focal_error: float | None = None
    """Standard deviation of the focal length as a share of it, where it was estimated here."""
    ground: GroundPlane | None = None
    """The board's plane, or that of most points that poses were found from."""


def find_ground(points: Float[np.ndarray, "P 3"], poses: Float[np.ndarray, "V 4 4"]) -> GroundPlane | None:
    """The plane near most points that all cameras look down on, by consensus of three points each (RANSAC).

    Its normal toward the cameras is at less than 78° from their mean upward direction, from which that of a wall before
    them is at more than 90°. None where fewer than `GROUND_POINTS` of the points lie on it.
    """
    centers, up = poses[:, :3, 3], -poses[:, :3, 1].mean(0)
    if len(points) < 3:
        return None
    reach = float(np.median(np.linalg.norm(centers - np.median(points, 0), axis=1)))
    limit = GROUND_THICKNESS * reach
    first, second, third = np.random.default_rng(0).choice(points, (3, PLANES_TRIED))
    normals = np.cross(second - first, third - first)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    offsets = np.sum(normals * first, 1)
    heights = centers @ normals.T - offsets
    sides = np.sign(heights).sum(0)
    upward = (np.abs(sides) == len(centers)) & (np.sign(sides) * (normals @ up) > LEAST_UPWARD * np.linalg.norm(up))
    near = (np.abs(points @ normals.T - offsets) < limit).sum(0) * upward
    best = int(np.argmax(near))
    if near[best] < GROUND_POINTS * len(points):
        return None
    normal, offset = normals[best], float(offsets[best])
    for _ in range(3):
        on = points[np.abs(points @ normal - offset) < limit]
        middle = on.mean(0)
        normal = np.linalg.svd(on - middle, full_matrices=False)[2][2]
        offset = float(normal @ middle)
    side = float(np.sign(np.median(centers @ normal - offset)))
    x, y, z = map(float, side * normal)
    return GroundPlane((x, y, z), side * offset)


def as_rows(matrix: Float[np.ndarray, "N N"]) -> Rows:
    """A pose or a covariance as the records have it."""
    return tuple(tuple(map(float, row)) for row in matrix)


def with_covariances(poses: Poses, seen: Sequence[SeenPoints], *, known_points: bool) -> Poses:
    """The same with how sure each pose is, by the points that its view shows; one entry a view."""
    found = pose_covariances(seen, known_points=known_points)
    if found is None:
        return poses
    views = [replace(view, covariance=as_rows(each)) for view, each in zip(poses.views, found, strict=True)]
    return replace(poses, views=tuple(views))


def without_the_rest(poses: Poses, frames: Frames, remedy: str) -> Poses:
    """The same with the frames that have none named; InputError when these are too many."""
    named = {view.name for view in poses.views}
    left_out = tuple(photograph.name for photograph in frames.photographs if photograph.name not in named)
    count, total = len(poses.views), len(frames.photographs)
    if count < max(LEAST_VIEWS, LEAST_POSED * total):
        raise InputError(
            expected=f"poses for at least {LEAST_VIEWS} frames and {LEAST_POSED:.0%} of them",
            found=f"{count} of {total} by {poses.origin}",
            remedy=remedy,
        )
    return replace(poses, left_out=left_out)


def lens_for(photograph: Photograph, lens: Lens) -> Lens:
    """A lens of the full picture as one of the frame; InputError when it is for pictures of another size."""
    full = photograph.full_width, photograph.full_height
    if (lens.width, lens.height) != full:
        turned = (lens.height, lens.width) == full
        raise InputError(
            expected=f"a camera for pictures of {full[0]}×{full[1]}, such as {photograph.source.name}",
            found=f"one for {lens.width}×{lens.height}",
            remedy="The pictures lie on their side by their EXIF tag, and the poses are for pixels as they are stored: "
            "add --no-upright."
            if turned
            else "Give the pictures that the poses were found from.",
        )
    return lens.downscaled(photograph.side)
