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

PARTS, SLAB = 4, 4


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
    coefficients: Float[np.ndarray, "A B C"], active: Bool[np.ndarray, "A B C"], whole: Int[np.ndarray, "A B C"]
) -> Float[np.ndarray, "A B C"]:
    """See `panoless.kernels.level_set`."""
    result = np.zeros(coefficients.shape)
    flat, (_, rows, columns) = np.ascontiguousarray(coefficients).ravel(), coefficients.shape
    for parity in range(2):
        run_shared(
            _third_differences, parity, flat, whole.reshape(len(whole), -1), rows * columns, columns, result.ravel()
        )
    return result


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
def _third_differences(counter, parity, coefficients, whole, by_row, by_column, result):
    """Slabs of every other four rows at once: none adds to what another adds to."""
    x, y, z = by_row, by_column, 1
    while True:
        slab = 2 * fetch_add(counter, 1) + parity
        if SLAB * slab >= len(whole):
            return
        for row in range(SLAB * slab, min(SLAB * (slab + 1), len(whole))):
            for column in range(by_row):
                kinds, place = np.int64(whole[row, column]), row * by_row + column
                if kinds == 0:
                    continue
                if kinds & 1:
                    _add_three(coefficients, result, place, z)
                if kinds & 2:
                    _add_two_and_one(coefficients, result, place, z, y)
                if kinds & 4:
                    _add_two_and_one(coefficients, result, place, y, z)
                if kinds & 8:
                    _add_three(coefficients, result, place, y)
                if kinds & 16:
                    _add_two_and_one(coefficients, result, place, z, x)
                if kinds & 32:
                    _add_one_each(coefficients, result, place, x, y, z)
                if kinds & 64:
                    _add_two_and_one(coefficients, result, place, y, x)
                if kinds & 128:
                    _add_two_and_one(coefficients, result, place, x, z)
                if kinds & 256:
                    _add_two_and_one(coefficients, result, place, x, y)
                if kinds & 512:
                    _add_three(coefficients, result, place, x)


@njit(**VECTORIZED_LOOPS)
def _add_three(values, result, place, step):
    """Of the third difference along an axis, which is once in |D³c|²."""
    a, b, c, d = place - step, place, place + step, place + 2 * step
    value = values[d] - values[a] + 3 * (values[b] - values[c])
    result[a] -= value
    result[b] += 3 * value
    result[c] -= 3 * value
    result[d] += value


@njit(**VECTORIZED_LOOPS)
def _add_two_and_one(values, result, place, twice, once):
    """Of the second difference along one axis and the first along another, three times in |D³c|²."""
    a, b, c = place - twice, place, place + twice
    d, e, f = a + once, b + once, c + once
    value = 3 * (values[d] + values[f] - values[a] - values[c] + 2 * (values[b] - values[e]))
    result[a] -= value
    result[b] += 2 * value
    result[c] -= value
    result[d] += value
    result[e] -= 2 * value
    result[f] += value


@njit(**VECTORIZED_LOOPS)
def _add_one_each(values, result, place, x, y, z):
    """Of the first differences along all three axes, six times in |D³c|²."""
    a, b, c, d = place, place + z, place + y, place + y + z
    e, f, g, h = a + x, b + x, c + x, d + x
    value = 6 * (values[b] - values[a] + values[c] - values[d] + values[e] - values[f] + values[h] - values[g])
    result[a] -= value
    result[b] += value
    result[c] += value
    result[d] -= value
    result[e] += value
    result[f] -= value
    result[g] -= value
    result[h] += value
