"""Seamless cubemap lookup, its adjoint and the product of both in Numba.

The faces are first copied, with their ring of neighboring texels, into a padded texture of which four channels lie
together, so that a ray touches two short runs of memory and needs no test where a face ends, and the four texels around
it are one value of sixteen lanes. The adjoint goes the same way back: fixed shares of the rays add to padded buffers of
their own, which are then summed and folded onto the faces in a fixed order, so the result depends neither on the
scheduling of threads nor on their number.

Rays go in blocks: all of a block are projected first, without a branch, then each is interpolated or deposited. What
the projection touches is passed flat, because LLVM vectorizes steps of a constant 3 but guesses wrong about the row
length of a matrix (22 times slower, measured).
"""

from functools import lru_cache
from threading import get_ident

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from panoless.kernels.cpu.compilation import LANE_CODE, VECTORIZED_LOOPS
from panoless.kernels.cpu.simd import lanes
from panoless.kernels.cpu.simd_memory import (
    add_cell,
    cell_weights,
    fetch_add,
    load_cell,
    load_color,
    store_color,
)
from panoless.kernels.cpu.workers import run_shared
from panoless.kernels.reference.cubemap import SHORTEST_DIRECTION, cubemap_padding

f32 = np.float32
SHORTEST, LARGEST = f32(SHORTEST_DIRECTION), np.finfo(np.float32).max
TOGETHER = 4
"""Channels of a texel that lie side by side; those that a cubemap has not are zero."""
RAYS_PER_BLOCK = 512
LINES_PER_CLAIM = 16
MOST_SHARES = 4
"""Of the rays that are scattered: so many threads can work at them."""


class SampleCubemap(torch.autograd.Function):
    """Bilinear lookup; saves the padded texture, which belongs to this call, and the directions."""

    @staticmethod
    def forward(ctx, cubemap, directions):
        texture, directions = padded_texture(cubemap), directions.detach().contiguous()
        values = directions.new_empty(len(directions), cubemap.shape[1])
        run_shared(_sample, texture.numpy(), flat(directions), values.numpy(), _samples(directions))
        ctx.save_for_backward(texture, directions)
        return values

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_values):
        texture, directions = ctx.saved_tensors
        grad_values = grad_values.contiguous()
        grad_cubemap = grad_directions = None
        if ctx.needs_input_grad[0]:
            grad_cubemap = scatter_cubemap(grad_values, directions, texture.shape[2] - 2)
        if ctx.needs_input_grad[1]:
            grad_directions = torch.empty_like(directions)
            samples = _samples(directions)
            each = grad_values if samples == 1 else (grad_values / samples).repeat_interleave(samples, 0)
            run_shared(_pull_to_directions, texture.numpy(), flat(directions), each.numpy(), flat(grad_directions))
        return grad_cubemap, grad_directions


def scatter_cubemap(
    values: Float[Tensor, "P C"], directions: Float[Tensor, "P *K 3"], resolution: int
) -> Float[Tensor, "6 C L L"]:
    """The adjoint of `SampleCubemap` in its first argument."""
    nothing = values.new_empty(0, 6, resolution + 2, resolution + 2, TOGETHER)
    return _scattered(nothing, values.detach().contiguous(), directions, resolution)


def weigh_cubemap(
    cubemap: Float[Tensor, "6 C L L"], directions: Float[Tensor, "P *K 3"], weights: Float[Tensor, "P W"]
) -> Float[Tensor, "6 C L L"]:
    """What is looked up, times weights, scattered: both ways while a block of rays is at hand."""
    weights = weights.detach().expand(-1, cubemap.shape[1]).contiguous()
    return _scattered(padded_texture(cubemap), weights, directions, cubemap.shape[2])


def _scattered(
    texture: Float[Tensor, "groups 6 padded padded 4"],
    values: Float[Tensor, "P C"],
    directions: Float[Tensor, "P *K 3"],
    resolution: int,
) -> Float[Tensor, "6 C L L"]:
    channels, samples = values.shape[1], _samples(directions)
    shares = useful_shares(4 * samples * len(directions), resolution)
    buffers = _scatter_buffers(shares, resolution, _groups(channels), get_ident())
    run_shared(_scatter, texture.numpy(), values.numpy(), flat(directions), buffers, samples)
    return folded(buffers, channels)


