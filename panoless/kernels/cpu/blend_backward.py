"""Gradients of the blended images to the records, front to back: what lies behind a fragment is the total minus what
was passed.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from panoless.kernels.cpu import records as rec
from panoless.kernels.cpu.blend import (
    CAP,
    LOW_PASS_PRECISION,
    SAVED_M1,
    SAVED_M2,
    SAVED_MEDIAN,
    SAVED_SIZE,
    STOP,
    deal_blocks,
    intersect,
    uncapped_alpha,
)
from panoless.kernels.cpu.simd import (
    LANES,
    any_lane,
    lane_columns,
    lane_rows,
    lanes,
    minimum,
    sum_each,
    where,
)
from panoless.kernels.cpu.simd_memory import fetch_add, load_block, load_lanes, store_lanes


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


@njit(forceinline=True)
def load_cotangent(outputs, gradients, saved, saved_at, offset, width, plane_size, inside):
    """Load the gradients of a block's pixels and form what every fragment needs of them."""
    m1 = load_lanes(saved, saved_at + SAVED_M1 * LANES)
    m2 = load_lanes(saved, saved_at + SAVED_M2 * LANES)
    red = load_block(gradients.colors, offset, width, inside)
    green = load_block(gradients.colors, offset + plane_size, width, inside)
    blue = load_block(gradients.colors, offset + 2 * plane_size, width, inside)
    normal_x = load_block(gradients.normals, offset, width, inside)
    normal_y = load_block(gradients.normals, offset + plane_size, width, inside)
    normal_z = load_block(gradients.normals, offset + 2 * plane_size, width, inside)
    depth = load_block(gradients.depth, offset, width, inside)
    opaque_gradient = load_block(gradients.alpha, offset, width, inside)
    distortion = load_block(gradients.distortion, offset, width, inside)
    opaque = load_block(outputs.alpha, offset, width, inside)
    total = red * load_block(outputs.colors, offset, width, inside)
    total += green * load_block(outputs.colors, offset + plane_size, width, inside)
    total += blue * load_block(outputs.colors, offset + 2 * plane_size, width, inside)
    total += normal_x * load_block(outputs.normals, offset, width, inside)
    total += normal_y * load_block(outputs.normals, offset + plane_size, width, inside)
    total += normal_z * load_block(outputs.normals, offset + 2 * plane_size, width, inside)
    total += depth * load_block(outputs.depth, offset, width, inside)
    total += opaque_gradient * opaque
    total += 2.0 * distortion * (opaque * m2 - m1 * m1)
    return Cotangent(
        red,
        green,
        blue,
        normal_x,
        normal_y,
        normal_z,
        depth,
        load_block(gradients.median, offset, width, inside),
        opaque_gradient + distortion * m2,
        -2.0 * distortion * m1,
        distortion * opaque,
        total,
        load_lanes(saved, saved_at + SAVED_MEDIAN * LANES),
    )


