"""Robust weights and errors (Geman and McClure 1987)."""

from jaxtyping import Float
from torch import Tensor


def robust_weight(error: Float[Tensor, "P 3"], scale: float) -> Float[Tensor, "P"]:
    """Geman–McClure weight (1 + ‖e‖²/s²)⁻²."""
    return (1 + error.square().sum(1) / scale**2) ** -2
