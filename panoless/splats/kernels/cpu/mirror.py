"""Deferred mirror shading against a photograph, and the silhouette: loss and gradients of sixteen pixels at a time."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from panoless.kernels.constants import SHORTEST_NORMAL
from panoless.kernels.cpu.compilation import INLINED_LANE_CODE, LANE_CODE
from panoless.kernels.cpu.simd import (
    LANES,
    absolute,
    any_lane,
    exp2,
    lane_count,
    lane_indices,
    lanes,
    log2,
    maximum,
    minimum,
    reciprocal,
    round_down,
    square_root,
    sum_each,
    where,
)
from panoless.kernels.cpu.simd_memory import (
    add_color,
    fetch_add,
    load_at,
    load_some,
    store_chosen,
    store_lanes,
    store_some,
    thread_slot,
)
from panoless.kernels.reference.cubemap import SHORTEST_DIRECTION
from panoless.splats.kernels.constants import ALPHA_MARGIN, CHARBONNIER
from panoless.splats.kernels.cpu.project import dot, rotate, rotate_back, scaled

f32 = np.float32
PIXELS_PER_CLAIM = 2048
SHORTEST_NORMAL_SQUARED = f32(SHORTEST_NORMAL**2)
SHORTEST, LARGEST = f32(SHORTEST_DIRECTION), np.finfo(np.float32).max
MARGIN = f32(ALPHA_MARGIN)
CHARBONNIER_SQUARED = f32(CHARBONNIER**2)
LOG2_E = f32(np.log2(np.e))
LARGEST_EXPONENT = f32(120)

RAY_CELL, RAY_RIGHT, RAY_DOWN, RAY_RED = 0, 1, 2, 3
RAY_SIZE = 6
"""What is kept of each pixel for the gradient of the environment: the flat index of the upper left of the four texels
around its ray (−1 for none), the place between them, and the gradient of the looked-up color.
"""
PIXEL_SUMS = 2
"""Photometric loss and cross-entropy (in bits), summed over a claim."""


class Pixels(NamedTuple):
    """Flat images that the shading reads, channels one after another; `albedo` is empty where there is none."""

    normals: Any
    alpha: Any
    albedo: Any
    mask: Any
    radiance: Any


class PixelGradients(NamedTuple):
    """Flat images that the shading writes; they are not touched without `geometry`."""

    normals: Any
    alpha: Any
    albedo: Any


class ShadingNumbers(NamedTuple):
    """What is the same for all pixels."""

    resolution: Any
    inverse_scale_squared: Any
    """1/s² of the robust weight."""
    share: Any
    """One over the number of solid pixels."""
    silhouette_share: Any
    """λ_s over the number of pixels; 0 for no silhouette."""
    solid_alpha: Any
    sigmoid: Any
    alpha_twice: Any
    """Whether alpha multiplies the albedo as well."""
    geometry: Any
    """Whether gradients of the images are wanted, beside the environment's."""
    width: Any
    focal: Any
    """f_x and f_y in pixels."""
    center: Any
    """c_x and c_y in pixels."""


class Cell(NamedTuple):
    """Where rays meet the cubemap; see `panoless.kernels.cpu.cubemap.locate`."""

    usable: Any
    on_x: Any
    on_y: Any
    sign: Any
    inverse: Any
    """1/|m|, m the component along the axis of the face."""
    s: Any
    t: Any
    """Coordinates on the face times |m|."""
    index: Any
    right: Any
    down: Any


