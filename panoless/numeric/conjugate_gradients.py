"""Preconditioned conjugate gradients for any symmetric product."""

from collections.abc import Callable

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
    energy = (residual * scaled).sum()
    for _ in range(steps):
        ahead = product(direction)
        step = energy / (direction * ahead).sum().clamp(min=1e-12)
        result += step * direction
        residual -= step * ahead
        scaled = precondition * residual
        new_energy = (residual * scaled).sum()
        direction = scaled + (new_energy / energy.clamp(min=1e-12)) * direction
        energy = new_energy
    return result