@njit(forceinline=True)
def blend_block_backward(curved, table, surfels, positions, length, x, y, inside, distance, reference, cotangent, rows):
    """Add the block's share to the tile's gradient rows, one row a surfel."""
    size = rows.shape[1]
    transmittance = lanes(1.0)
    alive = inside
    behind = cotangent.total
    for position in range(length):
        entry = positions[position]
        k = surfels[entry]
        fragment = intersect(table, k, x, y)
        covered = fragment.inside & alive
        uncapped = uncapped_alpha(table, k, fragment.rho)
        alpha = where(covered, minimum(uncapped, lanes(CAP)), 0.0)
        after = transmittance - transmittance * alpha
        ending = covered & (after < STOP)
        alive &= ~ending
        covered &= ~ending
        weight = where(covered, alpha * transmittance, 0.0)
        ratio = where(fragment.by_hit, fragment.inverse_w, 1.0)
        z = table[k, rec.DEPTH] * ratio
        inverse_z = where(fragment.by_hit, fragment.w, 1.0) * (np.float32(1) / table[k, rec.DEPTH])
        m = reference - distance * inverse_z

        per_weight = cotangent.constant + (cotangent.linear + cotangent.quadratic * m) * m + cotangent.depth * z
        per_weight += cotangent.red * table[k, rec.COLOR]
        per_weight += cotangent.green * table[k, rec.COLOR + 1]
        per_weight += cotangent.blue * table[k, rec.COLOR + 2]
        per_weight += cotangent.normal_x * table[k, rec.NORMAL]
        per_weight += cotangent.normal_y * table[k, rec.NORMAL + 1]
        per_weight += cotangent.normal_z * table[k, rec.NORMAL + 2]
        if curved:
            turn_u = cotangent.normal_x * table[k, rec.CURVED_U]
            turn_u += cotangent.normal_y * table[k, rec.CURVED_U + 1] + cotangent.normal_z * table[k, rec.CURVED_U + 2]
            turn_v = cotangent.normal_x * table[k, rec.CURVED_V]
            turn_v += cotangent.normal_y * table[k, rec.CURVED_V + 1] + cotangent.normal_z * table[k, rec.CURVED_V + 2]
            per_weight += where(fragment.by_hit, turn_u * fragment.u + turn_v * fragment.v, 0.0)
        behind -= weight * per_weight
        grad_alpha = transmittance * per_weight - behind / (1.0 - alpha)
        log_alpha = where(covered & (uncapped < CAP), grad_alpha * alpha, 0.0)
        grad_m = weight * (cotangent.linear + 2.0 * cotangent.quadratic * m)
        grad_z = weight * cotangent.depth + grad_m * distance * inverse_z * inverse_z
        grad_z += where(covered & (cotangent.median_entry == np.float32(entry)), cotangent.median, 0.0)

        grad_u = -log_alpha * fragment.u
        grad_v = -log_alpha * fragment.v
        if curved:
            grad_u += weight * turn_u
            grad_v += weight * turn_v
        from_w = where(fragment.by_hit, (grad_u * fragment.u + grad_v * fragment.v + grad_z * z) * ratio, 0.0)
        grad_u = where(fragment.by_hit, grad_u * ratio, 0.0)
        grad_v = where(fragment.by_hit, grad_v * ratio, 0.0)
        pull = where(fragment.by_hit, 0.0, log_alpha * LOW_PASS_PRECISION)
        flat_row = sum_each(
            (
                pull * fragment.dx
                + (from_w * table[k, rec.A2] - grad_u * table[k, rec.A0] - grad_v * table[k, rec.A1]),
                pull * fragment.dy
                + (from_w * table[k, rec.B2] - grad_u * table[k, rec.B0] - grad_v * table[k, rec.B1]),
                grad_u * fragment.dx,
                grad_u * fragment.dy,
                grad_v * fragment.dx,
                grad_v * fragment.dy,
                -from_w * fragment.dx,
                -from_w * fragment.dy,
                grad_z * ratio,
                log_alpha,
                weight * cotangent.red,
                weight * cotangent.green,
                weight * cotangent.blue,
                weight * cotangent.normal_x,
                weight * cotangent.normal_y,
                weight * cotangent.normal_z,
            )
        )
        store_lanes(rows, entry * size, load_lanes(rows, entry * size) + flat_row)
        if curved:
            along_u = where(fragment.by_hit, weight * fragment.u, 0.0)
            along_v = where(fragment.by_hit, weight * fragment.v, 0.0)
            curved_row = sum_each(
                (
                    along_u * cotangent.normal_x,
                    along_u * cotangent.normal_y,
                    along_u * cotangent.normal_z,
                    along_v * cotangent.normal_x,
                    along_v * cotangent.normal_y,
                    along_v * cotangent.normal_z,
                )
            )
            row_at = entry * size + rec.FLAT_GRADIENT_SIZE
            store_lanes(rows, row_at, load_lanes(rows, row_at) + curved_row)
        transmittance = where(covered, after, transmittance)
        if not any_lane(alive):
            break


@njit(forceinline=True)
def blend_tiles_backward(
    curved, counter, table, bins, camera_plane, outputs, gradients, saved, masks, entry_slots, slots
):
    """Claim tiles from the counter and pull their pixels' gradients back to one row a (tile, surfel) pair."""
    tile_starts, entry_surfels, longest = bins
    width, height, distance = camera_plane
    tiles_across = (width + rec.TILE - 1) // rec.TILE
    size = slots.shape[1]
    lists = np.empty((LANES, longest), np.int32)
    lengths = np.empty(LANES, np.int64)
    rows = np.empty((longest + 1, size), np.float32)
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
        lengths[:] = 0
        for entry in range(surfels.size):
            deal_blocks(np.int64(masks[start + entry]), entry, lists, lengths)
        rows[: surfels.size] = 0
        reference = distance / table[surfels[0], rec.DEPTH]
        for block in range(LANES):
            if lengths[block] == 0:
                continue
            x = left + rec.BLOCK * (block % rec.BLOCK)
            y = top + rec.BLOCK * (block // rec.BLOCK)
            column = lane_columns() + np.float32(x)
            row = lane_rows() + np.float32(y)
            inside = (column < np.float32(width)) & (row < np.float32(height))
            saved_at = (tile * LANES + block) * SAVED_SIZE * LANES
            cotangent = load_cotangent(
                outputs, gradients, saved, saved_at, y * width + x, width, width * height, inside
            )
            blend_block_backward(
                curved,
                table,
                surfels,
                lists[block],
                lengths[block],
                column + 0.5,
                row + 0.5,
                inside,
                distance,
                reference,
                cotangent,
                rows,
            )
        for entry in range(surfels.size):
            slot = entry_slots[start + entry]
            store_lanes(slots, slot * size, load_lanes(rows, entry * size))
            if curved:
                rest = size - LANES
                store_lanes(slots, slot * size + rest, load_lanes(rows, entry * size + rest))


@njit(nogil=True, cache=True, error_model="numpy")
def blend_flat_backward(counter, table, bins, camera_plane, outputs, gradients, saved, masks, entry_slots, slots):
    """Fill one gradient row a (tile, surfel) pair, tile by tile until `counter` runs past the last one."""
    blend_tiles_backward(
        False, counter, table, bins, camera_plane, outputs, gradients, saved, masks, entry_slots, slots
    )


@njit(nogil=True, cache=True, error_model="numpy")
def blend_curved_backward(counter, table, bins, camera_plane, outputs, gradients, saved, masks, entry_slots, slots):
    """As `blend_flat_backward`, for surfels whose normal varies across them."""
    blend_tiles_backward(True, counter, table, bins, camera_plane, outputs, gradients, saved, masks, entry_slots, slots)
