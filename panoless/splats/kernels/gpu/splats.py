"""The Triton blend of splats: one program a tile, all of whose pixels walk the tile's list together."""

from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from panoless.kernels.gpu import launch
from panoless.splats.kernels import constants
from panoless.splats.kernels.gpu.blend import tile_pixels
from panoless.splats.kernels.reference.splats import tile_boxes

CAP = tl.constexpr(constants.ALPHA_MAX)
LEAST = tl.constexpr(constants.ALPHA_MIN)
STOP = tl.constexpr(constants.TRANSMITTANCE_MIN)
GEOMETRY = tl.constexpr(6)


class Fragment(NamedTuple):
    """One splat seen through the pixels of a tile."""

    dx: Any
    dy: Any
    xx: Any
    xy: Any
    yy: Any
    gaussian: Any
    uncapped: Any
    """Opacity times Gaussian, before it is capped at ALPHA_MAX."""


@triton.jit
def find_fragment(splats, k, pixels):
    """See one splat through the pixels of a tile."""
    row = splats + k * GEOMETRY
    dx, dy = pixels.x - tl.load(row), pixels.y - tl.load(row + 1)
    xx, xy, yy = tl.load(row + 2), tl.load(row + 3), tl.load(row + 4)
    gaussian = tl.exp(-0.5 * (xx * dx * dx + 2.0 * xy * dx * dy + yy * dy * dy))
    return Fragment(dx, dy, xx, xy, yy, gaussian, tl.load(row + 5) * gaussian)


class Taken(NamedTuple):
    """What pixels take of one splat behind all before it, and how much light they let through then."""

    covered: Any
    """Whether it adds to a pixel."""
    alive: Any
    alpha: Any
    weight: Any
    """Transmittance times alpha, zero where it adds nothing."""
    transmittance: Any


@triton.jit
def take_fragment(seen, transmittance, alive):
    """Blend one splat over the pixels that are not finished."""
    alpha = tl.minimum(seen.uncapped, CAP)
    after = transmittance - transmittance * alpha
    covered = alive & (seen.uncapped >= LEAST)
    alive = alive & ~(covered & (after < STOP))
    covered = covered & (after >= STOP)
    weight = tl.where(covered, transmittance * alpha, 0.0)
    return Taken(covered, alive, alpha, weight, tl.where(covered, after, transmittance))


@triton.jit
def splats_forward(
    splats, attributes, entries, starts, channels, alphas, width, height, count, TILE: tl.constexpr, WIDE: tl.constexpr
):
    """Write the images of one tile; `WIDE` is a power of two of at least `count` channels."""
    tile = tl.program_id(0)
    pixels = tile_pixels(tile, width, height, TILE)
    each = tl.arange(0, WIDE)
    transmittance = tl.full((TILE * TILE,), 1.0, tl.float32)
    alive = pixels.inside
    sums = tl.zeros((TILE * TILE, WIDE), tl.float32)
    for entry in range(tl.load(starts + tile), tl.load(starts + tile + 1)):
        k = tl.load(entries + entry).to(tl.int64)
        seen = find_fragment(splats, k, pixels)
        taken = take_fragment(seen, transmittance, alive)
        alive = taken.alive
        values = tl.load(attributes + k * count + each, mask=each < count, other=0.0)
        sums += taken.weight[:, None] * values[None, :]
        transmittance = taken.transmittance
    places = each[None, :] * (width * height) + pixels.at[:, None]
    tl.store(channels + places, sums, mask=pixels.inside[:, None] & (each < count)[None, :])
    tl.store(alphas + pixels.at, 1.0 - transmittance, mask=pixels.inside)


