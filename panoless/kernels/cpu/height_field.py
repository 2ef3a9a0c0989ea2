"""Where rays meet a height over a plane, a uniform cubic B-spline, in Numba: Newton's steps along each ray."""

import numpy as np
from jaxtyping import Float
from numba import njit

from panoless.kernels.constants import MAX_NEWTON_STEPS, NEWTON_CONVERGED
from panoless.kernels.cpu.compilation import PLAIN_LOOPS
from panoless.kernels.cpu.simd_memory import fetch_add
from panoless.kernels.cpu.workers import run_shared

RAYS_PER_CLAIM = 4096


def first_hits(
    origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], coefficients: Float[np.ndarray, "M N"]
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P 2"]]:
    """See `panoless.kernels.revolution`."""
    count = len(origins)
    distance, slopes = np.empty(count), np.empty((count, 2))
    rays = np.ascontiguousarray(origins, dtype=np.float64), np.ascontiguousarray(directions, dtype=np.float64)
    run_shared(_trace, *rays, np.ascontiguousarray(coefficients, dtype=np.float64), distance, slopes)
    return distance, slopes


@njit(**PLAIN_LOOPS)
def _basis(t):
    """The four cubic B-splines over a cell, t in [0, 1], and their derivatives."""
    s = 1 - t
    values = (s * s * s / 6, (3 * t - 6) * t * t / 6 + 2 / 3, (3 * s - 6) * s * s / 6 + 2 / 3, t * t * t / 6)
    slopes = (-s * s / 2, (3 * t / 2 - 2) * t, -(3 * s / 2 - 2) * s, t * t / 2)
    return values, slopes


@njit(**PLAIN_LOOPS)
def _height(coefficients, x, y):
    """h and its two slopes."""
    rows, columns = coefficients.shape
    inside_x, inside_y = min(max(x, 0.0), rows - 3.0), min(max(y, 0.0), columns - 3.0)
    row, column = min(int(inside_x), rows - 4), min(int(inside_y), columns - 4)
    by_x, slope_x = _basis(inside_x - row)
    by_y, slope_y = _basis(inside_y - column)
    h, along_x, along_y = 0.0, 0.0, 0.0
    for i in range(4):
        value, slope = 0.0, 0.0
        for j in range(4):
            value += by_y[j] * coefficients[row + i, column + j]
            slope += slope_y[j] * coefficients[row + i, column + j]
        h += by_x[i] * value
        along_x += slope_x[i] * value
        along_y += by_x[i] * slope
    return h + along_x * (x - inside_x) + along_y * (y - inside_y), along_x, along_y


@njit(**PLAIN_LOOPS)
def _trace(counter, origins, directions, coefficients, distance, slopes):
    while True:
        begin = fetch_add(counter, RAYS_PER_CLAIM)
        if begin >= len(origins):
            return
        for ray in range(begin, min(begin + RAYS_PER_CLAIM, len(origins))):
            ox, oy, oz = origins[ray]
            dx, dy, dz = directions[ray]
            distance[ray], slopes[ray, 0], slopes[ray, 1] = np.inf, 0.0, 0.0
            if oz <= 0 or dz >= 0:
                continue
            t = -oz / dz
            for _ in range(MAX_NEWTON_STEPS):
                h, along_x, along_y = _height(coefficients, ox + t * dx, oy + t * dy)
                rate = dz - along_x * dx - along_y * dy
                gap = oz + t * dz - h
                if rate >= 0:
                    break
                if abs(gap) < NEWTON_CONVERGED:
                    if t > 0:
                        distance[ray], slopes[ray, 0], slopes[ray, 1] = t, along_x, along_y
                    break
                t -= gap / rate
