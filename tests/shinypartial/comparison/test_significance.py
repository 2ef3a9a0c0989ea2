"""P-values are shares of enumerated sign flips and are rarely small by chance; intervals cover as often as they say."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from shinypartial.comparison.significance import (
    MOST_ENUMERATED,
    Interval,
    Spread,
    mean_interval,
    sign_flip_test,
    summarize,
)

CONFIDENCE = 0.95
#: Draws that are symmetric about zero.
SYMMETRIC: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "normal": lambda random, count: random.normal(size=count),
    "heavy tails": lambda random, count: random.standard_t(2, size=count),
    "two values": lambda random, count: random.choice([-1.0, 1.0], size=count),
}
SAMPLES = st.integers(2, 7).flatmap(
    lambda count: arrays(np.float64, count, elements=st.integers(-1000, 1000).map(lambda x: x / 8))
)


def interval(values: np.ndarray) -> Interval:
    """The 95 % interval of two values or more."""
    found = mean_interval(values, CONFIDENCE)
    assert found is not None
    return found


@given(values=SAMPLES)
def test_the_p_value_is_the_share_of_flips_that_are_as_extreme(values: np.ndarray) -> None:
    """Against the definition; eighths sum exactly, so that ties are ties."""
    sums = [abs(sum(sign * value for sign, value in zip(signs, values, strict=True))) for signs in all_signs(values)]
    expected = np.mean([one >= abs(values.sum()) for one in sums])
    assert sign_flip_test(values) == pytest.approx(expected, abs=1e-12)


def all_signs(values: np.ndarray) -> list[tuple[int, ...]]:
    """The 2ⁿ ways to flip signs."""
    return list(itertools.product((-1, 1), repeat=len(values)))


@pytest.mark.parametrize("count", range(1, 11))
def test_differences_of_one_sign_have_the_smallest_p_value(count: int) -> None:
    """Of 2ⁿ flips only the given one and its opposite are as extreme."""
    values = np.arange(1.0, count + 1)
    assert sign_flip_test(values) == 2.0 ** (1 - count)
    assert sign_flip_test(-values) == 2.0 ** (1 - count)


@pytest.mark.parametrize("kind", SYMMETRIC)
@pytest.mark.parametrize("count", [6, pytest.param(8, marks=pytest.mark.slow)])
def test_small_p_values_are_as_rare_as_they_say(kind: str, count: int) -> None:
    """P(p ≤ α) ≤ α under symmetry, at each α; 500 trials spread by 1 % at α = 5 %."""
    random = np.random.default_rng(count)
    p_values = np.array([sign_flip_test(SYMMETRIC[kind](random, count)) for _ in range(500)])
    for level in (0.05, 0.1, 0.25):
        assert (p_values <= level).mean() <= level + 3 * np.sqrt(level * (1 - level) / 500)


def test_students_test_would_err_more_often_on_two_values() -> None:
    """The interval of 20 draws from {−1, 20} with mean zero misses zero far too often: the test above can fail."""
    random = np.random.default_rng(1)
    samples = random.choice([-1.0, 20.0], p=[20 / 21, 1 / 21], size=(500, 20))
    covered = [one.std() > 0 and interval(one).low <= 0 <= interval(one).high for one in samples]
    assert np.mean(covered) < 0.85


def test_many_differences_are_drawn_with_the_seed_and_nearly_exact() -> None:
    values = np.random.default_rng(4).normal(0.4, 1.0, MOST_ENUMERATED + 1)
    drawn, again, other = (sign_flip_test(values, seed) for seed in (3, 3, 4))
    assert drawn == again != other
    sums = np.abs(np.array(all_signs(values)) @ values)
    # 9,999 draws of a share of about a tenth spread by 0.003.
    assert drawn == pytest.approx(np.mean(sums >= abs(values.sum()) - 1e-12), abs=0.012)


@pytest.mark.parametrize("count", [2, 5, *(pytest.param(each, marks=pytest.mark.slow) for each in (3, 10))])
def test_the_interval_covers_a_normal_mean_as_often_as_it_says(count: int) -> None:
    """Exactly 95 %; 2,000 trials spread by 0.5 %."""
    samples = np.random.default_rng(count).normal(size=(2000, count))
    found = [interval(sample) for sample in samples]
    assert np.mean([one.low <= 0 <= one.high for one in found]) == pytest.approx(0.95, abs=0.015)


def test_the_percentile_bootstrap_would_not_pass() -> None:
    """It covers 76 % with three normal values: the test above can fail."""
    random = np.random.default_rng(3)
    draws = random.integers(3, size=(2000, 3))
    samples = random.normal(size=(600, 3))
    low, high = np.quantile(samples[:, draws].mean(-1), [0.025, 0.975], axis=1)
    assert np.mean((low <= 0) & (high >= 0)) < 0.82


@given(values=SAMPLES, shift=st.integers(-100, 100), exponent=st.integers(-8, 8))
def test_the_interval_follows_shift_scale_and_sign(values: np.ndarray, shift: int, exponent: int) -> None:
    found = interval(values)
    scale = 2.0**exponent
    moved, mirrored = interval((values + shift) * scale), interval(-values)
    size = 10 * np.abs(values).max() + abs(shift) + 1
    assert (moved.low, moved.high) == pytest.approx(
        ((found.low + shift) * scale, (found.high + shift) * scale), abs=1e-9 * size * scale
    )
    assert (-mirrored.high, -mirrored.low) == pytest.approx((found.low, found.high), abs=1e-9 * size)
    assert found.low <= values.mean() <= found.high


def test_few_and_equal_values() -> None:
    assert mean_interval(np.zeros(0), CONFIDENCE) is None
    assert mean_interval(np.ones(1), CONFIDENCE) is None
    assert sign_flip_test(np.zeros(0)) is None
    assert sign_flip_test(np.zeros(5)) == 1.0
    assert interval(np.full(6, -2.5)) == Interval(-2.5, -2.5)


def test_a_spread_holds_middle_extremes_and_deviation() -> None:
    assert summarize([5.0, 1.0, 3.0]) == Spread(3, 3.0, 1.0, 5.0, 3.0, 2.0)
    assert summarize([4.0]) == Spread(1, 4.0, 4.0, 4.0, 4.0, None)