@triton.jit
def splats_back(
    splats,
    attributes,
    entries,
    starts,
    channel_cotangents,
    alpha_cotangents,
    totals,
    gradients,
    attribute_gradients,
    width,
    height,
    count,
    TILE: tl.constexpr,
    WIDE: tl.constexpr,
):
    """Add what one tile pulls back to the gradients; `totals` is what all fragments of a pixel add to the loss."""
    tile = tl.program_id(0)
    pixels = tile_pixels(tile, width, height, TILE)
    each = tl.arange(0, WIDE)
    places = each[None, :] * (width * height) + pixels.at[:, None]
    inside = pixels.inside[:, None] & (each < count)[None, :]
    cotangents = tl.load(channel_cotangents + places, mask=inside, other=0.0)
    of_alpha = tl.load(alpha_cotangents + pixels.at, mask=pixels.inside, other=0.0)
    behind = tl.load(totals + pixels.at, mask=pixels.inside, other=0.0)
    transmittance = tl.full((TILE * TILE,), 1.0, tl.float32)
    alive = pixels.inside
    for entry in range(tl.load(starts + tile), tl.load(starts + tile + 1)):
        k = tl.load(entries + entry).to(tl.int64)
        seen = find_fragment(splats, k, pixels)
        taken = take_fragment(seen, transmittance, alive)
        alive = taken.alive
        values = tl.load(attributes + k * count + each, mask=each < count, other=0.0)
        worth = of_alpha + tl.sum(values[None, :] * cotangents, 1)
        behind -= taken.weight * worth
        pull = transmittance * worth - behind / (1.0 - taken.alpha)
        pull = tl.where(taken.covered & (seen.uncapped < CAP), pull, 0.0)
        row = gradients + k * GEOMETRY
        tl.atomic_add(row + 5, tl.sum(pull * seen.gaussian))
        pull *= -0.5 * seen.uncapped
        tl.atomic_add(row, tl.sum(-2.0 * pull * (seen.xx * seen.dx + seen.xy * seen.dy)))
        tl.atomic_add(row + 1, tl.sum(-2.0 * pull * (seen.xy * seen.dx + seen.yy * seen.dy)))
        tl.atomic_add(row + 2, tl.sum(pull * seen.dx * seen.dx))
        tl.atomic_add(row + 3, tl.sum(2.0 * pull * seen.dx * seen.dy))
        tl.atomic_add(row + 4, tl.sum(pull * seen.dy * seen.dy))
        pulled = tl.sum(taken.weight[:, None] * cotangents, 0)
        tl.atomic_add(attribute_gradients + k * count + each, pulled, mask=each < count)
        transmittance = taken.transmittance


def tile_lists(boxes: Tensor, depths: Tensor, height: int, width: int, tile: int) -> tuple[Tensor, Tensor]:
    """The splats of each tile, nearest first and ties by index, and where each tile's list starts."""
    left, right, top, bottom = boxes.long().unbind(1)
    seen = right >= left
    first_column, first_row = left // tile, top // tile
    columns, rows = right // tile - first_column + 1, bottom // tile - first_row + 1
    counts = torch.where(seen, columns * rows, 0)
    splats = torch.repeat_interleave(counts)
    local = torch.arange(len(splats), device=boxes.device) - (counts.cumsum(0) - counts)[splats]
    across, tiles = -(-width // tile), -(-width // tile) * -(-height // tile)
    tile_of = (first_row[splats] + local // columns[splats]) * across + first_column[splats] + local % columns[splats]
    by_depth = torch.argsort(depths[splats], stable=True)
    order = by_depth[torch.argsort(tile_of[by_depth], stable=True)]
    starts = torch.searchsorted(tile_of[order], torch.arange(tiles + 1, device=boxes.device))
    return splats[order].to(torch.int32), starts.to(torch.int32)


class _BlendSplats(torch.autograd.Function):
    @staticmethod
    def forward(ctx, centers, precisions, opacities, attributes, depths, drawn, height, width):
        tile = launch.TILES.tile
        boxes = tile_boxes(centers, precisions, opacities, drawn, height, width)
        entries, starts = tile_lists(boxes, depths, height, width, tile)
        splats = torch.cat([centers, precisions, opacities[:, None]], 1).contiguous()
        attributes = attributes.contiguous()
        count = attributes.shape[1]
        channels, alphas = splats.new_empty(count, height, width), splats.new_empty(height, width)
        ctx.setting = width, height, count, tile, triton.next_power_of_2(count)
        _launch(splats_forward, ctx.setting, splats, attributes, entries, starts, channels, alphas)
        ctx.save_for_backward(splats, attributes, entries, starts, channels, alphas)
        return channels, alphas

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, channel_cotangents, alpha_cotangents):
        splats, attributes, entries, starts, channels, alphas = ctx.saved_tensors
        totals = (channels * channel_cotangents).sum(0) + alphas * alpha_cotangents
        cotangents = channel_cotangents.contiguous(), alpha_cotangents.contiguous(), totals
        found, pulled = torch.zeros_like(splats), torch.zeros_like(attributes)
        _launch(splats_back, ctx.setting, splats, attributes, entries, starts, *cotangents, found, pulled)
        return found[:, :2], found[:, 2:5], found[:, 5], pulled, None, None, None, None


def _launch(kernel, setting, *tensors) -> None:
    width, height, count, tile, wide = setting
    tiles = triton.cdiv(width, tile) * triton.cdiv(height, tile)
    kernel[(tiles,)](*tensors, width, height, count, TILE=tile, WIDE=wide, num_warps=launch.TILES.warps)


def blend_splats(centers, precisions, opacities, attributes, depths, drawn, height, width):
    """Blend float32 splats on the GPU; see `panoless.splats.kernels.splats.blend_splats` for what it computes."""
    return _BlendSplats.apply(centers, precisions, opacities, attributes, depths, drawn, height, width)
