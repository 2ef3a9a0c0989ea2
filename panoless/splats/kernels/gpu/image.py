"""Depth to normals and structural similarity in Triton: one program a block of pixels."""

from functools import lru_cache
from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from panoless.kernels.gpu.launch import ELEMENTS_PER_PROGRAM, programs
from panoless.splats.kernels.gpu.vectors import dot, scaled
from panoless.splats.kernels.reference.image import SSIM_C1, SSIM_C2, SSIM_RADIUS, ssim_window

LARGEST = tl.constexpr(torch.finfo(torch.float32).max)
RADIUS = tl.constexpr(SSIM_RADIUS)
C1, C2 = tl.constexpr(SSIM_C1), tl.constexpr(SSIM_C2)


class DepthNormals(torch.autograd.Function):
    """Normals of a depth map; saves the depth and derives the rest again in the backward."""

    @staticmethod
    def forward(ctx, depth, fx, fy, cx, cy):
        depth = depth.detach().contiguous()
        height, width = depth.shape
        normals = depth.new_empty(3, height, width)
        ctx.camera = (float(fx), float(fy), float(cx), float(cy))
        ctx.save_for_backward(depth)
        if depth.numel():
            normals_forward[programs(depth.numel())](
                depth, normals, height, width, *ctx.camera, BLOCK=ELEMENTS_PER_PROGRAM
            )
        return normals

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_normals):
        (depth,) = ctx.saved_tensors
        height, width = depth.shape
        grad_depth = torch.empty_like(depth)
        if depth.numel():
            normals_backward[programs(depth.numel())](
                depth,
                grad_normals.contiguous(),
                grad_depth,
                height,
                width,
                *ctx.camera,
                BLOCK=ELEMENTS_PER_PROGRAM,
            )
        return grad_depth, None, None, None, None


class Ssim(torch.autograd.Function):
    """Mean SSIM; its gradient is a map times the scalar cotangent, so the map is made along with the value."""

    @staticmethod
    def forward(ctx, image, target):
        image, target = image.detach().contiguous(), target.detach().contiguous()
        height, width = image.shape[1:]
        size = image.numel()
        window = _window(image.device)
        grid, settings = programs(size), {"GRADIENT": ctx.needs_input_grad[0], "BLOCK": ELEMENTS_PER_PROGRAM}
        rows, similarity = image.new_empty(4, size), image.new_empty(size)
        derivatives = image.new_empty(3, size if settings["GRADIENT"] else 0)
        mean_products[grid](image, target, window, rows, size, width, BLOCK=ELEMENTS_PER_PROGRAM)
        statistics[grid](rows, window, similarity, derivatives, size, height, width, **settings)
        if settings["GRADIENT"]:
            gradient = torch.empty_like(image)
            mean_derivatives[grid](derivatives, window, rows, size, width, BLOCK=ELEMENTS_PER_PROGRAM)
            chain[grid](rows, window, image, target, gradient, size, height, width, BLOCK=ELEMENTS_PER_PROGRAM)
            ctx.save_for_backward(gradient)
        return similarity.mean()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_ssim):
        (gradient,) = ctx.saved_tensors
        return gradient * grad_ssim, None


@lru_cache(maxsize=8)
@torch.inference_mode(False)
def _window(device: torch.device) -> Tensor:
    return torch.tensor(ssim_window(), dtype=torch.float32, device=device)


# With a, b the depths right and left of a pixel, c, e below and above it, and X, Y its offset from the principal
# point in pixels, the cross product of the central differences of (X/fx·z, Y/fy·z, z) is, up to a positive factor,
# N = (fx p, fy q, −(X p + Y q + 1)) with p = (a − b)/(a + b), q = (c − e)/(c + e). It never vanishes and always
# faces the camera: N · (X/fx, Y/fy, 1) = −1.


class Surface(NamedTuple):
    """What a depth map shows around pixels; x, y are offsets from the principal point in pixels."""

    normal: Any
    inverse: Any
    """Inverse length of N."""
    x: Any
    y: Any
    right: Any
    left: Any
    below: Any
    above: Any
    defined: Any


@triton.jit
def usable(depth):
    """Whether a depth is positive and finite."""
    return (depth > 0.0) & (depth <= LARGEST)


