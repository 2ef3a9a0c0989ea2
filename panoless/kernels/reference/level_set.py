"""The zero level of a tricubic B-spline, in numpy with scipy's B-splines."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from panoless.kernels.constants import LEAST_STEP, MAX_ROOT_STEPS

if TYPE_CHECKING:
    from scipy.interpolate import NdBSpline

ORDERS = (
    (0, 0, 0),
    *((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    *((2, 0, 0), (1, 1, 0), (1, 0, 1), (0, 2, 0), (0, 1, 1), (0, 0, 2)),
)
LONGEST_SAMPLE = 0.05
"""Cells between the samples of a ray."""


def spline_of(coefficients: Float[np.ndarray, "A B C"]) -> "NdBSpline":
    """The spline as scipy holds it: coefficient i of N has its peak at place i − 1."""
    from scipy.interpolate import NdBSpline

    return NdBSpline(tuple(np.arange(-3.0, count + 1) for count in coefficients.shape), coefficients, 3)


def evaluate(coefficients: Float[np.ndarray, "A B C"], places: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 10"]:
    """See `panoless.kernels.level_set`; within the knots only."""
    spline = spline_of(coefficients)
    return np.stack([spline(places, nu=order) for order in ORDERS], 1)


def first_hits(
    coefficients: Float[np.ndarray, "A B C"],
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    leaving: bool,
    empty: Int[np.ndarray, "a b c"],
) -> Float[np.ndarray, "P"]:
    """See `panoless.kernels.level_set`: dense samples everywhere, then bisection."""
    from scipy.optimize import elementwise

    spline = spline_of(coefficients)
    found = np.full(len(origins), np.inf)
    for ray, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        distance = _samples(coefficients.shape, origin, direction)
        distance = distance[distance > (LEAST_STEP if leaving else 0.0)]
        if len(distance) < 2:
            continue
        value = spline(_along(coefficients.shape, origin, direction, distance))
        crossed = np.flatnonzero((value[:-1] > 0) & (value[1:] <= 0))
        if len(crossed):
            low, high = distance[crossed[0]], distance[crossed[0] + 1]
            root = elementwise.find_root(
                lambda t, o=origin, d=direction: spline(_along(coefficients.shape, o, d, t)),
                (np.array([low]), np.array([high])),
                maxiter=MAX_ROOT_STEPS,
            )
            found[ray] = root.x[0]
    return found


def nearest_approach(
    coefficients: Float[np.ndarray, "A B C"],
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    empty: Int[np.ndarray, "a b c"],
) -> Float[np.ndarray, "P"]:
    """See `panoless.kernels.level_set`: the least of dense samples, refined by a parabola."""
    spline = spline_of(coefficients)
    found = np.full(len(origins), np.inf)
    for ray, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        distance = _samples(coefficients.shape, origin, direction)
        if len(distance) < 3:
            continue
        value = spline(_along(coefficients.shape, origin, direction, distance))
        least = int(np.clip(value.argmin(), 1, len(distance) - 2))
        before, here, after = value[least - 1 : least + 2]
        shift = 0.5 * (before - after) / max(before - 2 * here + after, 1e-30)
        found[ray] = distance[least] + np.clip(shift, -1, 1) * (distance[1] - distance[0])
    return found


def _along(shape: tuple[int, ...], origin: np.ndarray, direction: np.ndarray, distance: np.ndarray) -> np.ndarray:
    return np.clip(origin + distance[:, None] * direction, 0, np.array(shape) - 3.0)


def _samples(shape: tuple[int, ...], origin: np.ndarray, direction: np.ndarray) -> Float[np.ndarray, "S"]:
    """Distances within the knots, closely."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([-origin / direction, (np.array(shape) - 3.0 - origin) / direction])
    low, high = max(np.nanmin(ends, 0).max(), 0.0), np.nanmax(ends, 0).min()
    if high <= low:
        return np.zeros(0)
    return np.linspace(low, high, int((high - low) / LONGEST_SAMPLE) + 3)
