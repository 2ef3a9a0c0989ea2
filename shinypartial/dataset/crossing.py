"""Where a looped camera path crosses itself, seen from the point that the cameras look at."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from shinypartial.core.camera import Camera
from shinypartial.core.errors import InputError

#: A path counts as closed when its ends are nearer than this many typical steps.
CLOSED_STEPS = 3.0
#: Where the positions tremble, neighbors cross as well: a crossing counts when both loops it makes hold this share.
SMALLEST_LOOP_SHARE = 0.1
#: Crossings nearer to each other than this many typical steps are one (two wavering lines can meet three times) …
SAME_CROSSING_STEPS = 3.0
#: … but not farther apart than this: views in no order have steps across the whole sphere.
SAME_CROSSING_LIMIT_DEG = 20.0
#: A point on the end of two segments must not fall between them.
SLACK = 1e-9


@dataclass(frozen=True)
class _Segments:
    """Great-circle arcs between neighbors, and the length of path before each."""

    start: Float[np.ndarray, "S 3"]
    end: Float[np.ndarray, "S 3"]
    length: Float[np.ndarray, "S"]
    before: Float[np.ndarray, "S"]
    closed: bool


def look_at_point(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """The point nearest, in least squares, to all optical axes; InputError when these are parallel."""
    forward = np.stack([camera.camera_to_world[:3, 2] for camera in cameras])
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    matrix = across.sum(0)
    if np.linalg.eigvalsh(matrix)[0] < 1e-6 * len(cameras):
        raise InputError(
            expected="cameras that look at one point from several sides",
            found=f"{len(cameras)} cameras with parallel axes",
            remedy="Check the axes of transform_matrix: OpenGL, the camera looks along −z.",
        )
    positions = np.stack([camera.position_world for camera in cameras])
    return np.linalg.solve(matrix, (across @ positions[..., None]).sum(0))[:, 0]


def find_crossings(directions: Float[np.ndarray, "V 3"]) -> list[Float[np.ndarray, "3"]]:
    """Unit directions in which an ordered path of unit directions crosses itself, one for each place.

    Neighbors are joined by great-circle arcs, and the ends as well when they are near. Crossings that cut off less
    than a tenth of the path are the trembling of neighbors and don't count.
    """
    if len(directions) < 4:
        return []
    segments = _segments(directions)
    first, second, points = _meetings(segments)
    inner = segments.before[second] - segments.before[first]
    total = segments.length.sum()
    loop = np.minimum(inner, total - inner) if segments.closed else inner
    kept = points[loop >= SMALLEST_LOOP_SHARE * total]
    same = min(SAME_CROSSING_STEPS * float(np.median(segments.length)), math.radians(SAME_CROSSING_LIMIT_DEG))
    return _merge(kept, same)


def _segments(directions: Float[np.ndarray, "V 3"]) -> _Segments:
    step = angles_rad(directions[:-1], directions[1:])
    gap = float(angles_rad(directions[-1:], directions[:1])[0])
    closed = gap <= CLOSED_STEPS * float(np.median(step))
    end = np.roll(directions, -1, 0)
    count = len(directions) if closed else len(directions) - 1
    length = np.append(step, gap)[:count]
    return _Segments(directions[:count], end[:count], length, np.cumsum(length) - length, closed)


def angles_rad(first: Float[np.ndarray, "... 3"], second: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
    """Angles between unit vectors, exact for small ones: atan2(|a × b|, a·b)."""
    return np.arctan2(np.linalg.norm(np.cross(first, second), axis=-1), (first * second).sum(-1))


def _meetings(
    segments: _Segments,
) -> tuple[Int[np.ndarray, "M"], Int[np.ndarray, "M"], Float[np.ndarray, "M 3"]]:
    """Pairs of segments (first < second) that have a point in common, and that point."""
    poles = np.cross(segments.start, segments.end)
    first, second = np.triu_indices(len(poles), 2)
    points = np.cross(poles[first], poles[second])
    size = np.linalg.norm(points, axis=-1)
    # Two arcs of one great circle have no single point in common.
    distinct = size > SLACK * np.linalg.norm(poles[first], axis=-1) * np.linalg.norm(poles[second], axis=-1)
    first, second = first[distinct], second[distinct]
    points = points[distinct] / size[distinct, None]
    # The great circles meet in two opposite points; the arcs are shorter than a quarter circle.
    points *= np.where((points * segments.start[first]).sum(-1) < 0, -1.0, 1.0)[:, None]
    meets = _lies_on(points, segments, poles, first) & _lies_on(points, segments, poles, second)
    return first[meets], second[meets], points[meets]


def _lies_on(
    points: Float[np.ndarray, "M 3"],
    segments: _Segments,
    poles: Float[np.ndarray, "S 3"],
    index: Int[np.ndarray, "M"],
) -> Bool[np.ndarray, "M"]:
    """Whether points of the segments' great circles lie between their ends."""
    after_start = (np.cross(segments.start[index], points) * poles[index]).sum(-1) >= -SLACK
    before_end = (np.cross(points, segments.end[index]) * poles[index]).sum(-1) >= -SLACK
    return after_start & before_end


def _merge(points: Float[np.ndarray, "M 3"], distance_rad: float) -> list[Float[np.ndarray, "3"]]:
    """Mean directions of groups, each of all points that are left and nearer than the distance to one of them."""
    means = []
    while len(points):
        near = angles_rad(points, points[:1]) < distance_rad
        total = points[near].sum(0)
        means.append(total / np.linalg.norm(total))
        points = points[~near]
    return means