@triton.jit
def normal_at(depth, row, column, height, width, fx, fy, cx, cy):
    """Unit normals at pixels, and the four depths that they come from."""
    inner = (row > 0) & (row < height - 1) & (column > 0) & (column < width - 1)
    here = depth + row * width + column
    right = tl.load(here + 1, mask=inner, other=0.0)
    left = tl.load(here - 1, mask=inner, other=0.0)
    below = tl.load(here + width, mask=inner, other=0.0)
    above = tl.load(here - width, mask=inner, other=0.0)
    defined = inner & usable(right) & usable(left) & usable(below) & usable(above)
    x, y = column.to(tl.float32) + 0.5 - cx, row.to(tl.float32) + 0.5 - cy
    slope_x = (right - left) / tl.where(defined, right + left, 1.0)
    slope_y = (below - above) / tl.where(defined, below + above, 1.0)
    n = (fx * slope_x, fy * slope_y, -(x * slope_x + y * slope_y + 1.0))
    inverse = 1.0 / tl.sqrt(tl.where(defined, dot(n, n), 1.0))
    return Surface(scaled(n, inverse), inverse, x, y, right, left, below, above, defined)


@triton.jit(do_not_specialize=["height", "width"])
def normals_forward(depth, normals, height, width, fx, fy, cx, cy, BLOCK: tl.constexpr):
    """Normals of a block of pixels."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = at < height * width
    surface = normal_at(depth, at // width, at % width, height, width, fx, fy, cx, cy)
    plane_size = height * width
    tl.store(normals + at, tl.where(surface.defined, surface.normal[0], 0.0), mask=active)
    tl.store(normals + plane_size + at, tl.where(surface.defined, surface.normal[1], 0.0), mask=active)
    tl.store(normals + 2 * plane_size + at, tl.where(surface.defined, surface.normal[2], 0.0), mask=active)


@triton.jit
def sent(depth, gradients, row, column, height, width, fx, fy, cx, cy):
    """Derivatives of the loss by the depths right of, left of, below and above a pixel, through its normal."""
    surface = normal_at(depth, row, column, height, width, fx, fy, cx, cy)
    normal, defined = surface.normal, surface.defined
    plane_size = height * width
    at = gradients + row * width + column
    gradient = (
        tl.load(at, mask=defined, other=0.0),
        tl.load(at + plane_size, mask=defined, other=0.0),
        tl.load(at + 2 * plane_size, mask=defined, other=0.0),
    )
    along = dot(normal, gradient)
    across_z = gradient[2] - normal[2] * along
    inverse_x = 1.0 / tl.where(defined, surface.right + surface.left, 1.0)
    inverse_y = 1.0 / tl.where(defined, surface.below + surface.above, 1.0)
    across_x = fx * (gradient[0] - normal[0] * along) - surface.x * across_z
    across_y = fy * (gradient[1] - normal[1] * along) - surface.y * across_z
    by_x = 2.0 * surface.inverse * inverse_x * inverse_x * across_x
    by_y = 2.0 * surface.inverse * inverse_y * inverse_y * across_y
    # Where nothing is defined a neighbor may be infinite, and its product with zero would be NaN.
    to_right = tl.where(defined, surface.left * by_x, 0.0)
    to_left = tl.where(defined, -surface.right * by_x, 0.0)
    to_below = tl.where(defined, surface.above * by_y, 0.0)
    to_above = tl.where(defined, -surface.below * by_y, 0.0)
    return to_right, to_left, to_below, to_above


@triton.jit(do_not_specialize=["height", "width"])
def normals_backward(depth, gradients, grad_depth, height, width, fx, fy, cx, cy, BLOCK: tl.constexpr):
    """Gather what the four pixels around each pixel send to it, in a fixed order."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row, column = at // width, at % width
    total = sent(depth, gradients, row, column - 1, height, width, fx, fy, cx, cy)[0]
    total += sent(depth, gradients, row, column + 1, height, width, fx, fy, cx, cy)[1]
    total += sent(depth, gradients, row - 1, column, height, width, fx, fy, cx, cy)[2]
    total += sent(depth, gradients, row + 1, column, height, width, fx, fy, cx, cy)[3]
    tl.store(grad_depth + at, total, mask=at < height * width)


