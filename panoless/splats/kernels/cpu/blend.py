"""Front-to-back blending of tiles: each 4×4 block of pixels is one vector whose state stays in registers while its
surfels pass.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from panoless.kernels.cpu.compilation import INLINED_LANE_CODE, LANE_CODE
from panoless.kernels.cpu.simd import (
    LANES,
    any_lane,
    exp2,
    lane_columns,
    lane_count,
    lane_indices,
    lane_rows,
    lanes,
    mask_bits,
    maximum,
    minimum,
    reciprocal,
    where,
)
from panoless.kernels.cpu.simd_memory import (
    fetch_add,
    load_bit,
    load_lanes,
    store_block,
    store_chosen,
    store_lanes,
    thread_slot,
)
from panoless.splats.kernels.constants import (
    ALPHA_MAX,
    HIT_RATIO_MIN,
    LOW_PASS_SIGMA,
    MEDIAN_TRANSMITTANCE,
    TRANSMITTANCE_MIN,
)
from panoless.splats.kernels.cpu import records as rec

LOW_PASS_PRECISION = np.float32(1 / LOW_PASS_SIGMA**2)
HALF_LOG2_E = np.float32(0.5 * np.log2(np.e))
HIT_MIN = np.float32(HIT_RATIO_MIN)
CAP = np.float32(ALPHA_MAX)
STOP = np.float32(TRANSMITTANCE_MIN)
MEDIAN = np.float32(MEDIAN_TRANSMITTANCE)

SAVED_MEDIAN, SAVED_M1, SAVED_M2 = 0, 1, 2
"""Vectors kept for each block between forward and backward; the last two for the distortion only."""


class Features(NamedTuple):
    """What a kernel is compiled for. A field is `YES` or `NO`, which differ in type: what isn't wanted is not there."""

    curved: Any
    """Surfels have a normal that varies across them."""
    colors: Any
    depth: Any
    """Accumulated and median depth."""
    distortion: Any


YES, NO = (0,), ()


CHUNK = 8
"""Fragments of a block that are found together before they are blended one after another.

One fragment is a chain of about a hundred cycles of latency; found ahead, several of them overlap, which took a third
off the backward's time.
"""

FRAGMENT_U, FRAGMENT_V, FRAGMENT_RATIO, FRAGMENT_ALPHA = 0, 1, 2, 3
"""Vectors of a fragment: the hit, depth of the hit over depth of the center (all 0 where the low pass wins), and alpha
before it is capped (0 where it is below ALPHA_MIN).
"""
FRAGMENT_SIZE = 4


@njit(**INLINED_LANE_CODE)
def find_fragment(table, k, x, y, fragments, at):
    """See surfel k through the pixels at (x, y): Huang et al. 2024, Eq. 10 and 11. Returns u and v."""
    dx = x - table[k, rec.CENTER_X]
    dy = y - table[k, rec.CENTER_Y]
    w = table[k, rec.A2] * dx + (table[k, rec.B2] * dy + table[k, rec.HIT_CENTER])
    inverse_w = reciprocal(w)
    u = (table[k, rec.A0] * dx + table[k, rec.B0] * dy) * inverse_w
    v = (table[k, rec.A1] * dx + table[k, rec.B1] * dy) * inverse_w
    rho_hit = u * u + v * v
    rho_low_pass = LOW_PASS_PRECISION * (dx * dx + dy * dy)
    by_hit = (rho_hit <= rho_low_pass) & (w >= HIT_MIN)
    rho = where(by_hit, rho_hit, rho_low_pass)
    alpha = exp2(table[k, rec.LOG2_OPACITY] - HALF_LOG2_E * rho)
    u = where(by_hit, u, 0.0)
    v = where(by_hit, v, 0.0)
    store_lanes(fragments, at + FRAGMENT_U * LANES, u)
    store_lanes(fragments, at + FRAGMENT_V * LANES, v)
    store_lanes(fragments, at + FRAGMENT_RATIO * LANES, where(by_hit, inverse_w, 0.0))
    store_lanes(fragments, at + FRAGMENT_ALPHA * LANES, where(rho <= table[k, rec.RHO_MAX], alpha, 0.0))
    return u, v


@njit(**INLINED_LANE_CODE)
def depth_ratio(fragments, at):
    """Depth of the fragment over depth of the surfel's center."""
    ratio = load_lanes(fragments, at + FRAGMENT_RATIO * LANES)
    return where(ratio > 0.0, ratio, 1.0)


@njit(**INLINED_LANE_CODE)
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


@njit(**INLINED_LANE_CODE)
def list_block(masks, start, count, block, positions):
    """Write to `positions` which of a tile's `count` surfels have the bit of `block` in their mask; return how many."""
    length = 0
    for first in range(0, count, LANES):
        chosen = load_bit(masks, start + first, block) & (lane_indices() < np.float32(count - first))
        store_chosen(positions, length, first, chosen)
        length += lane_count(chosen)
    return length


