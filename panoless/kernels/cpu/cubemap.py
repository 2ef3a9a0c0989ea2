"""Seamless cubemap lookup and its adjoint in Numba.

The faces are first copied, with their ring of neighboring texels, into a padded texture whose channels lie
together, so that a ray touches two short runs of memory and never asks where a face ends. The adjoint goes the
same way back: fixed shares of the rays add to padded buffers of their own, which are then summed and folded onto the
faces in a fixed order, so the result depends neither on the scheduling of threads nor on their number.

Rays go in blocks: all of a block are projected first, without a branch, then each is interpolated. What the ray loops
touch is passed flat, because LLVM vectorizes steps of a constant 3 but guesses wrong about the row length of a
matrix (22 times slower, measured); and the channels are passed as an `unrolled` tuple, because its length is a
constant to the compiler.
"""

from functools import lru_cache
from threading import get_ident

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from panoless.kernels.cpu.compilation import VECTORIZED_LOOPS
from panoless.kernels.cpu.simd_memory import fetch_add
from panoless.kernels.cpu.workers import run_shared
from panoless.kernels.reference.cubemap import SHORTEST_DIRECTION, cubemap_padding

f32 = np.float32
SHORTEST, LARGEST = f32(SHORTEST_DIRECTION), np.finfo(np.float32).max
RAYS_PER_BLOCK = 512
LINES_PER_CLAIM = 16
MOST_SHARES = 4
"""Of the rays that are scattered: so many threads can work at them."""


class SampleCubemap(torch.autograd.Function):
    """Bilinear lookup; saves the padded texture, which belongs to this call, and the directions."""

    @staticmethod
    def forward(ctx, cubemap, directions):
        _, channels, resolution, _ = cubemap.shape
        padding = cubemap_padding(resolution, torch.device("cpu"))
        texture = cubemap.new_empty(6, resolution + 2, resolution + 2, channels)
        faces = cubemap.detach().contiguous().numpy()
        run_shared(_pad, faces, padding.sources.numpy(), padding.corners.numpy(), texture.numpy())
        directions = directions.detach().contiguous()
        values = directions.new_empty(len(directions), channels)
        rays = _flat(directions), _flat(values)
        run_shared(_sample, _flat(texture), resolution, *rays, _samples(directions), (0,) * channels)
        ctx.save_for_backward(texture, directions)
        return values

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_values):
        texture, directions = ctx.saved_tensors
        grad_values = grad_values.contiguous()
        grad_cubemap = grad_directions = None
        if ctx.needs_input_grad[0]:
            grad_cubemap = scatter_cubemap(grad_values, directions, texture.shape[1] - 2)
        if ctx.needs_input_grad[1]:
            grad_directions = torch.empty_like(directions)
            _, padded, _, channels = texture.shape
            samples = _samples(directions)
            each = grad_values if samples == 1 else (grad_values / samples).repeat_interleave(samples, 0)
            rays = _flat(directions), _flat(each), _flat(grad_directions)
            run_shared(_pull_to_directions, _flat(texture), padded - 2, *rays, (0,) * channels)
        return grad_cubemap, grad_directions


