"""Whether a scene needs a block of unknowns: the one decision on what stays free.

A block of n unknowns xᵢ with the posterior standard deviations σᵢ, in units of the noise that residuals show, is needed
where

1/n Σ (xᵢ/σᵢ)² > (1 − 2/9n + z √(2/9n))³, z = 2.78:

which one in 370 blocks exceeds that are zero in truth (the quantile of χ²ₙ/n by Wilson and Hilferty 1931).

Model errors set a floor to σᵢ. Where the covariance C of a block is known, with the surface, the map and the other
blocks that follow it, the sum is xᵀ C⁻¹ x (Wald's statistic): exposures that drift with the camera's place are what a
map takes over, and mean nothing. Of a level set the σᵢ are those of each view: a turn and a shift that cancel each
other are known well, and the first to bend for a surface that is still too coarse. Held-out views do not decide: a
pose that makes up for such a surface explains views that took no part better, too.

A lens explains nothing for which no lens is made: focal length and distortion are not needed beyond five standard
deviations of their priors. Masks that are wrong alike in all views are explained best by k₁ = 17.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from panoless.problem.blocks import Block
from panoless.problem.nuisance import Nuisance

DEVIATIONS = 2.78
"""z: standard deviations of a normal number that are exceeded as seldom."""


@dataclass(frozen=True)
class Decision:
    """What became of a block, and by how much; numbers are root mean squares, of poses those of turns."""

    name: str
    kept: bool
    score: float
    """1/n Σ (xᵢ/σᵢ)²."""
    bound: float
    """(1 − 2/9n + z √(2/9n))³."""
    value: float
    sigma: float
    """Standard deviation of a number of the block, model errors included."""
    unit: str


def decided(
    block: Block,
    variances: Float[np.ndarray, "B M"],
    covariance: Float[np.ndarray, "N N"] | None = None,
    *,
    required: bool = False,
) -> Decision:
    """Whether a block is needed and its prior allows it; one that is `required` is kept."""
    found = scored(block, variances, covariance)
    is_possible = block.from_prior <= block.most_deviations**2 * block.values.size
    return replace(found, kept=required or (is_possible and found.score > found.bound))


def needed(
    nuisance: Nuisance,
    variances: Mapping[str, Float[np.ndarray, "B M"]],
    covariances: Mapping[str, Float[np.ndarray, "N N"]],
    required: Collection[str],
) -> tuple[Nuisance, list[Decision]]:
    """Without those of the free blocks that the scene does not need, and what was decided of each."""
    free = [each for each in nuisance.blocks if each.name in nuisance.free]
    decisions = [
        decided(each, variances[each.name], covariances.get(each.name), required=each.name in required) for each in free
    ]
    return nuisance.without([each.name for each in decisions if not each.kept]), decisions


def scored(
    block: Block, variances: Float[np.ndarray, "B M"], covariance: Float[np.ndarray, "N N"] | None = None
) -> Decision:
    """The score of a block that is kept, by the posterior variances of its unknowns or by their covariance, to both of
    which what model errors amount to is added.
    """
    value, variances = block.values.ravel(), block.with_model_errors(variances)
    if covariance is None:
        score = float((value**2 / variances.ravel()).mean())
    else:
        floor = np.diag(np.tile(block.floor**2, len(block.values)))
        score = float(value @ np.linalg.solve(covariance + floor, value)) / value.size
    share = 2 / (9 * value.size)
    bound = (1 - share + DEVIATIONS * math.sqrt(share)) ** 3
    sigma = block.scale * math.sqrt(float(variances[:, block.measured].mean()))
    return Decision(block.name, True, score, bound, block.rms, sigma, block.unit)
