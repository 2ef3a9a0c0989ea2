"""A planar mirror: one plane with an outline, and what a camera sees of it.

A surface of one normal needs neither surfels nor blending: coverage and depth are exact.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.kernels.rasterize import RasterCamera
from panoless.shading import SurfaceBuffers
from panoless.views import pose_of
from shinypartial.conventions import PIXEL_CENTER

LEAST_ALPHA = 1e-6
"""Coverage below this is rounding."""


@dataclass(frozen=True)
class Plane:
    """A one-sided mirror: x = d n + p₁ t_u + p₂ t_v in the normalized frame with (p₁, p₂) inside the outline.

    The normal n = t_u × t_v is unit and faces the cameras; d is the offset, n·x = d. The outline is one closed polygon
    without holes, convex or not, counterclockwise for who looks at the mirror; its last vertex is joined to its first.
    """

    normal: Float[np.ndarray, "3"]
    offset: float
    tangent_u: Float[np.ndarray, "3"]
    tangent_v: Float[np.ndarray, "3"]
    outline: Float[np.ndarray, "N 2"]
    rim_height: float = 0.0
    """How far the frame stands out in front of the mirror: it hides what the outline, moved by this along the normal,
    does not let through. Zero: no frame, or a flat one.
    """

    @property
    def numbers(self) -> int:
        """How many numbers it is made of: normal and offset; the outline's vertices; the rim."""
        return 3 + self.outline.size + (self.rim_height > 0)

    def points(self, coordinates: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 3"]:
        """Plane coordinates to points in space."""
        return self.offset * self.normal + coordinates @ np.stack([self.tangent_u, self.tangent_v])


def plane_buffers(plane: Plane, camera: RasterCamera) -> SurfaceBuffers:
    """The plane as surfels would be seen: alpha is the covered area of each pixel, depths are those of its center.

    Normals are alpha times the plane's normal in camera axes; the three depths agree, and where a pixel's center lies
    beside the plane they stay within the depths of the outline. All is zero where alpha is, and everywhere for a camera
    behind the mirror. `in_frustum` has one element. With a rim, alpha is the smaller of the coverages of the outline
    and of the rim, which is exact but for pixels that both outlines cut.
    """
    rotation, center = pose_of(camera)
    height_above = float(plane.normal @ center) - plane.offset
    if height_above <= 0:
        nothing = np.zeros((camera.height, camera.width))
        return _buffers(nothing, nothing, np.zeros(3), camera)
    corners = (plane.points(plane.outline) - center) @ rotation.T
    normal = rotation @ plane.normal
    alpha = projected_coverage(corners, camera)
    if 0 < plane.rim_height < height_above:
        alpha = np.minimum(alpha, projected_coverage(corners + plane.rim_height * normal, camera))
    x = (np.arange(camera.width) + PIXEL_CENTER - camera.cx) / camera.fx
    y = (np.arange(camera.height) + PIXEL_CENTER - camera.cy) / camera.fy
    slope = -(normal[0] * x + (normal[1] * y + normal[2])[:, None])
    nearest, farthest = max(corners[:, 2].min(), camera.near), max(corners[:, 2].max(), camera.near)
    depth = np.where(slope > 0, height_above / np.maximum(slope, 1e-12), farthest).clip(nearest, farthest)
    return _buffers(alpha, depth * (alpha > 0), normal, camera)


def unobstructed(plane: Plane, camera: RasterCamera) -> Float[Tensor, "H W"]:
    """Share of each pixel that sees the environment in the mirror, not the frame from within; 1 beside the mirror.

    A reflected ray passes the rim where the straight ray behind the mirror passes the rim's mirror image, which is the
    outline moved by the rim's height against the normal. Without a rim it is 1 everywhere.
    """
    rotation, center = pose_of(camera)
    if plane.rim_height <= 0 or plane.normal @ center <= plane.offset:
        return camera.world_to_camera.new_ones(camera.height, camera.width)
    outline = (plane.points(plane.outline) - center) @ rotation.T
    image = projected_coverage(outline - plane.rim_height * (rotation @ plane.normal), camera)
    return _tensor(np.where(projected_coverage(outline, camera) > 0, image, 1.0), camera)


def _buffers(
    alpha: Float[np.ndarray, "H W"],
    depth: Float[np.ndarray, "H W"],
    normal_camera: Float[np.ndarray, "3"],
    camera: RasterCamera,
) -> SurfaceBuffers:
    covered, distance = _tensor(alpha, camera), _tensor(depth, camera)
    return SurfaceBuffers(
        albedo=covered.new_zeros(3, *covered.shape),
        alpha=covered,
        raster_normals_camera=_tensor(normal_camera, camera)[:, None, None] * covered,
        expected_depth=distance,
        median_depth=distance,
        surface_depth=distance,
        distortion=torch.zeros_like(covered),
        in_frustum=(covered > 0).any()[None],
    )


def _tensor(values: Float[np.ndarray, "*S"], camera: RasterCamera) -> Float[Tensor, "*S"]:
    """In float32, on the device of a camera."""
    return torch.from_numpy(values).float().to(camera.world_to_camera.device)


def projected_coverage(corners_camera: Float[np.ndarray, "N 3"], camera: RasterCamera) -> Float[np.ndarray, "H W"]:
    """Coverage of the part of a flat polygon that lies beyond the near plane."""
    kept = _beyond(corners_camera, camera.near)
    pixels = kept[:, :2] / kept[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return polygon_coverage(pixels, camera.width, camera.height)


def _beyond(corners: Float[np.ndarray, "N 3"], near: float) -> Float[np.ndarray, "M 3"]:
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
        starts, ends = _cut(starts, ends, axis, limit)
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


def _cut(
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
