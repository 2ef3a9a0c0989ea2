"""Confidence intervals of a mean from few values: the bootstrap-t."""

import functools
import itertools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

#: A resample whose standard deviation is less than this share of the sample's counts as having this share. Without it,
#: two nearly equal values among four make an interval of any width; see the coverage in docs/metrics.md.
SMALLEST_SPREAD = 0.2


@dataclass(frozen=True)
class Interval:
    """Both ends of a confidence interval."""

    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Resamples:
    """How often each value is drawn in each resample, as shares, and the probability of each resample."""

    shares: Float[np.ndarray, "R N"]
    probabilities: Float[np.ndarray, "R"]


def mean_interval(
    values: Float[np.ndarray, "N"], confidence: float, resamples: int = 10_000, seed: int = 0
) -> Interval | None:
    """Bootstrap-t interval (Efron and Tibshirani 1993, An introduction to the bootstrap, section 12.5) of the mean.

    With mean m and standard deviation s (n − 1) of the values, and m*, s* those of a resample,
    [m − q₊ s/√n, m − q₋ s/√n], where q₋ and q₊ cut off (1 − confidence)/2 of t* = √n (m* − m) / max(s*, s/5) on either
    side. All resamples are enumerated where these are at most `resamples`, which is so up to eight values; else that
    many are drawn with `seed`. Two values can't be resampled usefully: theirs is Student's interval. None for fewer.
    Values that are all equal give an interval without width.
    """
    count = len(values)
    if count < 2:
        return None
    mean, spread = float(values.mean()), float(values.std(ddof=1))
    if spread == 0:
        return Interval(mean, mean)
    error = spread / math.sqrt(count)
    if count == 2:  # Student's t with one degree of freedom is Cauchy's distribution.
        half = math.tan(0.5 * math.pi * confidence) * error
        return Interval(mean - half, mean + half)
    drawn = _resamples(count, resamples, seed)
    standard = (values - mean) / spread
    means = drawn.shares @ standard
    variances = (drawn.shares @ standard**2 - means**2) * count / (count - 1)
    pivots = math.sqrt(count) * means / np.sqrt(np.maximum(variances, SMALLEST_SPREAD**2))
    tail = (1 - confidence) / 2
    lower, upper = _cut_off(pivots, drawn.probabilities, tail), -_cut_off(-pivots, drawn.probabilities, tail)
    return Interval(mean - max(upper, 0.0) * error, mean - min(lower, 0.0) * error)


def _cut_off(values: Float[np.ndarray, "R"], probabilities: Float[np.ndarray, "R"], tail: float) -> float:
    """The smallest value that at least a probability of `tail` doesn't exceed."""
    order = np.argsort(values)
    below = np.cumsum(probabilities[order])
    return float(values[order[np.searchsorted(below, tail * (1 - 1e-9))]])


@functools.lru_cache(maxsize=8)
def _resamples(count: int, number: int, seed: int) -> Resamples:
    """All of them, each multiset once with its multinomial probability, or `number` equally likely draws."""
    if math.comb(2 * count - 1, count) > number:
        draws = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=number)
        return Resamples(draws / count, np.full(number, 1 / number))
    indices = np.array(list(itertools.combinations_with_replacement(range(count), count)))
    times = (indices[:, :, None] == np.arange(count)).sum(1)
    factorials = np.array([math.factorial(i) for i in range(count + 1)], dtype=np.float64)
    return Resamples(times / count, factorials[count] / factorials[times].prod(1) / float(count) ** count)
