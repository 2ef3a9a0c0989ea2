"""Light of a far world that smooth mirrors collect over whole pixels, from the paths through a grid of points in each.

Around every point the direction is continued to second order, ω(a, b) = ω + a ω_x + b ω_y + ½ a² ω_xx + ½ b² ω_yy over
the sub-pixel a, b ∈ [−½, ½], with finite differences along rows and columns. There the lat-long map is averaged over
evenly spaced directions at most a texel apart, or half of one near lamps. So a lamp smaller than a pixel's footprint is
neither missed nor counted for more than its share. A pixel is smooth where the continuations of neighboring points meet
and footprints are small enough for this to pay; no other pixel gets any light here.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from shinypartial.blender.directions import GRID, MirrorPaths

#: Turn between neighboring paths (rad) above which a surface isn't smooth.
LARGEST_TURN = 0.2
#: Texels by which the continuations of neighboring points may miss each other halfway.
LARGEST_GAP = 0.25
#: Texels that a sub-pixel may span; beyond, path tracing costs no more.
MOST_TEXELS = 4
#: Difference between a texel and those beside it that makes a lamp.
LAMP_CONTRAST = 2.0
#: Rows of pixels that are worked on at a time, which bounds memory.
BAND = 32


@dataclass(frozen=True)
class SmoothLight:
    """Mean radiance of every pixel that is `smooth`, zero in the others."""

    radiance: Float[np.ndarray, "H W 3"]
    smooth: Bool[np.ndarray, "H W"]


class FarWorld:
    """A lat-long map made ready for many bilinear lookups."""

    def __init__(self, latlong: Float[np.ndarray, "H W 3"]) -> None:
        self.height, self.width = latlong.shape[:2]
        around = np.pad(latlong, ((0, 0), (1, 1), (0, 0)), mode="wrap")
        padded = np.pad(around, ((1, 1), (0, 0), (0, 0)), mode="edge")
        self._channels = np.ascontiguousarray(np.moveaxis(padded, -1, 0), np.float32)
        self._lamps = _lamps(padded)

    def __call__(self, directions: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """As `sphere.sample_latlong`, in single precision, several times as fast."""
        from scipy.ndimage import map_coordinates

        place = self._place(directions)
        return np.stack([map_coordinates(each, place, order=1, prefilter=False) for each in self._channels], -1)

    def count(self, directions: Float[np.ndarray, "P 3"], texels: Float[np.ndarray, "P"]) -> Int[np.ndarray, "P"]:
        """How many directions to take per axis of footprints of that many texels around the given ones."""
        row, column = np.rint(self._place(directions)).astype(int)
        return np.maximum(np.ceil(np.where(self._lamps[row, column], 2, 1) * texels), 1).astype(int)

    def texels(self, directions: Float[np.ndarray, "P 3"], turn: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
        """How many texels a small turn (rad) spans at most; near the poles they are narrow."""
        narrow = np.hypot(directions[:, 0], directions[:, 1])
        return turn * np.float32(self.height / np.pi) / np.maximum(narrow, 1 / MOST_TEXELS)

    def _place(self, directions: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "2 P"]:
        """Rows and columns of the padded map."""
        x, y, z = directions.T
        column = (0.5 - np.arctan2(y, x) / np.float32(2 * np.pi)) * self.width + 0.5
        row = np.arctan2(np.hypot(x, y), z) * np.float32(self.height / np.pi) + 0.5
        return np.stack([row, column])


def _lamps(latlong: Float[np.ndarray, "H W 3"]) -> Bool[np.ndarray, "H W"]:
    """Where half of the largest footprint away light changes by more than directions a texel apart average safely."""
    from scipy.ndimage import maximum_filter, minimum_filter

    beside = (3, 3, 1)
    contrast = (maximum_filter(latlong, beside) - minimum_filter(latlong, beside)).max(-1)
    return maximum_filter(contrast > LAMP_CONTRAST, MOST_TEXELS + 1)


def smooth_light(world: FarWorld, paths: MirrorPaths, threads: int = 1) -> SmoothLight:
    """Find the pixels whose every point continues smoothly to its neighbors, and average the world over them."""
    height, width = (length // GRID for length in paths.bounces.shape)
    result = SmoothLight(np.zeros((height, width, 3), np.float32), np.zeros((height, width), bool))

    def fill(top: int) -> None:
        _fill_band(world, paths, result, slice(top, min(top + BAND, height)))

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(fill, range(0, height, BAND)))
    return result


@dataclass(frozen=True)
class _Continued:
    """Differences along one axis; zero where a point isn't `smooth`. `gap` (rad) is the larger of those beside it."""

    first: Float[np.ndarray, "h w 3"]
    second: Float[np.ndarray, "h w 3"]
    smooth: Bool[np.ndarray, "h w"]
    gap: Float[np.ndarray, "h w"]


