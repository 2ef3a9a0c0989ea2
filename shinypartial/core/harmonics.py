"""Real spherical harmonics, and the projection of a map of the sphere onto them (numpy).

Orthonormal over the sphere and without the Condon–Shortley phase, as in Ramamoorthi and Hanrahan (2001) and in
graphics since: Y₁ = √(3/4π) · (y, z, x) for m = −1, 0, 1. A function of degree l and order m has the index l² + l + m.
"""

from math import factorial, pi, prod, sqrt
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.core.sphere import latlong_directions, latlong_solid_angles


def real_harmonics(directions: Float[np.ndarray, "*P 3"], degree: int) -> Float[np.ndarray, "*P K"]:
    """All (degree + 1)² values at unit directions, by `harmonic_polynomials`."""
    x, y, z = np.moveaxis(directions, -1, 0)
    basis = np.empty((*x.shape, (degree + 1) ** 2))
    for index, values in enumerate(harmonic_polynomials(x, y, z, degree)):
        basis[..., index] = values
    return basis


def harmonic_polynomials(x: Any, y: Any, z: Any, degree: int) -> list[Any]:
    """All (degree + 1)² functions as polynomials of x, y and z, which are arrays or tensors; the first is a number.

    Y_lm = N · P_l^|m|(z)/sin^|m|θ · {√2 Im, 1, √2 Re}(x + iy)^|m| for m < 0, m = 0, m > 0, with
    N² = (2l+1)/4π · (l−|m|)!/(l+|m|)! and P by its recurrence over l.
    """
    basis: list[Any] = [0.0] * (degree + 1) ** 2
    real, imaginary = 1.0, 0.0
    for m in range(degree + 1):
        before, legendre = 0.0, float(prod(range(1, 2 * m, 2)))
        for el in range(m, degree + 1):
            if el > m:
                before, legendre = legendre, ((2 * el - 1) * z * legendre - (el + m - 1) * before) / (el - m)
            norm = sqrt((2 * el + 1) / (4 * pi) * factorial(el - m) / factorial(el + m) * (2 if m else 1))
            basis[el * el + el - m] = norm * legendre * imaginary
            basis[el * el + el + m] = norm * legendre * real
        real, imaginary = x * real - y * imaginary, x * imaginary + y * real
    return basis


def project(
    values: Float[np.ndarray, "P C"], directions: Float[np.ndarray, "P 3"], areas: Float[np.ndarray, "P"], degree: int
) -> Float[np.ndarray, "K C"]:
    """Coefficients c_lm = Σ L Y_lm dω of values at unit directions that stand for so many steradians each."""
    return np.einsum("pk,pc->kc", real_harmonics(directions, degree) * areas[:, None], values.astype(np.float64))


def project_latlong(
    latlong: Float[np.ndarray, "H W C"], degree: int, axes_world: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "K C"]:
    """Coefficients c_lm = ∫ L Y_lm dω of a lat-long map: Σ over texels, Y_lm at their centers, exact solid angles.

    The columns of `axes_world` are the x, y and z of the harmonics.
    """
    height, channels = len(latlong), latlong.shape[-1]
    directions = (latlong_directions(height) @ axes_world).reshape(-1, 3)
    return project(latlong.reshape(-1, channels), directions, latlong_solid_angles(height).ravel(), degree)
