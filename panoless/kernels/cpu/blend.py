"""Front-to-back blending of tiles: each 4×4 block of pixels is one vector whose state stays in registers while its
surfels pass.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from panoless.kernels.constants import (
    ALPHA_MAX,
    HIT_RATIO_MIN,
    LOW_PASS_SIGMA,
    MEDIAN_TRANSMITTANCE,
    TRANSMITTANCE_MIN,
)
from panoless.kernels.cpu import records as rec
from panoless.kernels.cpu.simd import (
    LANES,
    any_lane,
    exp2,
    lane_columns,
    lane_rows,
    lanes,
    lowest_bit,
    mask_bits,
    maximum,
    minimum,
    where,
)
from panoless.kernels.cpu.simd_memory import fetch_add, store_block, store_lanes

LOW_PASS_PRECISION = np.float32(1 / LOW_PASS_SIGMA**2)
HALF_LOG2_E = np.float32(0.5 * np.log2(np.e))
HIT_MIN = np.float32(HIT_RATIO_MIN)
CAP = np.float32(ALPHA_MAX)
STOP = np.float32(TRANSMITTANCE_MIN)
MEDIAN = np.float32(MEDIAN_TRANSMITTANCE)

SAVED_M1, SAVED_M2, SAVED_MEDIAN = 0, 1, 2
SAVED_SIZE = 3
"""Vectors kept for each block between forward and backward."""


class Fragment(NamedTuple):
    """One surfel seen through sixteen pixels."""

    dx: Any
    dy: Any
    w: Any
    """Depth of the center over depth of the hit."""
    inverse_w: Any
    u: Any
    v: Any
    by_hit: Any
    """Mask: the surfel's own Gaussian wins over the low pass."""
    rho: Any
    inside: Any
    """Mask: alpha is at least ALPHA_MIN."""


@njit(forceinline=True)
def intersect(table, k, x, y):
    """See surfel k through the pixels at (x, y): Huang et al. 2024, Eq. 10 and 11."""
    dx = x - table[k, rec.CENTER_X]
    dy = y - table[k, rec.CENTER_Y]
    w = table[k, rec.A2] * dx + (table[k, rec.B2] * dy + table[k, rec.HIT_CENTER])
    inverse_w = 1.0 / w
    u = (table[k, rec.A0] * dx + table[k, rec.B0] * dy) * inverse_w
    v = (table[k, rec.A1] * dx + table[k, rec.B1] * dy) * inverse_w
    rho_hit = u * u + v * v
    rho_low_pass = LOW_PASS_PRECISION * (dx * dx + dy * dy)
    by_hit = (rho_hit <= rho_low_pass) & (w >= HIT_MIN)
    rho = where(by_hit, rho_hit, rho_low_pass)
    return Fragment(dx, dy, w, inverse_w, u, v, by_hit, rho, rho <= table[k, rec.RHO_MAX])


@njit(forceinline=True)
def uncapped_alpha(table, k, rho):
    """Opacity times Gaussian, before it is capped at ALPHA_MAX."""
    return exp2(table[k, rec.LOG2_OPACITY] - HALF_LOG2_E * rho)


