"""The visual hull below the size of a pixel: where every silhouette, interpolated between pixels, allows the object.

A mask's half level is a curve that lies between pixels. The hull function at a point is its largest signed distance
over the views, outside these curves, in normalized units; its zero level is the hull. A view does not count for what it
doesn't show.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.rays import camera_rays, pose_of
from panoless.capture.silhouettes import MaskDistance, mask_distance
from panoless.capture.views import Views
from shinypartial.core.conventions import PIXEL_CENTER
from shinypartial.core.errors import InputError

COARSE_VOXELS = 48
"""Voxels along a side of the grid on which carving starts; it is halved until it is fine enough."""
BAND_VOXELS = 1.5
"""|h|, in voxels, below which the surface may pass through a voxel's refined cells: half its diagonal and some to
spare."""
TESTED_RAYS = 4000
"""Rays through silhouettes that determine whether the views agree."""
RAY_SAMPLES = 128
"""Points tested along each of them."""
LARGEST_GAP_PX = 10.0
"""A ray that passes the hull at more than this distance counts as one at this distance."""
WORTHWHILE_PX = 0.25
"""Views are left out as contradictory if that closes the rays' mean gap by more than this."""
CONTRADICTION_PX = 0.5
"""Where the median ray passes the hull at more than this, cameras are a little off."""
LEAST_VOTES = 0.6
"""The share of the views that has to agree at least where they are."""

HULL_HALF_SIDE = 1.1
"""Half the side of the cube in which the hull is carved, in normalized units, unless the object reaches further."""
SPARE = 1.1
"""Then the cube holds the object's reach with this factor to spare."""
POINTS_AT_ONCE = 1 << 18
FEWEST_VOXELS = 8
DEEPEST = 4.0
"""−h, in normalized units, where no view shows it: deeper inside than any point of the usual cube."""


