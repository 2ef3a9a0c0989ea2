"""Uniform cubic B-splines.

Knots lie at whole places 0 … N − 3 for N coefficients; coefficient i has its peak at place i − 1.
"""

import numpy as np
from jaxtyping import Float, Int


def cubic_bspline_basis(t: Float[np.ndarray, "P"], derivatives: int = 2) -> Float[np.ndarray, "K P 4"]:
    """The four B-splines over a cell, t in [0, 1], and as many of their derivatives by t, up to the second.

    Closed forms, because scipy's design matrix has no derivatives.
    """
    values = ((1 - t) ** 3 / 6, (3 * t**3 - 6 * t**2 + 4) / 6, (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6, t**3 / 6)
    slopes = (-((1 - t) ** 2) / 2, (3 * t**2 - 4 * t) / 2, (-3 * t**2 + 2 * t + 1) / 2, t**2 / 2)
    bends = (1 - t, 3 * t - 2, 1 - 3 * t, t)
    return np.stack([np.stack(order, 1) for order in (values, slopes, bends)[: derivatives + 1]])


def cubic_bspline(place: Float[np.ndarray, "*P"]) -> Float[np.ndarray, "*P"]:
    """One B-spline at places about its peak."""
    away = np.abs(place)
    return np.where(away < 1, 2 / 3 - away**2 + away**3 / 2, np.clip(2 - away, 0, None) ** 3 / 6)


def cubic_bsplines_at(
    place: Float[np.ndarray, "P"], count: int | Int[np.ndarray, "P"], derivatives: int = 0
) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "K P 4"]]:
    """Which B-spline is the first of the four that act at each place, and the basis there, as of `cubic_bspline_basis`.

    `count` is the number N of coefficients, one for all places or one each. Beyond the knots the outermost cell's
    polynomial goes on.
    """
    cell = np.clip(np.floor(place), 0, np.maximum(np.asarray(count) - 4, 0)).astype(np.int64)
    return cell, cubic_bspline_basis(place - cell, derivatives)


def with_halved_knots(coefficients: Float[np.ndarray, "N ..."]) -> Float[np.ndarray, "M ..."]:
    """The 2N − 3 coefficients of the same spline with twice as many knots, along the first axis."""
    finer = np.empty((2 * len(coefficients) - 3, *coefficients.shape[1:]))
    finer[0::2] = (coefficients[:-1] + coefficients[1:]) / 2
    finer[1::2] = (coefficients[:-2] + 6 * coefficients[1:-1] + coefficients[2:]) / 8
    return finer