@njit(forceinline=True)
def touched_blocks(table, k, left, top):
    """Bit i is set if block i of the tile may hold a pixel with alpha ≥ ALPHA_MIN: the ellipse or the low-pass disk
    meets it.

    A convex quadratic is least over a rectangle on one of the two edges that face its center.
    """
    x = left + 4.0 * lane_columns()
    y = top + 4.0 * lane_rows()
    x_low = x - table[k, rec.ELLIPSE_X]
    y_low = y - table[k, rec.ELLIPSE_Y]
    x_high = x_low + 3.0
    y_high = y_low + 3.0
    zero = lanes(0.0)
    edge_x = minimum(maximum(x_low, zero), x_high)
    edge_y = minimum(maximum(y_low, zero), y_high)
    best_y = minimum(maximum(table[k, rec.SLOPE_Y] * edge_x, y_low), y_high)
    best_x = minimum(maximum(table[k, rec.SLOPE_X] * edge_y, x_low), x_high)
    xx = table[k, rec.FORM_XX]
    yy = table[k, rec.FORM_YY]
    xy = table[k, rec.FORM_XY] * np.float32(2)
    on_vertical = xx * edge_x * edge_x + (xy * edge_x + yy * best_y) * best_y
    on_horizontal = yy * edge_y * edge_y + (xy * edge_y + xx * best_x) * best_x
    x_low = x - table[k, rec.CENTER_X]
    y_low = y - table[k, rec.CENTER_Y]
    near_x = minimum(maximum(x_low, zero), x_low + 3.0)
    near_y = minimum(maximum(y_low, zero), y_low + 3.0)
    in_disk = LOW_PASS_PRECISION * (near_x * near_x + near_y * near_y) <= table[k, rec.RHO_MAX]
    return mask_bits((minimum(on_vertical, on_horizontal) <= 1.0) | in_disk)


class Planes(NamedTuple):
    """The images that a forward pass writes and a backward pass reads; also their gradients."""

    colors: Any
    normals: Any
    depth: Any
    alpha: Any
    median: Any
    distortion: Any


@njit(forceinline=True)
def deal_blocks(bits, entry, lists, lengths):
    """Append `entry` to the list of every block whose bit is set."""
    while bits:
        block = lowest_bit(bits)
        bits &= bits - 1
        lists[block, lengths[block]] = entry
        lengths[block] += 1


@njit(forceinline=True)
def blend_block(curved, table, surfels, masks, block, positions, length, x, y, inside, distance, reference, target):
    """Blend one block and write its pixels; clear the bit of every surfel that added nothing to it."""
    planes, saved, saved_at, offset, width, plane_size = target
    transmittance = lanes(1.0)
    alive = inside
    red = lanes(0.0)
    green = lanes(0.0)
    blue = lanes(0.0)
    normal_x = lanes(0.0)
    normal_y = lanes(0.0)
    normal_z = lanes(0.0)
    depth_sum = lanes(0.0)
    m1 = lanes(0.0)
    m2 = lanes(0.0)
    median = lanes(0.0)
    median_entry = lanes(-1.0)
    bit = np.uint16(1) << np.uint16(block)
    for position in range(length):
        entry = positions[position]
        k = surfels[entry]
        fragment = intersect(table, k, x, y)
        covered = fragment.inside & alive
        if not any_lane(covered):
            continue
        alpha = where(covered, minimum(uncapped_alpha(table, k, fragment.rho), lanes(CAP)), 0.0)
        after = transmittance - transmittance * alpha
        ending = covered & (after < STOP)
        alive &= ~ending
        covered &= ~ending
        masks[entry] |= bit
        weight = where(covered, alpha * transmittance, 0.0)
        inverse_ratio = where(fragment.by_hit, fragment.w, 1.0)
        z = table[k, rec.DEPTH] * where(fragment.by_hit, fragment.inverse_w, 1.0)
        m = reference - (distance / table[k, rec.DEPTH]) * inverse_ratio
        red += weight * table[k, rec.COLOR]
        green += weight * table[k, rec.COLOR + 1]
        blue += weight * table[k, rec.COLOR + 2]
        normal_x += weight * table[k, rec.NORMAL]
        normal_y += weight * table[k, rec.NORMAL + 1]
        normal_z += weight * table[k, rec.NORMAL + 2]
        if curved:
            along_u = where(fragment.by_hit, weight * fragment.u, 0.0)
            along_v = where(fragment.by_hit, weight * fragment.v, 0.0)
            normal_x += along_u * table[k, rec.CURVED_U] + along_v * table[k, rec.CURVED_V]
            normal_y += along_u * table[k, rec.CURVED_U + 1] + along_v * table[k, rec.CURVED_V + 1]
            normal_z += along_u * table[k, rec.CURVED_U + 2] + along_v * table[k, rec.CURVED_V + 2]
        depth_sum += weight * z
        weighted_m = weight * m
        m1 += weighted_m
        m2 += weighted_m * m
        in_front_half = covered & (transmittance > MEDIAN)
        median = where(in_front_half, z, median)
        median_entry = where(in_front_half, np.float32(entry), median_entry)
        transmittance = where(covered, after, transmittance)
        if not any_lane(alive):
            break
    opaque = 1.0 - transmittance
    store_block(planes.colors, offset, width, inside, red)
    store_block(planes.colors, offset + plane_size, width, inside, green)
    store_block(planes.colors, offset + 2 * plane_size, width, inside, blue)
    store_block(planes.normals, offset, width, inside, normal_x)
    store_block(planes.normals, offset + plane_size, width, inside, normal_y)
    store_block(planes.normals, offset + 2 * plane_size, width, inside, normal_z)
    store_block(planes.depth, offset, width, inside, depth_sum)
    store_block(planes.alpha, offset, width, inside, opaque)
    store_block(planes.median, offset, width, inside, median)
    store_block(planes.distortion, offset, width, inside, maximum(opaque * m2 - m1 * m1, lanes(0.0)))
    store_lanes(saved, saved_at + SAVED_M1 * LANES, m1)
    store_lanes(saved, saved_at + SAVED_M2 * LANES, m2)
    store_lanes(saved, saved_at + SAVED_MEDIAN * LANES, median_entry)


