"""Cubemap lookup, its gradients and its adjoint in Triton: one program a block of rays.

The faces are padded by their ring of neighbors in torch, as the definition has it; the kernels then never meet a seam.
"""

from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from panoless.kernels.gpu.launch import ELEMENTS_PER_PROGRAM, programs
from panoless.kernels.reference import cubemap as reference

SHORTEST = tl.constexpr(reference.SHORTEST_DIRECTION)
LARGEST = tl.constexpr(torch.finfo(torch.float32).max)


class SampleCubemap(torch.autograd.Function):
    """Bilinear lookup; saves the padded texture and the directions."""

    @staticmethod
    def forward(ctx, cubemap, directions):
        _, channels, resolution, _ = cubemap.shape
        texture = reference.padded_texels(cubemap.detach()).contiguous()
        directions = directions.detach().contiguous()
        values = directions.new_empty(len(directions), channels)
        if len(directions):
            sample[programs(len(directions))](
                texture,
                directions,
                values,
                len(directions),
                resolution,
                CHANNELS=channels,
                BLOCK=ELEMENTS_PER_PROGRAM,
            )
        ctx.save_for_backward(texture, directions)
        ctx.resolution = resolution
        return values

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_values):
        texture, directions = ctx.saved_tensors
        grad_values = grad_values.contiguous()
        grad_cubemap = grad_directions = None
        if ctx.needs_input_grad[0]:
            grad_cubemap = scatter_cubemap(grad_values, directions, ctx.resolution)
        if ctx.needs_input_grad[1]:
            grad_directions = torch.empty_like(directions)
            if len(directions):
                pull_to_directions[programs(len(directions))](
                    texture,
                    directions,
                    grad_values,
                    grad_directions,
                    len(directions),
                    ctx.resolution,
                    CHANNELS=texture.shape[1],
                    BLOCK=ELEMENTS_PER_PROGRAM,
                )
        return grad_cubemap, grad_directions


def scatter_cubemap(
    values: Float[Tensor, "P C"], directions: Float[Tensor, "P 3"], resolution: int
) -> Float[Tensor, "6 C L L"]:
    """The adjoint of `SampleCubemap` in its first argument; the order of its additions is not fixed."""
    channels = values.shape[1]
    padded = values.new_zeros(6 * (resolution + 2) ** 2, channels)
    if len(directions):
        scatter[programs(len(directions))](
            values.detach().contiguous(),
            directions.detach().contiguous(),
            padded,
            len(directions),
            resolution,
            CHANNELS=channels,
            BLOCK=ELEMENTS_PER_PROGRAM,
        )
    return reference.fold_padding(padded, resolution)


class Place(NamedTuple):
    """Where rays meet the cube; see `panoless.kernels.reference.cubemap`."""

    face: Any
    sign: Any
    """Of the dominant coordinate m, ±1."""
    inverse: Any
    """1/|m|."""
    s: Any
    t: Any
    usable: Any
    first: Any
    """Flat index of the upper left of the four texels around, in the padded faces."""
    right: Any
    """Share of the right ones."""
    down: Any
    """Share of the lower ones."""


@triton.jit
def locate(directions, ray, active, resolution):
    """Project rays to the cube."""
    x = tl.load(directions + 3 * ray, mask=active, other=1.0)
    y = tl.load(directions + 3 * ray + 1, mask=active, other=0.0)
    z = tl.load(directions + 3 * ray + 2, mask=active, other=0.0)
    far_x, far_y, far_z = tl.abs(x), tl.abs(y), tl.abs(z)
    on_x = (far_x >= far_y) & (far_x >= far_z)
    on_y = (on_x == 0) & (far_y >= far_z)
    major = tl.where(on_x, x, tl.where(on_y, y, z))
    sign = tl.where(major < 0.0, -1.0, 1.0)
    usable = (tl.abs(major) >= SHORTEST) & (far_x <= LARGEST) & (far_y <= LARGEST) & (far_z <= LARGEST)
    inverse = 1.0 / tl.where(usable, tl.abs(major), 1.0)
    s = tl.where(usable, tl.where(on_x, -sign * z, tl.where(on_y, x, sign * x)) * inverse, 0.0)
    t = tl.where(usable, tl.where(on_y, sign * z, -y) * inverse, 0.0)
    axis = tl.where(on_x, 0, tl.where(on_y, 2, 4))
    face = tl.where(usable, axis + (major < 0.0).to(tl.int32), 0)
    half = resolution * 0.5
    # A quotient of two numbers may round to a little more than 1.
    column = tl.minimum(tl.maximum(s * half + (half + 0.5), 0.0), resolution + 0.5)
    row = tl.minimum(tl.maximum(t * half + (half + 0.5), 0.0), resolution + 0.5)
    left, top = tl.floor(column), tl.floor(row)
    first = (face * (resolution + 2) + top.to(tl.int32)) * (resolution + 2) + left.to(tl.int32)
    return Place(face, sign, inverse, s, t, usable, first, column - left, row - top)


