"""Rank statistics against scipy, weights as repetition, and the extremes of the sparsification area."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from shinypartial.metrics.calibration import auroc, calibration_scores, sparsification_area, spearman

RANDOM = np.random.default_rng(0)
#: Rounded, so that there are ties.
VISIBILITY = RANDOM.random(300).round(1)
ERROR = (0.3 * (1 - VISIBILITY) + 0.2 * RANDOM.random(300)).round(2)
ONES = np.ones(300)


def test_spearman_agrees_with_scipy_under_ties() -> None:
    from scipy.stats import spearmanr

    assert spearman(VISIBILITY, ERROR, ONES) == pytest.approx(spearmanr(VISIBILITY, ERROR).statistic, abs=1e-12)


def test_auroc_agrees_with_the_mann_whitney_statistic() -> None:
    from scipy.stats import mannwhitneyu

    wrong = ERROR > 0.2
    expected = mannwhitneyu(VISIBILITY[~wrong], VISIBILITY[wrong]).statistic / (wrong.sum() * (~wrong).sum())
    assert auroc(VISIBILITY, wrong, ONES) == pytest.approx(expected, abs=1e-12)


@given(st.lists(st.integers(1, 4), min_size=20, max_size=20))
def test_integer_weights_are_repetitions(counts: list[int]) -> None:
    visibility, error, weights = VISIBILITY[:20], ERROR[:20], np.array(counts, float)
    repeated = [np.repeat(values, counts) for values in (visibility, error)]
    once, many = calibration_scores(visibility, error, weights), calibration_scores(*repeated, np.ones(sum(counts)))
    for name, value in vars(once).items():
        assert getattr(many, name) == pytest.approx(value, abs=1e-9), name


def test_perfect_visibility_has_perfect_scores() -> None:
    error = np.linspace(0, 0.5, 300)
    scores = calibration_scores(1 - error, error, ONES)
    assert scores.visibility_error_spearman == pytest.approx(-1.0)
    assert scores.visibility_error_auroc == pytest.approx(1.0)
    assert scores.sparsification_area == pytest.approx(0.0, abs=1e-12)


def test_constant_visibility_tells_nothing() -> None:
    error = np.linspace(0, 0.5, 300)
    scores = calibration_scores(np.full(300, 0.3), error, ONES)
    assert scores.visibility_error_spearman is None
    assert scores.visibility_error_auroc == pytest.approx(0.5)
    # The curve stays at 1; that of the oracle is the mean of k/n over k: one half.
    assert scores.sparsification_area == pytest.approx(0.5, abs=5e-3)


def test_misleading_visibility_is_worse_than_none() -> None:
    error = np.linspace(0, 0.5, 300)
    wrong_way, constant = (sparsification_area(values, error, ONES) for values in (error, ONES))
    assert wrong_way is not None
    assert constant is not None
    assert wrong_way > constant


def test_no_error_leaves_every_statistic_undefined() -> None:
    scores = calibration_scores(VISIBILITY, np.zeros(300), ONES)
    assert set(vars(scores).values()) == {None}


def test_four_directions_by_hand() -> None:
    """Visibility 1, 2, 2, 4 of errors 0.4, 0.2, 0, 0: all pairs counted, all curves integrated on paper."""
    visibility, error, ones = np.array([1.0, 2.0, 2.0, 4.0]), np.array([0.4, 0.2, 0.0, 0.0]), np.ones(4)
    # Mid-ranks 1, 2.5, 2.5, 4 and 4, 3, 1.5, 1.5: covariance −3.75, variances 4.5 and 4.5.
    assert spearman(visibility, error, ones) == pytest.approx(-3.75 / 4.5)
    # Wrong: the first two. Pairs with the third and fourth: 1 + 1 + ½ + 1 of 4.
    assert auroc(visibility, error > 0.1, ones) == pytest.approx(3.5 / 4)
    # Kept weight t: error 0 to t = 1, then 0.1 (t − 1)/t to 3, then (0.2 + 0.4 (t − 3))/t to 4;
    # in perfect order 0 to 2, 0.2 (t − 2)/t to 3, (0.2 + 0.4 (t − 3))/t to 4. The last parts cancel.
    stated, perfect = 0.1 * (2 - np.log(3)), 0.2 * (1 - 2 * np.log(1.5))
    assert sparsification_area(visibility, error, ones) == pytest.approx((stated - perfect) / 0.6)


def test_other_shapes_are_refused() -> None:
    with pytest.raises((ValueError, TypeCheckError)):
        calibration_scores(VISIBILITY.reshape(10, 30)[0], ERROR[:30], ONES[:29])
