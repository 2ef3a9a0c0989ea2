"""Steps solve damped normal equations and never raise a cost; finer models have to earn their place."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from panoless.numeric.gauss_newton import (
    accept_step,
    damped_step,
    jacobian_of_rows,
    keep_if_better,
    normal_equations,
)
from panoless.numeric.robust import bounded_error, robust_weight

ROWS = np.random.default_rng(0).normal(size=(20, 3))


def test_normal_equations_are_those_of_the_dense_matrix() -> None:
    generator = np.random.default_rng(1)
    columns = np.stack([generator.permutation(6)[:3] for _ in ROWS])
    dense = np.zeros((20, 6))
    np.put_along_axis(dense, columns, ROWS, 1)
    residual, weights = generator.normal(size=20), generator.uniform(size=20)
    gradient, matrix = normal_equations(jacobian_of_rows(ROWS, columns, 6), residual, weights)
    np.testing.assert_allclose(gradient, dense.T @ (weights * residual), atol=1e-12)
    np.testing.assert_allclose(matrix, dense.T @ (weights[:, None] * dense), atol=1e-12)


def test_an_undamped_step_ends_at_the_minimum_and_damping_shortens_it() -> None:
    matrix, minimum = ROWS.T @ ROWS, np.array([1.0, -2.0, 0.5])
    gradient = -matrix @ minimum
    np.testing.assert_allclose(damped_step(gradient, matrix, 0.0), minimum, atol=1e-12)
    lengths = [np.linalg.norm(damped_step(gradient, matrix, damping)) for damping in (0.0, 0.1, 1.0, 10.0)]
    assert lengths == sorted(lengths, reverse=True)
    np.testing.assert_allclose(damped_step(gradient, matrix, 1e9), -gradient / (1e9 * np.trace(matrix) / 3), rtol=1e-6)


def test_damping_knows_no_units() -> None:
    """A cost in other units has the same step."""
    gradient, matrix = ROWS[0], ROWS.T @ ROWS
    np.testing.assert_allclose(damped_step(1e6 * gradient, 1e6 * matrix, 0.3), damped_step(gradient, matrix, 0.3))


def test_what_nothing_tells_stays() -> None:
    assert damped_step(np.zeros(3), np.zeros((3, 3)), 1e-9).tolist() == [0, 0, 0]
    assert damped_step(np.array([1.0, 0.0]), np.diag([1.0, 0.0]), 1e-9)[1] == 0


def test_a_limit_shortens_the_whole_step() -> None:
    gradient, matrix = np.array([4.0, 1.0, -8.0]), np.eye(3)
    np.testing.assert_allclose(damped_step(gradient, matrix, 0.0, largest=2.0), [-1, -0.25, 2])
    np.testing.assert_allclose(damped_step(gradient, matrix, 0.0, largest=2.0, limited=slice(2)), [-2, -0.5, 4])


@given(st.floats(-3, 3), st.floats(0.01, 1))
def test_no_accepted_step_raises_the_cost(start: float, scale: float) -> None:
    """Robust location of three points, two of them outliers: plain steps overshoot, accepted ones never do."""
    points = np.array([0.0, 0.1, 5.0])

    def cost(place: float) -> float:
        return float(bounded_error(place - points, scale).sum())

    for _ in range(8):
        weights = robust_weight(start - points, scale)
        step = damped_step(np.array([weights @ (start - points)]), np.array([[weights.sum()]]), 0.0)
        moved = accept_step(start, 3 * step, lambda place, by: place + float(by[0]), cost)
        assert cost(moved) <= cost(start)
        start = moved


def test_the_first_length_that_helps_is_taken() -> None:
    """From 1 toward 0 by a step of −3: at full length the cost 4, at half 0.25."""
    moved = accept_step(1.0, np.array([-3.0]), lambda x, by: x + float(by[0]), lambda x: x * x)
    assert moved == pytest.approx(-0.5)
    assert accept_step(1.0, np.array([-3.0]), lambda x, by: x + float(by[0]), lambda x: x * x, lengths=(1.0,)) == 1.0


def test_finer_models_are_kept_up_to_the_first_that_does_not_pay() -> None:
    costs, evaluated = {"coarse": 1.0, "fine": 0.9, "finer": 0.89, "finest": 0.1}, []

    def cost(name: str) -> float:
        evaluated.append(name)
        return costs[name]

    assert keep_if_better(iter(costs), cost, 0.02) == "fine"
    assert evaluated == ["coarse", "fine", "finer"]
    assert keep_if_better(costs, cost, 0.0) == "finest"
    assert keep_if_better(["coarse"], cost) == "coarse"
    assert keep_if_better(["coarse", "fine"], lambda _: np.nan) == "coarse"
