"""Gradients of the blended images to the records, front to back: what lies behind a fragment is the total minus what
was passed.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from panoless.kernels.cpu.compilation import INLINED_LANE_CODE, LANE_CODE
from panoless.kernels.cpu.simd import (
    LANES,
    absolute,
    any_lane,
    lane_columns,
    lane_rows,
    lanes,
    minimum,
    reciprocal,
    sum_each,
    where,
)
from panoless.kernels.cpu.simd_memory import fetch_add, load_block, load_lanes, store_lanes, thread_slot
from panoless.splats.kernels.cpu import records as rec
from panoless.splats.kernels.cpu.blend import (
    CAP,
    CHUNK,
    FRAGMENT_ALPHA,
    FRAGMENT_RATIO,
    FRAGMENT_SIZE,
    FRAGMENT_U,
    FRAGMENT_V,
    LOW_PASS_PRECISION,
    SAVED_M1,
    SAVED_M2,
    SAVED_MEDIAN,
    STOP,
    depth_ratio,
    find_fragment,
    list_block,
)

PULLED_PER_WEIGHT, PULLED_WEIGHT, PULLED_LOG_ALPHA, PULLED_TURN_U, PULLED_TURN_V = range(
    FRAGMENT_SIZE, FRAGMENT_SIZE + 5
)
"""Further vectors of a fragment: gradient of its weight, the weight, gradient of the logarithm of alpha, and the
normal's derivatives by u and v along the normal's gradient.
"""
PULLED_SIZE = FRAGMENT_SIZE + 5


class Cotangent(NamedTuple):
    """Gradients that reach a block's pixels, with the distortion's folded into a quadratic in m.

    A fragment of weight w at distance coordinate m adds w·(constant + linear·m + quadratic·m²) for the distortion and
    the alpha.
    """

    red: Any
    green: Any
    blue: Any
    normal_x: Any
    normal_y: Any
    normal_z: Any
    depth: Any
    median: Any
    constant: Any
    linear: Any
    quadratic: Any
    total: Any
    """Σ over all fragments of weight times gradient of the weight."""
    median_entry: Any


@njit(**INLINED_LANE_CODE)
def load_cotangent(features, outputs, gradients, saved, saved_at, offset, width, plane_size, inside):
    """Load the gradients of a block's pixels and form what every fragment needs of them."""
    zero = lanes(0.0)
    normal_x = load_block(gradients.normals, offset, width, inside)
    normal_y = load_block(gradients.normals, offset + plane_size, width, inside)
    normal_z = load_block(gradients.normals, offset + 2 * plane_size, width, inside)
    total = normal_x * load_block(outputs.normals, offset, width, inside)
    total += normal_y * load_block(outputs.normals, offset + plane_size, width, inside)
    total += normal_z * load_block(outputs.normals, offset + 2 * plane_size, width, inside)
    constant = load_block(gradients.alpha, offset, width, inside)
    opaque = load_block(outputs.alpha, offset, width, inside)
    total += constant * opaque
    red, green, blue, depth, median, median_entry, linear, quadratic = zero, zero, zero, zero, zero, zero, zero, zero
    if len(features.colors):
        red = load_block(gradients.colors, offset, width, inside)
        green = load_block(gradients.colors, offset + plane_size, width, inside)
        blue = load_block(gradients.colors, offset + 2 * plane_size, width, inside)
        total += red * load_block(outputs.colors, offset, width, inside)
        total += green * load_block(outputs.colors, offset + plane_size, width, inside)
        total += blue * load_block(outputs.colors, offset + 2 * plane_size, width, inside)
    if len(features.depth):
        depth = load_block(gradients.depth, offset, width, inside)
        median = load_block(gradients.median, offset, width, inside)
        median_entry = load_lanes(saved, saved_at + SAVED_MEDIAN * LANES)
        total += depth * load_block(outputs.depth, offset, width, inside)
    if len(features.distortion):
        distortion = load_block(gradients.distortion, offset, width, inside)
        m1 = load_lanes(saved, saved_at + SAVED_M1 * LANES)
        m2 = load_lanes(saved, saved_at + SAVED_M2 * LANES)
        total += 2.0 * distortion * (opaque * m2 - m1 * m1)
        constant += distortion * m2
        linear = -2.0 * distortion * m1
        quadratic = distortion * opaque
    return Cotangent(
        red,
        green,
        blue,
        normal_x,
        normal_y,
        normal_z,
        depth,
        median,
        constant,
        linear,
        quadratic,
        total,
        median_entry,
    )


