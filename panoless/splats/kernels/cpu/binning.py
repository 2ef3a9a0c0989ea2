"""Depth order and tile lists: which surfels each 16×16 tile must look at, nearest first."""

import numpy as np
from numba import njit

from panoless.splats.kernels.cpu import records as rec

_DIGIT_BITS = 11
_DIGITS = 1 << _DIGIT_BITS


@njit(nogil=True, cache=True, error_model="numpy")
def sort_by_depth(keys, order, spare_order, sorted_keys, spare_keys):
    """Write the drawn surfels' indices to `order`, nearest first, equal depths by index; return how many there are.

    A radix sort in three passes of eleven bits; a pass whose digit is the same everywhere is left out.
    """
    drawn = 0
    histogram = np.zeros((3, _DIGITS), np.int64)
    for k in range(keys.size):
        key = keys[k]
        if key != np.uint32(rec.CULLED):
            spare_order[drawn] = k
            spare_keys[drawn] = key
            drawn += 1
            histogram[0, key & np.uint32(_DIGITS - 1)] += 1
            histogram[1, (key >> np.uint32(_DIGIT_BITS)) & np.uint32(_DIGITS - 1)] += 1
            histogram[2, key >> np.uint32(2 * _DIGIT_BITS)] += 1
    from_order, from_keys, to_order, to_keys = spare_order, spare_keys, order, sorted_keys
    for digit in range(3):
        shift = np.uint32(digit * _DIGIT_BITS)
        counts = histogram[digit]
        if drawn and counts[(from_keys[0] >> shift) & np.uint32(_DIGITS - 1)] == drawn:
            continue
        position = 0
        for value in range(_DIGITS):
            count = counts[value]
            counts[value] = position
            position += count
        for i in range(drawn):
            key = from_keys[i]
            value = (key >> shift) & np.uint32(_DIGITS - 1)
            target = counts[value]
            counts[value] = target + 1
            to_order[target] = from_order[i]
            to_keys[target] = key
        from_order, from_keys, to_order, to_keys = to_order, to_keys, from_order, from_keys
    for i in range(drawn):
        order[i] = from_order[i]
    return drawn


@njit(nogil=True, cache=True, error_model="numpy")
def count_entries(keys, tile_ranges, tiles_across, active, tile_starts, slot_starts):
    """Count (active tile, surfel) pairs; fill their prefix sums by tile and by surfel; return the longest list."""
    tile_starts[:] = 0
    slots = 0
    for k in range(keys.size):
        slot_starts[k] = slots
        if keys[k] != np.uint32(rec.CULLED):
            left, right, top, bottom = tile_ranges[k]
            for row in range(top, bottom + 1):
                for tile in range(row * tiles_across + left, row * tiles_across + right + 1):
                    if active[tile]:
                        tile_starts[tile + 1] += 1
                        slots += 1
    slot_starts[keys.size] = slots
    longest = 0
    for tile in range(tile_starts.size - 1):
        longest = max(longest, tile_starts[tile + 1])
        tile_starts[tile + 1] += tile_starts[tile]
    return longest


@njit(nogil=True, cache=True, error_model="numpy")
def fill_tiles(order, drawn, tile_ranges, tiles_across, active, tile_starts, slot_starts, entry_surfels, entry_slots):
    """Walk the surfels in depth order and append each to its active tiles, so that every list comes out sorted."""
    cursors = tile_starts[:-1].copy()
    for i in range(drawn):
        k = order[i]
        slot = slot_starts[k]
        left, right, top, bottom = tile_ranges[k]
        for row in range(top, bottom + 1):
            for tile in range(row * tiles_across + left, row * tiles_across + right + 1):
                if active[tile]:
                    entry = cursors[tile]
                    cursors[tile] = entry + 1
                    entry_surfels[entry] = k
                    entry_slots[entry] = slot
                    slot += 1