@triton.jit
def windowed(values, window, at, position, length, stride, active):
    """Gaussian mean along one image axis of the number at `at`, which lies at `position` of `length` with `stride`;
    what lies outside the image is zero.
    """
    total = tl.load(values + at, mask=active, other=0.0) * tl.load(window + RADIUS)
    for distance in tl.static_range(1, RADIUS + 1):
        before = tl.load(values + at - distance * stride, mask=active & (position >= distance), other=0.0)
        after = tl.load(values + at + distance * stride, mask=active & (position + distance < length), other=0.0)
        total += (before + after) * tl.load(window + RADIUS + distance)
    return total


@triton.jit(do_not_specialize=["size", "width"])
def mean_products(image, target, window, rows, size, width, BLOCK: tl.constexpr):
    """Means along the row of x, y, x² + y² and x·y."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = at < size
    position = at % width
    mean_x, mean_y = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    squares, cross = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for tap in tl.static_range(2 * RADIUS + 1):
        there = position + (tap - RADIUS)
        inside = active & (there >= 0) & (there < width)
        x = tl.load(image + at + (tap - RADIUS), mask=inside, other=0.0)
        y = tl.load(target + at + (tap - RADIUS), mask=inside, other=0.0)
        weight = tl.load(window + tap)
        mean_x += weight * x
        mean_y += weight * y
        squares += weight * (x * x + y * y)
        cross += weight * (x * y)
    tl.store(rows + at, mean_x, mask=active)
    tl.store(rows + size + at, mean_y, mask=active)
    tl.store(rows + 2 * size + at, squares, mask=active)
    tl.store(rows + 3 * size + at, cross, mask=active)


@triton.jit(do_not_specialize=["size", "height", "width"])
def statistics(rows, window, similarity, derivatives, size, height, width, GRADIENT: tl.constexpr, BLOCK: tl.constexpr):
    """SSIM of each pixel, and the derivatives of its mean over all by the means of x, of x² + y² and of x·y."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = at < size
    row = at // width % height
    x = windowed(rows, window, at, row, height, width, active)
    y = windowed(rows + size, window, at, row, height, width, active)
    squares = windowed(rows + 2 * size, window, at, row, height, width, active)
    cross = windowed(rows + 3 * size, window, at, row, height, width, active)
    product, power = x * y, x * x + y * y
    a1, b1 = product + product + C1, power + C1
    a2, b2 = 2.0 * (cross - product) + C2, squares - power + C2
    inverse = 1.0 / (b1 * b2)
    value = a1 * a2 * inverse
    tl.store(similarity + at, value, mask=active)
    if GRADIENT:
        share = inverse / size
        tl.store(derivatives + at, 2.0 * share * (y * (a2 - a1) - value * x * (b2 - b1)), mask=active)
        tl.store(derivatives + size + at, -share * value * b1, mask=active)
        tl.store(derivatives + 2 * size + at, 2.0 * share * a1, mask=active)


@triton.jit(do_not_specialize=["size", "width"])
def mean_derivatives(derivatives, window, rows, size, width, BLOCK: tl.constexpr):
    """Means of the three derivatives along the row."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = at < size
    for k in tl.static_range(3):
        mean = windowed(derivatives + k * size, window, at, at % width, width, 1, active)
        tl.store(rows + k * size + at, mean, mask=active)


@triton.jit(do_not_specialize=["size", "height", "width"])
def chain(rows, window, image, target, gradient, size, height, width, BLOCK: tl.constexpr):
    """Gradient of each pixel from the means of the derivatives around it."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    active = at < size
    row = at // width % height
    by_mean = windowed(rows, window, at, row, height, width, active)
    by_squares = windowed(rows + size, window, at, row, height, width, active)
    by_cross = windowed(rows + 2 * size, window, at, row, height, width, active)
    x = tl.load(image + at, mask=active, other=0.0)
    y = tl.load(target + at, mask=active, other=0.0)
    tl.store(gradient + at, by_mean + 2.0 * x * by_squares + y * by_cross, mask=active)
