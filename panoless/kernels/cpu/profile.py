"""Rays against a profile in the plane of radius and height, in Numba: envelopes of rays, distances from polylines."""

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from panoless.kernels.cpu.compilation import PLAIN_LOOPS


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


@njit(**PLAIN_LOOPS)
def distance_grid(
    polyline: Float[np.ndarray, "N 2"], lowest: float, cell: float, rows: int, columns: int
) -> Float[np.ndarray, "rows columns"]:
    """See `panoless.kernels.revolution`."""
    grid = np.empty((rows, columns))
    for row in range(rows):
        for column in range(columns):
            x, y = column * cell, lowest + row * cell
            distance, _, _ = polyline_distance(x, y, polyline)
            grid[row, column] = -distance if _inside(x, y, polyline) else distance
    return grid


@njit(**PLAIN_LOOPS)
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
    rows, columns = grid.shape
    for ray in range(count):
        o, d = origins[ray], directions[ray]
        middle, half = _chord(o, d, reach)
        if half < 0:
            continue
        steps = int(4 * half / cell) + 2
        size = 2 * half / (steps - 1)
        best, at = np.inf, -1
        before, here, left, right = np.inf, np.inf, np.inf, np.inf
        for step in range(steps):
            t = middle - half + step * size
            column = np.sqrt((o[0] + t * d[0]) ** 2 + (o[1] + t * d[1]) ** 2) / cell
            row = (o[2] + t * d[2] - lowest) / cell
            i, j = int(np.floor(row)), int(np.floor(column))
            value = np.inf
            if 0 <= i < rows - 1 and 0 <= j < columns - 1:
                p, q = row - i, column - j
                value = (1 - p) * ((1 - q) * grid[i, j] + q * grid[i, j + 1])
                value += p * ((1 - q) * grid[i + 1, j] + q * grid[i + 1, j + 1])
            before, here = here, value
            if at == step - 1:
                right = value
            if value < best:
                best, at, left, right = value, step, before, np.inf
        if at < 0:
            continue
        t = middle - half + at * size
        if np.isfinite(left) and np.isfinite(right):
            bend = left - 2 * best + right
            if bend > 1e-12:
                t += size * min(max(0.5 * (left - right) / bend, -1.0), 1.0)
        x, y = np.sqrt((o[0] + t * d[0]) ** 2 + (o[1] + t * d[1]) ** 2), o[2] + t * d[2]
        distance, side[ray], along[ray] = polyline_distance(x, y, polyline)
        where[ray], signed[ray] = t, -distance if _inside(x, y, polyline) else distance
    return where, signed, side, along
