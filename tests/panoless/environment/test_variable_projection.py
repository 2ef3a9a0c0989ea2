"""What a map that follows leaves of rays: against least squares over texels and unknowns together."""

from dataclasses import dataclass

import numpy as np
import pytest
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix

from panoless.environment.variable_projection import VariableProjection
from shinypartial.core.sphere import cube_directions, cube_to_directions


@dataclass(frozen=True)
class Problem:
    """Rays of few texels, and unknowns on which they depend."""

    projection: VariableProjection
    rows: Float[np.ndarray, "P C D"]
    residual: Float[np.ndarray, "P C"]

    @classmethod
    def random(cls, rays: int = 60, texels: int = 7, unknowns: int = 4) -> "Problem":
        generator = np.random.default_rng(5)
        of, weights = np.eye(texels)[generator.integers(0, texels, rays)], generator.uniform(0.1, 1, rays)
        projection = VariableProjection(weights, csr_matrix(of / np.sqrt(weights @ of)))
        return cls(projection, generator.normal(size=(rays, 3, unknowns)), generator.normal(size=(rays, 3)))

    def together(self) -> tuple[Float[np.ndarray, "D"], float]:
        """The unknowns and the cost at them of min ½ Σ w ‖J x + e + m‖² over x and the texels' changes m."""
        texels, unknowns = self.projection.basis.toarray(), self.rows.shape[2]
        root = np.sqrt(self.projection.weights)[:, None]
        zero = np.zeros_like(texels)
        columns, right = [], []
        for channel in range(3):
            own = [texels if other == channel else zero for other in range(3)]
            columns.append(root * np.concatenate([self.rows[:, channel], *own], 1))
            right.append(-root[:, 0] * self.residual[:, channel])
        matrix, wanted = np.concatenate(columns), np.concatenate(right)
        found = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
        return found[:unknowns], float(((matrix @ found - wanted) ** 2).sum() / 2)


@pytest.fixture
def problem() -> Problem:
    return Problem.random()


def test_a_step_is_that_of_texels_and_unknowns_together(problem: Problem) -> None:
    gradient, matrix = problem.projection.equations(problem.rows, problem.residual)
    step, cost = -np.linalg.solve(matrix, gradient), problem.together()[1]
    np.testing.assert_allclose(step, problem.together()[0], atol=1e-10)
    moved = problem.residual + problem.rows @ step
    assert problem.projection.cost(moved) == pytest.approx(cost)
    assert problem.projection.cost(problem.residual) > cost


def test_equations_are_the_derivatives_of_the_cost(problem: Problem) -> None:
    """The cost is quadratic, so differences are derivatives to rounding."""
    gradient, matrix = problem.projection.equations(problem.rows, problem.residual)
    direction, step = np.random.default_rng(6).normal(size=len(gradient)), 1e-3
    here, ahead, behind = (
        problem.projection.cost(problem.residual + sign * step * problem.rows @ direction) for sign in (0, 1, -1)
    )
    assert (ahead - behind) / (2 * step) == pytest.approx(gradient @ direction)
    assert (ahead - 2 * here + behind) / step**2 == pytest.approx(direction @ matrix @ direction, rel=1e-4)


def test_sparse_equations_are_those_of_full_rows(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each ray depends on three of ten unknowns; the texels come in parts."""
    monkeypatch.setattr("panoless.environment.variable_projection.CHANGES_AT_ONCE", 3)
    rays, unknowns = len(problem.residual), 10
    columns: Int[np.ndarray, "P 3"] = np.argsort(np.random.default_rng(7).random((rays, unknowns)), 1)[:, :3]
    full = np.zeros((rays, 3, unknowns))
    np.put_along_axis(full, np.broadcast_to(columns[:, None], (rays, 3, 3)), problem.rows[:, :, :3], 2)
    expected = problem.projection.equations(full, problem.residual)
    found = problem.projection.sparse_equations(problem.rows[:, :, :3], columns, unknowns, problem.residual)
    for each, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(each, other, atol=1e-10)


def test_what_all_rays_of_a_texel_ask_for_moves_nothing_else(problem: Problem) -> None:
    basis = problem.projection.basis
    representable = basis @ np.random.default_rng(8).normal(size=(basis.shape[1], 3))
    gradient, _ = problem.projection.equations(problem.rows, representable)
    np.testing.assert_allclose(gradient, 0, atol=1e-12)
    assert problem.projection.cost(representable) == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(problem.projection.beyond(representable), 0, atol=1e-12)


def test_rays_of_one_texel_are_together() -> None:
    """And texels that nobody sees are no unknowns."""
    directions = cube_directions(4).reshape(-1, 3)[[5, 17, 40]]
    projection = VariableProjection.of(np.repeat(directions, 2, 0), np.ones(6), 4)
    constants = projection.basis.toarray()[:, :3] > 0
    np.testing.assert_array_equal(constants, np.repeat(np.eye(3, dtype=bool), 2, 0))


def test_a_map_follows_what_varies_evenly_across_a_block_of_texels() -> None:
    """Rays of blocks of 2 × 2 texels see a slope of their own in each: next to nothing is left of it."""
    side, generator = 8, np.random.default_rng(9)
    face, st = np.zeros(4000, np.int64), generator.uniform(-1, 1, (4000, 2))
    projection = VariableProjection.of(cube_to_directions(face, st), generator.uniform(0.5, 1, 4000), side)
    blocks = np.floor((st + 1) * side / 4).astype(np.int64) @ [4, 1]
    slopes = (generator.normal(size=(16, 2))[blocks] * st).sum(1, keepdims=True)
    assert np.abs(projection.beyond(slopes)).max() < 0.02 * np.abs(slopes - slopes.mean()).max()
    bent = st[:, :1] ** 2 * side**2
    assert np.abs(projection.beyond(bent)).max() > 0.1
