"""The visual hull below the size of a pixel: where every outline, interpolated between mask pixels, allows the object.

A mask's half level is a curve that lies between pixels. The hull function at a point is its largest signed distance
over the views, outside these curves, in scene units; its zero level is the hull.
"""

import math
from collections.abc import Sequence
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

HULL_HALF_SIDE = 1.1
#: The grid is refined from about this many voxels a side, where the surface may be.
COARSE_RESOLUTION = 48
#: |h| of a voxel through whose refined cells the surface may pass: its half diagonal with something to spare.
BAND_VOXELS = 1.5
POINTS_AT_ONCE = 1 << 18
#: Rays through outlines tell whether the views agree, by how far from the hull they pass on average (up to a limit).
#: Leaving out views is worth it when it closes gaps by more than a quarter of a pixel.
TESTED_RAYS = 4000
STEPS_ALONG_RAY = 128
LARGEST_GAP_PX = 10.0
WORTHWHILE_PX = 0.25
FEWEST_VOXELS = 8


@dataclass(frozen=True)
class Hull:
    """The hull function (normalized units, negative inside) on a cubic grid of points, axes x, y, z.

    Within a few voxels of its zero level it is exact; elsewhere it has the right sign and at least that size.
    `pixel` is the size of a training pixel at the object.
    """

    distance: Float[np.ndarray, "N N N"]
    voxel: float
    pixel: float

    def sample(self, points: Float[np.ndarray, "P 3"]) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P 3"]]:
        """The function at points, interpolated, and its gradient by central differences over two voxels."""
        steps = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * self.voxel
        values = self.at(points[None] + steps[:, None])
        return values[0], (values[1:4] - values[4:]).T / (2 * self.voxel)

    def at(self, points: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P"]:
        """The function at points, interpolated; beyond the grid it is that of the border."""
        from scipy.ndimage import map_coordinates

        index = np.moveaxis((points + HULL_HALF_SIDE) / self.voxel, -1, 0)
        return map_coordinates(self.distance, index, order=1, mode="nearest")


def largest_distances(
    outlines: Sequence[MaskDistance], points: Float[Tensor, "P 3"], count: int
) -> Float[Tensor, "count P"]:
    """The largest, second largest, … signed distance of each point over the views."""
    blocks = []
    for block in points.split(POINTS_AT_ONCE):
        largest = torch.full((count, len(block)), -math.inf, device=points.device)
        for outline in outlines:
            value = outline.distances(block)
            for row in largest:
                lower = torch.minimum(row, value)
                torch.maximum(row, value, out=row)
                value = lower
        blocks.append(largest)
    return torch.cat(blocks, 1)


def carve_hull(views: Views, resolution: int, votes: float) -> Hull:
    """Visual hull of as many views as agree, but at least the share `votes` of them, on about `resolution`³ points.

    Where m views may be wrong, the hull function is the (m + 1)-th largest distance, and the hull larger than that of
    all views. A wrong view cuts the hull away from the rays of the others; m is the least with which rays through the
    outlines come as near to the hull as with the greatest. Raises InputError when nothing stays, which means masks
    and poses contradict each other.
    """
    outlines = [mask_distance(view) for view in views.train]
    pixel = float(np.median([outline.pixel for outline in outlines]))
    allowed = math.floor((1 - votes) * len(views.train))
    levels = max(0, round(math.log2(resolution / COARSE_RESOLUTION)))
    device = outlines[0].distance_px.device
    count = math.ceil((resolution - 1) / 2**levels) + 1
    candidates = largest_distances(outlines, _grid_points(np.arange(count**3), count, device), allowed + 1)
    grids = candidates.view(-1, count, count, count).cpu().numpy()
    wrong = _wrong_views(grids, outlines, pixel)
    distance = grids[wrong]
    for _ in range(levels):
        distance = _refine(distance, outlines, wrong, device)
    for axis in range(3):
        # A hull that leaves the cube is cut off there.
        border = np.moveaxis(distance, axis, 0)[[0, -1]]
        np.moveaxis(distance, axis, 0)[[0, -1]] = np.maximum(border, pixel)
    if (distance < 0).sum() < FEWEST_VOXELS:
        raise InputError(
            expected="masks and poses that agree on an object",
            found=f"no point in space that {votes:.0%} of the masks contain",
            remedy="Check the axes of transform_matrix (OpenGL) and that masks mark the object, not the background.",
        )
    return Hull(distance, 2 * HULL_HALF_SIDE / (distance.shape[0] - 1), pixel)


def _grid_points(flat: Int[np.ndarray, "P"], count: int, device: torch.device) -> Float[Tensor, "P 3"]:
    index = np.stack(np.unravel_index(flat, (count, count, count)), 1)
    points = index * (2 * HULL_HALF_SIDE / (count - 1)) - HULL_HALF_SIDE
    return torch.from_numpy(points.astype(np.float32)).to(device)


def _refine(
    distance: Float[np.ndarray, "N N N"], outlines: Sequence[MaskDistance], wrong: int, device: torch.device
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
    spacing = 2 * HULL_HALF_SIDE / (distance.shape[0] - 1)
    near = np.nonzero(np.abs(fine.ravel()) < BAND_VOXELS * spacing)[0]
    points = _grid_points(near, count, device)
    fine.ravel()[near] = largest_distances(outlines, points, wrong + 1)[wrong].cpu().numpy()
    return fine


def _wrong_views(grids: Float[np.ndarray, "K N N N"], outlines: Sequence[MaskDistance], pixel: float) -> int:
    """How many of the largest distances to leave out: the fewest with which rays through outlines touch the hull."""
    from scipy.ndimage import map_coordinates

    count = grids.shape[1]
    spacing = 2 * HULL_HALF_SIDE / (count - 1)
    points = _points_on_rays(outlines)
    index = ((points + HULL_HALF_SIDE) / spacing).reshape(-1, 3).T
    gaps = []
    for grid in grids:
        nearest = map_coordinates(grid, index, order=1, mode="nearest").reshape(points.shape[:2]).min(1)
        gaps.append(float((nearest / pixel).clip(0, LARGEST_GAP_PX).mean()) if len(nearest) else 0.0)
    return next(k for k, gap in enumerate(gaps) if gap <= gaps[-1] + WORTHWHILE_PX)


def _points_on_rays(outlines: Sequence[MaskDistance]) -> Float[np.ndarray, "R S 3"]:
    """Points in the cube along the rays of pixels just inside the outlines."""
    points = []
    each = max(1, TESTED_RAYS // len(outlines))
    for outline in outlines:
        camera, (rotation, center) = outline.camera, pose_of(outline.camera)
        distance = outline.distance_px.cpu().numpy()
        rows, columns = np.nonzero((distance < 0) & (distance > -1))
        chosen = np.linspace(0, len(rows) - 1, min(each, len(rows))).round().astype(int)
        rays = camera_rays(camera, columns[chosen] + PIXEL_CENTER, rows[chosen] + PIXEL_CENTER) @ rotation
        reach = np.linalg.norm(center) + HULL_HALF_SIDE * np.array([-1.0, 1.0]) * math.sqrt(3)
        depths = np.linspace(max(reach[0], camera.near), reach[1], STEPS_ALONG_RAY)
        points.append(center + depths[:, None] * (rays / np.linalg.norm(rays, axis=1, keepdims=True))[:, None])
    return np.concatenate(points)
