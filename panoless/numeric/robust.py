"""Robust statistics of residuals (Geman and McClure 1987), for numpy arrays and torch tensors alike."""

from typing import TypeVar

import numpy as np
from torch import Tensor

Residuals = TypeVar("Residuals", np.ndarray, Tensor)
"""(P,) numbers or (P, C) vectors, one residual a row."""
NORMAL_MEDIAN = 0.6745
"""The median of |x| of a normal x, in standard deviations."""


def robust_weight(error: Residuals, scale: float | Residuals) -> Residuals:
    """Geman–McClure weight w = (1 + ‖e‖²/s²)⁻² of each residual; (P,), in (0, 1].

    `error` is (P,) or (P, C); `scale` s has its unit and is one number or (P,). w e is the gradient of s²ρ/2 with ρ the
    bounded error: least squares, weighted again in each step, minimize Σ ρ.
    """
    return 1 / (1 + _squared(error) / scale**2) ** 2


def bounded_error(error: Residuals, scale: float | Residuals) -> Residuals:
    """ρ = ‖e‖²/(‖e‖² + s²) of each residual: 0 where it is none, 1 for an outlier. Arguments as for the weight."""
    squared = _squared(error)
    return squared / (squared + scale**2)


def robust_scale(error: np.ndarray, scale: float, multiple: float) -> float:
    """The scale, or that multiple of the median |e| (P,) if it is larger: a systematic error leaves all views a say."""
    return max(scale, multiple * float(np.median(np.abs(error)))) if len(error) else scale


def _squared(error: Residuals) -> Residuals:
    squared: Residuals = error * error
    return squared if error.ndim == 1 else squared.sum(-1)
