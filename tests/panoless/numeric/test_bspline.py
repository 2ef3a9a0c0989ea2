"""Uniform cubic B-splines against scipy's general ones."""

import numpy as np
from scipy.interpolate import BSpline

from panoless.numeric.bspline import cubic_bspline, cubic_bspline_basis, cubic_bsplines_at, with_halved_knots

COUNT = 9
PLACES = np.random.default_rng(0).uniform(0, COUNT - 3, 200)


def test_values_and_derivatives_are_those_of_scipy() -> None:
    coefficients = np.random.default_rng(1).normal(size=COUNT)
    spline = BSpline(np.arange(-3.0, COUNT + 1), coefficients, 3)
    first, basis = cubic_bsplines_at(PLACES, COUNT, derivatives=2)
    own = (basis * coefficients[first[:, None] + np.arange(4)]).sum(2)
    for order in range(3):
        np.testing.assert_allclose(own[order], spline(PLACES, nu=order), atol=1e-12)


def test_one_spline_about_its_peak_is_that_of_scipy() -> None:
    places = np.linspace(-3, 3, 61)
    expected = np.nan_to_num(BSpline.basis_element(np.arange(-2.0, 3), extrapolate=False)(places))
    np.testing.assert_allclose(cubic_bspline(places), expected, atol=1e-12)


def test_the_basis_is_a_partition_of_unity_and_reproduces_lines() -> None:
    first, (values, slopes, bends) = cubic_bsplines_at(PLACES, COUNT, derivatives=2)
    peaks = first[:, None] + np.arange(4) - 1.0
    np.testing.assert_allclose(values.sum(1), 1)
    np.testing.assert_allclose(slopes.sum(1), 0, atol=1e-12)
    np.testing.assert_allclose(bends.sum(1), 0, atol=1e-12)
    np.testing.assert_allclose((values * peaks).sum(1), PLACES, atol=1e-12)


def test_fewer_derivatives_are_the_first_of_more() -> None:
    t = np.linspace(0, 1, 7)
    for count in (0, 1):
        np.testing.assert_array_equal(cubic_bspline_basis(t, count), cubic_bspline_basis(t, 2)[: count + 1])


def test_the_last_knot_belongs_to_the_last_cell_and_counts_may_differ() -> None:
    first, basis = cubic_bsplines_at(np.array([6.0, 6.0, 1.0]), np.array([9, 12, 4]))
    assert first.tolist() == [5, 6, 0]
    np.testing.assert_allclose(basis[0], [[0, 1 / 6, 4 / 6, 1 / 6], [1 / 6, 4 / 6, 1 / 6, 0], [0, 1 / 6, 4 / 6, 1 / 6]])


def test_a_spline_with_halved_knots_is_the_same() -> None:
    coefficients = np.random.default_rng(2).normal(size=(COUNT, 2))
    finer = with_halved_knots(coefficients)
    assert finer.shape == (2 * COUNT - 3, 2)
    same = [BSpline(np.arange(-3.0, len(each) + 1), each, 3) for each in (coefficients, finer)]
    np.testing.assert_allclose(same[1](2 * PLACES), same[0](PLACES), atol=1e-12)