@njit(**INLINED_LANE_CODE)
def asks_for_nothing(features, cotangent):
    """Whether no pixel of a block has a gradient, so that its surfels get none from it."""
    given = absolute(cotangent.normal_x) + absolute(cotangent.normal_y) + absolute(cotangent.normal_z)
    given += absolute(cotangent.constant)
    if len(features.colors):
        given += absolute(cotangent.red) + absolute(cotangent.green) + absolute(cotangent.blue)
    if len(features.depth):
        given += absolute(cotangent.depth) + absolute(cotangent.median)
    if len(features.distortion):
        given += absolute(cotangent.linear) + absolute(cotangent.quadratic)
    return not any_lane(~(given == 0.0))


@njit(**INLINED_LANE_CODE)
def find_chunk(features, table, surfels, positions, begin, end, x, y, distance, reference, cotangent, fragments):
    """First pass over a chunk: its fragments, and what does not depend on what lies in front of them."""
    for position in range(begin, end):
        at = (position - begin) * PULLED_SIZE * LANES
        k = surfels[positions[position]]
        u, v = find_fragment(table, k, x, y, fragments, at)
        per_weight = cotangent.constant + cotangent.normal_x * table[k, rec.NORMAL]
        per_weight += cotangent.normal_y * table[k, rec.NORMAL + 1]
        per_weight += cotangent.normal_z * table[k, rec.NORMAL + 2]
        if len(features.colors):
            per_weight += cotangent.red * table[k, rec.COLOR]
            per_weight += cotangent.green * table[k, rec.COLOR + 1]
            per_weight += cotangent.blue * table[k, rec.COLOR + 2]
        if len(features.curved):
            turn_u = cotangent.normal_x * table[k, rec.CURVED_U]
            turn_u += cotangent.normal_y * table[k, rec.CURVED_U + 1] + cotangent.normal_z * table[k, rec.CURVED_U + 2]
            turn_v = cotangent.normal_x * table[k, rec.CURVED_V]
            turn_v += cotangent.normal_y * table[k, rec.CURVED_V + 1] + cotangent.normal_z * table[k, rec.CURVED_V + 2]
            per_weight += turn_u * u + turn_v * v
            store_lanes(fragments, at + PULLED_TURN_U * LANES, turn_u)
            store_lanes(fragments, at + PULLED_TURN_V * LANES, turn_v)
        if len(features.depth):
            per_weight += cotangent.depth * (table[k, rec.DEPTH] * depth_ratio(fragments, at))
        if len(features.distortion):
            m = reference - (distance / table[k, rec.DEPTH]) / depth_ratio(fragments, at)
            per_weight += (cotangent.linear + cotangent.quadratic * m) * m
        store_lanes(fragments, at + PULLED_PER_WEIGHT * LANES, per_weight)


