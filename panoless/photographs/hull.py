"""A visual hull on points, coarse and at once: what masks in some views say of the silhouette in another."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from panoless.capture.rays import camera_rays
from panoless.photographs.lens import opencv
from shinypartial.core.camera import Camera, project
from shinypartial.core.errors import InputError


def nearest_point(
    cameras: Sequence[Camera], seen: Sequence[tuple[Camera, tuple[float, float]]] = ()
) -> Float[np.ndarray, "3"]:
    """The point nearest, in least squares, to rays through pixels (x, y) and to the optical axes of all cameras.

    Axes weigh a hundredth of a ray; they determine the depth where there is one ray.
    """
    normal_matrix, right_side = np.zeros((3, 3)), np.zeros(3)
    axes = [(camera, (camera.cx, camera.cy), 0.01) for camera in cameras]
    for camera, (x, y), weight in axes + [(camera, middle, 1.0) for camera, middle in seen]:
        ray = camera.camera_to_world[:3, :3] @ camera_rays(camera, np.asarray(x, np.float64), np.asarray(y, np.float64))
        ray /= np.linalg.norm(ray)
        across = weight * (np.eye(3) - np.outer(ray, ray))
        normal_matrix += across
        right_side += across @ camera.position_world
    return np.linalg.lstsq(normal_matrix, right_side, rcond=None)[0]


def sighted_ball(
    cameras: Sequence[Camera], seen: Sequence[tuple[Camera, tuple[float, float, float, float]]]
) -> tuple[Float[np.ndarray, "3"], float]:
    """Center and radius of the object from rectangles (left, top, right, bottom in pixels) about it in some views.

    Raises InputError where the center lies behind a camera.
    """
    middles = [(camera, ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)) for camera, box in seen]
    center = nearest_point(cameras, middles)
    radii = []
    for camera, (left, top, right, bottom) in seen:
        depth = project(camera, center[None])[0, 2]
        radii.append(np.hypot((right - left) / camera.fx, (bottom - top) / camera.fy) / 2 * depth)
    if min(radii) <= 0:
        raise InputError(
            expected="rectangles about one object in front of all cameras",
            found="rays that meet behind a camera",
            remedy="Check --box and --box-in, and the poses.",
        )
    return center, float(np.median(radii))


def cube(center: Float[np.ndarray, "3"], half_side: float, count: int) -> Float[np.ndarray, "P 3"]:
    """The middles of count³ cells of a cube, the last axis fastest."""
    steps = (np.arange(count) + 0.5) / count * 2 - 1
    grid: np.ndarray = center + half_side * np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1)
    return grid.reshape(-1, 3)


def carve(
    seen: Sequence[tuple[Camera, Bool[np.ndarray, "_ _"]]],
    center: Float[np.ndarray, "3"],
    half_side: float,
    count: int,
    allowed: int = 0,
) -> Float[np.ndarray, "P 3"]:
    """Points of a cube of count³ that all masks but `allowed` of them contain; outside of a picture anything may be."""
    points = cube(center, half_side, count)
    missed = np.zeros(len(points), np.int32)
    for camera, mask in seen:
        rows, columns, within, depth = pixels_of(camera, points)
        outside = within & ~mask[np.where(within, rows, 0), np.where(within, columns, 0)]
        missed += outside | (depth <= 0)
        if not allowed:
            points, missed = points[missed == 0], missed[missed == 0]
    return points[missed <= allowed]


def silhouette(camera: Camera, points: Float[np.ndarray, "P 3"], spacing: float) -> Bool[np.ndarray, "H W"]:
    """Pixels that points of a grid cover, each as large as its cell."""
    cv2 = opencv()
    covered = np.zeros((camera.height, camera.width), np.uint8)
    if not len(points):
        return covered > 0
    rows, columns, within, depth = pixels_of(camera, points)
    within &= depth > 0
    covered[rows[within], columns[within]] = 1
    # Cells are seen at any angle: closing by their diagonal leaves no gap and does not grow the whole.
    side = 2 * int(np.ceil(np.sqrt(3) * spacing * camera.fx / np.median(depth) / 2)) + 1
    return cv2.morphologyEx(covered, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8)) > 0


def pixels_of(camera: Camera, points: Float[np.ndarray, "P 3"]) -> tuple[np.ndarray, ...]:
    """Row, column, whether that is within the picture, and depth of each point."""
    places = project(camera, points)
    columns, rows = np.floor(places[:, :2]).astype(np.int64).T
    within = (columns >= 0) & (rows >= 0) & (columns < camera.width) & (rows < camera.height)
    return rows, columns, within, places[:, 2]


def overlap(first: Bool[np.ndarray, "H W"], second: Bool[np.ndarray, "H W"]) -> float:
    """Intersection over union, in [0, 1]; 1 where both are empty."""
    union = np.count_nonzero(first | second)
    return np.count_nonzero(first & second) / union if union else 1.0
