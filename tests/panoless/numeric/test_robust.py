"""Robust weights are derivatives of bounded errors, alike in numpy and torch."""

import numpy as np
import pytest
import torch

from panoless.numeric.robust import bounded_error, robust_scale, robust_weight

ERRORS = np.random.default_rng(0).normal(size=(50, 3))


def test_known_values() -> None:
    """Both at |e| = 0, s and 3 s."""
    error = np.array([0.0, -2.0, 6.0])
    np.testing.assert_allclose(robust_weight(error, 2.0), [1, 1 / 4, 1 / 100])
    np.testing.assert_allclose(bounded_error(error, 2.0), [0, 1 / 2, 9 / 10])


def test_weight_times_error_is_the_gradient_of_the_bounded_error() -> None:
    scale = 0.7
    error = torch.from_numpy(ERRORS).requires_grad_()
    (scale**2 / 2 * bounded_error(error, scale).sum()).backward()
    weighted = robust_weight(ERRORS, scale)[:, None] * ERRORS
    np.testing.assert_allclose(error.grad.numpy(), weighted, atol=1e-12)


@pytest.mark.parametrize("function", [robust_weight, bounded_error])
def test_vectors_count_by_their_length_in_numpy_and_torch(function) -> None:
    length = np.linalg.norm(ERRORS, axis=1)
    scales = np.linspace(0.1, 2, 50)
    for scale in (0.3, scales):
        np.testing.assert_allclose(function(ERRORS, scale), function(length, scale))
        as_torch = scale if isinstance(scale, float) else torch.from_numpy(scale)
        np.testing.assert_allclose(function(torch.from_numpy(ERRORS), as_torch).numpy(), function(ERRORS, scale))


def test_the_scale_grows_with_the_typical_error_only() -> None:
    assert robust_scale(np.array([0.1, -0.2, 100.0]), 1.0, 3.0) == 1.0
    assert robust_scale(np.array([4.0, -5.0, 100.0]), 1.0, 3.0) == 15.0
    assert robust_scale(np.zeros(0), 1.0, 3.0) == 1.0
