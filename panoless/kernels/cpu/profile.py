"""Rays against a profile in the plane of radius and height, in Numba: envelopes of rays, distances from polylines."""

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from panoless.kernels.cpu.compilation import INLINED_LANE_CODE, PLAIN_LOOPS
from panoless.kernels.cpu.simd_memory import fetch_add
from panoless.kernels.cpu.workers import run_shared

RAYS_PER_CLAIM = 256
RUN = 8
"""Steps that are taken, or left out, at once."""
STEEPEST = 2**0.5
"""How fast a distance that is interpolated between four others may change with the place."""


@njit(**PLAIN_LOOPS)
def envelope(
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    lowest: float,
    cell: float,
    cells: int,
    ranks: int,
    reach: float,
) -> Float[np.ndarray, "cells ranks"]:
    """See `panoless.kernels.revolution`."""
    best = np.full((cells, ranks), np.inf)
    for ray in range(len(origins)):
        o, d = origins[ray], directions[ray]
        middle, half = _chord(o, d, reach)
        if half < 0:
            continue
        last, least = -1, np.inf
        for step in range(int(8 * half / cell) + 1):
            t = middle - half + step * cell / 4
            index = int(np.floor((o[2] + t * d[2] - lowest) / cell))
            rho = np.sqrt((o[0] + t * d[0]) ** 2 + (o[1] + t * d[1]) ** 2)
            if index != last:
                _keep(best, last, least)
                last, least = index, rho
            elif rho < least:
                least = rho
        _keep(best, last, least)
    return best


@njit(**PLAIN_LOOPS)
def _chord(origin, direction, reach):
    """Middle and half length of the part of a unit ray's line within `reach` of the origin; −1 for none."""
    middle = -(origin[0] * direction[0] + origin[1] * direction[1] + origin[2] * direction[2])
    clear = origin[0] ** 2 + origin[1] ** 2 + origin[2] ** 2 - middle**2
    return middle, np.sqrt(reach**2 - clear) if clear <= reach**2 else -1.0


@njit(**PLAIN_LOOPS)
def _keep(best, index, value):
    if index < 0 or index >= len(best):
        return
    row = best[index]
    for k in range(len(row)):
        if value < row[k]:
            value, row[k] = row[k], value


@njit(**PLAIN_LOOPS)
def polyline_distance(x: float, y: float, polyline: Float[np.ndarray, "N 2"]) -> tuple[float, int, float]:
    """Distance of a point from a polyline, the nearest side, and where on it, 0 to 1."""
    best, side, along = np.inf, 0, 0.0
    for i in range(len(polyline) - 1):
        ax, ay = polyline[i, 0], polyline[i, 1]
        dx, dy = polyline[i + 1, 0] - ax, polyline[i + 1, 1] - ay
        u = ((x - ax) * dx + (y - ay) * dy) / max(dx * dx + dy * dy, 1e-30)
        u = min(max(u, 0.0), 1.0)
        squared = (ax + u * dx - x) ** 2 + (ay + u * dy - y) ** 2
        if squared < best:
            best, side, along = squared, i, u
    return np.sqrt(best), side, along


@njit(**PLAIN_LOOPS)
def _inside(x, y, polyline):
    """Whether a point lies in the polygon of a polyline and the axis x = 0, by crossings of a ray to x = ∞."""
    odd = False
    for i in range(len(polyline) - 1):
        y0, y1 = polyline[i, 1], polyline[i + 1, 1]
        if (y0 > y) != (y1 > y):
            cross = polyline[i, 0] + (y - y0) / (y1 - y0) * (polyline[i + 1, 0] - polyline[i, 0])
            if cross > x:
                odd = not odd
    return odd


def distance_grid(
    polyline: Float[np.ndarray, "N 2"], lowest: float, cell: float, rows: int, columns: int
) -> Float[np.ndarray, "rows columns"]:
    """See `panoless.kernels.revolution`."""
    grid = np.empty((rows, columns))
    run_shared(_distance_grid, polyline, lowest, cell, grid)
    return grid


@njit(**PLAIN_LOOPS)
def _distance_grid(counter, polyline, lowest, cell, grid):
    while True:
        row = fetch_add(counter, 1)
        if row >= len(grid):
            return
        for column in range(grid.shape[1]):
            x, y = column * cell, lowest + row * cell
            distance, _, _ = polyline_distance(x, y, polyline)
            grid[row, column] = -distance if _inside(x, y, polyline) else distance