@njit(**INLINED_LANE_CODE)
def blend_block(features, table, surfels, masks, block, length, x, y, inside, distance, reference, scratch, target):
    """Blend one block and write its pixels; clear the bit of every surfel that was met and added nothing to it."""
    positions, fragments = scratch
    planes, saved, saved_at, offset, width, plane_size = target
    zero = lanes(0.0)
    transmittance = lanes(1.0)
    alive = inside
    red, green, blue = zero, zero, zero
    normal_x, normal_y, normal_z = zero, zero, zero
    depth_sum, median = zero, zero
    m1, m2 = zero, zero
    median_entry = lanes(-1.0)
    for begin in range(0, length, CHUNK):
        end = min(begin + CHUNK, length)
        for position in range(begin, end):
            at = (position - begin) * FRAGMENT_SIZE * LANES
            find_fragment(table, surfels[positions[position]], x, y, fragments, at)
        for position in range(begin, end):
            at = (position - begin) * FRAGMENT_SIZE * LANES
            entry = positions[position]
            k = surfels[entry]
            alpha = load_lanes(fragments, at + FRAGMENT_ALPHA * LANES)
            covered = (alpha > 0.0) & alive
            masks[entry] ^= np.uint16(not any_lane(covered)) << np.uint16(block)
            alpha = minimum(alpha, lanes(CAP))
            after = transmittance - transmittance * alpha
            ending = covered & (after < STOP)
            alive &= ~ending
            covered &= ~ending
            weight = where(covered, alpha * transmittance, 0.0)
            normal_x += weight * table[k, rec.NORMAL]
            normal_y += weight * table[k, rec.NORMAL + 1]
            normal_z += weight * table[k, rec.NORMAL + 2]
            if len(features.colors):
                red += weight * table[k, rec.COLOR]
                green += weight * table[k, rec.COLOR + 1]
                blue += weight * table[k, rec.COLOR + 2]
            if len(features.curved):
                along_u = weight * load_lanes(fragments, at + FRAGMENT_U * LANES)
                along_v = weight * load_lanes(fragments, at + FRAGMENT_V * LANES)
                normal_x += along_u * table[k, rec.CURVED_U] + along_v * table[k, rec.CURVED_V]
                normal_y += along_u * table[k, rec.CURVED_U + 1] + along_v * table[k, rec.CURVED_V + 1]
                normal_z += along_u * table[k, rec.CURVED_U + 2] + along_v * table[k, rec.CURVED_V + 2]
            if len(features.depth):
                z = table[k, rec.DEPTH] * depth_ratio(fragments, at)
                depth_sum += weight * z
                in_front_half = covered & (transmittance > MEDIAN)
                median = where(in_front_half, z, median)
                median_entry = where(in_front_half, np.float32(entry), median_entry)
            if len(features.distortion):
                m = reference - (distance / table[k, rec.DEPTH]) / depth_ratio(fragments, at)
                weighted_m = weight * m
                m1 += weighted_m
                m2 += weighted_m * m
            transmittance = where(covered, after, transmittance)
            if not any_lane(alive):
                break
        if not any_lane(alive):
            break
    opaque = 1.0 - transmittance
    store_block(planes.alpha, offset, width, inside, opaque)
    store_block(planes.normals, offset, width, inside, normal_x)
    store_block(planes.normals, offset + plane_size, width, inside, normal_y)
    store_block(planes.normals, offset + 2 * plane_size, width, inside, normal_z)
    if len(features.colors):
        store_block(planes.colors, offset, width, inside, red)
        store_block(planes.colors, offset + plane_size, width, inside, green)
        store_block(planes.colors, offset + 2 * plane_size, width, inside, blue)
    if len(features.depth):
        store_block(planes.depth, offset, width, inside, depth_sum)
        store_block(planes.median, offset, width, inside, median)
        store_lanes(saved, saved_at + SAVED_MEDIAN * LANES, median_entry)
    if len(features.distortion):
        store_block(planes.distortion, offset, width, inside, maximum(opaque * m2 - m1 * m1, zero))
        store_lanes(saved, saved_at + SAVED_M1 * LANES, m1)
        store_lanes(saved, saved_at + SAVED_M2 * LANES, m2)


@njit(**LANE_CODE)
def blend(counter, features, table, bins, camera_plane, planes, saved, masks, lists, chunks):
    """Blend tiles until `counter` runs past the last one; several threads may share the counter.

    `masks` has a word for each (tile, surfel) pair, and sixteen to spare: which blocks of the tile the surfel was
    seen in. `lists` has a row for each thread, as long as the longest list and sixteen more, and `chunks` holds the
    vectors of a chunk of fragments for each thread.
    """
    tile_starts, entry_surfels = bins
    width, height, distance = camera_plane
    tiles_across = (width + rec.TILE - 1) // rec.TILE
    thread = thread_slot(counter)
    scratch = lists[thread], chunks[thread]
    while True:
        tile = fetch_add(counter, 1)
        if tile >= tile_starts.size - 1:
            return
        left = (tile % tiles_across) * rec.TILE
        top = (tile // tiles_across) * rec.TILE
        start = tile_starts[tile]
        surfels = entry_surfels[start : tile_starts[tile + 1]]
        tile_masks = masks[start : tile_starts[tile + 1]]
        for entry in range(surfels.size):
            tile_masks[entry] = touched_blocks(table, surfels[entry], np.float32(left + 0.5), np.float32(top + 0.5))
        reference = distance / table[surfels[0], rec.DEPTH] if surfels.size else np.float32(0)
        for block in range(LANES):
            x = left + rec.BLOCK * (block % rec.BLOCK)
            y = top + rec.BLOCK * (block // rec.BLOCK)
            if x >= width or y >= height:
                continue
            column = lane_columns() + np.float32(x)
            row = lane_rows() + np.float32(y)
            inside = (column < np.float32(width)) & (row < np.float32(height))
            length = list_block(masks, start, surfels.size, block, scratch[0])
            target = (
                planes,
                saved,
                (tile * LANES + block) * saved.shape[2] * LANES,
                y * width + x,
                width,
                width * height,
            )
            blend_block(
                features,
                table,
                surfels,
                tile_masks,
                block,
                length,
                column + 0.5,
                row + 0.5,
                inside,
                distance,
                reference,
                scratch,
                target,
            )
