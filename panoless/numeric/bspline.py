"""Uniform cubic B-splines."""

import numpy as np
from jaxtyping import Float


def cubic_bspline_basis(t: Float[np.ndarray, "P"]) -> list[Float[np.ndarray, "P 4"]]:
    """The four uniform cubic B-splines over a cell, t in [0, 1], and their first and second derivatives by t."""
    values = ((1 - t) ** 3 / 6, (3 * t**3 - 6 * t**2 + 4) / 6, (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6, t**3 / 6)
    slopes = (-((1 - t) ** 2) / 2, (9 * t**2 - 12 * t) / 6, (-9 * t**2 + 6 * t + 3) / 6, t**2 / 2)
    bends = (1 - t, 3 * t - 2, 1 - 3 * t, t)
    return [np.stack(each, 1) for each in (values, slopes, bends)]
