"""What a few repetitions show: their spread, Student's interval of a mean, and the exact sign-flip test of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

#: Up to so many differences all sign flips are enumerated (16,384 of them); beyond, DRAWN_FLIPS are drawn.
MOST_ENUMERATED = 14
DRAWN_FLIPS = 9_999


@dataclass(frozen=True)
class Spread:
    """Values of one quantity over repetitions; `standard_deviation` (n − 1) is None for a single one."""

    number: int
    median: float
    low: float
    high: float
    mean: float
    standard_deviation: float | None


@dataclass(frozen=True)
class Interval:
    """Both ends of a confidence interval."""

    low: float
    high: float


def summarize(values: Sequence[float]) -> Spread:
    """The spread of at least one value."""
    deviation = float(np.std(values, ddof=1)) if len(values) > 1 else None
    extremes = float(min(values)), float(max(values))
    return Spread(len(values), float(np.median(values)), *extremes, float(np.mean(values)), deviation)


def mean_interval(values: Float[np.ndarray, "N"], confidence: float) -> Interval | None:
    """Student's t interval of the mean (Student, Biometrika 6, 1908); None for fewer than two values.

    It is exact for values that are normally distributed. Equal values have an interval without width.
    """
    from scipy import stats

    if len(values) < 2:
        return None
    mean, error = float(values.mean()), float(stats.sem(values))
    if error == 0:
        return Interval(mean, mean)
    low, high = stats.t.interval(confidence, len(values) - 1, loc=mean, scale=error)
    return Interval(float(low), float(high))


def sign_flip_test(differences: Float[np.ndarray, "P"], seed: int = 0) -> float | None:
    """Two-sided p-value that paired differences are symmetric about zero; None without any.

    Fisher's randomization test (The design of experiments, 1935, section 21): the share of all 2ⁿ ways to flip signs
    whose mean is at least as far from zero as the mean found. It assumes no distribution, and its smallest value is
    2¹⁻ⁿ. With more than MOST_ENUMERATED differences DRAWN_FLIPS ways are drawn with `seed`.
    """
    from scipy import stats

    if not len(differences):
        return None
    if len(differences) == 1:
        return 1.0
    flips = np.inf if len(differences) <= MOST_ENUMERATED else DRAWN_FLIPS
    result = stats.permutation_test(
        (differences,),
        np.mean,
        permutation_type="samples",
        vectorized=True,
        n_resamples=flips,
        rng=np.random.default_rng(seed),
    )
    return float(result.pvalue)