@njit(**INLINED_LANE_CODE)
def weigh_chunk(count, transmittance, alive, behind, fragments):
    """Second pass, in order: weights, and gradients of the logarithm of alpha. Returns the state for the next chunk."""
    for i in range(count):
        at = i * PULLED_SIZE * LANES
        uncapped = load_lanes(fragments, at + FRAGMENT_ALPHA * LANES)
        per_weight = load_lanes(fragments, at + PULLED_PER_WEIGHT * LANES)
        alpha = minimum(uncapped, lanes(CAP))
        covered = (uncapped > 0.0) & alive
        after = transmittance - transmittance * alpha
        ending = covered & (after < STOP)
        alive &= ~ending
        covered &= ~ending
        weight = where(covered, alpha * transmittance, 0.0)
        behind -= weight * per_weight
        grad_alpha = transmittance * per_weight - behind * reciprocal(1.0 - alpha)
        log_alpha = where(covered & (uncapped < CAP), grad_alpha * alpha, 0.0)
        store_lanes(fragments, at + PULLED_WEIGHT * LANES, weight)
        store_lanes(fragments, at + PULLED_LOG_ALPHA * LANES, log_alpha)
        transmittance = where(covered, after, transmittance)
    return transmittance, alive, behind


@njit(**INLINED_LANE_CODE)
def pull_chunk(features, table, surfels, positions, begin, end, x, y, distance, reference, cotangent, fragments, rows):
    """Third pass: add each fragment's share to its surfel's row."""
    size = rows.shape[1]
    for position in range(begin, end):
        at = (position - begin) * PULLED_SIZE * LANES
        entry = positions[position]
        k = surfels[entry]
        dx = x - table[k, rec.CENTER_X]
        dy = y - table[k, rec.CENTER_Y]
        u = load_lanes(fragments, at + FRAGMENT_U * LANES)
        v = load_lanes(fragments, at + FRAGMENT_V * LANES)
        hit_ratio = load_lanes(fragments, at + FRAGMENT_RATIO * LANES)
        by_hit = hit_ratio > 0.0
        ratio = where(by_hit, hit_ratio, 1.0)
        weight = load_lanes(fragments, at + PULLED_WEIGHT * LANES)
        log_alpha = load_lanes(fragments, at + PULLED_LOG_ALPHA * LANES)
        grad_z = lanes(0.0)
        z = table[k, rec.DEPTH] * ratio
        if len(features.depth):
            grad_z = weight * cotangent.depth
            grad_z += where(cotangent.median_entry == np.float32(entry), cotangent.median, 0.0)
        if len(features.distortion):
            inverse_z = 1.0 / z
            m = reference - distance * inverse_z
            grad_m = weight * (cotangent.linear + 2.0 * cotangent.quadratic * m)
            grad_z += grad_m * distance * inverse_z * inverse_z
        grad_u = -log_alpha * u
        grad_v = -log_alpha * v
        if len(features.curved):
            grad_u += weight * load_lanes(fragments, at + PULLED_TURN_U * LANES)
            grad_v += weight * load_lanes(fragments, at + PULLED_TURN_V * LANES)
        from_w = (grad_u * u + grad_v * v + grad_z * z) * hit_ratio
        grad_u *= hit_ratio
        grad_v *= hit_ratio
        pull = where(by_hit, 0.0, log_alpha * LOW_PASS_PRECISION)
        footprint = (
            pull * dx + (from_w * table[k, rec.A2] - grad_u * table[k, rec.A0] - grad_v * table[k, rec.A1]),
            pull * dy + (from_w * table[k, rec.B2] - grad_u * table[k, rec.B0] - grad_v * table[k, rec.B1]),
            grad_u * dx,
            grad_u * dy,
            grad_v * dx,
            grad_v * dy,
            -from_w * dx,
            -from_w * dy,
            grad_z * ratio,
            log_alpha,
            weight * cotangent.normal_x,
            weight * cotangent.normal_y,
            weight * cotangent.normal_z,
        )
        color = (weight * cotangent.red, weight * cotangent.green, weight * cotangent.blue)
        row_at = entry * size
        if len(features.curved):
            along_u = weight * u
            along_v = weight * v
            turned_u = (along_u * cotangent.normal_x, along_u * cotangent.normal_y, along_u * cotangent.normal_z)
            turned_v = (along_v * cotangent.normal_x, along_v * cotangent.normal_y, along_v * cotangent.normal_z)
            add_row(rows, row_at, footprint + turned_u)
            if len(features.colors):
                add_row(rows, row_at + LANES, turned_v + color)
            else:
                add_row(rows, row_at + LANES, turned_v)
        elif len(features.colors):
            add_row(rows, row_at, footprint + color)
        else:
            add_row(rows, row_at, footprint)


