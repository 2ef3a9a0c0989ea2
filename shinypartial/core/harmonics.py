"""Real spherical harmonics, and the projection of a map of the sphere onto them (numpy).

Orthonormal over the sphere and without the Condon–Shortley phase, as in Ramamoorthi and Hanrahan (2001) and in
graphics since: Y₁ = √(3/4π) · (y, z, x) for m = −1, 0, 1. A function of degree l and order m has the index l² + l + m.
"""

from math import factorial, isqrt, pi, sqrt

import numpy as np
from jaxtyping import Float

from shinypartial.core.sphere import latlong_directions, latlong_solid_angles


def real_harmonics(directions: Float[np.ndarray, "... 3"], degree: int) -> Float[np.ndarray, "... K"]:
    """All (degree + 1)² values at unit directions.

    Y_lm = N · P_l^|m|(z) · {√2 sin |m|φ, 1, √2 cos mφ} for m < 0, m = 0, m > 0; N² = (2l+1)/4π · (l−|m|)!/(l+|m|)!
    """
    from scipy.special import lpmv

    x, y, z = np.moveaxis(directions, -1, 0)
    azimuth, columns = np.arctan2(y, x), []
    for index in range((degree + 1) ** 2):
        el = isqrt(index)
        m = index - el * el - el
        order = abs(m)
        norm = sqrt((2 * el + 1) / (4 * pi) * factorial(el - order) / factorial(el + order))
        around = np.ones_like(azimuth) if m == 0 else sqrt(2) * (np.sin if m < 0 else np.cos)(order * azimuth)
        columns.append((-1) ** order * norm * lpmv(order, el, z) * around)  # scipy's P has the phase (−1)^m.
    return np.stack(columns, -1)


def project_latlong(
    latlong: Float[np.ndarray, "H W C"], degree: int, axes_world: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "K C"]:
    """Coefficients c_lm = ∫ L Y_lm dω of a lat-long map: Σ over texels, Y_lm at their centers, exact solid angles.

    The columns of `axes_world` are the x, y and z of the harmonics.
    """
    height = len(latlong)
    basis = real_harmonics(latlong_directions(height) @ axes_world, degree) * latlong_solid_angles(height)[..., None]
    return np.einsum("hwk,hwc->kc", basis, latlong.astype(np.float64))
