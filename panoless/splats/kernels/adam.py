"""One step of Adam (Kingma and Ba 2015) on many tensors at once."""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.kernels.backend import Backend, choose_backend
from panoless.splats.kernels.reference.adam import adam_step_reference

UNBOUNDED = (-math.inf, math.inf)


@dataclass(frozen=True)
class AdamTensor:
    """A parameter with its gradient, its running moments, its rate and the number of steps including this one.

    After the step the parameter is clipped to `bounds`.
    """

    parameter: Float[Tensor, "*S"]
    gradient: Float[Tensor, "*S"]
    mean: Float[Tensor, "*S"]
    square: Float[Tensor, "*S"]
    rate: float
    steps: int
    bounds: tuple[float, float] = UNBOUNDED


@torch.no_grad()
def adam_step(
    tensors: list[AdamTensor], betas: tuple[float, float], epsilon: float, *, backend: Backend = "auto"
) -> None:
    """Move every parameter, in place, by −rate · m̂/(√v̂ + ε).

    m ← β₁ m + (1 − β₁) g and v ← β₂ v + (1 − β₂) g², also in place; m̂ = m/(1 − β₁ᵗ), v̂ = v/(1 − β₂ᵗ) after t steps.
    As `torch.optim.Adam` without weight decay. Raises ValueError for mixed dtypes or devices.
    """
    if not tensors:
        return
    given = [tensor for each in tensors for tensor in (each.parameter, each.gradient, each.mean, each.square)]
    if choose_backend(backend, **_named(given)) == "cpu" and all(tensor.is_contiguous() for tensor in given):
        from panoless.splats.kernels.cpu.adam import adam_step_cpu

        adam_step_cpu(tensors, betas, epsilon)
        return
    for each in tensors:
        adam_step_reference(each, betas, epsilon)


@lru_cache(maxsize=8)
def _names(count: int) -> tuple[str, ...]:
    return tuple(f"{field} {index // 4}" for index in range(0, count, 4) for field in _TENSORS)


def _named(tensors: list[Tensor]) -> dict[str, Tensor]:
    return dict(zip(_names(len(tensors)), tensors, strict=True))


_TENSORS = ("parameter", "gradient", "mean", "square")
