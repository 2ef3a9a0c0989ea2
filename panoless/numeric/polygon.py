"""Polygons, as vertices in order: exact coverage of pixels, nearest sides, signed distance, clipping."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.kernels.camera import RasterCamera

LEAST_ALPHA = 1e-6
"""Coverage below this is rounding."""


def projected_coverage(corners_camera: Float[np.ndarray, "N 3"], camera: RasterCamera) -> Float[np.ndarray, "H W"]:
    """Coverage of the part of a flat polygon that lies beyond the near plane."""
    kept = _clip_to_near(corners_camera, camera.near)
    pixels = kept[:, :2] / kept[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return polygon_coverage(pixels, camera.width, camera.height)


def _clip_to_near(corners: Float[np.ndarray, "N 3"], near: float) -> Float[np.ndarray, "M 3"]:
    """The polygon clipped to z ≥ near (Sutherland and Hodgman 1974); edges along the cut may double and then cancel."""
    following = np.roll(corners, -1, 0)
    inside, next_inside = corners[:, 2] >= near, following[:, 2] >= near
    share = (near - corners[:, 2]) / np.where(inside == next_inside, 1.0, following[:, 2] - corners[:, 2])
    crossings = corners + share[:, None] * (following - corners)
    candidates = np.stack([corners, crossings], 1).reshape(-1, 3)
    return candidates[np.stack([inside, inside != next_inside], 1).ravel()]


def polygon_coverage(vertices_px: Float[np.ndarray, "N 2"], width: int, height: int) -> Float[np.ndarray, "H W"]:
    """Share of each pixel's area inside a simple polygon, exact by Green's theorem.

    Every edge is cut where it crosses pixel borders. A piece that rises by δ at mean x adds δ times the part of the row
    to its right, as the difference of neighboring columns; their running sum is the area with the sign of orientation.
    """
    starts, ends = vertices_px, np.roll(vertices_px, -1, 0)
    for axis, limit in ((1, height), (0, width)):
        starts, ends = _cut_at_whole_numbers(starts, ends, axis, limit)
    middle, rise = (starts + ends) / 2, ends[:, 1] - starts[:, 1]
    row = np.floor(middle[:, 1]).astype(np.int64)
    keep = (row >= 0) & (row < height)
    x, rise, row = middle[keep, 0].clip(0, width), rise[keep], row[keep]
    column = np.floor(x).astype(np.int64)
    cell = row * (width + 2) + column
    size = height * (width + 2)
    change = np.bincount(cell, rise * (column + 1 - x), size) + np.bincount(cell + 1, rise * (x - column), size)
    area = np.abs(np.cumsum(change.reshape(height, width + 2), 1)[:, :width])
    return np.where(area < LEAST_ALPHA, 0.0, area.clip(max=1.0))


def _cut_at_whole_numbers(
    starts: Float[np.ndarray, "N 2"], ends: Float[np.ndarray, "N 2"], axis: int, limit: int
) -> tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, "M 2"]]:
    """Cut edges wherever their coordinate `axis` is a whole number in [0, limit]."""
    a, b = starts[:, axis], ends[:, axis]
    first = np.ceil(np.minimum(a, b).clip(0, limit + 1)).astype(np.int64)
    last = np.floor(np.maximum(a, b).clip(-1, limit)).astype(np.int64)
    cuts = np.maximum(last - first + 1, 0)
    edge = np.repeat(np.arange(len(a)), cuts + 1)
    piece = np.arange(len(edge)) - np.repeat(np.cumsum(cuts + 1) - (cuts + 1), cuts + 1)
    line = np.where(b >= a, 1, -1)[edge] * piece + np.where(b >= a, first, last)[edge]
    across = np.where(a == b, 1.0, b - a)[edge]
    until = np.where(piece < cuts[edge], ((line - a[edge]) / across).clip(0, 1), 1.0)
    since = np.where(piece > 0, np.roll(until, 1), 0.0)
    along = (ends - starts)[edge]
    return starts[edge] + since[:, None] * along, starts[edge] + until[:, None] * along


def nearest_side(
    points: Float[np.ndarray, "P 2"], boundary: Float[np.ndarray, "N 2"]
) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """The side nearest to each point, where on it (0 at its first vertex, 1 at its second), and the distance from it.

    Side i leads from vertex i to the next; infinite distances from a boundary without vertices.
    """
    least, side, along = np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64), np.zeros(len(points))
    for index, (share, squared) in enumerate(_feet(points, boundary)):
        nearer = squared < least
        least[nearer], along[nearer], side[nearer] = squared[nearer], share[nearer], index
    return side, along, np.sqrt(least)


def contains(boundary: Float[np.ndarray, "N 2"], points: Float[np.ndarray, "P 2"]) -> Bool[np.ndarray, "P"]:
    """Whether points lie inside a polygon: a ray from them to x = ∞ crosses it an odd number of times."""
    x, y = np.ascontiguousarray(points.T)
    inside = np.zeros(len(points), dtype=bool)
    for (x0, y0), (dx, dy) in zip(boundary, _sides(boundary), strict=True):
        if dy:
            inside ^= ((y0 > y) != (y0 + dy > y)) & (x < x0 + (y - y0) * dx / dy)
    return inside


def depth_inside(points: Float[np.ndarray, "P 2"], boundary: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "P"]:
    """Distance of points from a boundary, negative outside of it."""
    least = np.full(len(points), np.inf)
    for _, squared in _feet(points, boundary):
        np.minimum(least, squared, out=least)
    return np.where(contains(boundary, points), 1.0, -1.0) * np.sqrt(least)


def with_cut_sides(corners: Float[np.ndarray, "N 2"], longest: float) -> Float[np.ndarray, "M 2"]:
    """The same polygon with sides of equal pieces that are no longer."""
    sides = _sides(corners)
    counts = np.maximum(np.ceil(np.linalg.norm(sides, axis=1) / longest - 1e-9), 1).astype(int)
    parts = [
        corner + np.arange(count)[:, None] / count * side
        for corner, side, count in zip(corners, sides, counts, strict=True)
    ]
    return np.concatenate(parts)


def _feet(
    points: Float[np.ndarray, "P 2"], boundary: Float[np.ndarray, "N 2"]
) -> Iterator[tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P"]]]:
    """For each side, where on it the point nearest to each of the others is, and its squared distance."""
    x, y = np.ascontiguousarray(points.T)
    for (x0, y0), (dx, dy) in zip(boundary, _sides(boundary), strict=True):
        share = (((x - x0) * dx + (y - y0) * dy) / max(dx * dx + dy * dy, 1e-18)).clip(0, 1)
        yield share, (x - x0 - share * dx) ** 2 + (y - y0 - share * dy) ** 2


def _sides(boundary: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    return np.roll(boundary, -1, 0) - boundary
