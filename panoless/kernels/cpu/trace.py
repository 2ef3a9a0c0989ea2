"""Depth maps fused into a signed-distance grid, and rays marched through it."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from panoless.kernels.cpu.compilation import VECTORIZED_LOOPS
from panoless.kernels.cpu.simd_memory import fetch_add

f32 = np.float32
RAYS_PER_CLAIM = 4096
MOST_STEPS = 400
SHORTEST_STEP = f32(0.3)
#: A grid's distance is not exactly that of a surface, so a step takes less than all of it.
CAUTION = f32(0.9)
LIFT = f32(1)
"""Voxels by which a ray starts above the surface, so that it doesn't meet the surface that it leaves."""
LIFT_FADES_OVER = f32(24)
LEAST_COSINE = f32(0.05)


class Picture(NamedTuple):
    """What a camera sees: 0 depth where there is no surface; normals unit, in camera axes, facing the camera."""

    depth: Any
    normals: Any
    """H × W × 3."""
    world_to_camera: Any
    intrinsics: Any
    """fx, fy, cx, cy."""


class Tally(NamedTuple):
    """Sums over the views for each voxel: of weights, weighted distances and normals near a surface; of views that see
    it empty.
    """

    weight: Any
    distance: Any
    normal: Any
    empty: Any
    near: Any
    """Views that see a surface near it."""


@njit(**VECTORIZED_LOOPS)
def tally_view(counter, picture, half_side, voxel, band, tally):
    """Add one view to the sums. Lengths in scene units; normals are turned into the world."""
    resolution = tally.weight.shape[0]
    m = picture.world_to_camera
    fx, fy, cx, cy = picture.intrinsics
    height, width = picture.depth.shape
    while True:
        i = fetch_add(counter, 1)
        if i >= resolution:
            return
        x = f32(i) * voxel - half_side
        for j in range(resolution):
            y = f32(j) * voxel - half_side
            for k in range(resolution):
                z = f32(k) * voxel - half_side
                pz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                if pz <= f32(0):
                    continue
                px = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
                py = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
                column, row = int(np.floor(px / pz * fx + cx)), int(np.floor(py / pz * fy + cy))
                if column < 0 or row < 0 or column >= width or row >= height or picture.depth[row, column] == f32(0):
                    tally.empty[i, j, k] += 1
                    continue
                depth = picture.depth[row, column]
                if depth - pz > band:
                    tally.empty[i, j, k] += 1
                    continue
                if pz - depth > band:
                    continue
                nx, ny, nz = picture.normals[row, column]
                ray_x, ray_y = (f32(column) + f32(0.5) - cx) / fx, (f32(row) + f32(0.5) - cy) / fy
                to_plane = nx * (px - ray_x * depth) + ny * (py - ray_y * depth) + nz * (pz - depth)
                cosine = -(nx * ray_x + ny * ray_y + nz) / np.sqrt(ray_x * ray_x + ray_y * ray_y + f32(1))
                weight = max(cosine, LEAST_COSINE)
                weight *= weight
                tally.near[i, j, k] += 1
                tally.weight[i, j, k] += weight
                tally.distance[i, j, k] += weight * min(max(to_plane, -band), band)
                for axis in range(3):
                    turned = m[0, axis] * nx + m[1, axis] * ny + m[2, axis] * nz
                    tally.normal[i, j, k, axis] += weight * turned


@njit(**VECTORIZED_LOOPS)
def _distance_at(grid, x, y, z):
    """Trilinear value at voxel coordinates inside the grid."""
    i, j, k = int(x), int(y), int(z)
    u, v, w = x - f32(i), y - f32(j), z - f32(k)
    low = (grid[i, j, k] * (f32(1) - w) + grid[i, j, k + 1] * w) * (f32(1) - v) + (
        grid[i, j + 1, k] * (f32(1) - w) + grid[i, j + 1, k + 1] * w
    ) * v
    high = (grid[i + 1, j, k] * (f32(1) - w) + grid[i + 1, j, k + 1] * w) * (f32(1) - v) + (
        grid[i + 1, j + 1, k] * (f32(1) - w) + grid[i + 1, j + 1, k + 1] * w
    ) * v
    return low * (f32(1) - u) + high * u


@njit(**VECTORIZED_LOOPS)
def march(counter, grid, origins, normals, directions, lengths):
    """Length along each ray, in voxels, to where the distance turns negative; infinite for rays that leave the grid.

    Origins in voxel coordinates. The lift along the normal fades, so that far hits lie on the ray itself.
    """
    last = f32(grid.shape[0] - 1) - f32(1e-3)
    count = len(origins)
    while True:
        begin = fetch_add(counter, 1) * RAYS_PER_CLAIM
        if begin >= count:
            return
        for r in range(begin, min(begin + RAYS_PER_CLAIM, count)):
            lengths[r] = np.inf
            length, before, length_before = f32(0), LIFT, f32(0)
            for _ in range(MOST_STEPS):
                lift = LIFT * max(f32(0), f32(1) - length / LIFT_FADES_OVER)
                x = origins[r, 0] + length * directions[r, 0] + lift * normals[r, 0]
                y = origins[r, 1] + length * directions[r, 1] + lift * normals[r, 1]
                z = origins[r, 2] + length * directions[r, 2] + lift * normals[r, 2]
                # Written so that a ray that is not a number leaves, too.
                if not (x >= 0 and y >= 0 and z >= 0 and x < last and y < last and z < last):
                    break
                distance = _distance_at(grid, x, y, z)
                if distance < f32(0):
                    share = before / max(before - distance, f32(1e-6))
                    lengths[r] = length_before + share * (length - length_before)
                    break
                before, length_before = distance, length
                length += max(CAUTION * distance, SHORTEST_STEP)