@triton.jit(do_not_specialize=["rays", "resolution"])
def sample(texture, directions, values, rays, resolution, CHANNELS: tl.constexpr, BLOCK: tl.constexpr):
    """Look up a block of rays."""
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = ray < rays
    place = locate(directions, ray, active, resolution)
    right, down, seen = place.right, place.down, active & place.usable
    below = (resolution + 2) * CHANNELS
    for channel in tl.static_range(CHANNELS):
        texel = texture + place.first * CHANNELS + channel
        upper = tl.load(texel, mask=seen, other=0.0) * (1.0 - right)
        upper += tl.load(texel + CHANNELS, mask=seen, other=0.0) * right
        lower = tl.load(texel + below, mask=seen, other=0.0) * (1.0 - right)
        lower += tl.load(texel + below + CHANNELS, mask=seen, other=0.0) * right
        tl.store(values + ray * CHANNELS + channel, upper * (1.0 - down) + lower * down, mask=active)


@triton.jit(do_not_specialize=["rays", "resolution"])
def scatter(values, directions, padded, rays, resolution, CHANNELS: tl.constexpr, BLOCK: tl.constexpr):
    """Add a block of rays to the four texels that each would read."""
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = ray < rays
    place = locate(directions, ray, active, resolution)
    right, down, seen = place.right, place.down, active & place.usable
    below = (resolution + 2) * CHANNELS
    for channel in tl.static_range(CHANNELS):
        value = tl.load(values + ray * CHANNELS + channel, mask=seen, other=0.0)
        texel = padded + place.first * CHANNELS + channel
        tl.atomic_add(texel, value * (1.0 - right) * (1.0 - down), mask=seen, sem="relaxed")
        tl.atomic_add(texel + CHANNELS, value * right * (1.0 - down), mask=seen, sem="relaxed")
        tl.atomic_add(texel + below, value * (1.0 - right) * down, mask=seen, sem="relaxed")
        tl.atomic_add(texel + below + CHANNELS, value * right * down, mask=seen, sem="relaxed")


@triton.jit(do_not_specialize=["rays", "resolution"])
def pull_to_directions(
    texture, directions, grad_values, grad_directions, rays, resolution, CHANNELS: tl.constexpr, BLOCK: tl.constexpr
):
    """Derivative of the interpolation by the place in the cell, then of the central projection by the direction: with
    s = s_c/|m|, ∂/∂s_c = ∂/∂s / |m| and ∂/∂m = −sign(m)·(s·∂/∂s + t·∂/∂t) / |m|.
    """
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = ray < rays
    place = locate(directions, ray, active, resolution)
    right, down, seen = place.right, place.down, active & place.usable
    below = (resolution + 2) * CHANNELS
    by_right, by_down = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for channel in tl.static_range(CHANNELS):
        gradient = tl.load(grad_values + ray * CHANNELS + channel, mask=seen, other=0.0)
        texel = texture + place.first * CHANNELS + channel
        a = tl.load(texel, mask=seen, other=0.0)
        b = tl.load(texel + CHANNELS, mask=seen, other=0.0)
        c = tl.load(texel + below, mask=seen, other=0.0)
        d = tl.load(texel + below + CHANNELS, mask=seen, other=0.0)
        by_right += gradient * ((1.0 - down) * (b - a) + down * (d - c))
        by_down += gradient * ((1.0 - right) * (c - a) + right * (d - b))
    half = resolution * 0.5
    by_s, by_t = by_right * half * place.inverse, by_down * half * place.inverse
    sign, usable = place.sign, place.usable
    by_major = -sign * (by_s * place.s + by_t * place.t)
    on_x, on_y = place.face < 2, (place.face == 2) | (place.face == 3)
    grad_x = tl.where(on_x, by_major, tl.where(on_y, by_s, sign * by_s))
    grad_y = tl.where(on_y, by_major, -by_t)
    grad_z = tl.where(on_x, -sign * by_s, tl.where(on_y, sign * by_t, by_major))
    tl.store(grad_directions + 3 * ray, tl.where(usable, grad_x, 0.0), mask=active)
    tl.store(grad_directions + 3 * ray + 1, tl.where(usable, grad_y, 0.0), mask=active)
    tl.store(grad_directions + 3 * ray + 2, tl.where(usable, grad_z, 0.0), mask=active)
