"""The zero level of a tricubic uniform B-spline φ: rays that meet it, what it mirrors, and derivatives by coefficients.

Places are in cells: knots lie at whole x in [0, A − 3], y in [0, B − 3] and z in [0, C − 3]; the coefficient (i, j, k)
has its peak at (i − 1, j − 1, k − 1). φ is negative inside. Every function raises ValueError for an unknown backend.
"""

from functools import reduce

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.kernels.backend import ArrayBackend, array_kernels
from panoless.kernels.constants import SUB_PIXELS

VALUE, GRADIENT = 0, slice(1, 4)
"""Columns of derivatives: φ; φ_x, φ_y, φ_z; φ_xx, φ_xy, φ_xz, φ_yy, φ_yz, φ_zz."""

DIFFERENCE_ORDERS = tuple((i, j, 3 - i - j) for i in range(4) for j in range(4 - i))
"""Of third differences, along x, y and z."""
DIFFERENCE_TAPS = (0,), (0, 1), (-1, 0, 1), (-1, 0, 1, 2)
"""The coefficients that a difference of each order takes along an axis."""


def evaluate(
    coefficients: Float[np.ndarray, "A B C"], places: Float[np.ndarray, "P 3"], *, backend: ArrayBackend = "cpu"
) -> Float[np.ndarray, "P 10"]:
    """φ with its first and second derivatives at places; beyond the knots the outermost cells' polynomials go on."""
    _check_coefficients(coefficients)
    return array_kernels(backend, "level_set").evaluate(coefficients, places)


def first_hits(
    coefficients: Float[np.ndarray, "A B C"],
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    *,
    leaving: bool = False,
    empty: Int[np.ndarray, "a b c"] | None = None,
    backend: ArrayBackend = "cpu",
) -> Float[np.ndarray, "P"]:
    """Distance along rays of unit direction to where φ first falls through zero; infinite for a miss.

    φ = 0 is met to 1e-9 of the distance. Rays that start on the surface and are `leaving` it are followed from up to a
    quarter of a cell on. Where φ is near to zero steps are a quarter of a cell or more, so a part of the surface that a
    ray crosses within less than that may be missed. Cells whose coefficients are all positive are passed at once:
    `empty` are their `empty_cells`, counted again where they are not given.
    """
    _check_coefficients(coefficients)
    empty = empty_cells(coefficients) if empty is None else empty
    return array_kernels(backend, "level_set").first_hits(coefficients, origins, directions, leaving, empty)


def nearest_approach(
    coefficients: Float[np.ndarray, "A B C"],
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    *,
    empty: Int[np.ndarray, "a b c"] | None = None,
    backend: ArrayBackend = "cpu",
) -> Float[np.ndarray, "P"]:
    """Distance along rays of unit direction to where φ is least; infinite for rays that pass the knots by. `empty` as
    for `first_hits`.
    """
    _check_coefficients(coefficients)
    empty = empty_cells(coefficients) if empty is None else empty
    return array_kernels(backend, "level_set").nearest_approach(coefficients, origins, directions, empty)


def empty_cells(coefficients: Float[np.ndarray, "A B C"]) -> Int[np.ndarray, "a b c"]:
    """How many cells around each cell, and itself, are free of the inside: a ray may pass so many less one.

    A spline lies within the range of its coefficients, so a cell whose 64 are all positive is empty.
    """
    from scipy.ndimage import distance_transform_cdt, minimum_filter1d

    least = coefficients
    for axis, count in enumerate(coefficients.shape):
        least = minimum_filter1d(least, 4, axis, origin=-2).take(range(count - 3), axis)
    if (least > 0).all():
        return np.full(least.shape, max(least.shape), dtype=np.int32)
    found: np.ndarray = distance_transform_cdt(least > 0, "chessboard").astype(np.int32)
    return found


