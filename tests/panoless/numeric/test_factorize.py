"""Regular matrices stay as they are; singular ones get a solution that stays near zero in what is open."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from panoless.numeric.factorize import LEAST_DAMPING, factorize, regularize
from panoless.numeric.gauss_newton import damped_step
from shinypartial.core.errors import InputError


def of_rank(rank: int, size: int, seed: int, decades: float = 0.0) -> np.ndarray:
    """JᵀJ of that rank, in units that differ by so many decades."""
    generator = np.random.default_rng(seed)
    rows = generator.normal(size=(rank, size))
    units = 10 ** generator.uniform(-decades / 2, decades / 2, size)
    return (rows * units).T @ (rows * units)


@given(st.integers(1, 8), st.integers(0, 100), st.floats(0, 12))
def test_a_regular_matrix_stays_to_the_bit_in_any_units(size: int, seed: int, decades: float) -> None:
    matrix = of_rank(3 * size, size, seed, decades)
    assert (regularize(matrix, "x") == matrix).all()


@given(st.integers(0, 7), st.integers(1, 8), st.integers(0, 100), st.floats(0, 12))
def test_any_matrix_has_a_factor_and_an_inverse(rank: int, size: int, seed: int, decades: float) -> None:
    matrix = of_rank(rank, size, seed, decades)
    regular = regularize(matrix, "x")
    lower = np.linalg.cholesky(regular)
    assert np.isfinite(np.linalg.inv(regular)).all()
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    assert (np.abs(lower @ lower.T - matrix) <= 1.01 * LEAST_DAMPING * np.outer(scale, scale) + (scale == 1e-150)).all()


def test_of_a_stack_only_the_singular_ones_change() -> None:
    stack = np.stack([of_rank(9, 3, 0), of_rank(2, 3, 1), np.zeros((3, 3))])
    found = regularize(stack, "x")
    assert (found[0] == stack[0]).all()
    assert (np.linalg.eigvalsh(found) > 0).all()
    assert regularize(stack[:0], "x").shape == (0, 3, 3)


@given(st.integers(1, 7), st.integers(0, 100))
def test_a_solution_of_what_is_told_is_found_beside_what_is_open(rank: int, seed: int) -> None:
    """H x = b with b in the range of H, whose rank is not full: what is determined is met, and the rest stays small."""
    matrix = of_rank(rank, 8, seed)
    right_side = matrix @ np.random.default_rng(seed + 1).normal(size=8)
    found = np.linalg.solve(regularize(matrix, "x"), right_side)
    # Damping of 1e-9 moves the solution by as much as the smallest eigenvalue that is not zero, 1e-3 here, allows.
    np.testing.assert_allclose(matrix @ found, right_side, atol=1e-4 * np.abs(right_side).max())
    assert np.linalg.norm(found) < 1e4 * np.linalg.norm(np.linalg.pinv(matrix, hermitian=True) @ right_side)


def test_a_matrix_that_rounding_made_indefinite_becomes_definite() -> None:
    matrix = np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]])
    assert np.linalg.eigvalsh(matrix)[0] < 0
    assert np.linalg.eigvalsh(regularize(matrix, "x"))[0] > 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused_by_name(bad: float) -> None:
    matrix = np.eye(3)
    matrix[0, 1] = bad
    with pytest.raises(InputError, match="finite equations for the poses"):
        regularize(matrix, "the poses")
    with pytest.raises(InputError, match="finite equations for the plate"):
        factorize(sparse.csr_matrix(matrix), "the plate")
    with pytest.raises(InputError, match="finite equations"):
        damped_step(np.ones(3), matrix)
    with pytest.raises(InputError, match="finite equations"):
        damped_step(np.array([1.0, bad, 0.0]), np.eye(3))


def chain(count: int, held: float) -> sparse.csr_matrix:
    """The Laplacian of a path, whose first node is held with that weight."""
    line = sparse.diags([np.ones(count - 1)], [1])
    laplacian = sparse.diags(np.asarray((line + line.T).sum(1)).ravel()) - line - line.T
    return (laplacian + sparse.diags(np.append(held, np.zeros(count - 1)))).tocsr()


def test_a_regular_sparse_matrix_is_solved_as_a_dense_one_is() -> None:
    matrix, right_side = chain(40, 1.0), np.random.default_rng(0).normal(size=40)
    found = factorize(matrix, "x")(right_side)
    np.testing.assert_allclose(found, np.linalg.solve(matrix.toarray(), right_side), rtol=1e-9)


@pytest.mark.parametrize("held", [0.0, 1e-300, 1e-18, 1e-14])
def test_a_path_that_nothing_holds_is_solved_and_stays_near_zero(held: float) -> None:
    """Its constant is open. Forces that sum to zero determine the rest."""
    matrix, forces = chain(40, held), np.random.default_rng(0).normal(size=40)
    forces -= forces.mean()
    found = factorize(matrix, "x")(forces)
    expected = np.linalg.pinv(matrix.toarray(), hermitian=True, rcond=1e-12) @ forces
    np.testing.assert_allclose(found - found.mean(), expected - expected.mean(), atol=1e-4)
    assert abs(found.mean()) < 1e2


@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_matrix_of_zeros_is_solved_by_zero(count: int) -> None:
    assert (factorize(sparse.csr_matrix((count, count)), "x")(np.zeros(count)) == 0).all()
