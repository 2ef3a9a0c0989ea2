"""Depth to normals and structural similarity in Numba.

Both walk down the image in strips of rows, so that what a row needs is still in the cache. Every inner loop runs along
one row with unit stride and writes few arrays, because that is the shape that LLVM vectorizes: with more pointers in a
loop it gives up proving that they don't overlap.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from threading import get_ident

import numpy as np
import torch
from jaxtyping import Float
from numba import njit

from panoless.kernels.cpu.compilation import VECTORIZED_LOOPS
from panoless.kernels.cpu.simd_memory import fetch_add
from panoless.kernels.cpu.workers import run_shared, thread_count
from panoless.splats.kernels.reference.image import SSIM_C1, SSIM_C2, SSIM_RADIUS, ssim_window

f32 = np.float32
LARGEST = np.finfo(np.float32).max
NORMAL_STRIP_ROWS = 16
NUMBERS_PER_CLAIM = 1 << 15
C1, C2 = f32(SSIM_C1), f32(SSIM_C2)
WINDOW = 2 * SSIM_RADIUS + 1
W0, W1, W2, W3, W4, W5 = (f32(weight) for weight in ssim_window()[SSIM_RADIUS:])

# Rows of a strip's scratch for SSIM: four padded products and their full means, three padded derivatives and
# their full means, then a ring of the last eleven horizontal means of each of these seven.
PRODUCTS, MEANS, DERIVATIVES, PULLED, RINGS = 0, 4, 8, 11, 14
SCRATCH_ROWS = RINGS + 7 * WINDOW


class DepthNormals(torch.autograd.Function):
    """Normals of a depth map; saves the depth and derives the rest again in the backward."""

    @staticmethod
    def forward(ctx, depth, fx, fy, cx, cy):
        depth = depth.contiguous()
        normals = depth.new_empty(3, *depth.shape)
        ctx.camera = (f32(fx), f32(fy), f32(cx), f32(cy))
        ctx.save_for_backward(depth)
        run_shared(_normals_forward, depth.detach().numpy(), *ctx.camera, normals.numpy())
        return normals

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_normals):
        (depth,) = ctx.saved_tensors
        grad_depth = torch.empty_like(depth)
        grad_normals = grad_normals.contiguous().numpy()
        arrays = grad_normals, grad_depth.numpy()
        run_shared(_normals_backward, depth.detach().numpy(), *ctx.camera, *arrays)
        return grad_depth, None, None, None, None


class Ssim(torch.autograd.Function):
    """Mean SSIM; its gradient is a map times the scalar cotangent, so the map is made along with the value."""

    @staticmethod
    def forward(ctx, image, target):
        threads = thread_count()
        channels, height, width = image.shape
        needs_gradient = ctx.needs_input_grad[0]
        gradient = image.new_empty(image.shape if needs_gradient else (channels, 0, width))
        strips = min(threads // math.gcd(threads, channels), height)
        scratch = _ssim_scratch(channels * strips, width, get_ident())
        pixels, target_pixels = image.detach().contiguous().numpy(), target.detach().contiguous().numpy()
        run_shared(_ssim_strips, pixels, target_pixels, scratch.rows, scratch.totals, gradient.numpy())
        ctx.save_for_backward(gradient)
        return image.new_tensor(scratch.totals.sum() / image.numel())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_ssim):
        (gradient,) = ctx.saved_tensors
        grad_image = torch.empty_like(gradient)
        run_shared(_scale, gradient.numpy().reshape(-1), f32(grad_ssim.item()), grad_image.numpy().reshape(-1))
        return grad_image, None


@dataclass(frozen=True)
class SsimScratch:
    """Working rows and result of every strip; reused by every call of the same shape, never saved."""

    rows: Float[np.ndarray, "strips rows padded_width"]
    totals: Float[np.ndarray, "strips"]


@lru_cache(maxsize=16)
def _ssim_scratch(strips: int, width: int, owner: int) -> SsimScratch:
    """Scratch of one Python thread (`owner`), so that two of them may compute SSIM at once."""
    # The outer columns are the zeros that continue the image: no kernel ever writes there.
    return SsimScratch(np.zeros((strips, SCRATCH_ROWS, width + 2 * SSIM_RADIUS), f32), np.zeros(strips))


@njit(**VECTORIZED_LOOPS)
def _ssim_strips(counter, image, target, scratch, totals, gradient):
    """Sum the SSIM of each strip and, unless `gradient` is empty, find the gradient of the mean over everything.

    Three fronts move down together: products are read at `row`, SSIM is known `SSIM_RADIUS` rows above, and its
    gradient as much above that.
    """
    channels, height, width = image.shape
    strips = scratch.shape[0] // channels
    scale = f32(1) / f32(image.size)
    halo = 2 * SSIM_RADIUS if gradient.size > 0 else SSIM_RADIUS
    while True:
        task = fetch_add(counter, 1)
        if task >= channels * strips:
            return
        channel, strip = task // strips, task % strips
        begin, end = strip * height // strips, (strip + 1) * height // strips
        rows = scratch[task]
        total = 0.0
        for row in range(begin - halo, end + halo):
            inside = 0 <= row < height
            if inside:
                _products(image[channel, row], target[channel, row], rows)
            for k in range(4):
                _push_row(rows, PRODUCTS + k, k, row, inside, width)
            middle = row - SSIM_RADIUS
            if middle < begin - halo + SSIM_RADIUS:
                continue
            inside = 0 <= middle < height
            if inside:
                for k in range(4):
                    _mean_down(rows, k, middle, rows[MEANS + k], width)
                partial = _statistics(rows, scale, width)
                if begin <= middle < end:
                    total += partial
            if gradient.size == 0:
                continue
            for k in range(3):
                _push_row(rows, DERIVATIVES + k, 4 + k, middle, inside, width)
            top = middle - SSIM_RADIUS
            if top >= begin:
                for k in range(3):
                    _mean_down(rows, 4 + k, top, rows[PULLED + k], width)
                _chain(image[channel, top], target[channel, top], rows, gradient[channel, top])
        totals[task] = total


@njit(**VECTORIZED_LOOPS)
def _products(x, y, rows):
    """x, y, x² + y² and xy of one row, inside the zero padding."""
    mean_x, mean_y, squares, cross = rows[PRODUCTS], rows[PRODUCTS + 1], rows[PRODUCTS + 2], rows[PRODUCTS + 3]
    for i in range(x.size):
        mean_x[i + SSIM_RADIUS] = x[i]
        mean_y[i + SSIM_RADIUS] = y[i]
        squares[i + SSIM_RADIUS] = x[i] * x[i] + y[i] * y[i]
        cross[i + SSIM_RADIUS] = x[i] * y[i]


@njit(**VECTORIZED_LOOPS)
def _push_row(rows, source, ring, row, inside, width):
    """Put the horizontal mean of a padded row into its place in a ring; outside the image that is zero."""
    a = rows[source]
    out = rows[RINGS + ring * WINDOW + (row + 2 * WINDOW) % WINDOW]
    if not inside:
        out[:] = f32(0)
        return
    for i in range(width):
        far = W5 * (a[i] + a[i + 10]) + W4 * (a[i + 1] + a[i + 9]) + W3 * (a[i + 2] + a[i + 8])
        near = W2 * (a[i + 3] + a[i + 7]) + W1 * (a[i + 4] + a[i + 6]) + W0 * a[i + 5]
        out[i] = far + near


@njit(**VECTORIZED_LOOPS)
def _mean_down(rows, ring, middle, out, width):
    """Vertical mean around row `middle` of the eleven horizontal means in a ring."""
    first = RINGS + ring * WINDOW
    phase = middle - SSIM_RADIUS + 2 * WINDOW
    a0, a1, a2 = rows[first + phase % WINDOW], rows[first + (phase + 1) % WINDOW], rows[first + (phase + 2) % WINDOW]
    a3, a4 = rows[first + (phase + 3) % WINDOW], rows[first + (phase + 4) % WINDOW]
    a5, a6 = rows[first + (phase + 5) % WINDOW], rows[first + (phase + 6) % WINDOW]
    a7, a8 = rows[first + (phase + 7) % WINDOW], rows[first + (phase + 8) % WINDOW]
    a9, a10 = rows[first + (phase + 9) % WINDOW], rows[first + (phase + 10) % WINDOW]
    for i in range(width):
        far = W5 * (a0[i] + a10[i]) + W4 * (a1[i] + a9[i]) + W3 * (a2[i] + a8[i])
        near = W2 * (a3[i] + a7[i]) + W1 * (a4[i] + a6[i]) + W0 * a5[i]
        out[i] = far + near


@njit(**VECTORIZED_LOOPS)
def _statistics(rows, scale, width):
    """Sum of SSIM over a row, and `scale` times its derivatives by the means of x, of x² + y² and of xy."""
    mean_x, mean_y, squares, cross = rows[MEANS], rows[MEANS + 1], rows[MEANS + 2], rows[MEANS + 3]
    by_mean, by_squares, by_cross = rows[DERIVATIVES], rows[DERIVATIVES + 1], rows[DERIVATIVES + 2]
    total = f32(0)
    for i in range(width):
        x, y = mean_x[i], mean_y[i]
        product, power = x * y, x * x + y * y
        a1, b1 = product + product + C1, power + C1
        a2, b2 = f32(2) * (cross[i] - product) + C2, squares[i] - power + C2
        inverse = f32(1) / (b1 * b2)
        similarity = a1 * a2 * inverse
        total += similarity
        factor = f32(2) * scale * inverse
        by_mean[i + SSIM_RADIUS] = factor * (y * (a2 - a1) - similarity * x * (b2 - b1))
        by_squares[i + SSIM_RADIUS] = -scale * similarity * inverse * b1
        by_cross[i + SSIM_RADIUS] = factor * a1
    return total


@njit(**VECTORIZED_LOOPS)
def _chain(x, y, rows, gradient):
    """Gradient of one row of the image from the means of the derivatives around it."""
    by_mean, by_squares, by_cross = rows[PULLED], rows[PULLED + 1], rows[PULLED + 2]
    for i in range(x.size):
        gradient[i] = by_mean[i] + f32(2) * x[i] * by_squares[i] + y[i] * by_cross[i]


@njit(**VECTORIZED_LOOPS)
def _scale(counter, numbers, factor, out):
    """A product that torch would hand to its OpenMP threads, which spin on afterwards and hold up the next kernel."""
    while True:
        begin = fetch_add(counter, NUMBERS_PER_CLAIM)
        if begin >= numbers.size:
            return
        for i in range(begin, min(begin + NUMBERS_PER_CLAIM, numbers.size)):
            out[i] = numbers[i] * factor


# With a, b the depths right and left of a pixel, c, e below and above it, and X, Y its offset from the principal
# point in pixels, the cross product of the central differences of (X/fx·z, Y/fy·z, z) is, up to a positive factor,
# N = (fx p, fy q, −(X p + Y q + 1)) with p = (a − b)/(a + b), q = (c − e)/(c + e). It never vanishes and always
# faces the camera: N · (X/fx, Y/fy, 1) = −1.


@njit(**VECTORIZED_LOOPS)
def _normals_forward(counter, depth, fx, fy, cx, cy, normals):
    height, width = depth.shape
    while True:
        begin = fetch_add(counter, NORMAL_STRIP_ROWS)
        if begin >= height:
            return
        for row in range(begin, min(begin + NORMAL_STRIP_ROWS, height)):
            if row == 0 or row == height - 1 or width < 3:
                normals[:, row] = f32(0)
                continue
            _normals_of_row(depth, fx, fy, cx, cy, row, normals)
            normals[:, row, 0] = f32(0)
            normals[:, row, width - 1] = f32(0)


@njit(**VECTORIZED_LOOPS)
def _normals_of_row(depth, fx, fy, cx, cy, row, normals):
    y = f32(row) + f32(0.5) - cy
    above, here, below = depth[row - 1], depth[row], depth[row + 1]
    out_x, out_y, out_z = normals[0, row], normals[1, row], normals[2, row]
    for i in range(1, depth.shape[1] - 1):
        x = f32(i) + f32(0.5) - cx
        a, b, c, e = here[i + 1], here[i - 1], below[i], above[i]
        slope_x = (a - b) / (a + b)
        slope_y = (c - e) / (c + e)
        nx, ny, nz = fx * slope_x, fy * slope_y, -(x * slope_x + y * slope_y + f32(1))
        inverse = f32(1) / math.sqrt(nx * nx + ny * ny + nz * nz)
        defined = _all_usable(a, b, c, e)
        out_x[i] = nx * inverse if defined else f32(0)
        out_y[i] = ny * inverse if defined else f32(0)
        out_z[i] = nz * inverse if defined else f32(0)


@njit(**VECTORIZED_LOOPS)
def _normals_backward(counter, depth, fx, fy, cx, cy, grad_normals, grad_depth):
    """Each strip finds what its pixels, and those just around it, send to their neighbors, then gathers it."""
    height, width = depth.shape
    # One ring of three rows for each neighbor: right, left, below, above.
    sent = np.zeros((4, 3, width + 2), np.float32)
    while True:
        begin = fetch_add(counter, NORMAL_STRIP_ROWS)
        if begin >= height:
            return
        end = min(begin + NORMAL_STRIP_ROWS, height)
        for row in range(begin - 1, end + 1):
            slot = (row + 3) % 3
            if 0 < row < height - 1:
                _normals_send(depth, fx, fy, cx, cy, grad_normals, row, sent, slot)
            else:
                sent[:, slot] = f32(0)
            if row > begin:
                _normals_gather(sent, row, grad_depth[row - 1])


@njit(**VECTORIZED_LOOPS)
def _normals_send(depth, fx, fy, cx, cy, grad_normals, row, sent, slot):
    """Derivatives of the loss by the four depths around each pixel of a row, through that pixel's normal."""
    y = f32(row) + f32(0.5) - cy
    above, here, below = depth[row - 1], depth[row], depth[row + 1]
    grad_x, grad_y, grad_z = grad_normals[0, row], grad_normals[1, row], grad_normals[2, row]
    to_right, to_left, to_below, to_above = sent[0, slot], sent[1, slot], sent[2, slot], sent[3, slot]
    for i in range(1, depth.shape[1] - 1):
        x = f32(i) + f32(0.5) - cx
        a, b, c, e = here[i + 1], here[i - 1], below[i], above[i]
        inverse_x, inverse_y = f32(1) / (a + b), f32(1) / (c + e)
        slope_x, slope_y = (a - b) * inverse_x, (c - e) * inverse_y
        nx, ny, nz = fx * slope_x, fy * slope_y, -(x * slope_x + y * slope_y + f32(1))
        inverse = f32(1) / math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * inverse, ny * inverse, nz * inverse
        along = nx * grad_x[i] + ny * grad_y[i] + nz * grad_z[i]
        gz = grad_z[i] - nz * along
        defined = _all_usable(a, b, c, e)
        by_x = f32(2) * inverse * inverse_x * inverse_x * (fx * (grad_x[i] - nx * along) - x * gz)
        by_y = f32(2) * inverse * inverse_y * inverse_y * (fy * (grad_y[i] - ny * along) - y * gz)
        to_right[i] = b * by_x if defined else f32(0)
        to_left[i] = -a * by_x if defined else f32(0)
        to_below[i] = e * by_y if defined else f32(0)
        to_above[i] = -c * by_y if defined else f32(0)


@njit(**VECTORIZED_LOOPS)
def _normals_gather(sent, row, grad_depth):
    """Gradient of the row before `row`: what its own pixels and the rows above and below send to it."""
    to_right, to_left = sent[0, (row + 2) % 3], sent[1, (row + 2) % 3]
    to_below, to_above = sent[2, (row + 1) % 3], sent[3, row % 3]
    grad_depth[0] = to_left[1] + to_below[0] + to_above[0]
    for i in range(1, grad_depth.size):
        grad_depth[i] = to_right[i - 1] + to_left[i + 1] + to_below[i] + to_above[i]


@njit(**VECTORIZED_LOOPS)
def _all_usable(a, b, c, e):
    positive = (a > f32(0)) & (b > f32(0)) & (c > f32(0)) & (e > f32(0))
    return positive & (a <= LARGEST) & (b <= LARGEST) & (c <= LARGEST) & (e <= LARGEST)