def useful_shares(additions: int, resolution: int) -> int:
    """Of work worth so many additions of a color to a texel. Clearing and adding up one more buffer must cost less than
    what it takes from the others.
    """
    return min(MOST_SHARES, max(1, additions // (6 * resolution**2)))


def folded(buffers: Float[np.ndarray, "shares groups 6 padded padded 4"], channels: int) -> Float[Tensor, "6 C L L"]:
    """The sum of padded faces, with their rings added to the texels that these show."""
    resolution = buffers.shape[3] - 2
    padding = cubemap_padding(resolution, torch.device("cpu"))
    cubemap = torch.empty(6, channels, resolution, resolution)
    run_shared(_add_up, buffers, cubemap.numpy())
    _fold_rings(buffers, padding.sources.numpy(), padding.corners.numpy(), cubemap.numpy())
    return cubemap


def padded_texture(cubemap: Float[Tensor, "6 C L L"]) -> Float[Tensor, "groups 6 padded padded 4"]:
    """The faces with their rings, four channels together."""
    _, channels, resolution, _ = cubemap.shape
    padding = cubemap_padding(resolution, torch.device("cpu"))
    texture = cubemap.new_empty(_groups(channels), 6, resolution + 2, resolution + 2, TOGETHER)
    faces = cubemap.detach().contiguous().numpy()
    run_shared(_pad, faces, padding.sources.numpy(), padding.corners.numpy(), texture.numpy())
    return texture


def _samples(directions: Float[Tensor, "P *K 3"]) -> int:
    """How many directions belong to each value."""
    return directions.shape[1] if directions.ndim == 3 else 1


def _groups(channels: int) -> int:
    return -(-channels // TOGETHER)


def flat(tensor: Tensor) -> Float[np.ndarray, "N"]:
    """A tensor as one row."""
    return tensor.detach().contiguous().numpy().reshape(-1)


@lru_cache(maxsize=4)
def _scatter_buffers(
    shares: int, resolution: int, groups: int, owner: int
) -> Float[np.ndarray, "shares groups 6 padded padded 4"]:
    """Scratch of one Python thread (`owner`) that every scatter of this shape clears and uses again."""
    return np.empty((shares, groups, 6, resolution + 2, resolution + 2, TOGETHER), f32)


@njit(**VECTORIZED_LOOPS)
def _pad(counter, cubemap, sources, corners, texture):
    """Copy the faces, channels last, with their ring of neighbors."""
    resolution = cubemap.shape[3]
    last, rows, nothing = resolution + 1, 6 * (resolution + 2), np.zeros(resolution, np.float32)
    while True:
        first = fetch_add(counter, LINES_PER_CLAIM)
        if first >= rows * len(texture):
            return
        for line in range(first, min(first + LINES_PER_CLAIM, rows * len(texture))):
            group, face, row = line // rows, line % rows // (resolution + 2), line % (resolution + 2)
            out, faces = texture[group, face, row], cubemap[face, TOGETHER * group : TOGETHER * (group + 1)]
            if 0 < row < last:
                _interleave(
                    faces[0, row - 1],
                    faces[1, row - 1] if len(faces) > 1 else nothing,
                    faces[2, row - 1] if len(faces) > 2 else nothing,
                    faces[3, row - 1] if len(faces) > 3 else nothing,
                    out[1:last].reshape(-1),
                )
            for column in range(0, resolution + 2, last if 0 < row < last else 1):
                out[column] = f32(0)
                for lane in range(len(faces)):
                    channel = TOGETHER * group + lane
                    out[column, lane] = _extended_texel(cubemap, corners, sources[face, row, column], channel)


@njit(**VECTORIZED_LOOPS)
def _interleave(first, second, third, fourth, out):
    for i in range(first.size):
        out[TOGETHER * i] = first[i]
        out[TOGETHER * i + 1] = second[i]
        out[TOGETHER * i + 2] = third[i]
        out[TOGETHER * i + 3] = fourth[i]


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
def locate(directions, resolution, cells, rights, downs, present):
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
def _sample(counter, texture, directions, values, samples):
    """Means over so many directions each."""
    stride, count, block = texture.shape[2], len(values), max(RAYS_PER_BLOCK // samples, 1)
    cells, places = np.empty(block * samples, np.int32), np.empty((3, block * samples), np.float32)
    colors = np.empty(TOGETHER * block, np.float32)
    while True:
        begin = fetch_add(counter, block)
        if begin >= count:
            return
        end = min(begin + block, count)
        share = directions[3 * samples * begin : 3 * samples * end]
        locate(share, stride - 2, cells, places[0], places[1], places[2])
        for group in range(len(texture)):
            _interpolate(texture[group], stride, cells, places, samples, end - begin, colors)
            _give(colors, group, values[begin:end])


@njit(**LANE_CODE)
def _interpolate(texture, stride, cells, places, samples, pixels, colors):
    """Four channels of each pixel, from a group's texture."""
    share = f32(1) / f32(samples)
    for pixel in range(pixels):
        total = lanes(f32(0))
        for i in range(samples * pixel, samples * (pixel + 1)):
            right, down = places[0, i], places[1, i] * share
            left, up = places[2, i] - right, share - down
            upper = TOGETHER * np.int64(cells[i])
            weights = cell_weights(up * left, up * right, down * left, down * right)
            total += load_cell(texture, upper, upper + TOGETHER * stride) * weights
        store_color(colors, TOGETHER * pixel, total)


@njit(**LANE_CODE)
def _deposit(colors, stride, cells, places, samples, pixels, buffer):
    """Add four channels of each pixel to the texels of a group's buffer."""
    share = f32(1) / f32(samples)
    for pixel in range(pixels):
        color = load_color(colors, TOGETHER * pixel)
        for i in range(samples * pixel, samples * (pixel + 1)):
            right, down = places[0, i], places[1, i] * share
            left, up = places[2, i] - right, share - down
            upper = TOGETHER * np.int64(cells[i])
            weights = cell_weights(up * left, up * right, down * left, down * right)
            add_cell(buffer, upper, upper + TOGETHER * stride, color * weights)


@njit(**VECTORIZED_LOOPS)
def _give(colors, group, values):
    """Write the channels of a group to where all of a pixel lie together."""
    first = TOGETHER * group
    for lane in range(min(values.shape[1] - first, TOGETHER)):
        for pixel in range(len(values)):
            values[pixel, first + lane] = colors[TOGETHER * pixel + lane]


@njit(**VECTORIZED_LOOPS)
def _take(values, group, colors):
    """The way back; channels that are not there are zero."""
    first = TOGETHER * group
    used = min(values.shape[1] - first, TOGETHER)
    for lane in range(TOGETHER):
        for pixel in range(len(values)):
            colors[TOGETHER * pixel + lane] = values[pixel, first + lane] if lane < used else f32(0)


@njit(**VECTORIZED_LOOPS)
def _scatter(counter, texture, values, directions, buffers, samples):
    """Clear each padded buffer and add its share of the rays to it: the same share whichever thread comes to it.

    Values are added, or where the texture has groups, values times what `_sample` gives.
    """
    shares, groups, _, stride, _, _ = buffers.shape
    count, block = len(values), max(RAYS_PER_BLOCK // samples, 1)
    cells, places = np.empty(block * samples, np.int32), np.empty((3, block * samples), np.float32)
    colors, seen = np.empty(TOGETHER * block, np.float32), np.empty(TOGETHER * block, np.float32)
    while True:
        task = fetch_add(counter, 1)
        if task >= shares:
            return
        buffers[task] = f32(0)
        last = (task + 1) * count // shares
        for begin in range(task * count // shares, last, block):
            end = min(begin + block, last)
            share = directions[3 * samples * begin : 3 * samples * end]
            locate(share, stride - 2, cells, places[0], places[1], places[2])
            for group in range(groups):
                _take(values[begin:end], group, colors)
                if len(texture):
                    _interpolate(texture[group], stride, cells, places, samples, end - begin, seen)
                    for i in range(TOGETHER * (end - begin)):
                        colors[i] *= seen[i]
                _deposit(colors, stride, cells, places, samples, end - begin, buffers[task, group])


@njit(**VECTORIZED_LOOPS)
def _add_up(counter, buffers, cubemap):
    """Sum the inner parts of the buffers, in their order, channels first."""
    _, channels, resolution, _ = cubemap.shape
    total = np.empty(TOGETHER * resolution, np.float32)
    while True:
        first = fetch_add(counter, LINES_PER_CLAIM)
        if first >= 6 * resolution:
            return
        for line in range(first, min(first + LINES_PER_CLAIM, 6 * resolution)):
            face, row = line // resolution, line % resolution
            for group in range(buffers.shape[1]):
                total[:] = f32(0)
                for share in range(len(buffers)):
                    _add(buffers[share, group, face, row + 1].reshape(-1), total)
                for lane in range(min(channels - TOGETHER * group, TOGETHER)):
                    out = cubemap[face, TOGETHER * group + lane, row]
                    for i in range(resolution):
                        out[i] = total[TOGETHER * i + lane]


@njit(**VECTORIZED_LOOPS)
def _add(line, total):
    """Add the inner part of a padded line."""
    for i in range(total.size):
        total[i] += line[i + TOGETHER]


@njit(**VECTORIZED_LOOPS)
def _fold_rings(buffers, sources, corners, cubemap):
    """Add what was deposited in the ring around each face to the texels that it shows."""
    channels, padded = cubemap.shape[1], buffers.shape[3]
    for face in range(6):
        for row in range(padded):
            for column in range(0, padded, padded - 1 if 0 < row < padded - 1 else 1):
                source = sources[face, row, column]
                for channel in range(channels):
                    total = f32(0)
                    for share in range(len(buffers)):
                        total += buffers[share, channel // TOGETHER, face, row, column, channel % TOGETHER]
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
def _pull_to_directions(counter, texture, directions, grad_values, grad_directions):
    """Derivative of the interpolation by the place in the cell, then of the central projection by the direction."""
    stride, rays = texture.shape[2], len(grad_values)
    cells, places = np.empty(RAYS_PER_BLOCK, np.int32), np.empty((3, RAYS_PER_BLOCK), np.float32)
    colors, pulls = np.empty(TOGETHER * RAYS_PER_BLOCK, np.float32), np.empty((2, RAYS_PER_BLOCK), np.float32)
    while True:
        begin = fetch_add(counter, RAYS_PER_BLOCK)
        if begin >= rays:
            return
        end = min(begin + RAYS_PER_BLOCK, rays)
        share = directions[3 * begin : 3 * end]
        locate(share, stride - 2, cells, places[0], places[1], places[2])
        pulls[:] = f32(0)
        for group in range(len(texture)):
            _take(grad_values[begin:end], group, colors)
            _pull_to_places(texture[group].reshape(-1), stride, cells, places, colors, pulls[:, : end - begin])
        _pull_through_projection(share, stride - 2, pulls[0], pulls[1], grad_directions[3 * begin : 3 * end])


@njit(**VECTORIZED_LOOPS)
def _pull_to_places(texture, stride, cells, places, colors, pulls):
    """Add the derivatives of the loss by each ray's place in its cell."""
    for i in range(pulls.shape[1]):
        right, down = places[0, i], places[1, i]
        left, up = f32(1) - right, f32(1) - down
        a = TOGETHER * np.int64(cells[i])
        b, c = a + TOGETHER, a + TOGETHER * stride
        d = c + TOGETHER
        by_right, by_down = f32(0), f32(0)
        for k in range(TOGETHER):
            grad = colors[TOGETHER * i + k]
            by_right += grad * (up * (texture[b + k] - texture[a + k]) + down * (texture[d + k] - texture[c + k]))
            by_down += grad * (left * (texture[c + k] - texture[a + k]) + right * (texture[d + k] - texture[b + k]))
        pulls[0, i] += by_right
        pulls[1, i] += by_down


@njit(**VECTORIZED_LOOPS)
def _pull_through_projection(directions, resolution, by_rights, by_downs, grad_directions):
    """With s = s_c/|m|: ∂/∂s_c = ∂/∂s / |m| and ∂/∂m = −sign(m)·(s·∂/∂s + t·∂/∂t) / |m|; see `locate`."""
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
