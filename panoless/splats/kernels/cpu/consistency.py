"""Consistency of rasterized normals with those of the surface depth (Eqs. 3, 4 and 12), sixteen pixels at a time.

The surface depth and what each pixel sends to its neighbors lie in images with a margin of two, so that no neighbor is
ever outside. For the formulas of the normal see `panoless.splats.kernels.cpu.image`.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from panoless.kernels.constants import ALPHA_FLOOR, SHORTEST_NORMAL
from panoless.kernels.cpu.compilation import INLINED_LANE_CODE, LANE_CODE
from panoless.kernels.cpu.simd import (
    LANES,
    any_lane,
    lane_indices,
    lanes,
    maximum,
    reciprocal,
    square_root,
    sum_each,
    where,
)
from panoless.kernels.cpu.simd_memory import fetch_add, load_lanes, load_some, store_lanes, store_some
from panoless.splats.kernels.constants import SURFACE_ALPHA
from panoless.splats.kernels.cpu.mirror import SHORTEST_NORMAL_SQUARED, load_channels, store_channels
from panoless.splats.kernels.cpu.project import dot, scaled

f32 = np.float32
ROWS_PER_CLAIM = 8
MARGIN = 2
FLOOR, SURFACE = f32(ALPHA_FLOOR), f32(SURFACE_ALPHA)
LARGEST = np.finfo(np.float32).max


class Surface(NamedTuple):
    """Flat images that are read."""

    normals: Any
    alpha: Any
    accumulated: Any
    median: Any
    mask: Any


class SurfaceGradients(NamedTuple):
    """Flat images that the gradients are added to (normals and alpha) or written to."""

    normals: Any
    alpha: Any
    accumulated: Any
    median: Any


class Grid(NamedTuple):
    """Size and intrinsics of the image."""

    width: Any
    height: Any
    stride: Any
    """Row length of the images with a margin."""
    fx: Any
    fy: Any
    cx: Any
    cy: Any


class Around(NamedTuple):
    """Depths right, left, below and above of sixteen pixels, and where they all exist."""

    a: Any
    b: Any
    c: Any
    e: Any
    defined: Any


@njit(**LANE_CODE)
def blend_depth(counter, surface, grid, blend, depth):
    """Write the surface depth, 0 where it is not positive and finite and all around the image; a row a task."""
    while True:
        first_row = fetch_add(counter, ROWS_PER_CLAIM)
        if first_row >= grid.height + 2 * MARGIN:
            return
        for row in range(first_row, min(first_row + ROWS_PER_CLAIM, grid.height + 2 * MARGIN)):
            at = row * grid.stride
            for column in range(0, grid.stride, LANES):
                store_some(depth, at + column, lane_indices() < f32(min(grid.stride - column, LANES)), lanes(0.0))
            if row < MARGIN or row >= grid.height + MARGIN:
                continue
            for column in range(0, grid.width, LANES):
                first = (row - MARGIN) * grid.width + column
                active = lane_indices() < f32(min(grid.width - column, LANES))
                alpha = load_some(surface.alpha, first, active)
                expected = load_some(surface.accumulated, first, active) / maximum(alpha, lanes(FLOOR))
                value = expected
                if blend > 0:
                    value = (f32(1) - blend) * expected + blend * load_some(surface.median, first, active)
                usable = (value > 0.0) & (value <= LARGEST)
                store_some(depth, at + MARGIN + column, active, where(usable, value, 0.0))


@njit(**INLINED_LANE_CODE)
def depths_around(depth, at, stride, row, column, grid, active):
    """Load the neighbors of sixteen pixels; those on the rim of the image have none."""
    a = load_lanes(depth, at + 1)
    b = load_lanes(depth, at - 1)
    c = load_lanes(depth, at + stride)
    e = load_lanes(depth, at - stride)
    place = lane_indices() + f32(column)
    inner = (place > 0.0) & (place < f32(grid.width - 1)) & active
    return Around(a, b, c, e, (a > 0.0) & (b > 0.0) & (c > 0.0) & (e > 0.0) & inner)


@njit(**INLINED_LANE_CODE)
def weights_of(surface, first, active, around):
    """How much each pixel counts."""
    mask = load_some(surface.mask, first, active)
    alpha = load_some(surface.alpha, first, active)
    return where(around.defined & (alpha > SURFACE), mask, 0.0)


@njit(**LANE_CODE)
def add_weights(counter, surface, grid, depth, sums):
    """Sum the weights of all pixels, a run of rows a task."""
    while True:
        task = fetch_add(counter, 1)
        first_row = task * ROWS_PER_CLAIM
        if first_row >= grid.height:
            return
        total = lanes(0.0)
        for row in range(max(first_row, 1), min(first_row + ROWS_PER_CLAIM, grid.height - 1)):
            for column in range(0, grid.width, LANES):
                active = lane_indices() < f32(min(grid.width - column, LANES))
                at = (row + MARGIN) * grid.stride + MARGIN + column
                around = depths_around(depth, at, grid.stride, row, column, grid, active)
                total += weights_of(surface, row * grid.width + column, active, around)
        store_lanes(sums, task * LANES, sum_each((total,)))


@njit(**LANE_CODE)
def compare_normals(counter, surface, grid, depth, scale, sent, gradients, sums):
    """Sum weight·(1 − N·n), add the gradient of the rasterized normals, and write what the depths' gradient is made of.

    `sent` are two images with a margin: the derivatives by (a − b)/(a + b) and (c − e)/(c + e), over (a + b)²/2 and
    (c + e)²/2. Gradients are multiplied by `scale`; without images for them, only the sum is found.
    """
    pixels = surface.alpha.size
    wanted = gradients.alpha.size > 0
    area = grid.stride * (grid.height + 2 * MARGIN)
    zero = lanes(0.0)
    while True:
        task = fetch_add(counter, 1)
        first_row = task * ROWS_PER_CLAIM - MARGIN
        if first_row >= grid.height + MARGIN:
            return
        total = zero
        for row in range(first_row, min(first_row + ROWS_PER_CLAIM, grid.height + MARGIN)):
            line = (row + MARGIN) * grid.stride
            if wanted:
                for column in range(0, grid.stride, LANES):
                    inside = lane_indices() < f32(min(grid.stride - column, LANES))
                    store_some(sent, line + column, inside, zero)
                    store_some(sent, area + line + column, inside, zero)
            if row < 1 or row >= grid.height - 1:
                continue
            y = f32(row) + f32(0.5) - grid.cy
            for column in range(0, grid.width, LANES):
                active = lane_indices() < f32(min(grid.width - column, LANES))
                at = line + MARGIN + column
                first = row * grid.width + column
                around = depths_around(depth, at, grid.stride, row, column, grid, active)
                weight = weights_of(surface, first, active, around)
                if not any_lane(weight > 0.0):
                    continue
                x = lane_indices() + (f32(column) + f32(0.5) - grid.cx)
                inverse_x = reciprocal(where(around.defined, around.a + around.b, 1.0))
                inverse_y = reciprocal(where(around.defined, around.c + around.e, 1.0))
                slope_x = (around.a - around.b) * inverse_x
                slope_y = (around.c - around.e) * inverse_y
                normal = (grid.fx * slope_x, grid.fy * slope_y, -(x * slope_x + y * slope_y + 1.0))
                inverse = 1.0 / square_root(dot(normal, normal))
                normal = scaled(normal, inverse)
                raster = load_channels(surface.normals, pixels, first, active)
                squared = dot(raster, raster)
                short = squared < SHORTEST_NORMAL_SQUARED
                raster_inverse = where(short, f32(1 / SHORTEST_NORMAL), 1.0 / square_root(where(short, 1.0, squared)))
                unit = scaled(raster, raster_inverse)
                cosine = dot(unit, normal)
                total += weight * (1.0 - cosine)
                if not wanted:
                    continue
                push = -scale * weight
                radial = where(short, 0.0, cosine)
                held = load_channels(gradients.normals, pixels, first, active)
                by_raster = (
                    held[0] + push * (normal[0] - radial * unit[0]) * raster_inverse,
                    held[1] + push * (normal[1] - radial * unit[1]) * raster_inverse,
                    held[2] + push * (normal[2] - radial * unit[2]) * raster_inverse,
                )
                store_channels(gradients.normals, pixels, first, active, by_raster)
                by_z = push * (unit[2] - normal[2] * cosine)
                by_x = grid.fx * push * (unit[0] - normal[0] * cosine) - x * by_z
                by_y = grid.fy * push * (unit[1] - normal[1] * cosine) - y * by_z
                store_some(sent, at, active, 2.0 * inverse * inverse_x * inverse_x * by_x)
                store_some(sent, area + at, active, 2.0 * inverse * inverse_y * inverse_y * by_y)
        store_lanes(sums, task * LANES, sum_each((total,)))


@njit(**LANE_CODE)
def spread_to_depths(counter, surface, grid, blend, depth, sent, gradients):
    """Collect what each depth is sent by its four neighbors, and pass it on to what the depth was blended from."""
    area = grid.stride * (grid.height + 2 * MARGIN)
    stride = grid.stride
    while True:
        first_row = fetch_add(counter, ROWS_PER_CLAIM)
        if first_row >= grid.height:
            return
        for row in range(first_row, min(first_row + ROWS_PER_CLAIM, grid.height)):
            for column in range(0, grid.width, LANES):
                active = lane_indices() < f32(min(grid.width - column, LANES))
                at = (row + MARGIN) * stride + MARGIN + column
                first = row * grid.width + column
                # A depth is the right neighbor of the pixel left of it, and so on.
                by_depth = load_lanes(sent, at - 1) * load_lanes(depth, at - 2)
                by_depth -= load_lanes(sent, at + 1) * load_lanes(depth, at + 2)
                by_depth += load_lanes(sent, area + at - stride) * load_lanes(depth, at - 2 * stride)
                by_depth -= load_lanes(sent, area + at + stride) * load_lanes(depth, at + 2 * stride)
                alpha = load_some(surface.alpha, first, active)
                inverse = 1.0 / maximum(alpha, lanes(FLOOR))
                by_accumulated = (f32(1) - blend) * by_depth * inverse
                store_some(gradients.accumulated, first, active, by_accumulated)
                if blend > 0:
                    store_some(gradients.median, first, active, blend * by_depth)
                by_alpha = by_accumulated * load_some(surface.accumulated, first, active) * inverse
                held = load_some(gradients.alpha, first, active)
                store_some(gradients.alpha, first, active, held - where(alpha >= FLOOR, by_alpha, 0.0))
