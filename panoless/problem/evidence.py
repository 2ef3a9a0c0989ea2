"""Whether a scene needs a block of unknowns: the one decision on what stays free.

A block of n unknowns xᵢ with the posterior standard deviations σᵢ, in units of the noise that residuals show, is needed
where

1/n Σ (xᵢ/σᵢ)² > 1 + 2 √(2/n):

two standard deviations beyond what a block has that is zero in truth. Held-out views do not decide: a pose that makes
up for a surface that is still too coarse explains views that took no part better, too. Nor do covariances: a turn and a
shift that cancel each other are known well, and the first to bend for such a surface.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from panoless.problem.nuisance import Block

DEVIATIONS = 2.0
"""Of the mean square beyond 1, from which a block is needed."""


@dataclass(frozen=True)
class Decision:
    """What became of a block, and by how much; numbers are root mean squares, of poses those of turns."""

    name: str
    kept: bool
    score: float
    """1/n Σ (xᵢ/σᵢ)²."""
    bound: float
    """1 + 2 √(2/n)."""
    value: float
    sigma: float
    """Standard deviation of a number of the block."""
    unit: str


def decided(block: Block, variances: Float[np.ndarray, "B M"], *, required: bool = False) -> Decision:
    """Whether a block is needed, by the posterior variances of its unknowns; one that is `required` is kept."""
    score = float((block.values**2 / variances).mean())
    bound = 1 + DEVIATIONS * math.sqrt(2 / block.values.size)
    sigma = block.scale * math.sqrt(float(variances[:, block.measured].mean()))
    return Decision(block.name, required or score > bound, score, bound, block.rms, sigma, block.unit)