@njit(**INLINED_LANE_CODE)
def locate(direction, resolution, wanted):
    """Find the face and the four texels around sixteen directions."""
    x, y, z = direction
    ax, ay, az = absolute(x), absolute(y), absolute(z)
    on_x = (ax >= ay) & (ax >= az)
    on_y = ~on_x & (ay >= az)
    major = where(on_x, x, where(on_y, y, z))
    sign = where(major < 0.0, -1.0, 1.0)
    s = where(on_x, -sign * z, where(on_y, x, sign * x))
    t = where(on_y, sign * z, -y)
    magnitude = absolute(major)
    usable = (magnitude >= SHORTEST) & (ax <= LARGEST) & (ay <= LARGEST) & (az <= LARGEST) & wanted
    inverse = reciprocal(where(usable, magnitude, 1.0))
    half = f32(0.5) * f32(resolution)
    last = lanes(f32(resolution))
    column = where(usable, s * inverse * half + (half + f32(0.5)), 0.0)
    row = where(usable, t * inverse * half + (half + f32(0.5)), 0.0)
    left = minimum(maximum(round_down(column), lanes(0.0)), last)
    top = minimum(maximum(round_down(row), lanes(0.0)), last)
    stride = f32(resolution + 2)
    face = where(on_x, 0.0, where(on_y, 2.0, 4.0)) + where(major < 0.0, 1.0, 0.0)
    index = (face * stride + top) * stride + left
    return Cell(usable, on_x, on_y, sign, inverse, s, t, index, column - left, row - top)


class Look(NamedTuple):
    """One channel of the environment along the rays, and its derivatives by the place in the cell."""

    value: Any
    by_right: Any
    by_down: Any


@njit(**INLINED_LANE_CODE)
def look(texture, cell, stride):
    """Interpolate one channel of the padded faces."""
    a = load_at(texture, cell.index, cell.usable)
    b = load_at(texture, cell.index + 1.0, cell.usable)
    c = load_at(texture, cell.index + f32(stride), cell.usable)
    d = load_at(texture, cell.index + f32(stride + 1), cell.usable)
    upper = b - a
    lower = d - c
    by_right = upper + cell.down * (lower - upper)
    by_down = (c - a) + cell.right * (lower - upper)
    return Look(a + cell.right * upper + cell.down * (c - a + cell.right * (lower - upper)), by_right, by_down)


@njit(**INLINED_LANE_CODE)
def activated(value):
    """σ(value), and nothing that overflows."""
    exponent = minimum(maximum(-LOG2_E * value, lanes(-LARGEST_EXPONENT)), lanes(LARGEST_EXPONENT))
    return 1.0 / (1.0 + exp2(exponent))


@njit(**INLINED_LANE_CODE)
def pull_to_direction(cell, resolution, by_right, by_down):
    """From gradients of the place in the cell to that of the direction: the central projection's derivative."""
    half = f32(0.5) * f32(resolution)
    by_s, by_t = by_right * half * cell.inverse, by_down * half * cell.inverse
    by_major = -cell.sign * (by_s * (cell.s * cell.inverse) + by_t * (cell.t * cell.inverse))
    return (
        where(cell.on_x, by_major, where(cell.on_y, by_s, cell.sign * by_s)),
        where(cell.on_y, by_major, -by_t),
        where(cell.on_x, -cell.sign * by_s, where(cell.on_y, cell.sign * by_t, by_major)),
    )


@njit(**INLINED_LANE_CODE)
def load_channels(image, pixels, first, wanted):
    """Three channels of sixteen pixels."""
    return (
        load_some(image, first, wanted),
        load_some(image, pixels + first, wanted),
        load_some(image, 2 * pixels + first, wanted),
    )


@njit(**INLINED_LANE_CODE)
def store_channels(image, pixels, first, wanted, values):
    """Three channels of sixteen pixels."""
    store_some(image, first, wanted, values[0])
    store_some(image, pixels + first, wanted, values[1])
    store_some(image, 2 * pixels + first, wanted, values[2])


@njit(**INLINED_LANE_CODE)
def unit_rays(first, numbers):
    """Camera rays through the centers of sixteen pixels from flat index `first`, which may go on in later rows."""
    row = first // numbers.width
    column = lane_indices() + f32(first - row * numbers.width)
    later = round_down((column + 0.5) / f32(numbers.width))
    x = ((column - later * f32(numbers.width) + 0.5) - numbers.center[0]) / numbers.focal[0]
    y = ((later + f32(row) + 0.5) - numbers.center[1]) / numbers.focal[1]
    length = square_root(x * x + y * y + 1.0)
    return x / length, y / length, 1.0 / length