def _fill_band(world: FarWorld, paths: MirrorPaths, result: SmoothLight, rows: slice) -> None:
    """Write some rows of pixels; two points beyond their outermost ones are looked at as well."""
    top, bottom = GRID * rows.start, GRID * rows.stop
    halo = slice(max(top - 2, 0), bottom + 2)
    inner = slice(top - halo.start, top - halo.start + bottom - top)
    bounces, directions = paths.bounces[halo], paths.directions_world[halo]
    along_y = _continued(bounces, directions, 0)
    along_x = _continued(bounces, directions, 1)
    turn = np.sqrt(np.maximum((along_x.first**2).sum(-1), (along_y.first**2).sum(-1)))[inner]
    gap = np.maximum(along_x.gap, along_y.gap)[inner]
    needed, missing = (
        world.texels(directions[inner].reshape(-1, 3), angle.ravel()).reshape(turn.shape) for angle in (turn, gap)
    )
    safe = (along_x.smooth & along_y.smooth)[inner] & (missing <= LARGEST_GAP) & (needed <= MOST_TEXELS)
    smooth = _whole_pixels(safe)
    chosen = np.repeat(np.repeat(smooth, GRID, 0), GRID, 1)
    radiance = np.zeros((*turn.shape, 3), np.float32)
    count = world.count(directions[inner][chosen], needed[chosen])
    terms = [each[inner][chosen] for each in (directions, along_x.first, along_y.first, along_x.second, along_y.second)]
    radiance[chosen] = _averages(world, np.stack(terms), count)
    high, wide = smooth.shape
    result.radiance[rows] = radiance.reshape(high, GRID, wide, GRID, 3).mean((1, 3))
    result.smooth[rows] = smooth


def _averages(
    world: FarWorld, terms: Float[np.ndarray, "5 P 3"], count: Int[np.ndarray, "P"]
) -> Float[np.ndarray, "P 3"]:
    """The mean over count × count directions of each sub-pixel; terms are ω, ω_x, ω_y, ω_xx, ω_yy."""
    result = np.zeros(terms.shape[1:], np.float32)
    for each in np.unique(count):
        of_that_count = count == each
        center, x, y, xx, yy = terms[:, of_that_count]
        offsets = ((np.arange(each) + 0.5) / each - 0.5).astype(np.float32)
        total = np.zeros_like(center)
        for b in offsets:
            in_row = center + b * y + b * b / 2 * yy
            for a in offsets:
                total += world(in_row + a * x + a * a / 2 * xx)
        result[of_that_count] = total / np.float32(each**2)
    return result


def _continued(bounces: Int[np.ndarray, "h w"], directions: Float[np.ndarray, "h w 3"], axis: int) -> _Continued:
    """Central differences at the points whose neighbors on both sides had as many bounces and turn little."""
    directions, bounces = np.moveaxis(directions, axis, 0), np.moveaxis(bounces, axis, 0)
    step = directions[1:] - directions[:-1]
    safe = (bounces[1:] == bounces[:-1]) & (bounces[1:] > 0) & ((step**2).sum(-1) < LARGEST_TURN**2)
    smooth = np.zeros(bounces.shape, bool)
    smooth[1:-1] = safe[1:] & safe[:-1]
    first, second = np.zeros_like(directions), np.zeros_like(directions)
    inside = smooth[1:-1, ..., None]
    first[1:-1] = np.where(inside, (step[1:] + step[:-1]) / 2, 0)
    second[1:-1] = np.where(inside, step[1:] - step[:-1], 0)
    # Forward from one point and backward from the next: ω + ω'/2 + ω''/8 against ω − ω'/2 + ω''/8.
    missed = step - (first[1:] + first[:-1]) / 2 + (second[1:] - second[:-1]) / 8
    between = np.where(smooth[1:] & smooth[:-1], np.sqrt((missed**2).sum(-1)), 0)
    gap = np.zeros(bounces.shape, np.float32)
    gap[1:-1] = np.maximum(between[1:], between[:-1])
    back = [np.moveaxis(each, 0, axis) for each in (first, second, smooth, gap)]
    return _Continued(*back)


def _whole_pixels(points: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "H W"]:
    """Where all points of a pixel are set."""
    height, width = (length // GRID for length in points.shape)
    return points.reshape(height, GRID, width, GRID).all((1, 3))
