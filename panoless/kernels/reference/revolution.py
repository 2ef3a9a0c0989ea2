"""Rays against surfaces of revolution in numpy: loops over sides of the profile or over rays."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from panoless.kernels.constants import LEAST_FACING, LEAST_RISE
from panoless.kernels.reference.cubemap import project_to_face


def first_hits(
    origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], profile: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "P"], Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """See `panoless.kernels.revolution`. On a side, (ρ, h) = (r, z) + u (dr, dz): the roots of ρ(t)² = (r + u(t) dr)²
    with u(t) = (h(t) − z)/dz, and u = (ρ − r)/dr at h(t) = z on a level one.
    """
    (x, y, h), (dx, dy, dh) = origins.T, directions.T
    a, b, c = dx * dx + dy * dy, x * dx + y * dy, x * x + y * y
    distance, side, along = np.full(len(x), np.inf), np.full(len(x), -1), np.zeros(len(x))
    for index, ((r, z), (dr, dz)) in enumerate(zip(profile[:-1], np.diff(profile, axis=0), strict=True)):
        with np.errstate(divide="ignore", invalid="ignore"):
            if abs(dz) < 1e-7 * np.hypot(dr, dz):
                roots = [(z - h) / dh]
            else:
                k, m = r + (h - z) * dr / dz, dh * dr / dz
                root = np.sqrt((b - k * m) ** 2 - (a - m * m) * (c - k * k))
                roots = [(-(b - k * m) + sign * root) / (a - m * m) for sign in (-1, 1)]
            for t in roots:
                rho = np.sqrt(np.maximum((a * t + 2 * b) * t + c, 0))
                u = ((rho - r) * dr + (h + t * dh - z) * dz) / (dr * dr + dz * dz)
                on_side = np.hypot(r + u * dr - rho, z + u * dz - h - t * dh) < 1e-7
                nearer = on_side & (t > 0) & (t < distance) & (u >= -1e-9) & (u <= 1 + 1e-9)
                distance[nearer], side[nearer], along[nearer] = t[nearer], index, u[nearer].clip(0, 1)
    return distance, side, along


def follow(
    points: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    places: tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"]],
    profile: Float[np.ndarray, "N 2"],
    angles: Float[np.ndarray, "S 2"],
    epsilon: float,
    max_bounces: int,
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"], Int[np.ndarray, "P"]]:
    """See `panoless.kernels.revolution`."""
    (last, final), bounces = np.zeros((2, len(points), 3)), np.zeros(len(points), dtype=np.int64)
    (side, along), ray = places, np.arange(len(points))
    for bounce in range(1, max_bounces + 1):
        angle = angles[side, 0] + along * (angles[side, 1] - angles[side, 0])
        radial = points[:, :2] / np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-12)[:, None]
        normals = np.concatenate([np.sin(angle)[:, None] * radial, -np.cos(angle)[:, None]], 1)
        directions = directions - 2 * (directions * normals).sum(1, keepdims=True) * normals
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        starts = points + epsilon * directions
        distance, side, along = first_hits(starts, directions, profile)
        left, on = side < 0, side >= 0
        last[ray[left]], final[ray[left]], bounces[ray[left]] = starts[left], directions[left], bounce
        points = starts[on] + distance[on, None] * directions[on]
        ray, directions, side, along = ray[on], directions[on], side[on], along[on]
    return last, final, bounces


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
    least = np.full((cells, len(origins) + ranks), np.inf)
    for ray, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        chord = _chord(origin, direction, reach)
        if chord is None:
            continue
        middle, half = chord
        rho, height = _meridian(origin, direction, middle - half + np.arange(int(8 * half / cell) + 1) * cell / 4).T
        index = np.floor((height - lowest) / cell).astype(np.int64)
        within = (index >= 0) & (index < cells)
        np.minimum.at(least[:, ray], index[within], rho[within])
    return np.sort(least, 1)[:, :ranks]


def distance_grid(
    polyline: Float[np.ndarray, "N 2"], lowest: float, cell: float, rows: int, columns: int
) -> Float[np.ndarray, "rows columns"]:
    """See `panoless.kernels.revolution`."""
    rho, height = np.meshgrid(np.arange(columns) * cell, lowest + np.arange(rows) * cell)
    points = np.stack([rho.ravel(), height.ravel()], 1)
    distance, _, _ = _nearest_side(points, polyline)
    return np.where(_inside(points, polyline), -distance, distance).reshape(rows, columns)


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
    from scipy.interpolate import RegularGridInterpolator

    indices = np.arange(grid.shape[1]), np.arange(grid.shape[0])
    interpolate = RegularGridInterpolator(indices, grid.T, bounds_error=False, fill_value=np.inf)
    where, side = np.zeros(len(origins)), np.full(len(origins), -1)
    signed, along = np.zeros(len(origins)), np.zeros(len(origins))
    for ray, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        chord = _chord(origin, direction, reach)
        if chord is None:
            continue
        middle, half = chord
        t, step = np.linspace(middle - half, middle + half, int(4 * half / cell) + 2, retstep=True)
        values = interpolate((_meridian(origin, direction, t) - [0, lowest]) / cell)
        best = int(values.argmin())
        if not np.isfinite(values[best]):
            continue
        left, least, right = np.pad(values, 1, constant_values=np.inf)[best : best + 3]
        bend, nearest = left - 2 * least + right, t[best]
        if np.isfinite(bend) and bend > 1e-12:
            nearest += step * np.clip((left - right) / (2 * bend), -1, 1)
        point = _meridian(origin, direction, nearest[None])
        (distance,), (side[ray],), (along[ray],) = _nearest_side(point, polyline)
        where[ray], signed[ray] = nearest, -distance if _inside(point, polyline)[0] else distance
    return where, signed, side, along


def slope_votes(
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    radiance: Float[np.ndarray, "P 3"],
    texels: Float[np.ndarray, "6 L L 3"],
    frame: Float[np.ndarray, "3 3"],
    grid: Float[np.ndarray, "5"],
    angles: Float[np.ndarray, "S"],
    scale: float,
) -> Float[np.ndarray, "2 cells S"]:
    """See `panoless.kernels.revolution`."""
    cell, top, mouth = grid[0], grid[1], grid[4]
    columns, rows = int(grid[2]), int(grid[3])
    result = np.zeros((2, rows * columns, len(angles)))
    for origin, direction, color in zip(origins, directions, radiance, strict=True):
        if direction[2] > -LEAST_RISE:
            continue
        t = (top - origin[2]) / direction[2] + (np.arange(8 * columns) + 0.5) * cell / 2
        points = origin + t[:, None] * direction
        rho = np.hypot(points[:, 0], points[:, 1])
        row, column = np.floor((top - points[:, 2]) / cell), np.floor(rho / cell)
        kept = (row >= 0) & (row < rows) & (column < columns) & (rho > 0.1 * cell)
        points, rho, at = points[kept], rho[kept], (row * columns + column)[kept].astype(np.int64)
        radial = np.concatenate([points[:, :2] / rho[:, None], np.zeros((len(rho), 1))], 1)
        normals = np.sin(angles)[:, None] * radial[:, None] - np.cos(angles)[:, None] * np.array([0.0, 0.0, 1.0])
        facing = normals @ direction
        mirrored = direction - 2 * facing[..., None] * normals
        rise = np.maximum(mirrored[..., 2], LEAST_RISE)
        ahead = np.maximum(mouth - points[:, 2], 0)[:, None] / rise
        leaving = points[:, None, :2] + ahead[..., None] * mirrored[..., :2]
        through = (ahead == 0) | ((leaving**2).sum(-1) < (columns * cell) ** 2)
        counted = (facing < -LEAST_FACING) & (mirrored[..., 2] > LEAST_RISE) & through
        squared = ((_nearest_texels(texels, mirrored @ frame) - color) ** 2).sum(-1)
        np.add.at(result[0], at, counted * squared / (squared + scale**2))
        np.add.at(result[1], at, counted)
    return result


def _chord(
    origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], reach: float
) -> tuple[float, float] | None:
    """Middle and half length of the part of a unit ray's line within `reach` of the origin; None if there is none."""
    middle = -float(origin @ direction)
    squared = reach**2 - (float(origin @ origin) - middle**2)
    return (middle, squared**0.5) if squared >= 0 else None


