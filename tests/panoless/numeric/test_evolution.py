"""Minimization without derivatives on functions with known minima."""

import numpy as np
import pytest

from panoless.numeric.evolution import evolve


def valley(values: np.ndarray) -> float:
    """Least at (1, …, 1); its axes are turned, and its curvatures differ by a factor of a hundred."""
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(len(values), len(values))))
    return float((np.geomspace(1, 100, len(values)) * (turn @ (values - 1)) ** 2).sum())


def test_a_turned_narrow_valley_is_followed_to_its_bottom() -> None:
    found, least = evolve(valley, np.zeros(5), np.full(5, 0.3), 1500)
    assert least < 1e-6
    np.testing.assert_allclose(found, 1, atol=1e-3)


def test_a_jagged_cost_is_no_obstacle() -> None:
    found, _ = evolve(lambda x: np.floor(50 * valley(x)) / 50, np.zeros(3), np.full(3, 0.3), 600)
    np.testing.assert_allclose(found, 1, atol=0.2)


def test_the_result_is_never_worse_than_the_start_and_the_same_each_time() -> None:
    start = np.ones(4)
    found, least = evolve(valley, start, np.full(4, 2.0), 30)
    np.testing.assert_array_equal(found, start)
    assert least == 0
    once, again = (evolve(valley, np.zeros(4), np.full(4, 0.5), 100, seed=3)[0] for _ in range(2))
    np.testing.assert_array_equal(once, again)


def test_points_do_not_depend_on_the_axes_that_a_machine_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Axes of a covariance have any sign, and at first, where it is the identity, any direction."""
    once, _ = evolve(valley, np.zeros(4), np.full(4, 0.5), 100)
    eigh = np.linalg.eigh

    def turned(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        variances, axes = eigh(matrix)
        other, _ = np.linalg.qr(np.random.default_rng(1).normal(size=axes.shape))
        return variances, other if np.allclose(matrix, np.eye(len(matrix))) else -axes

    monkeypatch.setattr(np.linalg, "eigh", turned)
    np.testing.assert_allclose(evolve(valley, np.zeros(4), np.full(4, 0.5), 100)[0], once, atol=1e-9)