def closest_approach(
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    polyline: Float[np.ndarray, "N 2"],
    grid: Float[np.ndarray, "rows columns"],
    lowest: float,
    cell: float,
    reach: float,
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P"], Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """See `panoless.kernels.revolution`."""
    count = len(origins)
    where, signed = np.zeros(count), np.zeros(count)
    side, along = np.full(count, -1), np.zeros(count)
    run_shared(_closest_approach, origins, directions, polyline, grid, lowest, cell, reach, where, signed, side, along)
    return where, signed, side, along


@njit(**PLAIN_LOOPS)
def _closest_approach(counter, origins, directions, polyline, grid, lowest, cell, reach, where, signed, side, along):
    """All steps of a run are left out if none can be nearer to the body than the nearest middle of a run.

    Of a profile that begins and ends on the axis the signed distance changes by no more than its place does, and its
    interpolation by no more than √2 times as much.
    """
    is_closed = polyline[0, 0] == 0 and polyline[-1, 0] == 0
    least = np.empty(int(4 * reach / cell) // RUN + 2)
    while True:
        begin = fetch_add(counter, RAYS_PER_CLAIM)
        if begin >= len(origins):
            return
        for ray in range(begin, min(begin + RAYS_PER_CLAIM, len(origins))):
            o, d = origins[ray], directions[ray]
            middle, half = _chord(o, d, reach)
            if half < 0:
                continue
            steps = int(4 * half / cell) + 2
            first, size = middle - half, 2 * half / (steps - 1)
            reached = RUN // 2 * size
            best, at = np.inf, -1
            for run in range((steps + RUN - 1) // RUN):
                step = RUN * run + RUN // 2
                value, beyond = _interpolated(o, d, first + step * size, grid, lowest, cell)
                least[run] = value - STEEPEST * reached
                if (value == np.inf and beyond * cell <= reached) or not is_closed:
                    least[run] = -np.inf
                if value < best and step < steps:
                    best, at = value, step
            for run in range((steps + RUN - 1) // RUN):
                if least[run] > best:
                    continue
                for step in range(RUN * run, min(RUN * run + RUN, steps)):
                    value, _ = _interpolated(o, d, first + step * size, grid, lowest, cell)
                    if value < best or (value == best and step < at):
                        best, at = value, step
            if at < 0:
                continue
            t, left, right = first + at * size, np.inf, np.inf
            if at > 0:
                left, _ = _interpolated(o, d, first + (at - 1) * size, grid, lowest, cell)
            if at < steps - 1:
                right, _ = _interpolated(o, d, first + (at + 1) * size, grid, lowest, cell)
            if np.isfinite(left) and np.isfinite(right):
                bend = left - 2 * best + right
                if bend > 1e-12:
                    t += size * min(max(0.5 * (left - right) / bend, -1.0), 1.0)
            x, y = np.sqrt((o[0] + t * d[0]) ** 2 + (o[1] + t * d[1]) ** 2), o[2] + t * d[2]
            distance, side[ray], along[ray] = polyline_distance(x, y, polyline)
            where[ray], signed[ray] = t, -distance if _inside(x, y, polyline) else distance


@njit(**INLINED_LANE_CODE)
def _interpolated(origin, direction, t, grid, lowest, cell):
    """A grid's value at a place on a ray, infinite beyond the grid, and how many cells beyond it that is."""
    rows, columns = grid.shape
    column = np.sqrt((origin[0] + t * direction[0]) ** 2 + (origin[1] + t * direction[1]) ** 2) / cell
    row = (origin[2] + t * direction[2] - lowest) / cell
    i, j = int(np.floor(row)), int(np.floor(column))
    if not (0 <= i < rows - 1 and 0 <= j < columns - 1):
        return np.inf, max(column - (columns - 1), -row, row - (rows - 1))
    p, q = row - i, column - j
    value = (1 - p) * ((1 - q) * grid[i, j] + q * grid[i, j + 1])
    return value + p * ((1 - q) * grid[i + 1, j] + q * grid[i + 1, j + 1]), 0.0
