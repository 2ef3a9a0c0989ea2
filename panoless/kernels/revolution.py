"""Rays against surfaces of revolution about the z axis.

A profile is a polyline of (ρ, h): radius and height. Its directions θ are those of its sides, and the normal at azimuth
φ is (sin θ cos φ, sin θ sin φ, −cos θ). Every function raises ValueError for an unknown backend.
"""

import numpy as np
from jaxtyping import Float, Int

from panoless.kernels.backend import ArrayBackend, array_kernels


def first_hits(
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    profile: Float[np.ndarray, "N 2"],
    *,
    backend: ArrayBackend = "cpu",
) -> tuple[Float[np.ndarray, "P"], Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """Distance along each ray, in lengths of its direction, to the surface; side of the profile; where on it, 0 to 1.

    Both faces of the surface count, from t = 0 on; a miss has an infinite distance and side −1.
    """
    return array_kernels(backend, "revolution").first_hits(origins, directions, profile)


def follow(
    points: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    places: tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"]],
    profile: Float[np.ndarray, "N 2"],
    angles: Float[np.ndarray, "S 2"],
    epsilon: float,
    max_bounces: int,
    *,
    backend: ArrayBackend = "cpu",
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"], Int[np.ndarray, "P"]]:
    """Where rays leave the surface for good, in which unit directions, and after how many reflections; zeros for those
    that have not after `max_bounces`.

    Rays come in `directions` and meet the surface at `points`, on that side and place of it; each next one starts
    `epsilon` from its point. `angles` are the profile's directions at both ends of every side (rad), between which
    those of normals are interpolated.
    """
    return array_kernels(backend, "revolution").follow(
        points, directions, places, profile, angles, epsilon, max_bounces
    )


def envelope(
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    lowest: float,
    cell: float,
    cells: int,
    ranks: int,
    reach: float,
    *,
    backend: ArrayBackend = "cpu",
) -> Float[np.ndarray, "cells ranks"]:
    """For every cell of heights from `lowest` on the smallest of the rays' smallest radii in it, in order; infinite
    where fewer pass.

    Rays have unit directions and are followed where they are within `reach` of the origin, by steps of a quarter of a
    cell.
    """
    return array_kernels(backend, "revolution").envelope(origins, directions, lowest, cell, cells, ranks, reach)


def distance_grid(
    polyline: Float[np.ndarray, "N 2"],
    lowest: float,
    cell: float,
    rows: int,
    columns: int,
    *,
    backend: ArrayBackend = "cpu",
) -> Float[np.ndarray, "rows columns"]:
    """Signed distance (negative inside) from a profile at (ρ, h) = (column, row)·cell + (0, lowest)."""
    return array_kernels(backend, "revolution").distance_grid(polyline, lowest, cell, rows, columns)


def closest_approach(
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    polyline: Float[np.ndarray, "N 2"],
    grid: Float[np.ndarray, "rows columns"],
    lowest: float,
    cell: float,
    reach: float,
    *,
    backend: ArrayBackend = "cpu",
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P"], Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """Where each unit ray comes nearest to the body, or deepest into it: distance along the ray, signed distance from
    the profile, side of the profile and where on it. A ray that passes beyond `reach` has side −1.

    The least value of `distance_grid` at steps of half a cell within `reach` of the origin, refined by a parabola.
    """
    return array_kernels(backend, "revolution").closest_approach(
        origins, directions, polyline, grid, lowest, cell, reach
    )


def slope_votes(
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    radiance: Float[np.ndarray, "P 3"],
    texels: Float[np.ndarray, "6 L L 3"],
    frame: Float[np.ndarray, "3 3"],
    grid: Float[np.ndarray, "5"],
    angles: Float[np.ndarray, "S"],
    scale: float,
    *,
    backend: ArrayBackend = "cpu",
) -> Float[np.ndarray, "2 cells S"]:
    """Sum of ‖e‖²/(‖e‖² + s²), and number of rays, for each cell and direction of the profile.

    Rays have unit directions in the frame of the axis, whose rows are `frame`. `grid` holds the size of a cell, the
    height of the uppermost ones, how many there are by column and by row, and the height of the mouth, as wide as the
    columns. Only rays count that see the front of a slope and leave it through the mouth, or above. Radiance is that of
    the texel in the mirrored direction.
    """
    return array_kernels(backend, "revolution").slope_votes(
        origins, directions, radiance, texels, frame, grid, angles, scale
    )
