"""Front-to-back blending: one program a tile, all of whose pixels walk the tile's list together."""

import math
from typing import Any, NamedTuple

import triton
import triton.language as tl

from panoless.splats.kernels import constants
from panoless.splats.kernels.gpu.records import (
    A0,
    A1,
    A2,
    B0,
    B1,
    B2,
    CENTER_X,
    CENTER_Y,
    COLOR,
    CURVED_U,
    CURVED_V,
    DEPTH,
    HIT_CENTER,
    LOG2_OPACITY,
    NORMAL,
    RECORD_SIZE,
    RHO_MAX,
)

LOW_PASS_PRECISION = tl.constexpr(1 / constants.LOW_PASS_SIGMA**2)
HALF_LOG2_E = tl.constexpr(0.5 * math.log2(math.e))
HIT_RATIO_MIN = tl.constexpr(constants.HIT_RATIO_MIN)
CAP = tl.constexpr(constants.ALPHA_MAX)
STOP = tl.constexpr(constants.TRANSMITTANCE_MIN)
MEDIAN = tl.constexpr(constants.MEDIAN_TRANSMITTANCE)
NONE = tl.constexpr(-1)


class Pixels(NamedTuple):
    """The pixels of a tile: centers, flat indices into a plane, and whether they lie in the image."""

    x: Any
    y: Any
    at: Any
    inside: Any


class Fragment(NamedTuple):
    """One surfel seen through the pixels of a tile; where a hit is not valid, `inverse_w` is 1."""

    dx: Any
    dy: Any
    w: Any
    inverse_w: Any
    u: Any
    v: Any
    by_hit: Any
    rho: Any
    uncapped: Any
    """Opacity times Gaussian, before it is capped at ALPHA_MAX."""


