"""PSNR, L1 and SSIM: closed forms, and SSIM against scikit-image over the full frame."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from shinypartial.metrics.image import l1, psnr, ssim, weighted_mean
from shinypartial.metrics.registry import PSNR_CEILING_DB


@given(st.floats(1e-4, 1.0), st.sampled_from([1.0, 255.0]))
def test_psnr_of_a_constant_offset(offset: float, data_range: float) -> None:
    truth = np.full((12, 14, 3), 0.2) * data_range
    value = psnr(truth + offset * data_range, truth, data_range=data_range)
    assert value == pytest.approx(-20 * math.log10(offset), abs=1e-6)  # rounding of the sums: 1e-9 measured


def test_identical_images_reach_the_ceiling_and_nothing_exceeds_it() -> None:
    truth = np.random.default_rng(0).random((12, 12, 3))
    assert psnr(truth, truth, data_range=1.0) == PSNR_CEILING_DB
    assert psnr(truth + 1e-9, truth, data_range=1.0) == PSNR_CEILING_DB


def test_weights_choose_the_pixels_that_count() -> None:
    truth, weights = np.zeros((4, 6, 3)), np.zeros((4, 6))
    prediction = truth.copy()
    prediction[0], prediction[1:], weights[0] = 0.1, 5.0, 2.0
    assert psnr(prediction, truth, data_range=1.0, weights=weights) == pytest.approx(20.0)
    assert l1(prediction, truth, weights=weights) == pytest.approx(0.1)
    assert l1(prediction, truth) == pytest.approx((0.1 + 3 * 5.0) / 4)


def test_nothing_is_clipped_in_silence() -> None:
    truth = np.zeros((12, 12, 3))
    assert l1(truth + 3.0, truth) == 3.0


def test_shapes_and_weights_that_do_not_fit_are_refused() -> None:
    with pytest.raises((ValueError, TypeCheckError)):
        l1(np.zeros((3, 4, 3)), np.zeros((3, 4, 1)))
    with pytest.raises(ValueError, match="positive sum"):
        weighted_mean(np.ones((3, 3)), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="larger than 10"):
        ssim(np.zeros((10, 30, 3)), np.zeros((10, 30, 3)))


@pytest.mark.parametrize(
    ("top", "left", "height", "width"),
    [(30, 25, 12, 20), (0, 0, 3, 3), (57, 70, 7, 10), (20, 0, 1, 80), (0, 0, 64, 80)],
)
def test_ssim_equals_scikit_image_over_the_full_frame(top: int, left: int, height: int, width: int) -> None:
    from skimage.metrics import structural_similarity

    random = np.random.default_rng(1)
    truth = np.zeros((64, 80, 3), np.float32)
    truth[10:50, 10:60] = random.random((40, 50, 3))
    prediction = truth.copy()
    prediction[top : top + height, left : left + width] = random.random((height, width, 3))
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected = structural_similarity(
        truth.astype(float), prediction.astype(float), data_range=1.0, channel_axis=-1, **options
    )
    assert ssim(prediction, truth) == pytest.approx(expected, abs=1e-12)  # order of summation only


def test_ssim_of_equal_images_is_one_and_of_others_less() -> None:
    truth = np.random.default_rng(2).random((40, 40, 3))
    assert ssim(truth, truth) == 1.0
    assert ssim(1 - truth, truth) < 0.0
