"""How many surfel–pixel pairs the rasterizer evaluates, and how many of them contribute, with and without culling."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from panoless.kernels.camera import RasterCamera
from panoless.kernels.cpu.compilation import LANE_CODE
from panoless.kernels.cpu.simd import (
    LANES,
    any_lane,
    lane_columns,
    lane_count,
    lane_rows,
    lanes,
    minimum,
    where,
)
from panoless.kernels.cpu.simd_memory import load_lanes
from panoless.splats.kernels.cpu import rasterize as cpu
from panoless.splats.kernels.cpu import records as rec
from panoless.splats.kernels.cpu.blend import (
    CAP,
    CHUNK,
    FRAGMENT_ALPHA,
    FRAGMENT_SIZE,
    STOP,
    find_fragment,
    touched_blocks,
)


@dataclass(frozen=True)
class LaneCounts:
    """Pairs of one image. What is evaluated stops where all pixels of a block are finished."""

    contributing: int
    evaluated: int
    evaluated_without_culling: int

    @property
    def share(self) -> float:
        """Of the evaluated lanes, those that contribute."""
        return self.contributing / max(self.evaluated, 1)

    @property
    def share_without_culling(self) -> float:
        """The same if every block looked at every surfel of its tile."""
        return self.contributing / max(self.evaluated_without_culling, 1)


def count_lanes(parameters: tuple, camera: RasterCamera) -> LaneCounts:
    """Count for means, quats, scales, opacities, colors and curvatures (or None), seen by one camera."""
    surfels = cpu._as_arrays((*parameters, None))
    width, height = camera.width, camera.height
    curved = parameters[5] is not None
    footprints = cpu._find_footprints(surfels, cpu._camera_array(camera), width, height, curved, None)
    counts = []
    for culled in (True, False):
        found = np.zeros(2, np.int64)
        scratch = np.empty((CHUNK * FRAGMENT_SIZE, LANES), np.float32)
        _count(footprints.table, footprints.bins, width, height, culled, scratch, found)
        counts.append(found)
    return LaneCounts(int(counts[0][1]), LANES * int(counts[0][0]), LANES * int(counts[1][0]))


@njit(**LANE_CODE)
def _count(table, bins, width, height, culled, scratch, counts):
    """Walk as `blend` does; counts[0] are evaluated vectors, counts[1] contributing lanes."""
    tile_starts, entry_surfels = bins
    across = (width + rec.TILE - 1) // rec.TILE
    for tile in range(tile_starts.size - 1):
        left, top = (tile % across) * rec.TILE, (tile // across) * rec.TILE
        for block in range(LANES):
            x, y = left + rec.BLOCK * (block % rec.BLOCK), top + rec.BLOCK * (block // rec.BLOCK)
            column, row = lane_columns() + np.float32(x), lane_rows() + np.float32(y)
            alive = (column < np.float32(width)) & (row < np.float32(height))
            transmittance = lanes(1.0)
            for entry in range(tile_starts[tile], tile_starts[tile + 1]):
                if not any_lane(alive):
                    break
                k = entry_surfels[entry]
                bits = touched_blocks(table, k, np.float32(left + 0.5), np.float32(top + 0.5))
                if culled and not (bits >> block) & 1:
                    continue
                find_fragment(table, k, column + 0.5, row + 0.5, scratch, 0)
                alpha = load_lanes(scratch, FRAGMENT_ALPHA * LANES)
                covered = (alpha > 0.0) & alive
                after = transmittance - transmittance * minimum(alpha, lanes(CAP))
                ending = covered & (after < STOP)
                alive &= ~ending
                covered &= ~ending
                counts[0] += 1
                counts[1] += lane_count(covered)
                transmittance = where(covered, after, transmittance)