def scatter_cubemap(
    values: Float[Tensor, "P C"], directions: Float[Tensor, "P *K 3"], resolution: int
) -> Float[Tensor, "6 C L L"]:
    """The adjoint of `SampleCubemap` in its first argument."""
    channels, samples = values.shape[1], _samples(directions)
    padding = cubemap_padding(resolution, torch.device("cpu"))
    # Clearing and adding up one more buffer must cost less than the work it takes from the others.
    useful = max(1, 4 * samples * len(directions) // (6 * resolution**2))
    buffers = _scatter_buffers(min(MOST_SHARES, useful), resolution, channels, get_ident())
    flat_buffers = buffers.reshape(len(buffers), -1)
    run_shared(_scatter, _flat(values), _flat(directions), flat_buffers, resolution, samples, (0,) * channels)
    cubemap = values.new_empty(6, channels, resolution, resolution)
    run_shared(_add_up, buffers, cubemap.numpy())
    _fold_rings(buffers, padding.sources.numpy(), padding.corners.numpy(), cubemap.numpy())
    return cubemap


def _samples(directions: Float[Tensor, "P *K 3"]) -> int:
    """How many directions belong to each value."""
    return directions.shape[1] if directions.ndim == 3 else 1


def _flat(tensor: Tensor) -> Float[np.ndarray, "N"]:
    return tensor.detach().contiguous().numpy().reshape(-1)


@lru_cache(maxsize=4)
def _scatter_buffers(
    count: int, resolution: int, channels: int, owner: int
) -> Float[np.ndarray, "buffers 6 padded padded C"]:
    """Scratch of one Python thread (`owner`) that every scatter of this shape clears and uses again."""
    return np.empty((count, 6, resolution + 2, resolution + 2, channels), f32)


@njit(**VECTORIZED_LOOPS)
def _pad(counter, cubemap, sources, corners, texture):
    """Copy the faces, channels last, with their ring of neighbors."""
    _, channels, resolution, _ = cubemap.shape
    last = resolution + 1
    while True:
        first = fetch_add(counter, LINES_PER_CLAIM)
        if first >= 6 * (resolution + 2):
            return
        for line in range(first, min(first + LINES_PER_CLAIM, 6 * (resolution + 2))):
            face, row = line // (resolution + 2), line % (resolution + 2)
            out = texture[face, row]
            if 0 < row < last:
                for channel in range(channels):
                    texels = cubemap[face, channel, row - 1]
                    for i in range(resolution):
                        out[i + 1, channel] = texels[i]
            for column in range(0, resolution + 2, last if 0 < row < last else 1):
                source = sources[face, row, column]
                for channel in range(channels):
                    out[column, channel] = _extended_texel(cubemap, corners, source, channel)


@njit(**VECTORIZED_LOOPS)
def _extended_texel(cubemap, corners, source, channel):
    area = cubemap.shape[2] * cubemap.shape[3]
    if source < 6 * area:
        return cubemap[source // area, channel].flat[source % area]
    total = f32(0)
    for texel in corners[source - 6 * area]:
        total += cubemap[texel // area, channel].flat[texel % area]
    return total / f32(3)


@njit(**VECTORIZED_LOOPS)
def _locate(directions, resolution, cells, rights, downs, present):
    """Upper left of the four texels around each ray, position between them, and 1, or 0 if it looks nowhere."""
    half = f32(0.5) * f32(resolution)
    middle = half + f32(0.5)
    stride = np.int32(resolution + 2)
    for i in range(directions.size // 3):
        x, y, z = directions[3 * i], directions[3 * i + 1], directions[3 * i + 2]
        ax, ay, az = abs(x), abs(y), abs(z)
        on_x = (ax >= ay) & (ax >= az)
        on_y = (not on_x) & (ay >= az)
        major = x if on_x else (y if on_y else z)
        negative = major < f32(0)
        sign = f32(-1) if negative else f32(1)
        s = -sign * z if on_x else (x if on_y else sign * x)
        t = sign * z if on_y else -y
        magnitude = abs(major)
        usable = (magnitude >= SHORTEST) & (ax <= LARGEST) & (ay <= LARGEST) & (az <= LARGEST)
        scale = half / magnitude
        column = s * scale + middle if usable else f32(0)
        row = t * scale + middle if usable else f32(0)
        left, top = np.int32(column), np.int32(row)
        rights[i], downs[i] = column - f32(left), row - f32(top)
        axis = np.int32(0) if on_x else (np.int32(2) if on_y else np.int32(4))
        face = axis + (np.int32(1) if negative else np.int32(0))
        cells[i] = (face * stride + top) * stride + left if usable else np.int32(0)
        present[i] = f32(1) if usable else f32(0)


@njit(**VECTORIZED_LOOPS)
def _sample(counter, texture, resolution, directions, values, samples, unrolled):
    """Means over so many directions each."""
    count, channels, block = directions.size // 3 // samples, len(unrolled), max(RAYS_PER_BLOCK // samples, 1)
    cells, places = np.empty(block * samples, np.int32), np.empty((3, block * samples), np.float32)
    while True:
        begin = fetch_add(counter, block)
        if begin >= count:
            return
        end = min(begin + block, count)
        share = directions[3 * samples * begin : 3 * samples * end]
        _locate(share, resolution, cells, places[0], places[1], places[2])
        out = values[channels * begin : channels * end]
        if samples == 1:
            _interpolate(texture, resolution + 2, cells, places, out, unrolled)
        else:
            _interpolate_means(texture, resolution + 2, cells, places, out, samples, unrolled)


@njit(**VECTORIZED_LOOPS)
def _interpolate(texture, stride, cells, places, values, unrolled):
    channels = len(unrolled)
    for i in range(values.size // channels):
        right, down = places[0, i], places[1, i]
        left, up = places[2, i] - right, f32(1) - down
        a = np.int64(cells[i]) * channels
        b, c = a + channels, a + stride * channels
        d = c + channels
        for k in range(channels):
            upper = left * texture[a + k] + right * texture[b + k]
            lower = left * texture[c + k] + right * texture[d + k]
            values[channels * i + k] = up * upper + down * lower


@njit(**VECTORIZED_LOOPS)
def _interpolate_means(texture, stride, cells, places, values, samples, unrolled):
    channels, share = len(unrolled), f32(1) / f32(samples)
    values[:] = f32(0)
    for pixel in range(values.size // channels):
        for i in range(samples * pixel, samples * (pixel + 1)):
            right, down = places[0, i], places[1, i] * share
            left, up = places[2, i] - right, share - down
            a = np.int64(cells[i]) * channels
            b, c = a + channels, a + stride * channels
            d = c + channels
            for k in range(channels):
                upper = left * texture[a + k] + right * texture[b + k]
                lower = left * texture[c + k] + right * texture[d + k]
                values[channels * pixel + k] += up * upper + down * lower


@njit(**VECTORIZED_LOOPS)
def _scatter(counter, values, directions, buffers, resolution, samples, unrolled):
    """Clear each padded buffer and add its share of the rays to it: the same share whichever thread comes to it."""
    count, channels, block = directions.size // 3 // samples, len(unrolled), max(RAYS_PER_BLOCK // samples, 1)
    shares = len(buffers)
    cells, places = np.empty(block * samples, np.int32), np.empty((3, block * samples), np.float32)
    while True:
        task = fetch_add(counter, 1)
        if task >= shares:
            return
        buffer = buffers[task]
        buffer[:] = f32(0)
        last = (task + 1) * count // shares
        for begin in range(task * count // shares, last, block):
            end = min(begin + block, last)
            share = directions[3 * samples * begin : 3 * samples * end]
            _locate(share, resolution, cells, places[0], places[1], places[2])
            _deposit(
                values[channels * begin : channels * end], resolution + 2, cells, places, buffer, samples, unrolled
            )


@njit(**VECTORIZED_LOOPS)
def _deposit(values, stride, cells, places, buffer, samples, unrolled):
    channels, share = len(unrolled), f32(1) / f32(samples)
    for pixel in range(values.size // channels):
        for i in range(samples * pixel, samples * (pixel + 1)):
            right, down = places[0, i], places[1, i] * share
            left, up = places[2, i] - right, share - down
            a = np.int64(cells[i]) * channels
            b, c = a + channels, a + stride * channels
            d = c + channels
            for k in range(channels):
                value = values[channels * pixel + k]
                buffer[a + k] += up * left * value
                buffer[b + k] += up * right * value
                buffer[c + k] += down * left * value
                buffer[d + k] += down * right * value


@njit(**VECTORIZED_LOOPS)
def _add_up(counter, buffers, cubemap):
    """Sum the inner parts of the buffers, in their order, channels first."""
    count, _, padded, _, channels = buffers.shape
    resolution = padded - 2
    while True:
        first = fetch_add(counter, LINES_PER_CLAIM)
        if first >= 6 * resolution:
            return
        for line in range(first, min(first + LINES_PER_CLAIM, 6 * resolution)):
            face, row = line // resolution, line % resolution
            for channel in range(channels):
                out = cubemap[face, channel, row]
                for i in range(resolution):
                    total = f32(0)
                    for buffer in range(count):
                        total += buffers[buffer, face, row + 1, i + 1, channel]
                    out[i] = total


@njit(**VECTORIZED_LOOPS)
def _fold_rings(buffers, sources, corners, cubemap):
    """Add what was deposited in the ring around each face to the texels that it shows."""
    count, _, padded, _, channels = buffers.shape
    for face in range(6):
        for row in range(padded):
            for column in range(0, padded, padded - 1 if 0 < row < padded - 1 else 1):
                source = sources[face, row, column]
                for channel in range(channels):
                    total = f32(0)
                    for buffer in range(count):
                        total += buffers[buffer, face, row, column, channel]
                    _add_to_extended_texel(cubemap, corners, source, channel, total)


@njit(**VECTORIZED_LOOPS)
def _add_to_extended_texel(cubemap, corners, source, channel, value):
    resolution = cubemap.shape[3]
    area = resolution * resolution
    if source < 6 * area:
        cubemap[source // area, channel, source % area // resolution, source % resolution] += value
        return
    for texel in corners[source - 6 * area]:
        cubemap[texel // area, channel, texel % area // resolution, texel % resolution] += value / f32(3)


@njit(**VECTORIZED_LOOPS)
def _pull_to_directions(counter, texture, resolution, directions, grad_values, grad_directions, unrolled):
    """Derivative of the interpolation by the place in the cell, then of the central projection by the direction."""
    rays, channels = directions.size // 3, len(unrolled)
    cells, places = np.empty(RAYS_PER_BLOCK, np.int32), np.empty((3, RAYS_PER_BLOCK), np.float32)
    while True:
        begin = fetch_add(counter, RAYS_PER_BLOCK)
        if begin >= rays:
            return
        end = min(begin + RAYS_PER_BLOCK, rays)
        share = directions[3 * begin : 3 * end]
        _locate(share, resolution, cells, places[0], places[1], places[2])
        _pull_to_places(
            texture, resolution + 2, cells, places, grad_values[channels * begin : channels * end], unrolled
        )
        _pull_through_projection(share, resolution, places[0], places[1], grad_directions[3 * begin : 3 * end])


@njit(**VECTORIZED_LOOPS)
def _pull_to_places(texture, stride, cells, places, grad_values, unrolled):
    """Replace each ray's place in its cell by the derivatives of the loss by it."""
    channels = len(unrolled)
    for i in range(grad_values.size // channels):
        right, down = places[0, i], places[1, i]
        left, up = f32(1) - right, f32(1) - down
        a = np.int64(cells[i]) * channels
        b, c = a + channels, a + stride * channels
        d = c + channels
        by_right, by_down = f32(0), f32(0)
        for k in range(channels):
            grad = grad_values[channels * i + k]
            by_right += grad * (up * (texture[b + k] - texture[a + k]) + down * (texture[d + k] - texture[c + k]))
            by_down += grad * (left * (texture[c + k] - texture[a + k]) + right * (texture[d + k] - texture[b + k]))
        places[0, i], places[1, i] = by_right, by_down


@njit(**VECTORIZED_LOOPS)
def _pull_through_projection(directions, resolution, by_rights, by_downs, grad_directions):
    """With s = s_c/|m|: ∂/∂s_c = ∂/∂s / |m| and ∂/∂m = −sign(m)·(s·∂/∂s + t·∂/∂t) / |m|; see `_locate`."""
    half = f32(0.5) * f32(resolution)
    for i in range(directions.size // 3):
        x, y, z = directions[3 * i], directions[3 * i + 1], directions[3 * i + 2]
        ax, ay, az = abs(x), abs(y), abs(z)
        on_x = (ax >= ay) & (ax >= az)
        on_y = (not on_x) & (ay >= az)
        major = x if on_x else (y if on_y else z)
        sign = f32(-1) if major < f32(0) else f32(1)
        s = -sign * z if on_x else (x if on_y else sign * x)
        t = sign * z if on_y else -y
        magnitude = abs(major)
        usable = (magnitude >= SHORTEST) & (ax <= LARGEST) & (ay <= LARGEST) & (az <= LARGEST)
        inverse = f32(1) / magnitude
        by_s, by_t = by_rights[i] * half * inverse, by_downs[i] * half * inverse
        by_major = -sign * (by_s * (s * inverse) + by_t * (t * inverse))
        grad_x = by_major if on_x else (by_s if on_y else sign * by_s)
        grad_y = by_major if on_y else -by_t
        grad_z = -sign * by_s if on_x else (sign * by_t if on_y else by_major)
        grad_directions[3 * i] = grad_x if usable else f32(0)
        grad_directions[3 * i + 1] = grad_y if usable else f32(0)
        grad_directions[3 * i + 2] = grad_z if usable else f32(0)
