"""Derivatives by the coefficients of a tricubic B-spline, in numpy with scipy's sparse design matrices."""

from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.kernels.reference.level_set import ORDERS, spline_of


def apply_rows(
    coefficients: Float[np.ndarray, "A B C"],
    places: Float[np.ndarray, "P 3"],
    rows: Float[np.ndarray, "P K 4"],
    weights: Float[np.ndarray, "P"],
) -> Float[np.ndarray, "P K"]:
    """See `panoless.kernels.level_set`."""
    spline = spline_of(coefficients)
    values = np.stack([spline(places, nu=order) for order in ORDERS[:4]], 1)
    return np.einsum("pkn,pn->pk", rows, values) * (weights > 0)[:, None]


def add_rows(
    residuals: Float[np.ndarray, "P K"],
    places: Float[np.ndarray, "P 3"],
    rows: Float[np.ndarray, "P K 4"],
    weights: Float[np.ndarray, "P"],
    shape: tuple[int, int, int],
) -> Float[np.ndarray, "A B C"]:
    """See `panoless.kernels.level_set`."""
    jacobian = _jacobian(places, rows, shape)
    return np.einsum("pkc,pk->c", jacobian, weights.clip(0)[:, None] * residuals).reshape(shape)


def add_squares(
    places: Float[np.ndarray, "P 3"],
    rows: Float[np.ndarray, "P K 4"],
    weights: Float[np.ndarray, "P"],
    shape: tuple[int, int, int],
) -> Float[np.ndarray, "A B C"]:
    """See `panoless.kernels.level_set`."""
    return np.einsum("pkc,p->c", _jacobian(places, rows, shape) ** 2, weights.clip(0)).reshape(shape)


def without_means(
    values: Float[np.ndarray, "P K"],
    weights: Float[np.ndarray, "P"],
    groups: Int[np.ndarray, "P"],
    total: Float[np.ndarray, "G"],
) -> Float[np.ndarray, "P K"]:
    """See `panoless.kernels.level_set`."""
    sums = np.stack([np.bincount(groups, weights * column, len(total)) for column in values.T], 1)
    return values - (sums / total[:, None])[groups]


def third_differences(
    coefficients: Float[np.ndarray, "A B C"], active: Bool[np.ndarray, "A B C"], whole: Int[np.ndarray, "A B C"]
) -> Float[np.ndarray, "A B C"]:
    """See `panoless.kernels.level_set`: every path of three forward differences along axes is one term of |D³c|²."""
    result = np.zeros_like(coefficients)
    for axes in product(range(3), repeat=3):
        difference, whole = coefficients, active
        for axis in axes:
            difference = np.diff(difference, axis=axis)
            whole = np.take(whole, range(1, whole.shape[axis]), axis) & np.take(
                whole, range(whole.shape[axis] - 1), axis
            )
        image = np.where(whole, difference, 0.0)
        for axis in axes:
            padding = [(1, 1) if other == axis else (0, 0) for other in range(3)]
            image = -np.diff(np.pad(image, padding), axis=axis)
        result += image
    return result


def _jacobian(
    places: Float[np.ndarray, "P 3"], rows: Float[np.ndarray, "P K 4"], shape: tuple[int, int, int]
) -> Float[np.ndarray, "P K N"]:
    """The dense matrix, by one unit spline after the other."""
    columns = []
    for index in range(int(np.prod(shape))):
        unit = np.zeros(shape)
        unit.flat[index] = 1.0
        columns.append(apply_rows(unit, places, rows, np.ones(len(places))))
    return np.stack(columns, 2)