@njit(**INLINED_LANE_CODE)
def add_row(rows, at, values):
    """Add the sum over the lanes of each value to sixteen consecutive numbers."""
    store_lanes(rows, at, load_lanes(rows, at) + sum_each(values))


@njit(**INLINED_LANE_CODE)
def blend_block_backward(features, table, surfels, length, x, y, inside, distance, reference, cotangent, scratch):
    """Add the block's share to the tile's gradient rows, one row a surfel."""
    positions, fragments, rows = scratch
    transmittance = lanes(1.0)
    alive = inside
    behind = cotangent.total
    for begin in range(0, length, CHUNK):
        end = min(begin + CHUNK, length)
        find_chunk(features, table, surfels, positions, begin, end, x, y, distance, reference, cotangent, fragments)
        transmittance, alive, behind = weigh_chunk(end - begin, transmittance, alive, behind, fragments)
        pull_chunk(
            features, table, surfels, positions, begin, end, x, y, distance, reference, cotangent, fragments, rows
        )
        if not any_lane(alive):
            break


@njit(**LANE_CODE)
def blend_backward(
    counter,
    features,
    table,
    bins,
    camera_plane,
    outputs,
    gradients,
    saved,
    masks,
    entry_slots,
    slots,
    lists,
    chunks,
    row_scratch,
):
    """Pull the pixels' gradients back to one row a (tile, surfel) pair, until `counter` runs past the last tile.

    `lists` and `chunks` are as in the forward pass; `row_scratch` has for each thread a row for each surfel of the
    longest list: one vector for flat surfels, two for curved ones, of which `slots` keeps what is used.
    """
    tile_starts, entry_surfels = bins
    width, height, distance = camera_plane
    tiles_across = (width + rec.TILE - 1) // rec.TILE
    size = slots.shape[1]
    thread = thread_slot(counter)
    rows = row_scratch[thread]
    row_size = rows.shape[1]
    scratch = lists[thread], chunks[thread], rows
    while True:
        tile = fetch_add(counter, 1)
        if tile >= tile_starts.size - 1:
            return
        start = tile_starts[tile]
        surfels = entry_surfels[start : tile_starts[tile + 1]]
        if surfels.size == 0:
            continue
        left = (tile % tiles_across) * rec.TILE
        top = (tile // tiles_across) * rec.TILE
        rows[: surfels.size] = 0
        reference = distance / table[surfels[0], rec.DEPTH]
        for block in range(LANES):
            x = left + rec.BLOCK * (block % rec.BLOCK)
            y = top + rec.BLOCK * (block // rec.BLOCK)
            if x >= width or y >= height:
                continue
            column = lane_columns() + np.float32(x)
            row = lane_rows() + np.float32(y)
            inside = (column < np.float32(width)) & (row < np.float32(height))
            saved_at = (tile * LANES + block) * saved.shape[2] * LANES
            cotangent = load_cotangent(
                features, outputs, gradients, saved, saved_at, y * width + x, width, width * height, inside
            )
            if asks_for_nothing(features, cotangent):
                continue
            length = list_block(masks, start, surfels.size, block, scratch[0])
            blend_block_backward(
                features,
                table,
                surfels,
                length,
                column + 0.5,
                row + 0.5,
                inside,
                distance,
                reference,
                cotangent,
                scratch,
            )
        for entry in range(surfels.size):
            slot = entry_slots[start + entry]
            store_lanes(slots, slot * size, load_lanes(rows, entry * row_size))
            if len(features.curved):
                rest = size - LANES
                store_lanes(slots, slot * size + rest, load_lanes(rows, entry * row_size + rest))
