"""A tricubic B-spline and where rays meet its zero level, in Numba.

Values along the last axis, which is contiguous, are summed four at a time: 16 rows of four coefficients around a place.
"""

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from panoless.kernels.constants import LEAST_STEP, MAX_ROOT_STEPS, ROOT_CONVERGED
from panoless.kernels.cpu.compilation import VECTORIZED_LOOPS
from panoless.kernels.cpu.simd_memory import fetch_add
from panoless.kernels.cpu.workers import run_shared

PLACES_PER_CLAIM = 2048
SAFE_SHARE, LONGEST_STEP = 0.8, 1.0
SAMPLE_STEP, SAMPLE_SHARE, CLOSE_SHARE = 0.5, 0.5, 0.5
LEAVING_STEP, LEAVING_TRIALS = 0.25, 8
LEVEL_CONVERGED = 1e-7
NEAR_CELLS = 3
ZERO = (0.0, 0.0, 0.0, 0.0)


def evaluate(coefficients: Float[np.ndarray, "A B C"], places: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 10"]:
    """See `panoless.kernels.level_set`."""
    found = np.empty((len(places), 10))
    run_shared(_evaluate, _array(coefficients), _array(places), found)
    return found


def first_hits(
    coefficients: Float[np.ndarray, "A B C"],
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    leaving: bool,
    empty: Int[np.ndarray, "a b c"],
) -> Float[np.ndarray, "P"]:
    """See `panoless.kernels.level_set`."""
    distance = np.empty(len(origins))
    run_shared(_trace, _array(coefficients), empty, _array(origins), _array(directions), leaving, distance)
    return distance


def nearest_approach(
    coefficients: Float[np.ndarray, "A B C"],
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    empty: Int[np.ndarray, "a b c"],
) -> Float[np.ndarray, "P"]:
    """See `panoless.kernels.level_set`."""
    distance = np.empty(len(origins))
    run_shared(_approach, _array(coefficients), empty, _array(origins), _array(directions), distance)
    return distance


def _array(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float64)


@njit(**VECTORIZED_LOOPS)
def cell_of(place, count):
    """The cell of a place along an axis of so many coefficients, and where in it; the outermost go on."""
    cell = min(max(int(np.floor(place)), 0), count - 4)
    return cell, place - cell


@njit(**VECTORIZED_LOOPS)
def weights_of(t):
    """The four cubic B-splines over a cell."""
    s = 1 - t
    return s * s * s / 6, (3 * t - 6) * t * t / 6 + 2 / 3, (3 * s - 6) * s * s / 6 + 2 / 3, t * t * t / 6


@njit(**VECTORIZED_LOOPS)
def slopes_of(t):
    """Their derivatives."""
    s = 1 - t
    return -s * s / 2, (1.5 * t - 2) * t, -(1.5 * s - 2) * s, t * t / 2


@njit(**VECTORIZED_LOOPS)
def bends_of(t):
    """Their second derivatives."""
    return 1 - t, 3 * t - 2, 1 - 3 * t, t


@njit(**VECTORIZED_LOOPS)
def _more(sums, weight, row, first):
    """Four running sums and a weighted row of four coefficients."""
    return (
        sums[0] + weight * row[first],
        sums[1] + weight * row[first + 1],
        sums[2] + weight * row[first + 2],
        sums[3] + weight * row[first + 3],
    )


@njit(**VECTORIZED_LOOPS)
def _added(sums, weight, others):
    return (
        sums[0] + weight * others[0],
        sums[1] + weight * others[1],
        sums[2] + weight * others[2],
        sums[3] + weight * others[3],
    )


@njit(**VECTORIZED_LOOPS)
def _dot(weights, sums):
    return weights[0] * sums[0] + weights[1] * sums[1] + weights[2] * sums[2] + weights[3] * sums[3]


@njit(**VECTORIZED_LOOPS)
def value_at(coefficients, x, y, z):
    """φ at a place."""
    first, u = cell_of(x, coefficients.shape[0])
    second, v = cell_of(y, coefficients.shape[1])
    third, w = cell_of(z, coefficients.shape[2])
    by_x, by_y, sums = weights_of(u), weights_of(v), ZERO
    for i in range(4):
        plain = ZERO
        for j in range(4):
            plain = _more(plain, by_y[j], coefficients[first + i, second + j], third)
        sums = _added(sums, by_x[i], plain)
    return _dot(weights_of(w), sums)


@njit(**VECTORIZED_LOOPS)
def value_and_gradient(coefficients, x, y, z):
    """φ and ∇φ at a place."""
    first, u = cell_of(x, coefficients.shape[0])
    second, v = cell_of(y, coefficients.shape[1])
    third, w = cell_of(z, coefficients.shape[2])
    by_x, by_y, along_x, along_y = weights_of(u), weights_of(v), slopes_of(u), slopes_of(v)
    sums = sums_x = sums_y = ZERO
    for i in range(4):
        plain = steep = ZERO
        for j in range(4):
            row = coefficients[first + i, second + j]
            plain = _more(plain, by_y[j], row, third)
            steep = _more(steep, along_y[j], row, third)
        sums, sums_y = _added(sums, by_x[i], plain), _added(sums_y, by_x[i], steep)
        sums_x = _added(sums_x, along_x[i], plain)
    by_z = weights_of(w)
    return _dot(by_z, sums), _dot(by_z, sums_x), _dot(by_z, sums_y), _dot(slopes_of(w), sums)


@njit(**VECTORIZED_LOOPS)
def _evaluate(counter, coefficients, places, found):
    while True:
        begin = fetch_add(counter, PLACES_PER_CLAIM)
        if begin >= len(places):
            return
        for place in range(begin, min(begin + PLACES_PER_CLAIM, len(places))):
            first, u = cell_of(places[place, 0], coefficients.shape[0])
            second, v = cell_of(places[place, 1], coefficients.shape[1])
            third, w = cell_of(places[place, 2], coefficients.shape[2])
            by_x, along_x, bend_x = weights_of(u), slopes_of(u), bends_of(u)
            by_y, along_y, bend_y = weights_of(v), slopes_of(v), bends_of(v)
            sums = sums_x = sums_y = sums_xx = sums_xy = sums_yy = ZERO
            for i in range(4):
                plain = steep = bent = ZERO
                for j in range(4):
                    row = coefficients[first + i, second + j]
                    plain = _more(plain, by_y[j], row, third)
                    steep = _more(steep, along_y[j], row, third)
                    bent = _more(bent, bend_y[j], row, third)
                sums, sums_y, sums_yy = (
                    _added(sums, by_x[i], plain),
                    _added(sums_y, by_x[i], steep),
                    _added(sums_yy, by_x[i], bent),
                )
                sums_x, sums_xy = _added(sums_x, along_x[i], plain), _added(sums_xy, along_x[i], steep)
                sums_xx = _added(sums_xx, bend_x[i], plain)
            by_z, along_z = weights_of(w), slopes_of(w)
            found[place, 0] = _dot(by_z, sums)
            found[place, 1] = _dot(by_z, sums_x)
            found[place, 2] = _dot(by_z, sums_y)
            found[place, 3] = _dot(along_z, sums)
            found[place, 4] = _dot(by_z, sums_xx)
            found[place, 5] = _dot(by_z, sums_xy)
            found[place, 6] = _dot(along_z, sums_x)
            found[place, 7] = _dot(by_z, sums_yy)
            found[place, 8] = _dot(along_z, sums_y)
            found[place, 9] = _dot(bends_of(w), sums)


@njit(**VECTORIZED_LOOPS)
def _span(shape, ox, oy, oz, dx, dy, dz):
    """Where a ray from t = 0 on is between the outermost knots; an end before the start where it never is."""
    start, end = 0.0, np.inf
    for axis in range(3):
        origin = ox if axis == 0 else oy if axis == 1 else oz
        direction = dx if axis == 0 else dy if axis == 1 else dz
        last = shape[axis] - 3.0
        if abs(direction) < 1e-12:
            if origin < 0 or origin > last:
                return 1.0, 0.0
            continue
        one, other = -origin / direction, (last - origin) / direction
        start, end = max(start, min(one, other)), min(end, max(one, other))
    return start, end


@njit(**VECTORIZED_LOOPS)
def _root(coefficients, ox, oy, oz, dx, dy, dz, outside, inside, t):
    """Where φ = 0 between `outside` and `inside`: Newton's steps from t, or halves where these leave the bracket."""
    for _ in range(MAX_ROOT_STEPS):
        value, gx, gy, gz = value_and_gradient(coefficients, ox + t * dx, oy + t * dy, oz + t * dz)
        if value > 0:
            outside = t
        else:
            inside = t
        rate = gx * dx + gy * dy + gz * dz
        following = t - value / rate if rate < 0 else outside - 1.0
        if following < outside or following > inside:
            following = 0.5 * (outside + inside)
        if abs(following - t) < ROOT_CONVERGED * (1.0 + t):
            return following
        t = following
    return t


@njit(**VECTORIZED_LOOPS)
def _free(empty, x, y, z):
    """The number of empty cells around a place."""
    i, j = min(max(int(x), 0), empty.shape[0] - 1), min(max(int(y), 0), empty.shape[1] - 1)
    return empty[i, j, min(max(int(z), 0), empty.shape[2] - 1)]


@njit(**VECTORIZED_LOOPS)
def _march(coefficients, empty, ox, oy, oz, dx, dy, dz, start, end):
    """The first t from `start` on, which lies outside, at which a ray enters the inside; infinite where it never does.

    Through empty cells by their number, elsewhere by a share of φ, in steps that are neither tiny nor long.
    """
    if start >= end:
        return np.inf
    t, value = start, 0.0
    widest = max(abs(dx), abs(dy), abs(dz))
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    free = _free(empty, x, y, z)
    if free == 0:
        value = value_at(coefficients, x, y, z)
    while True:
        before, above = t, value
        if free > 0:
            t += max(free - 1.0, LEAST_STEP) / widest
        else:
            t += min(max(SAFE_SHARE * value, LEAST_STEP), LONGEST_STEP)
        if t >= end:
            return np.inf
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        free, value = _free(empty, x, y, z), 0.0
        if free == 0:
            value = value_at(coefficients, x, y, z)
            if value <= 0:
                between = before + (t - before) * (above / (above - value) if above > 0 else 0.5)
                return _root(coefficients, ox, oy, oz, dx, dy, dz, before, t, between)


@njit(**VECTORIZED_LOOPS)
def _trace(counter, coefficients, empty, origins, directions, leaving, distance):
    while True:
        begin = fetch_add(counter, PLACES_PER_CLAIM)
        if begin >= len(origins):
            return
        for ray in range(begin, min(begin + PLACES_PER_CLAIM, len(origins))):
            ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            start, end = _span(coefficients.shape, ox, oy, oz, dx, dy, dz)
            distance[ray] = np.inf
            if start >= end:
                continue
            if leaving:
                step = LEAVING_STEP
                for _ in range(LEAVING_TRIALS):
                    if value_at(coefficients, ox + step * dx, oy + step * dy, oz + step * dz) > 0:
                        break
                    step *= 0.5
                start += step
            distance[ray] = _march(coefficients, empty, ox, oy, oz, dx, dy, dz, start, end)


@njit(**VECTORIZED_LOOPS)
def _least_sample(coefficients, empty, near, ox, oy, oz, dx, dy, dz, start, end):
    """Where the least of samples of φ along a ray lies, and the samples before and after it; infinite where there are
    none, because the inside is never at most `near` cells away.

    Samples lie closely where φ is small. The farther a ray is from the surface, or from where it was nearest so far,
    the farther they lie apart.
    """
    least, best, low, high, before, t = np.inf, np.inf, start, end, start, start
    widest = max(abs(dx), abs(dy), abs(dz))
    while t < end:
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        free = _free(empty, x, y, z)
        if free > near:
            t += max(free - near, SAMPLE_STEP) / widest
            continue
        value = value_at(coefficients, x, y, z)
        following = t + max(SAMPLE_STEP, SAMPLE_SHARE * max(value - max(least, 0.0), CLOSE_SHARE * value))
        if value < least:
            least, best, low, high = value, t, max(before, t - LONGEST_STEP), following
        before, t = t, following
    return best, low, min(high, end)


@njit(**VECTORIZED_LOOPS)
def _approach(counter, coefficients, empty, origins, directions, distance):
    while True:
        begin = fetch_add(counter, PLACES_PER_CLAIM)
        if begin >= len(origins):
            return
        for ray in range(begin, min(begin + PLACES_PER_CLAIM, len(origins))):
            ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            start, end = _span(coefficients.shape, ox, oy, oz, dx, dy, dz)
            if start >= end:
                distance[ray] = np.inf
                continue
            best, low, high = _least_sample(coefficients, empty, NEAR_CELLS, ox, oy, oz, dx, dy, dz, start, end)
            if best == np.inf:
                best, low, high = _least_sample(coefficients, empty, empty.size, ox, oy, oz, dx, dy, dz, start, end)
            distance[ray] = _level(coefficients, ox, oy, oz, dx, dy, dz, low, high)


@njit(**VECTORIZED_LOOPS)
def _level(coefficients, ox, oy, oz, dx, dy, dz, low, high):
    """Where φ ceases to fall between two t: the end beyond which it falls on, or the root of its slope along the ray,
    by regula falsi with Illinois weights (Dowell and Jarratt 1971), the slope being nearly linear there.
    """
    falling, rising = (
        _slope(coefficients, ox, oy, oz, dx, dy, dz, low),
        _slope(coefficients, ox, oy, oz, dx, dy, dz, high),
    )
    if falling >= 0:
        return low
    if rising <= 0:
        return high
    side, t = 0, low
    for _ in range(MAX_ROOT_STEPS):
        before, t = t, (low * rising - high * falling) / (rising - falling)
        if abs(t - before) < LEVEL_CONVERGED:
            break
        slope = _slope(coefficients, ox, oy, oz, dx, dy, dz, t)
        if slope > 0:
            high, rising = t, slope
            falling *= 0.5 if side > 0 else 1.0
            side = 1
        else:
            low, falling = t, slope
            rising *= 0.5 if side < 0 else 1.0
            side = -1
    return t


@njit(**VECTORIZED_LOOPS)
def _slope(coefficients, ox, oy, oz, dx, dy, dz, t):
    """Of φ along a ray."""
    _, gx, gy, gz = value_and_gradient(coefficients, ox + t * dx, oy + t * dy, oz + t * dz)
    return gx * dx + gy * dy + gz * dz
