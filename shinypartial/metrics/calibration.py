"""Does low visibility announce error? Solid-angle weighted rank statistics of a visibility map against an error map."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

#: A direction counts as wrong when its absolute sRGB error exceeds this.
ERROR_THRESHOLD = 0.1

Samples = Float[np.ndarray, "P"]


@dataclass(frozen=True)
class CalibrationScores:
    """None: undefined, since the maps are constant or no direction (or every direction) is wrong."""

    visibility_error_spearman: float | None
    visibility_error_auroc: float | None
    sparsification_area: float | None


@dataclass(frozen=True)
class _Ties:
    """Groups of equal values in ascending order: the group of each sample and the total weight of each group."""

    group: Int[np.ndarray, "P"]
    weights: Float[np.ndarray, "G"]

    def total(self, values: Samples) -> Float[np.ndarray, "G"]:
        """Sum of the values of each group."""
        return np.bincount(self.group, values, len(self.weights))


def _ties(values: Samples, weights: Samples) -> _Ties:
    _, group = np.unique(values, return_inverse=True)
    return _Ties(group, np.bincount(group, weights))


def _mid_ranks(values: Samples, weights: Samples) -> Samples:
    """Weight below each value plus half the weight of its ties; with weights 1 the usual mid-rank less ½."""
    ties = _ties(values, weights)
    return (np.cumsum(ties.weights) - ties.weights / 2)[ties.group]


def spearman(a: Samples, b: Samples, weights: Samples) -> float | None:
    """Weighted correlation of mid-ranks, in [−1, 1]; None when either is constant."""
    rank_a, rank_b = _mid_ranks(a, weights), _mid_ranks(b, weights)
    centered_a = rank_a - np.average(rank_a, weights=weights)
    centered_b = rank_b - np.average(rank_b, weights=weights)
    variance_a, variance_b = (np.sum(weights * centered**2) for centered in (centered_a, centered_b))
    if min(variance_a, variance_b) <= 1e-12 * weights.sum() ** 3:
        return None
    return float(np.sum(weights * centered_a * centered_b) / np.sqrt(variance_a * variance_b))


def auroc(visibility: Samples, wrong: Bool[np.ndarray, "P"], weights: Samples) -> float | None:
    """Chance that a wrong direction has lower visibility than a right one, ties counting half; None without both."""
    ties = _ties(visibility, weights)
    weight_wrong, weight_right = ties.total(weights * wrong), ties.total(weights * ~wrong)
    total = weight_wrong.sum() * weight_right.sum()
    if total <= 0:
        return None
    wrong_below = np.cumsum(weight_wrong) - weight_wrong / 2
    return float((weight_right * wrong_below).sum() / total)


def sparsification_area(visibility: Samples, error: Samples, weights: Samples) -> float | None:
    """Area between two curves over the kept share of directions: mean error kept when the least visible are dropped
    first, and the same when the most wrong are dropped first, both relative to the mean error of all directions.

    0 is perfect; None when there is no error. Tied directions share their mean error (Ilg et al. 2018).
    """
    if not np.any(weights * error > 0):
        return None
    by_visibility, oracle = (_area_below(confidence, error, weights) for confidence in (visibility, -error))
    return (by_visibility - oracle) / float(np.sum(weights * error))


def _area_below(confidence: Samples, error: Samples, weights: Samples) -> float:
    """∫ of the mean error kept over the kept weight, the most confident first.

    Within a group of ties of mean error e, after weight W of summed error E, the curve is (E + e t)/(W + t); its
    integral over t from 0 to w is e w + (E − e W) ln(1 + w/W), so splitting a sample changes nothing.
    """
    ties = _ties(-confidence, weights)
    present = ties.weights > 0
    width, summed = ties.weights[present], ties.total(weights * error)[present]
    mean = summed / width
    before, error_before = np.cumsum(width) - width, np.cumsum(summed) - summed
    curved = (error_before[1:] - mean[1:] * before[1:]) * np.log1p(width[1:] / before[1:])
    return float(summed.sum() + curved.sum())


def calibration_scores(visibility: Samples, error: Samples, weights: Samples) -> CalibrationScores:
    """All three statistics of samples of equal shape; weights are solid angles."""
    if not visibility.shape == error.shape == weights.shape:
        raise ValueError(f"expected one shape, got {visibility.shape}, {error.shape} and {weights.shape}")
    error = error.astype(np.float64)
    return CalibrationScores(
        visibility_error_spearman=spearman(visibility, error, weights),
        visibility_error_auroc=auroc(visibility, error > ERROR_THRESHOLD, weights),
        sparsification_area=sparsification_area(visibility, error, weights),
    )