@triton.jit
def tile_pixels(tile, width, height, TILE: tl.constexpr):
    """The pixels of one tile, row by row."""
    tiles_across = (width + TILE - 1) // TILE
    pixel = tl.arange(0, TILE * TILE)
    column = (tile % tiles_across) * TILE + pixel % TILE
    row = (tile // tiles_across) * TILE + pixel // TILE
    inside = (column < width) & (row < height)
    return Pixels(column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5, row * width + column, inside)


@triton.jit
def load_triple(pointer):
    """Three consecutive numbers, the same for all pixels."""
    return tl.load(pointer), tl.load(pointer + 1), tl.load(pointer + 2)


@triton.jit
def intersect(record, x, y):
    """See one surfel through the pixels at (x, y): Huang et al. 2024, Eq. 10 and 11."""
    dx = x - tl.load(record + CENTER_X)
    dy = y - tl.load(record + CENTER_Y)
    w = tl.load(record + A2) * dx + (tl.load(record + B2) * dy + tl.load(record + HIT_CENTER))
    valid = w >= HIT_RATIO_MIN
    inverse_w = 1.0 / tl.where(valid, w, 1.0)
    u = (tl.load(record + A0) * dx + tl.load(record + B0) * dy) * inverse_w
    v = (tl.load(record + A1) * dx + tl.load(record + B1) * dy) * inverse_w
    rho_hit = u * u + v * v
    rho_low_pass = (dx * dx + dy * dy) * LOW_PASS_PRECISION
    by_hit = valid & (rho_hit <= rho_low_pass)
    rho = tl.where(by_hit, rho_hit, rho_low_pass)
    uncapped = tl.exp2(tl.load(record + LOG2_OPACITY) - rho * HALF_LOG2_E)
    return Fragment(dx, dy, w, inverse_w, u, v, by_hit, rho, uncapped)


@triton.jit
def first_depth(table, surfels, start, end):
    """Depth of the first surfel on a list, 1 if the list is empty: distances are measured from it, because the
    distortion A·M2 − M1² is a small difference of large numbers.
    """
    k = tl.load(surfels + start, mask=start < end, other=0)
    return tl.load(table + k * RECORD_SIZE + DEPTH, mask=start < end, other=1.0)


@triton.jit
def store_planes(pointer, at, plane_size, mask, triple):
    """Store one pixel each of three planes."""
    tl.store(pointer + at, triple[0], mask=mask)
    tl.store(pointer + plane_size + at, triple[1], mask=mask)
    tl.store(pointer + 2 * plane_size + at, triple[2], mask=mask)


@triton.jit(do_not_specialize=["width", "height"])
def blend(
    table,
    surfels,
    starts,
    colors,
    normals,
    depths,
    alphas,
    medians,
    distortions,
    saved,
    saved_places,
    width,
    height,
    distance,
    CURVED: tl.constexpr,
    TILE: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """Write all images of one tile, and what its backward needs: final transmittance and the distance's moments in
    `saved`, places in the list of the last and of the median fragment in `saved_places`.
    """
    tile = tl.program_id(0)
    pixels = tile_pixels(tile, width, height, TILE)
    at, inside = pixels.at, pixels.inside
    start, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    reference = distance / first_depth(table, surfels, start, end)
    zero = tl.zeros([TILE * TILE], tl.float32)
    nowhere = tl.full([TILE * TILE], NONE, tl.int32)
    alive, transmittance = inside, zero + 1.0
    red, green, blue = zero, zero, zero
    normal_x, normal_y, normal_z = zero, zero, zero
    depth_sum, m1, m2, median = zero, zero, zero, zero
    last, median_place = nowhere, nowhere
    chunk = start
    going = start < end
    while going:
        chunk_end = tl.minimum(chunk + CHUNK, end)
        for place in range(chunk, chunk_end):
            record = table + tl.load(surfels + place) * RECORD_SIZE
            fragment = intersect(record, pixels.x, pixels.y)
            by_hit = fragment.by_hit
            alpha = tl.minimum(fragment.uncapped, CAP)
            after = transmittance - transmittance * alpha
            reached = alive & (fragment.rho <= tl.load(record + RHO_MAX))
            alive = alive & ((reached == 0) | (after >= STOP))
            covered = reached & (after >= STOP)
            weight = tl.where(covered, alpha * transmittance, 0.0)
            center_depth = tl.load(record + DEPTH)
            z = center_depth * tl.where(by_hit, fragment.inverse_w, 1.0)
            m = reference - distance / center_depth * tl.where(by_hit, fragment.w, 1.0)
            color, normal = load_triple(record + COLOR), load_triple(record + NORMAL)
            red += weight * color[0]
            green += weight * color[1]
            blue += weight * color[2]
            normal_x += weight * normal[0]
            normal_y += weight * normal[1]
            normal_z += weight * normal[2]
            if CURVED:
                turn_u, turn_v = load_triple(record + CURVED_U), load_triple(record + CURVED_V)
                along_u = tl.where(by_hit, weight * fragment.u, 0.0)
                along_v = tl.where(by_hit, weight * fragment.v, 0.0)
                normal_x += along_u * turn_u[0] + along_v * turn_v[0]
                normal_y += along_u * turn_u[1] + along_v * turn_v[1]
                normal_z += along_u * turn_u[2] + along_v * turn_v[2]
            depth_sum += weight * z
            m1 += weight * m
            m2 += weight * m * m
            in_front_half = covered & (transmittance > MEDIAN)
            median = tl.where(in_front_half, z, median)
            median_place = tl.where(in_front_half, place, median_place)
            last = tl.where(covered, place, last)
            transmittance = tl.where(covered, after, transmittance)
        chunk = chunk_end
        going = (chunk < end) & (tl.max(alive.to(tl.int32), axis=0) > 0)
    plane_size = width * height
    opaque = 1.0 - transmittance
    store_planes(colors, at, plane_size, inside, (red, green, blue))
    store_planes(normals, at, plane_size, inside, (normal_x, normal_y, normal_z))
    tl.store(depths + at, depth_sum, mask=inside)
    tl.store(alphas + at, opaque, mask=inside)
    tl.store(medians + at, median, mask=inside)
    tl.store(distortions + at, tl.maximum(opaque * m2 - m1 * m1, 0.0), mask=inside)
    store_planes(saved, at, plane_size, inside, (transmittance, m1, m2))
    tl.store(saved_places + at, last, mask=inside)
    tl.store(saved_places + plane_size + at, median_place, mask=inside)