@njit(forceinline=True)
def blend_tiles(curved, counter, table, bins, camera_plane, planes, saved, masks):
    """Claim tiles from the counter and blend them; `curved` must be a literal, so that flat surfels do not pay for
    it.
    """
    tile_starts, entry_surfels, longest = bins
    width, height, distance = camera_plane
    tiles_across = (width + rec.TILE - 1) // rec.TILE
    lists = np.empty((LANES, longest), np.int32)
    lengths = np.empty(LANES, np.int64)
    while True:
        tile = fetch_add(counter, 1)
        if tile >= tile_starts.size - 1:
            return
        left = (tile % tiles_across) * rec.TILE
        top = (tile // tiles_across) * rec.TILE
        start = tile_starts[tile]
        surfels = entry_surfels[start : tile_starts[tile + 1]]
        tile_masks = masks[start : tile_starts[tile + 1]]
        lengths[:] = 0
        for entry in range(surfels.size):
            bits = touched_blocks(table, surfels[entry], np.float32(left + 0.5), np.float32(top + 0.5))
            deal_blocks(bits, entry, lists, lengths)
            tile_masks[entry] = 0
        reference = distance / table[surfels[0], rec.DEPTH] if surfels.size else np.float32(0)
        for block in range(LANES):
            x = left + rec.BLOCK * (block % rec.BLOCK)
            y = top + rec.BLOCK * (block // rec.BLOCK)
            column = lane_columns() + np.float32(x)
            row = lane_rows() + np.float32(y)
            inside = (column < np.float32(width)) & (row < np.float32(height))
            saved_at = (tile * LANES + block) * SAVED_SIZE * LANES
            target = (planes, saved, saved_at, y * width + x, width, width * height)
            blend_block(
                curved,
                table,
                surfels,
                tile_masks,
                block,
                lists[block],
                lengths[block],
                column + 0.5,
                row + 0.5,
                inside,
                distance,
                reference,
                target,
            )


@njit(nogil=True, cache=True, error_model="numpy")
def blend_flat(counter, table, bins, camera_plane, planes, saved, masks):
    """Blend tiles until `counter` runs past the last one; several threads may share the counter."""
    blend_tiles(False, counter, table, bins, camera_plane, planes, saved, masks)


@njit(nogil=True, cache=True, error_model="numpy")
def blend_curved(counter, table, bins, camera_plane, planes, saved, masks):
    """As `blend_flat`, for surfels whose normal varies across them."""
    blend_tiles(True, counter, table, bins, camera_plane, planes, saved, masks)