@njit(**INLINED_LANE_CODE)
def shade_group(first, active, solid, alpha, images, rotation, texture, numbers, gradients, kept):
    """Shade sixteen pixels, some of which are solid; returns their losses and the gradient of their alpha."""
    pixels = images.alpha.size
    stride = numbers.resolution + 2
    normal = load_channels(images.normals, pixels, first, solid)
    ray = unit_rays(first, numbers)
    squared = dot(normal, normal)
    short = squared < SHORTEST_NORMAL_SQUARED
    inverse_length = where(short, f32(1 / SHORTEST_NORMAL), 1.0 / square_root(where(short, 1.0, squared)))
    unit = scaled(normal, inverse_length)
    along = dot(ray, unit)
    mirrored = (ray[0] - 2.0 * along * unit[0], ray[1] - 2.0 * along * unit[1], ray[2] - 2.0 * along * unit[2])
    cell = locate(rotate(rotation, mirrored), numbers.resolution, solid)
    red = look(texture[0], cell, stride)
    green = look(texture[1], cell, stride)
    blue = look(texture[2], cell, stride)
    seen = (red.value, green.value, blue.value)
    slope = (lanes(1.0), lanes(1.0), lanes(1.0))
    if numbers.sigmoid:
        seen = (activated(seen[0]), activated(seen[1]), activated(seen[2]))
        slope = (seen[0] * (1.0 - seen[0]), seen[1] * (1.0 - seen[1]), seen[2] * (1.0 - seen[2]))
    diffuse = (lanes(0.0), lanes(0.0), lanes(0.0))
    if images.albedo.size:
        diffuse = load_channels(images.albedo, pixels, first, solid)
    by_alpha = seen
    diffuse_share = lanes(1.0)
    if numbers.alpha_twice:
        by_alpha = (seen[0] + diffuse[0], seen[1] + diffuse[1], seen[2] + diffuse[2])
        diffuse_share = alpha
    target = load_channels(images.radiance, pixels, first, solid)
    error = (
        diffuse[0] * diffuse_share + seen[0] * alpha - target[0],
        diffuse[1] * diffuse_share + seen[1] * alpha - target[1],
        diffuse[2] * diffuse_share + seen[2] * alpha - target[2],
    )
    size = dot(error, error)
    distance = square_root(size + CHARBONNIER_SQUARED)
    vote = reciprocal(1.0 + size * numbers.inverse_scale_squared)
    vote = where(solid, vote * vote * numbers.share, 0.0)
    by_color = scaled(error, vote / distance)
    by_seen = (
        by_color[0] * alpha * slope[0],
        by_color[1] * alpha * slope[1],
        by_color[2] * alpha * slope[2],
    )
    store_some(kept, RAY_CELL * pixels + first, active, where(cell.usable, cell.index, -1.0))
    store_some(kept, RAY_RIGHT * pixels + first, active, cell.right)
    store_some(kept, RAY_DOWN * pixels + first, active, cell.down)
    for channel in range(3):
        store_some(kept, (RAY_RED + channel) * pixels + first, active, by_seen[channel])
    grad_alpha = lanes(0.0)
    if numbers.geometry:
        grad_alpha = where(solid, dot(by_color, by_alpha), 0.0)
        if gradients.albedo.size:
            store_channels(gradients.albedo, pixels, first, active, scaled(by_color, diffuse_share))
        by_right = by_seen[0] * red.by_right + by_seen[1] * green.by_right + by_seen[2] * blue.by_right
        by_down = by_seen[0] * red.by_down + by_seen[1] * green.by_down + by_seen[2] * blue.by_down
        pulled = rotate_back(rotation, pull_to_direction(cell, numbers.resolution, by_right, by_down))
        across = dot(pulled, unit)
        by_unit = (
            -2.0 * (across * ray[0] + along * pulled[0]),
            -2.0 * (across * ray[1] + along * pulled[1]),
            -2.0 * (across * ray[2] + along * pulled[2]),
        )
        radial = where(short, 0.0, dot(by_unit, unit))
        by_normal = (
            where(cell.usable, (by_unit[0] - radial * unit[0]) * inverse_length, 0.0),
            where(cell.usable, (by_unit[1] - radial * unit[1]) * inverse_length, 0.0),
            where(cell.usable, (by_unit[2] - radial * unit[2]) * inverse_length, 0.0),
        )
        store_channels(gradients.normals, pixels, first, active, by_normal)
    return vote * distance, grad_alpha