def mirrored(
    derivatives: Float[np.ndarray, "P 10"],
    directions: Float[np.ndarray, "P 3"],
    distance: Float[np.ndarray, "P"],
    pixel_steps: Float[np.ndarray, "P 2 3"],
    samples: int,
    *,
    backend: ArrayBackend = "cpu",
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P K 3"], Float[np.ndarray, "P"]]:
    """Unit normals n = ∇φ/‖∇φ‖; r = d − 2 (d·n) n at K = 1 or 4 places over each pixel; how far r turns in a pixel.

    `pixel_steps` are the changes of the unit direction d by a pixel to the right and down. With them the hit moves by
    t δd + b d, b = −t (δd·n)/(d·n), along the surface, and the normal by H/‖∇φ‖ times that, but for its own direction.
    The K directions are r and its linear change, so they are unit to first order. Raises ValueError for another K.
    """
    if samples not in SUB_PIXELS:
        raise ValueError(f"expected {' or '.join(map(str, SUB_PIXELS))} samples of a pixel; found {samples}.")
    return array_kernels(backend, "level_set_light").mirrored(derivatives, directions, distance, pixel_steps, samples)


def seen_with_slopes(
    padded: Float[np.ndarray, "6 M M 3"], directions: Float[np.ndarray, "P K 3"], *, backend: ArrayBackend = "cpu"
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3 3"], Int[np.ndarray, "P"]]:
    """Mean of a cubemap over K directions, its derivative (channel, axis) by a change that all of them share, and the
    flat index (face, row, column) of the texel that their mean falls into.

    `padded` holds the faces with a ring of texels of their neighbors, as `padded_texels` makes it.
    """
    return array_kernels(backend, "level_set_light").seen_with_slopes(padded, directions)


def mirror_rows(
    derivatives: Float[np.ndarray, "P 10"],
    directions: Float[np.ndarray, "P 3"],
    slopes: Float[np.ndarray, "P 3 3"],
    *,
    backend: ArrayBackend = "cpu",
) -> Float[np.ndarray, "P 3 4"]:
    """Rows (s, u) with δE = s δφ + u·∇δφ: what three channels of the mirrored light change by with φ at the hit.

    With a a channel's slope by r, n = ∇φ/‖∇φ‖ and P = 1 − n nᵀ: u = −2 P [(a·n) d + (d·n) a]/‖∇φ‖, and because the hit
    slides along its ray by −δφ/(∇φ·d), s = −u·(H d)/(∇φ·d).
    """
    return array_kernels(backend, "level_set_light").mirror_rows(derivatives, directions, slopes)


def apply_rows(
    coefficients: Float[np.ndarray, "A B C"],
    places: Float[np.ndarray, "P 3"],
    rows: Float[np.ndarray, "P K 4"],
    weights: Float[np.ndarray, "P"],
    *,
    backend: ArrayBackend = "cpu",
) -> Float[np.ndarray, "P K"]:
    """J c: K residuals for each place, row·(φ, ∇φ) of the spline of c there; zero where the weight is not positive."""
    return array_kernels(backend, "level_set_products").apply_rows(coefficients, places, rows, weights)


def add_rows(
    residuals: Float[np.ndarray, "P K"],
    places: Float[np.ndarray, "P 3"],
    rows: Float[np.ndarray, "P K 4"],
    weights: Float[np.ndarray, "P"],
    shape: tuple[int, int, int],
    *,
    backend: ArrayBackend = "cpu",
) -> Float[np.ndarray, "A B C"]:
    """Jᵀ W e, the adjoint of `apply_rows` after weighing: ⟨J c, W e⟩ = ⟨c, Jᵀ W e⟩. Not positive weights are none."""
    return array_kernels(backend, "level_set_products").add_rows(residuals, places, rows, weights, shape)


def add_squares(
    places: Float[np.ndarray, "P 3"],
    rows: Float[np.ndarray, "P K 4"],
    weights: Float[np.ndarray, "P"],
    shape: tuple[int, int, int],
    *,
    backend: ArrayBackend = "cpu",
) -> Float[np.ndarray, "A B C"]:
    """The diagonal of Jᵀ W J."""
    return array_kernels(backend, "level_set_products").add_squares(places, rows, weights, shape)


def without_means(
    values: Float[np.ndarray, "P K"],
    weights: Float[np.ndarray, "P"],
    groups: Int[np.ndarray, "P"],
    total: Float[np.ndarray, "G"],
    *,
    backend: ArrayBackend = "cpu",
) -> Float[np.ndarray, "P K"]:
    """(1 − Π) e: values without what their group has in common, Π e = Σ w e/`total`, the sum being over the group."""
    return array_kernels(backend, "level_set_products").without_means(values, weights, groups, total)


def third_differences(
    coefficients: Float[np.ndarray, "A B C"],
    active: Bool[np.ndarray, "A B C"],
    *,
    whole: Int[np.ndarray, "A B C"] | None = None,
    backend: ArrayBackend = "cpu",
) -> Float[np.ndarray, "A B C"]:
    """DᵀD c with ‖D c‖² = Σ |D³c|² over all third differences whose coefficients are all active.

    There are ten kinds, of which a mixed one counts as often as it is in |D³c|². `whole` are the `whole_differences` of
    what is active, found again where they are not given.
    """
    _check_coefficients(coefficients)
    whole = whole_differences(active) if whole is None else whole
    return array_kernels(backend, "level_set_products").third_differences(coefficients, active, whole)


def whole_differences(active: Bool[np.ndarray, "A B C"]) -> Int[np.ndarray, "A B C"]:
    """Which third differences at each coefficient have active ones only, a bit for each kind, in the order of
    `DIFFERENCE_ORDERS`.
    """
    found, padded = np.zeros(active.shape, dtype=np.int16), np.pad(active, ((1, 2),) * 3)
    for bit, orders in enumerate(DIFFERENCE_ORDERS):
        taken = padded
        for axis, (order, count) in enumerate(zip(orders, active.shape, strict=True)):
            line = np.moveaxis(taken, axis, 0)
            shifted = [line[1 + tap : 1 + tap + count] for tap in DIFFERENCE_TAPS[order]]
            taken = np.moveaxis(reduce(np.logical_and, shifted), 0, axis)
        found |= taken.astype(np.int16) << bit
    return found


def _check_coefficients(coefficients: np.ndarray) -> None:
    if coefficients.ndim != 3 or min(coefficients.shape) < 4:
        raise ValueError(f"expected four coefficients or more along each of three axes; found {coefficients.shape}.")
