"""Robust least squares by damped Gauss–Newton steps, what accepts a step, and what accepts a finer model."""

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from jaxtyping import Float, Int

from panoless.numeric.factorize import LEAST_DAMPING, require_finite

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

State = TypeVar("State")
LEAST_GAIN = 0.02
"""Share of its held-out cost by which a finer model has to be better. Chosen on the development scenes."""


def jacobian_of_rows(
    values: Float[np.ndarray, "P K"], columns: Int[np.ndarray, "P K"], parameters: int
) -> "csr_matrix":
    """The sparse (P, parameters) matrix whose row p holds `values[p]` in `columns[p]`, equal columns added."""
    from scipy.sparse import csr_matrix

    starts = np.arange(len(values) + 1) * values.shape[1]
    return csr_matrix((values.ravel(), columns.ravel(), starts), shape=(len(values), parameters))


def normal_equations(
    jacobian: "csr_matrix", residual: Float[np.ndarray, "P"], weights: Float[np.ndarray, "P"]
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """The gradient g = Jᵀ W e and the matrix H = Jᵀ W J of ½ Σ w e²."""
    weighted = jacobian.multiply(weights[:, None]).tocsr()
    return weighted.T @ residual, (weighted.T @ jacobian).toarray()


def damped_step(
    gradient: Float[np.ndarray, "D"],
    matrix: Float[np.ndarray, "D D"],
    damping: float = LEAST_DAMPING,
    largest: float = np.inf,
    limited: slice = slice(None),
) -> Float[np.ndarray, "D"]:
    """−(H + d·tr(H)/D·I)⁻¹ g for a positive semidefinite H; zero where H is.

    `damping` d is a share of the mean diagonal, at least `LEAST_DAMPING`. The whole step is shortened until none of
    the parameters `limited` moves by more than `largest`. Raises InputError for NaN and infinity.
    """
    mean_diagonal = float(np.trace(require_finite(matrix, "a step"))) / len(matrix)
    if mean_diagonal <= 0:
        return np.zeros_like(gradient)
    damped = matrix + max(damping, LEAST_DAMPING) * mean_diagonal * np.eye(len(matrix))
    step = -np.linalg.solve(damped, require_finite(gradient, "a step"))
    return step * min(1.0, largest / max(float(np.abs(step[limited]).max()), 1e-300))


def accept_step(
    state: State,
    step: Float[np.ndarray, "D"],
    apply: Callable[[State, Float[np.ndarray, "D"]], State],
    cost: Callable[[State], float],
    lengths: Sequence[float] = (1.0, 0.5, 0.25),
) -> State:
    """`apply(state, t·step)` for the first length t that lowers the cost, else the state as it is.

    So cost(result) ≤ cost(state), whatever the step. The cost must not change its own weights or scales from state to
    state: for steps of robust least squares it is the sum of `bounded_error` at the scale of the step's weights.
    """
    before = cost(state)
    for length in lengths:
        moved = apply(state, length * step)
        if cost(moved) < before:
            return moved
    return state


def keep_if_better(
    candidates: Iterable[State], held_out_cost: Callable[[State], float], least_gain: float = LEAST_GAIN
) -> State:
    """The last of the candidates, from simple to fine, up to which each lowers the held-out cost by `least_gain`.

    A candidate is kept if its cost is below (1 − least_gain) times that of the one before it. The first that is not
    ends the search, so candidates may be made one by one. At least one is needed, and of a single one there is no
    cost.
    """
    remaining = iter(candidates)
    kept, least = next(remaining), None
    for candidate in remaining:
        least = held_out_cost(kept) if least is None else least
        cost = held_out_cost(candidate)
        if not cost < (1 - least_gain) * least:
            break
        kept, least = candidate, cost
    return kept