def _meridian(
    origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], t: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "T 2"]:
    """Radius and height along a ray."""
    points = origin + t[:, None] * direction
    return np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], 1)


def _nearest_side(
    points: Float[np.ndarray, "P 2"], polyline: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "P"], Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """Distance from a polyline, the nearest side, and where on it, 0 to 1."""
    starts, sides = polyline[:-1], np.diff(polyline, axis=0)
    along = ((points[:, None] - starts) * sides).sum(-1) / np.maximum((sides**2).sum(1), 1e-30)
    distance = np.linalg.norm(starts + along.clip(0, 1)[..., None] * sides - points[:, None], axis=-1)
    side = distance.argmin(1)
    rows = np.arange(len(points))
    return distance[rows, side], side, along.clip(0, 1)[rows, side]


def _inside(points: Float[np.ndarray, "P 2"], polyline: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, "P"]:
    """Whether points lie in the polygon of a polyline and the axis: rays to ρ = ∞ cross it an odd number of times."""
    (x, y), (x0, y0), (x1, y1) = points.T[:, :, None], polyline[:-1].T, polyline[1:].T
    crossed = (y0 > y) != (y1 > y)
    return (crossed & (x < x0 + (y - y0) / np.where(y1 == y0, 1.0, y1 - y0) * (x1 - x0))).sum(1) % 2 == 1


def _nearest_texels(
    texels: Float[np.ndarray, "6 L L 3"], directions: Float[np.ndarray, "*P 3"]
) -> Float[np.ndarray, "*P 3"]:
    face, st, _ = project_to_face(torch.from_numpy(directions.reshape(-1, 3)))
    side = texels.shape[1]
    column, row = ((st.numpy() + 1) / 2 * side).astype(np.int64).clip(max=side - 1).T
    return texels[face.numpy(), row, column].reshape(directions.shape)