@njit(**INLINED_LANE_CODE)
def outline_group(active, alpha, mask, share):
    """Cross-entropy of sixteen pixels in bits, and its gradient by alpha times `share`."""
    inner = minimum(maximum(alpha, lanes(MARGIN)), lanes(f32(1) - MARGIN))
    outer = 1.0 - inner
    bits = -(mask * log2(inner) + (1.0 - mask) * log2(outer))
    moves = (alpha >= MARGIN) & (alpha <= f32(1) - MARGIN) & active
    return where(active, bits, 0.0), where(moves, (inner - mask) / (inner * outer) * share, 0.0)


@njit(**LANE_CODE)
def shade_pixels(counter, images, rotation, texture, numbers, gradients, kept, sums):
    """Shade every pixel, a run of pixels a task; `sums` gets the losses of each run."""
    pixels = images.alpha.size
    nothing = lanes(0.0)
    while True:
        task = fetch_add(counter, 1)
        begin = task * PIXELS_PER_CLAIM
        if begin >= pixels:
            return
        photometric, outline = nothing, nothing
        for first in range(begin, min(begin + PIXELS_PER_CLAIM, pixels), LANES):
            active = lane_indices() < f32(min(pixels - first, LANES))
            mask = load_some(images.mask, first, active)
            alpha = load_some(images.alpha, first, active)
            grad_alpha = nothing
            solid = (mask > numbers.solid_alpha) & active
            if any_lane(solid):
                loss, grad_alpha = shade_group(
                    first, active, solid, alpha, images, rotation, texture, numbers, gradients, kept
                )
                photometric += loss
            else:
                store_some(kept, RAY_CELL * pixels + first, active, lanes(-1.0))
                if numbers.geometry:
                    store_channels(gradients.normals, pixels, first, active, (nothing, nothing, nothing))
                    if gradients.albedo.size:
                        store_channels(gradients.albedo, pixels, first, active, (nothing, nothing, nothing))
            if numbers.silhouette_share > 0:
                bits, by_alpha = outline_group(active, alpha, mask, numbers.silhouette_share)
                outline += bits
                grad_alpha += by_alpha
            if numbers.geometry:
                store_some(gradients.alpha, first, active, grad_alpha)
        store_lanes(sums, task * LANES, sum_each((photometric, outline)))


@njit(**LANE_CODE)
def scatter_rays(counter, kept, pixels, stride, faces, lists):
    """Add the gradients of the looked-up colors to the padded faces (four channels, the last unused), a face a task.

    A texel's sum is taken in the order of the pixels, so it doesn't depend on the number of threads.
    """
    chosen_rays = lists[thread_slot(counter)]
    while True:
        face = fetch_add(counter, 1)
        if face >= 6:
            return
        faces[face] = f32(0)
        low, high = f32(face * stride * stride), f32((face + 1) * stride * stride)
        for first in range(0, pixels, LANES):
            active = lane_indices() < f32(min(pixels - first, LANES))
            cell = load_some(kept, first, active)
            chosen = (cell >= low) & (cell < high) & active
            if not any_lane(chosen):
                continue
            store_chosen(chosen_rays, 0, first, chosen)
            for i in range(lane_count(chosen)):
                deposit(kept, pixels, chosen_rays[i], stride, faces)


@njit(**INLINED_LANE_CODE)
def deposit(kept, pixels, ray, stride, faces):
    """Add one ray's gradient to the four texels around it."""
    at = 4 * np.int64(kept[ray])
    right, down = kept[RAY_RIGHT * pixels + ray], kept[RAY_DOWN * pixels + ray]
    left, up = f32(1) - right, f32(1) - down
    red = kept[RAY_RED * pixels + ray]
    green = kept[(RAY_RED + 1) * pixels + ray]
    blue = kept[(RAY_RED + 2) * pixels + ray]
    add_color(faces, at, up * left, red, green, blue)
    add_color(faces, at + 4, up * right, red, green, blue)
    add_color(faces, at + 4 * stride, down * left, red, green, blue)
    add_color(faces, at + 4 * stride + 4, down * right, red, green, blue)
