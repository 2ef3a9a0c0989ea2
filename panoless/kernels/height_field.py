"""Rays against a height over a plane that is a uniform cubic B-spline."""

import numpy as np
from jaxtyping import Float

from panoless.kernels.backend import ArrayBackend, array_kernels


def first_hits(
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    coefficients: Float[np.ndarray, "M N"],
    *,
    backend: ArrayBackend = "cpu",
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P 2"]]:
    """Distance along each ray, in lengths of its direction, to the front of z = h(x, y), and the slopes of h there.

    Knots lie at whole x in [0, M − 3] and y in [0, N − 3]; the coefficient (i, j) has its peak at (i − 1, j − 1).
    Beyond the knots the surface goes on straight. A miss, or a ray that no step brings nearer, has an infinite distance
    and no slope. Newton's steps start where the ray meets z = 0, so a surface that hides part of itself is not looked
    for. Raises ValueError for an unknown backend.
    """
    return array_kernels(backend, "height_field").first_hits(origins, directions, coefficients)
