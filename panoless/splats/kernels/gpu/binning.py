"""Tile lists: which surfels each tile must look at, nearest first."""

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from panoless.kernels.gpu.launch import ELEMENTS_PER_PROGRAM, programs
from panoless.splats.kernels import constants
from panoless.splats.kernels.gpu.records import (
    CENTER_X,
    CENTER_Y,
    ELLIPSE_X,
    ELLIPSE_Y,
    FORM_XX,
    FORM_XY,
    FORM_YY,
    RECORD_SIZE,
    RHO_MAX,
)

LOW_PASS_PRECISION = tl.constexpr(1 / constants.LOW_PASS_SIGMA**2)
DEPTH_BITS = tl.constexpr(32)


class TileLists(NamedTuple):
    """`surfels[starts[t] : starts[t + 1]]` is the list of tile t; what follows the last list means nothing."""

    surfels: Tensor
    starts: Tensor


@triton.jit
def clamped(value, low, high):
    """The nearest number in [low, high]."""
    return tl.minimum(tl.maximum(value, low), high)


@triton.jit
def touches(record, left, top, mask, TILE: tl.constexpr):
    """Whether a tile, whose first pixel center is given, may hold a pixel with alpha ≥ ALPHA_MIN: the ellipse or the
    low-pass disk meets it. A convex quadratic is least over a rectangle on one of the two edges that face its center.
    """
    xx = tl.load(record + FORM_XX, mask=mask, other=0.0)
    xy = tl.load(record + FORM_XY, mask=mask, other=0.0)
    yy = tl.load(record + FORM_YY, mask=mask, other=0.0)
    x_low = left - tl.load(record + ELLIPSE_X, mask=mask, other=0.0)
    y_low = top - tl.load(record + ELLIPSE_Y, mask=mask, other=0.0)
    x_high, y_high = x_low + (TILE - 1), y_low + (TILE - 1)
    edge_x, edge_y = clamped(0.0, x_low, x_high), clamped(0.0, y_low, y_high)
    best_y = clamped(-xy / tl.where(yy > 0.0, yy, 1.0) * edge_x, y_low, y_high)
    best_x = clamped(-xy / tl.where(xx > 0.0, xx, 1.0) * edge_y, x_low, x_high)
    on_vertical = xx * edge_x * edge_x + (2.0 * xy * edge_x + yy * best_y) * best_y
    on_horizontal = yy * edge_y * edge_y + (2.0 * xy * edge_y + xx * best_x) * best_x
    x_low = left - tl.load(record + CENTER_X, mask=mask, other=0.0)
    y_low = top - tl.load(record + CENTER_Y, mask=mask, other=0.0)
    near_x, near_y = clamped(0.0, x_low, x_low + (TILE - 1)), clamped(0.0, y_low, y_low + (TILE - 1))
    rho_low_pass = (near_x * near_x + near_y * near_y) * LOW_PASS_PRECISION
    in_disk = rho_low_pass <= tl.load(record + RHO_MAX, mask=mask, other=0.0)
    return (tl.minimum(on_vertical, on_horizontal) <= 1.0) | in_disk


@triton.jit(do_not_specialize=["total", "tiles_across", "tiles"])
def sorting_keys(
    table,
    tile_boxes,
    surfels,
    first_candidates,
    keys,
    total,
    tiles_across,
    tiles,
    TILE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Key each (surfel, tile of its box) by tile, then depth; a tile that the surfel doesn't touch becomes `tiles`,
    which sorts behind all. The bits of positive floats are ordered as the floats are.
    """
    candidate = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    active = candidate < total
    k = tl.load(surfels + candidate, mask=active, other=0)
    local = (candidate - tl.load(first_candidates + k, mask=active, other=0)).to(tl.int32)
    box = tile_boxes + 4 * k
    columns = tl.load(box + 2, mask=active, other=1)
    column = tl.load(box, mask=active, other=0) + local % columns
    row = tl.load(box + 1, mask=active, other=0) + local // columns
    left = (column * TILE).to(tl.float32) + 0.5
    top = (row * TILE).to(tl.float32) + 0.5
    touched = touches(table + k * RECORD_SIZE, left, top, active, TILE)
    tile = tl.where(touched, row * tiles_across + column, tiles)
    depth_bits = tl.load(box + 3, mask=active, other=0)
    tl.store(keys + candidate, (tile.to(tl.int64) << DEPTH_BITS) | depth_bits.to(tl.int64), mask=active)


def tile_lists(
    table: Tensor, tile_boxes: Tensor, candidates: Tensor, tiles_across: int, tiles: int, tile: int
) -> TileLists:
    """Sort the touched tiles of all surfels. The sort is stable, so equal depths keep the order of the surfels.

    Reading the number of candidates is the only point at which the host waits for the device.
    """
    ends = torch.cumsum(candidates, 0)
    total = int(ends[-1]) if len(ends) else 0
    everyone = torch.arange(len(candidates), dtype=torch.int32, device=table.device)
    surfels = torch.repeat_interleave(everyone, candidates, output_size=total)
    keys = torch.empty(total, dtype=torch.int64, device=table.device)
    if total:
        sorting_keys[programs(total)](
            table,
            tile_boxes,
            surfels,
            ends - candidates,
            keys,
            total,
            tiles_across,
            tiles,
            TILE=tile,
            BLOCK=ELEMENTS_PER_PROGRAM,
        )
    keys, order = torch.sort(keys, stable=True)
    boundaries = torch.arange(tiles + 1, device=table.device) << DEPTH_BITS.value
    return TileLists(surfels[order], torch.searchsorted(keys, boundaries).to(torch.int32))
