"""The Numba blend of splats as a differentiable torch operator. Results are the same bit for bit whatever the number of
threads: each tile writes its part of the gradient of a splat to a row of its own, and these are added in one order.
"""

import math

import numpy as np
import torch
from numba import njit

from panoless.kernels.cpu.compilation import VECTORIZED_LOOPS
from panoless.kernels.cpu.simd_memory import fetch_add, thread_slot
from panoless.kernels.cpu.workers import run_shared, thread_count
from panoless.splats.kernels.constants import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN
from panoless.splats.kernels.cpu import records as rec
from panoless.splats.kernels.cpu.binning import count_entries, fill_tiles, sort_by_depth
from panoless.splats.kernels.cpu.buffers import take
from panoless.splats.kernels.reference.splats import tile_boxes

CAP, LEAST, STOP = np.float32(ALPHA_MAX), np.float32(ALPHA_MIN), np.float32(TRANSMITTANCE_MIN)
HALF, TWO = np.float32(0.5), np.float32(2)
GEOMETRY = 6
"""Gradients of a splat beside its attributes: center, precision, opacity."""


@njit(**VECTORIZED_LOOPS)
def blend_forward(counter, splats, attributes, boxes, lists, width, height, channels, alpha, scratch):
    """Blend tiles until `counter` runs past the last one; `splats` has rows (x, y, Q_xx, Q_xy, Q_yy, opacity)."""
    starts, entries = lists
    across = (width + TILE - 1) // TILE
    transmittances = scratch[thread_slot(counter)]
    count = attributes.shape[1]
    while True:
        tile = fetch_add(counter, 1)
        if tile >= starts.size - 1:
            return
        left, top = (tile % across) * TILE, (tile // across) * TILE
        right, bottom = min(left + TILE, width) - 1, min(top + TILE, height) - 1
        transmittances[:] = 1
        alive = (right - left + 1) * (bottom - top + 1)
        for entry in range(starts[tile], starts[tile + 1]):
            k = entries[entry]
            x, y, xx, xy, yy, opacity = splats[k]
            for row in range(max(boxes[k, 2], top), min(boxes[k, 3], bottom) + 1):
                dy = np.float32(row) + HALF - y
                for column in range(max(boxes[k, 0], left), min(boxes[k, 1], right) + 1):
                    pixel = (row - top) * TILE + column - left
                    before = transmittances[pixel]
                    if before < 0:
                        continue
                    dx = np.float32(column) + HALF - x
                    fragment = opacity * math.exp(-HALF * (xx * dx * dx + TWO * xy * dx * dy + yy * dy * dy))
                    if fragment < LEAST:
                        continue
                    fragment = min(fragment, CAP)
                    after = before - before * fragment
                    if after < STOP:
                        transmittances[pixel] = -before
                        alive -= 1
                        continue
                    transmittances[pixel] = after
                    weight = before * fragment
                    for channel in range(count):
                        channels[channel, row, column] += weight * attributes[k, channel]
            if alive == 0:
                break
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                alpha[row, column] = 1 - abs(transmittances[(row - top) * TILE + column - left])


@njit(**VECTORIZED_LOOPS)
def blend_back(
    counter, splats, attributes, boxes, lists, entry_slots, width, height, cotangents, totals, slots, scratch
):
    """Pull cotangents of the images back; `totals` holds what all fragments of a pixel add to the loss."""
    starts, entries = lists
    channel_cotangents, alpha_cotangents = cotangents
    across = (width + TILE - 1) // TILE
    state = scratch[thread_slot(counter)]
    count = attributes.shape[1]
    while True:
        tile = fetch_add(counter, 1)
        if tile >= starts.size - 1:
            return
        left, top = (tile % across) * TILE, (tile // across) * TILE
        right, bottom = min(left + TILE, width) - 1, min(top + TILE, height) - 1
        state[0, :] = 1
        state[1, :] = 0
        for entry in range(starts[tile], starts[tile + 1]):
            k = entries[entry]
            x, y, xx, xy, yy, opacity = splats[k]
            found = slots[entry_slots[entry]]
            found[:] = 0
            for row in range(max(boxes[k, 2], top), min(boxes[k, 3], bottom) + 1):
                dy = np.float32(row) + HALF - y
                for column in range(max(boxes[k, 0], left), min(boxes[k, 1], right) + 1):
                    pixel = (row - top) * TILE + column - left
                    before = state[0, pixel]
                    if before < 0:
                        continue
                    dx = np.float32(column) + HALF - x
                    gaussian = math.exp(-HALF * (xx * dx * dx + TWO * xy * dx * dy + yy * dy * dy))
                    uncapped = opacity * gaussian
                    if uncapped < LEAST:
                        continue
                    fragment = min(uncapped, CAP)
                    after = before - before * fragment
                    if after < STOP:
                        state[0, pixel] = -before
                        continue
                    state[0, pixel] = after
                    weight = before * fragment
                    worth = alpha_cotangents[row, column]
                    for channel in range(count):
                        cotangent = channel_cotangents[channel, row, column]
                        worth += attributes[k, channel] * cotangent
                        found[GEOMETRY + channel] += weight * cotangent
                    state[1, pixel] += weight * worth
                    if uncapped >= CAP:
                        continue
                    behind = totals[row, column] - state[1, pixel]
                    pull = before * worth - behind / (1 - fragment)
                    found[5] += pull * gaussian
                    pull *= -HALF * uncapped
                    found[0] -= TWO * pull * (xx * dx + xy * dy)
                    found[1] -= TWO * pull * (xy * dx + yy * dy)
                    found[2] += pull * dx * dx
                    found[3] += TWO * pull * dx * dy
                    found[4] += pull * dy * dy


@njit(**VECTORIZED_LOOPS)
def add_slots(slots, starts, gradients):
    """Sum the rows of each splat."""
    for k in range(gradients.shape[0]):
        for slot in range(starts[k], starts[k + 1]):
            for item in range(gradients.shape[1]):
                gradients[k, item] += slots[slot, item]


def _tile_lists(boxes, depths, drawn, height, width):
    """Sorted lists of the splats in each tile, and a row for each pair of a splat and a tile."""
    count, across = len(boxes), -(-width // TILE)
    keys = np.where(drawn & (boxes[:, 1] >= boxes[:, 0]), depths.view(np.uint32), np.uint32(rec.CULLED))
    ranges = np.ascontiguousarray(boxes // TILE)
    tiles = across * -(-height // TILE)
    everywhere, starts, slot_starts = (
        np.ones(tiles, np.bool_),
        np.empty(tiles + 1, np.int64),
        np.empty(count + 1, np.int64),
    )
    count_entries(keys, ranges, across, everywhere, starts, slot_starts)
    order = take((count,), np.int32)
    spares = take((count,), np.int32), take((count,), np.uint32), take((count,), np.uint32)
    seen = sort_by_depth(keys, order, *spares)
    entries, entry_slots = (take((int(starts[-1]),), np.int32) for _ in range(2))
    fill_tiles(order, seen, ranges, across, everywhere, starts, slot_starts, entries, entry_slots)
    return (starts, entries), entry_slots, slot_starts


class _BlendSplats(torch.autograd.Function):
    @staticmethod
    def forward(ctx, centers, precisions, opacities, attributes, depths, drawn, height, width):
        with torch.no_grad():
            boxes = tile_boxes(centers, precisions, opacities, drawn, height, width).numpy()
            splats = torch.cat([centers, precisions, opacities[:, None]], 1).contiguous().numpy()
        table = attributes.detach().contiguous().numpy()
        lists, entry_slots, slot_starts = _tile_lists(boxes, depths.contiguous().numpy(), drawn.numpy(), height, width)
        channels = np.zeros((table.shape[1], height, width), np.float32)
        alpha = np.empty((height, width), np.float32)
        scratch = take((thread_count(), TILE * TILE))
        run_shared(blend_forward, splats, table, boxes, lists, width, height, channels, alpha, scratch)
        images = torch.from_numpy(channels), torch.from_numpy(alpha)
        ctx.save_for_backward(*images)
        ctx.saved = splats, table, boxes, lists, entry_slots, slot_starts
        return images

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, channel_cotangents, alpha_cotangents):
        channels, alpha = ctx.saved_tensors
        splats, table, boxes, lists, entry_slots, slot_starts = ctx.saved
        height, width = alpha.shape
        totals = (channels * channel_cotangents).sum(0) + alpha * alpha_cotangents
        slots = np.zeros((entry_slots.size, GEOMETRY + table.shape[1]), np.float32)
        cotangents = channel_cotangents.contiguous().numpy(), alpha_cotangents.contiguous().numpy()
        scratch = take((thread_count(), 2, TILE * TILE))
        scene = splats, table, boxes, lists, entry_slots, width, height, cotangents, totals.numpy(), slots, scratch
        run_shared(blend_back, *scene)
        gradients = np.zeros((len(splats), slots.shape[1]), np.float32)
        add_slots(slots, slot_starts, gradients)
        found = torch.from_numpy(gradients).split((2, 3, 1, table.shape[1]), 1)
        return found[0], found[1], found[2][:, 0], found[3], None, None, None, None


def blend_splats(centers, precisions, opacities, attributes, depths, drawn, height, width):
    """Blend float32 splats on the CPU; see `panoless.splats.kernels.splats.blend_splats` for what it computes."""
    return _BlendSplats.apply(centers, precisions, opacities, attributes, depths, drawn, height, width)
