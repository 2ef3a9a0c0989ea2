"""Preconditioned conjugate gradients for any symmetric product."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from torch import Tensor

CONJUGATE_GRADIENT_STEPS = 6


def conjugate_gradients(
    product: Callable[[Float[Tensor, "6 C L L"]], Float[Tensor, "6 C L L"]],
    start: Float[Tensor, "6 C L L"],
    residual: Float[Tensor, "6 C L L"],
    precondition: Float[Tensor, "6 _ L L"],
    steps: int = CONJUGATE_GRADIENT_STEPS,
) -> Float[Tensor, "6 C L L"]:
    """A few steps on A x = b with a symmetric positive definite A given by its product (Hestenes and Stiefel 1952).

    `residual` is b − A·start; `precondition` holds the inverse of a diagonal near to A's. The error eᵀ A e never grows,
    and vanishes after as many steps as there are unknowns.
    """
    result, residual = start.clone(), residual.clone()
    scaled = precondition * residual
    direction = scaled.clone()
    energy = _inner(residual, scaled)
    for _ in range(steps):
        ahead = product(direction)
        step = energy / _inner(direction, ahead).clamp(min=1e-12)
        result += step * direction
        residual -= step * ahead
        scaled = precondition * residual
        new_energy = _inner(residual, scaled)
        direction = scaled + (new_energy / energy.clamp(min=1e-12)) * direction
        energy = new_energy
    return result


def _inner(first: Float[Tensor, "*S L"], second: Float[Tensor, "*S L"]) -> Float[Tensor, ""]:
    """Σ a b, row by row: torch splits one sum of all among its threads, so that it would depend on their number."""
    return (first * second).sum(-1).sum()


def solve_by_products(
    product: Callable[[Float[np.ndarray, "*S"]], Float[np.ndarray, "*S"]],
    right_side: Float[np.ndarray, "*S"],
    precondition: Float[np.ndarray, "*S"],
    steps: int,
    tolerance: float,
) -> Float[np.ndarray, "*S"]:
    """x with A x ≈ b from zero on, for arrays of any shape; A has to be positive definite where `precondition` is not
    zero, and x is zero elsewhere.

    Ends after so many steps, or when rᵀ P r is `tolerance` times its first value, r = b − A x, P the preconditioner.
    """
    result, residual = np.zeros_like(right_side), right_side.copy()
    scaled = precondition * residual
    direction, energy = scaled.copy(), float((residual * scaled).sum())
    enough = tolerance * energy
    for _ in range(steps):
        if energy <= enough:
            break
        ahead = product(direction)
        curvature = float((direction * ahead).sum())
        if curvature <= 0:
            break
        result += energy / curvature * direction
        residual -= energy / curvature * ahead
        scaled = precondition * residual
        following = float((residual * scaled).sum())
        direction = scaled + following / energy * direction
        energy = following
    return result
