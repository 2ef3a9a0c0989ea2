"""The interval of a mean covers the truth about as often as it says, from two values on; what it is equivariant to."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from shinypartial.comparison.intervals import Interval, _resamples, mean_interval

CONFIDENCE = 0.95
TRIALS = 600
#: Draws with mean zero.
DIFFERENCES: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "normal": lambda random, count: random.normal(size=count),
    "skewed": lambda random, count: random.exponential(size=count) - 1,
    "heavy tails": lambda random, count: random.standard_t(3, size=count),
}


def interval(values: np.ndarray, resamples: int = 10_000) -> Interval:
    """The 95 % interval of two values or more."""
    found = mean_interval(values, CONFIDENCE, resamples)
    assert found is not None
    return found


@pytest.mark.parametrize("count", [2, 3, 4, 5, 7, 10])
@pytest.mark.parametrize("kind", DIFFERENCES)
def test_the_interval_covers_the_truth_about_as_often_as_it_says(kind: str, count: int) -> None:
    """Over 4,000 trials the coverage lies between 90 % (two skewed values) and 98.7 %; 600 trials spread by 1.2 %."""
    random = np.random.default_rng(count)
    found = [interval(DIFFERENCES[kind](random, count), resamples=2000) for _ in range(TRIALS)]
    covered = np.mean([each.low <= 0 <= each.high for each in found])
    assert 0.88 < covered < 0.995
    if kind != "skewed":
        assert covered > 0.92


def test_the_percentile_bootstrap_would_not_pass() -> None:
    """It covers 76 % with three normal values: the test above can fail."""
    random = np.random.default_rng(3)
    draws = random.integers(3, size=(2000, 3))
    samples = random.normal(size=(TRIALS, 3))
    low, high = np.quantile(samples[:, draws].mean(-1), [0.025, 0.975], axis=1)
    assert np.mean((low <= 0) & (high >= 0)) < 0.82


def test_two_values_have_students_interval() -> None:
    values = np.array([1.0, 4.0])
    low, high = stats.t.interval(CONFIDENCE, 1, loc=2.5, scale=stats.sem(values))
    found = interval(values)
    assert (found.low, found.high) == pytest.approx((low, high), rel=1e-12)


def test_many_normal_values_have_nearly_students_interval() -> None:
    values = np.random.default_rng(2).normal(1.0, 2.0, 200)
    low, high = stats.t.interval(CONFIDENCE, 199, loc=values.mean(), scale=stats.sem(values))
    found = interval(values)
    # The ends are quantiles of 10,000 draws: they spread by 2 % of the width.
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.06 * (high - low))


@pytest.mark.parametrize("count", range(3, 9))
def test_every_resample_is_enumerated_with_its_probability(count: int) -> None:
    """Weighted with these, shares have mean 1/n and the covariance (δ − 1/n)/n² of multinomial draws."""
    drawn = _resamples(count, 10_000, 0)
    assert drawn.probabilities.sum() == pytest.approx(1)
    assert len(np.unique(drawn.shares, axis=0)) == len(drawn.shares)
    np.testing.assert_allclose(drawn.probabilities @ drawn.shares, 1 / count)
    centered = drawn.shares - 1 / count
    covariance = (drawn.probabilities[:, None] * centered).T @ centered
    np.testing.assert_allclose(covariance, (np.eye(count) - 1 / count) / count**2, atol=1e-12)


def test_a_draw_approaches_the_enumeration() -> None:
    values = np.array([0.1, 0.5, -0.3, 1.2, 0.4, 0.2, -0.6])
    exact, drawn = interval(values), interval(values, resamples=1700)  # 1,716 multisets.
    assert (drawn.low, drawn.high) == pytest.approx((exact.low, exact.high), abs=0.2)
    assert drawn != exact


SAMPLES = st.integers(2, 7).flatmap(
    lambda count: arrays(np.float64, count, elements=st.integers(-1000, 1000).map(lambda x: x / 8))
)


@given(values=SAMPLES, shift=st.integers(-100, 100), exponent=st.integers(-8, 8))
def test_the_interval_follows_shift_scale_and_sign(values: np.ndarray, shift: int, exponent: int) -> None:
    found = interval(values)
    scale = 2.0**exponent
    moved = interval((values + shift) * scale)
    size = scale * (np.abs(values).max() + abs(shift) + 1)
    # Ties between resamples may fall either way, but only among pivots equal to rounding.
    assert moved.low == pytest.approx((found.low + shift) * scale, abs=1e-7 * size)
    assert moved.high == pytest.approx((found.high + shift) * scale, abs=1e-7 * size)
    mirrored = interval(-values)
    assert (-mirrored.high, -mirrored.low) == pytest.approx((found.low, found.high), abs=1e-7 * size / scale)
    assert found.low <= values.mean() <= found.high


@given(values=SAMPLES)
def test_near_ties_make_no_wild_interval(values: np.ndarray) -> None:
    """As s* counts as s/5 at least, |t*| ≤ 5 √n |m* − m| / s ≤ 5 (n − 1).

    For no value is farther from the mean than (n − 1) s / √n, and so is no m*.
    """
    found, count = interval(values), len(values)
    half = 5 * (count - 1) * values.std(ddof=1) / np.sqrt(count) if count > 2 else np.inf
    assert max(values.mean() - found.low, found.high - values.mean()) <= half * (1 + 1e-9) + 1e-12


def test_fewer_than_two_values_have_no_interval() -> None:
    assert mean_interval(np.zeros(0), CONFIDENCE) is None
    assert mean_interval(np.ones(1), CONFIDENCE) is None


def test_equal_values_have_an_interval_without_width() -> None:
    assert interval(np.full(6, -2.5)) == Interval(-2.5, -2.5)