@dataclass(frozen=True)
class Hull:
    """The hull function (normalized units, negative inside) on a cubic grid of points, axes x, y, z.

    Within a few voxels of its zero level it is exact; elsewhere it has the right sign and at least that size.
    `pixel` is the size of a training pixel at the object, `half_side` half a side of the cube.
    """

    distance: Float[np.ndarray, "N N N"]
    half_side: float
    pixel: float
    left_out: int = 0
    """How many views have no weight at a point, because they contradict the others."""

    @property
    def voxel(self) -> float:
        """Spacing of the grid."""
        return 2 * self.half_side / (len(self.distance) - 1)

    def sample(self, points: Float[np.ndarray, "P 3"]) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P 3"]]:
        """The function at points, interpolated, and its gradient by central differences over two voxels."""
        steps = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * self.voxel
        values = self.at(points[None] + steps[:, None])
        return values[0], (values[1:4] - values[4:]).T / (2 * self.voxel)

    def at(self, points: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P"]:
        """The function at points, interpolated; beyond the grid it is that of the border."""
        from scipy.ndimage import map_coordinates

        index = np.moveaxis((points + self.half_side) / self.voxel, -1, 0)
        return map_coordinates(self.distance, index, order=1, mode="nearest")


def largest_distances(
    silhouettes: Sequence[MaskDistance], points: Float[Tensor, "P 3"], count: int
) -> Float[Tensor, "count P"]:
    """The largest, second largest, … signed distance of each point over the views that count there."""
    blocks = []
    for block in points.split(POINTS_AT_ONCE):
        largest = torch.full((count, len(block)), -math.inf, device=points.device)
        for silhouette in silhouettes:
            value = silhouette.distances(block)
            for row in largest:
                lower = torch.minimum(row, value)
                torch.maximum(row, value, out=row)
                value = lower
        blocks.append(largest.clamp_(min=-DEEPEST))
    return torch.cat(blocks, 1)


def carve_hull(views: Views, resolution: int, votes: float) -> Hull:
    """Visual hull of as many views as agree, but at least the share `votes` of them, on about `resolution`³ points.

    Those are points of the usual cube; a larger one, for an object that reaches out of it, has the same spacing.

    Where m views may be wrong, the hull function is the (m + 1)-th largest distance, and the hull larger than that of
    all views. A wrong view cuts the hull away from the rays of the others; m is the least with which rays through the
    silhouettes come as near to the hull as with the greatest. Where even then most of them pass it by, because all
    cameras are a little off, m is the least with which half of them meet it; but for `votes` of 1, with which all views
    count. Raises InputError when nothing stays, which means masks and poses contradict each other.
    """
    silhouettes, half_side, pixel = _silhouettes_and_cube(views)
    resolution = math.ceil(resolution * half_side / HULL_HALF_SIDE)
    allowed = math.floor((1 - votes) * len(views.train))
    levels = max(0, round(math.log2(resolution / COARSE_VOXELS)))
    device = silhouettes[0].distance_px.device
    count = math.ceil((resolution - 1) / 2**levels) + 1
    points = _grid_points(np.arange(count**3), count, half_side, device)
    tested = _points_on_rays(silhouettes, half_side)

    def hulls(most: int) -> Iterator[Hull]:
        grids = largest_distances(silhouettes, points, most + 1).view(-1, count, count, count).cpu().numpy()
        return (Hull(grid, half_side, pixel) for grid in grids)

    wrong, hull = _least_wrong(list(hulls(allowed)), tested)
    most = math.floor((1 - min(votes, LEAST_VOTES)) * len(views.train)) if votes < 1 else allowed
    if most > allowed and _passed_by_px(hull, tested) > CONTRADICTION_PX:
        met = ((k, each) for k, each in enumerate(hulls(most)) if _passed_by_px(each, tested) <= 0)
        wrong, hull = next(met, (wrong, hull))
    distance = hull.distance
    for _ in range(levels):
        distance = _refine(distance, half_side, silhouettes, wrong)
    for axis in range(3):
        # A hull that leaves the cube is cut off there.
        border = np.moveaxis(distance, axis, 0)[[0, -1]]
        np.moveaxis(distance, axis, 0)[[0, -1]] = np.maximum(border, pixel)
    if (distance < 0).sum() < FEWEST_VOXELS:
        raise InputError(
            expected="masks and poses that agree on an object",
            found=f"no point in space that {votes:.0%} of the masks contain",
            remedy="Check the axes of transform_matrix (OpenGL), and that masks mark one object, not the background.",
        )
    return Hull(distance, half_side, pixel, wrong)


def contradiction_px(views: Views) -> float:
    """How far rays through all silhouettes pass by the hull of all views, in the median and in pixels; at least 0.

    Silhouettes of one thing that true cameras see touch the hull, whatever its shape. Those that err by themselves, and
    those of wrong cameras, carve it away from each other's rays: the median is about the standard deviation of what
    they err by. What all err by alike, as masks that are too large, contradicts nothing.
    """
    silhouettes, half_side, pixel = _silhouettes_and_cube(views)
    count = math.ceil(COARSE_VOXELS * half_side / HULL_HALF_SIDE)
    points = _grid_points(np.arange(count**3), count, half_side, silhouettes[0].distance_px.device)
    grid = largest_distances(silhouettes, points, 1)[0].view(count, count, count).cpu().numpy()
    hull = Hull(grid, half_side, pixel)
    return max(0.0, _passed_by_px(hull, _points_on_rays(silhouettes, half_side)))


def _silhouettes_and_cube(views: Views) -> tuple[list[MaskDistance], float, float]:
    """The silhouettes of all views, half a side of the cube that holds the object, and the size of a pixel there."""
    silhouettes = [mask_distance(view) for view in views.train]
    half_side = max(HULL_HALF_SIDE, SPARE * views.object_frame.reach)
    return silhouettes, half_side, float(np.median([silhouette.pixel for silhouette in silhouettes]))


def _grid_points(
    flat: Int[np.ndarray, "P"], count: int, half_side: float, device: torch.device
) -> Float[Tensor, "P 3"]:
    index = np.stack(np.unravel_index(flat, (count, count, count)), 1)
    points = index * (2 * half_side / (count - 1)) - half_side
    return torch.from_numpy(points.astype(np.float32)).to(device)


def _refine(
    distance: Float[np.ndarray, "N N N"],
    half_side: float,
    silhouettes: Sequence[MaskDistance],
    wrong: int,
) -> Float[np.ndarray, "M M M"]:
    """The hull function on a grid of half the spacing, evaluated where it is small and else interpolated."""
    count = 2 * distance.shape[0] - 1
    fine = distance
    for axis in range(3):
        first = np.moveaxis(fine, axis, 0)
        twice = np.empty((count, *first.shape[1:]), dtype=np.float32)
        twice[::2] = first
        twice[1::2] = (first[:-1] + first[1:]) / 2
        fine = np.moveaxis(twice, 0, axis)
    fine = np.ascontiguousarray(fine)
    # Signed distances are 1-Lipschitz, up to perspective, and so are their maxima.
    spacing = 2 * half_side / (distance.shape[0] - 1)
    near = np.nonzero(np.abs(fine.ravel()) < BAND_VOXELS * spacing)[0]
    points = _grid_points(near, count, half_side, silhouettes[0].distance_px.device)
    fine.ravel()[near] = largest_distances(silhouettes, points, wrong + 1)[wrong].cpu().numpy()
    return fine


def _least_wrong(hulls: Sequence[Hull], tested: Float[np.ndarray, "R S 3"]) -> tuple[int, Hull]:
    """How many views to leave out, and the hull of the others: the fewest with which silhouettes' rays touch it."""
    gaps = []
    for hull in hulls:
        nearest = hull.at(tested).min(1)
        gaps.append(float((nearest / hull.pixel).clip(0, LARGEST_GAP_PX).mean()) if len(nearest) else 0.0)
    return next((k, hulls[k]) for k, gap in enumerate(gaps) if gap <= gaps[-1] + WORTHWHILE_PX)


def _passed_by_px(hull: Hull, tested: Float[np.ndarray, "R S 3"]) -> float:
    """At which distance from the hull silhouettes' rays pass, in the median (px); less than 0 if they enter it."""
    return float(np.median(hull.at(tested).min(1))) / hull.pixel if len(tested) else 0.0


def _points_on_rays(silhouettes: Sequence[MaskDistance], half_side: float) -> Float[np.ndarray, "R S 3"]:
    """Points in the cube along the rays of pixels just inside the silhouettes."""
    points = []
    rays_a_view = max(1, TESTED_RAYS // len(silhouettes))
    for silhouette in silhouettes:
        camera, (rotation, center) = silhouette.camera, pose_of(silhouette.camera)
        distance = silhouette.distance_px.cpu().numpy()
        rows, columns = np.nonzero((distance < 0) & (distance > -1))
        chosen = np.linspace(0, len(rows) - 1, min(rays_a_view, len(rows))).round().astype(int)
        rays = camera_rays(camera, columns[chosen] + PIXEL_CENTER, rows[chosen] + PIXEL_CENTER) @ rotation
        reach = np.linalg.norm(center) + half_side * np.array([-1.0, 1.0]) * math.sqrt(3)
        depths = np.linspace(max(reach[0], camera.near), reach[1], RAY_SAMPLES)
        points.append(center + depths[:, None] * (rays / np.linalg.norm(rays, axis=1, keepdims=True))[:, None])
    return np.concatenate(points)
