"""Derivatives of residuals by the coefficients of a tricubic B-spline, as products that store no matrix, in Numba.

A residual depends on φ and ∇φ at one place, so its row of the matrix is four numbers and that place. The rays are
scattered in four parts, each into an array of its own, so that sums do not depend on the number of threads.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from panoless.kernels.cpu.compilation import VECTORIZED_LOOPS
from panoless.kernels.cpu.level_set import cell_of, slopes_of, value_and_gradient, weights_of
from panoless.kernels.cpu.simd_memory import fetch_add
from panoless.kernels.cpu.workers import run_shared

PARTS = 4


def apply_rows(
    coefficients: Float[np.ndarray, "A B C"],
    places: Float[np.ndarray, "P 3"],
    rows: Float[np.ndarray, "P K 4"],
    weights: Float[np.ndarray, "P"],
) -> Float[np.ndarray, "P K"]:
    """See `panoless.kernels.level_set`."""
    residuals = np.zeros(rows.shape[:2])
    run_shared(_apply, PARTS, np.ascontiguousarray(coefficients), places, rows, weights, residuals)
    return residuals


def add_rows(
    residuals: Float[np.ndarray, "P K"],
    places: Float[np.ndarray, "P 3"],
    rows: Float[np.ndarray, "P K 4"],
    weights: Float[np.ndarray, "P"],
    shape: tuple[int, int, int],
) -> Float[np.ndarray, "A B C"]:
    """See `panoless.kernels.level_set`."""
    sums = np.zeros((PARTS, *shape))
    run_shared(_add, np.ascontiguousarray(residuals), places, rows, weights, sums)
    return sums.sum(0)


def add_squares(
    places: Float[np.ndarray, "P 3"],
    rows: Float[np.ndarray, "P K 4"],
    weights: Float[np.ndarray, "P"],
    shape: tuple[int, int, int],
) -> Float[np.ndarray, "A B C"]:
    """See `panoless.kernels.level_set`."""
    sums = np.zeros((PARTS, *shape))
    run_shared(_add_squares, places, rows, weights, sums)
    return sums.sum(0)


def without_means(
    values: Float[np.ndarray, "P K"], weights: Float[np.ndarray, "P"], groups: Int[np.ndarray, "P"], total: np.ndarray
) -> Float[np.ndarray, "P K"]:
    """See `panoless.kernels.level_set`."""
    sums = np.zeros((PARTS, len(total), values.shape[1]))
    run_shared(_sum_groups, values, weights, groups, sums)
    means = sums.sum(0) / total[:, None]
    result = np.empty_like(values)
    run_shared(_subtract, PARTS, values, means, groups, result)
    return result


def third_differences(
    coefficients: Float[np.ndarray, "A B C"], active: Bool[np.ndarray, "A B C"]
) -> Float[np.ndarray, "A B C"]:
    """See `panoless.kernels.level_set`."""
    sums = np.zeros((PARTS, *coefficients.shape))
    stencils = _OFFSETS, _FACTORS, _LENGTHS
    run_shared(_third_differences, np.ascontiguousarray(coefficients), active, *stencils, sums)
    return sums.sum(0)


def third_difference_stencils() -> list[tuple[Int[np.ndarray, "T 3"], Float[np.ndarray, "T"]]]:
    """Offsets and factors of the ten third differences, each times the root of how often it is in |D³φ|²."""
    single = {
        0: ((0, 1.0),),
        1: ((0, -1.0), (1, 1.0)),
        2: ((-1, 1.0), (0, -2.0), (1, 1.0)),
        3: ((-1, -1.0), (0, 3.0), (1, -3.0), (2, 1.0)),
    }
    found = []
    for orders in [(i, j, 3 - i - j) for i in range(4) for j in range(4 - i)]:
        often = 6 / np.prod([(1, 1, 2, 6)[order] for order in orders])
        taps = [
            ((i, j, k), a * b * c * often**0.5)
            for i, a in single[orders[0]]
            for j, b in single[orders[1]]
            for k, c in single[orders[2]]
        ]
        found.append((np.array([place for place, _ in taps]), np.array([factor for _, factor in taps])))
    return found


_STENCILS = third_difference_stencils()
_LENGTHS = np.array([len(factors) for _, factors in _STENCILS])
_OFFSETS = np.zeros((len(_STENCILS), max(_LENGTHS), 3), dtype=np.int64)
_FACTORS = np.zeros((len(_STENCILS), max(_LENGTHS)))
for _index, (_places, _values) in enumerate(_STENCILS):
    _OFFSETS[_index, : len(_values)], _FACTORS[_index, : len(_values)] = _places, _values


@njit(**VECTORIZED_LOOPS)
def _part(slot, parts, count):
    return count * slot // parts, count * (slot + 1) // parts


@njit(**VECTORIZED_LOOPS)
def _apply(counter, parts, coefficients, places, rows, weights, residuals):
    while True:
        slot = fetch_add(counter, 1)
        if slot >= parts:
            return
        begin, end = _part(slot, parts, len(places))
        for ray in range(begin, end):
            if weights[ray] <= 0:
                continue
            value, gx, gy, gz = value_and_gradient(coefficients, places[ray, 0], places[ray, 1], places[ray, 2])
            for k in range(rows.shape[1]):
                row = rows[ray, k]
                residuals[ray, k] = row[0] * value + row[1] * gx + row[2] * gy + row[3] * gz


@njit(**VECTORIZED_LOOPS)
def _add(counter, residuals, places, rows, weights, sums):
    while True:
        slot = fetch_add(counter, 1)
        if slot >= len(sums):
            return
        total = sums[slot]
        begin, end = _part(slot, len(sums), len(places))
        for ray in range(begin, end):
            weight = weights[ray]
            if weight <= 0:
                continue
            value = gx = gy = gz = 0.0
            for k in range(rows.shape[1]):
                share, row = weight * residuals[ray, k], rows[ray, k]
                value += share * row[0]
                gx += share * row[1]
                gy += share * row[2]
                gz += share * row[3]
            first, u = cell_of(places[ray, 0], total.shape[0])
            second, v = cell_of(places[ray, 1], total.shape[1])
            third, w = cell_of(places[ray, 2], total.shape[2])
            by_x, by_y, along_x, along_y = weights_of(u), weights_of(v), slopes_of(u), slopes_of(v)
            z0, z1, z2, z3 = weights_of(w)
            s0, s1, s2, s3 = slopes_of(w)
            for i in range(4):
                across, bend, up = by_x[i] * value + along_x[i] * gx, by_x[i] * gy, by_x[i] * gz
                for j in range(4):
                    flat, steep = by_y[j] * across + along_y[j] * bend, by_y[j] * up
                    line = total[first + i, second + j]
                    line[third] += z0 * flat + s0 * steep
                    line[third + 1] += z1 * flat + s1 * steep
                    line[third + 2] += z2 * flat + s2 * steep
                    line[third + 3] += z3 * flat + s3 * steep


@njit(**VECTORIZED_LOOPS)
def _add_squares(counter, places, rows, weights, sums):
    while True:
        slot = fetch_add(counter, 1)
        if slot >= len(sums):
            return
        total = sums[slot]
        begin, end = _part(slot, len(sums), len(places))
        for ray in range(begin, end):
            weight = weights[ray]
            if weight <= 0:
                continue
            first, u = cell_of(places[ray, 0], total.shape[0])
            second, v = cell_of(places[ray, 1], total.shape[1])
            third, w = cell_of(places[ray, 2], total.shape[2])
            by_x, by_y, along_x, along_y = weights_of(u), weights_of(v), slopes_of(u), slopes_of(v)
            z0, z1, z2, z3 = weights_of(w)
            s0, s1, s2, s3 = slopes_of(w)
            for k in range(rows.shape[1]):
                value, gx, gy, gz = rows[ray, k, 0], rows[ray, k, 1], rows[ray, k, 2], rows[ray, k, 3]
                for i in range(4):
                    across, bend, up = by_x[i] * value + along_x[i] * gx, by_x[i] * gy, by_x[i] * gz
                    for j in range(4):
                        flat, steep = by_y[j] * across + along_y[j] * bend, by_y[j] * up
                        line = total[first + i, second + j]
                        line[third] += weight * (z0 * flat + s0 * steep) ** 2
                        line[third + 1] += weight * (z1 * flat + s1 * steep) ** 2
                        line[third + 2] += weight * (z2 * flat + s2 * steep) ** 2
                        line[third + 3] += weight * (z3 * flat + s3 * steep) ** 2


@njit(**VECTORIZED_LOOPS)
def _sum_groups(counter, values, weights, groups, sums):
    while True:
        slot = fetch_add(counter, 1)
        if slot >= len(sums):
            return
        total = sums[slot]
        begin, end = _part(slot, len(sums), len(values))
        for ray in range(begin, end):
            for k in range(values.shape[1]):
                total[groups[ray], k] += weights[ray] * values[ray, k]


@njit(**VECTORIZED_LOOPS)
def _subtract(counter, parts, values, means, groups, result):
    while True:
        slot = fetch_add(counter, 1)
        if slot >= parts:
            return
        begin, end = _part(slot, parts, len(values))
        for ray in range(begin, end):
            for k in range(values.shape[1]):
                result[ray, k] = values[ray, k] - means[groups[ray], k]


@njit(**VECTORIZED_LOOPS)
def _third_differences(counter, coefficients, active, offsets, factors, lengths, sums):
    while True:
        slot = fetch_add(counter, 1)
        if slot >= len(sums):
            return
        begin, end = _part(slot, len(sums), coefficients.shape[0])
        for i in range(begin, end):
            for j in range(coefficients.shape[1]):
                for k in range(coefficients.shape[2]):
                    if active[i, j, k]:
                        _add_differences(coefficients, active, offsets, factors, lengths, sums[slot], i, j, k)


@njit(**VECTORIZED_LOOPS)
def _add_differences(coefficients, active, offsets, factors, lengths, result, i, j, k):
    """What the differences that begin at one coefficient add."""
    rows, columns, layers = coefficients.shape
    inner = 1 <= i < rows - 2 and 1 <= j < columns - 2 and 1 <= k < layers - 2
    for kind in range(len(lengths)):
        value, whole = 0.0, True
        for tap in range(lengths[kind]):
            a, b, c = i + offsets[kind, tap, 0], j + offsets[kind, tap, 1], k + offsets[kind, tap, 2]
            if not inner and (min(a, b, c) < 0 or a >= rows or b >= columns or c >= layers):
                whole = False
                break
            if not active[a, b, c]:
                whole = False
                break
            value += factors[kind, tap] * coefficients[a, b, c]
        if whole:
            for tap in range(lengths[kind]):
                a, b, c = i + offsets[kind, tap, 0], j + offsets[kind, tap, 1], k + offsets[kind, tap, 2]
                result[a, b, c] += factors[kind, tap] * value
