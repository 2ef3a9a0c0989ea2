"""Environment scores: closed forms, and blindness to where the map is cut."""

import math

import numpy as np
import pytest

from shinypartial.core.sphere import latlong_directions
from shinypartial.metrics.coverage import cells_of_view, cells_to_latlong, coverage, nothing_observed
from shinypartial.metrics.environment import (
    PROTOCOL_HEIGHT,
    RegionMasks,
    best_exposure_stops,
    direction_weights,
    inverse_distance_error,
    region_scores,
    to_protocol_size,
    unweighted_scores,
)

EVERYWHERE = RegionMasks(None, None)


def cosine_map(height: int) -> np.ndarray:
    """Radiance 0.5 + 0.4 cos(azimuth), gray."""
    azimuth = (0.5 - (np.arange(2 * height) + 0.5) / (2 * height)) * 2 * np.pi
    return np.broadcast_to((0.5 + 0.4 * np.cos(azimuth))[None, :, None], (height, 2 * height, 3)).copy()


@pytest.mark.parametrize("texels", [1, 17, 128, 256])
def test_a_rotated_map_has_the_analytic_loss(texels: int) -> None:
    """0.4 (cos φ − cos(φ − δ)) is a sine of amplitude 0.8 sin(δ/2): its mean square and mean absolute are known."""
    truth = cosine_map(PROTOCOL_HEIGHT)
    delta = 2 * math.pi * texels / truth.shape[1]
    scores = region_scores(np.roll(truth, texels, 1), truth, EVERYWHERE).full
    amplitude = 0.8 * math.sin(delta / 2)
    assert scores.psnr_linear == pytest.approx(-10 * math.log10(amplitude**2 / 2), abs=1e-9)
    assert scores.l1_linear == pytest.approx(amplitude * 2 / math.pi, rel=1e-4)  # 512 texels for an integral: 2e-5


def random_map(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((PROTOCOL_HEIGHT, 2 * PROTOCOL_HEIGHT, 3)) * 1.5


def test_scores_do_not_depend_on_where_the_map_is_cut() -> None:
    prediction, truth = random_map(0), random_map(1)
    here = region_scores(prediction, truth, EVERYWHERE).full
    there = region_scores(np.roll(prediction, 100, 1), np.roll(truth, 100, 1), EVERYWHERE).full
    for name, value in vars(here).items():
        assert getattr(there, name) == pytest.approx(value, rel=1e-9), name


def test_masks_choose_directions() -> None:
    truth = cosine_map(PROTOCOL_HEIGHT)
    prediction = truth.copy()
    upper = latlong_directions(PROTOCOL_HEIGHT)[..., 2] > 0
    prediction[~upper] = 0.0
    scores = region_scores(prediction, truth, RegionMasks(upper, ~upper))
    assert scores.observed is not None
    assert scores.resolved is not None
    assert scores.observed.l1_linear == 0.0
    assert scores.resolved.l1_linear == pytest.approx(0.5, rel=1e-9)
    assert scores.full.l1_linear == pytest.approx(0.25, rel=1e-9)


def test_weights_are_solid_angles_and_plain_pictures_overrate_the_poles() -> None:
    assert direction_weights().sum() == pytest.approx(4 * math.pi)
    truth = np.zeros((PROTOCOL_HEIGHT, 2 * PROTOCOL_HEIGHT, 3))
    prediction = truth.copy()
    prediction[: PROTOCOL_HEIGHT // 4] = 0.5
    cap_share = (1 - math.cos(math.pi / 4)) / 2
    assert region_scores(prediction, truth, EVERYWHERE).full.l1_linear == pytest.approx(0.5 * cap_share, rel=1e-9)
    assert unweighted_scores(prediction, truth).psnr_linear_unweighted == pytest.approx(-10 * math.log10(0.25 / 4))


@pytest.mark.parametrize("height", [512, 300, 256, 100])
def test_resampling_keeps_constants_and_area_averages_keep_the_mean(height: int) -> None:
    assert to_protocol_size(np.full((height, 2 * height, 3), 0.7)) == pytest.approx(0.7)
    image = np.random.default_rng(0).random((height, 2 * height, 1))
    if height >= PROTOCOL_HEIGHT:
        assert to_protocol_size(image).mean() == pytest.approx(image.mean(), rel=1e-12)


def test_area_averaging_by_two_is_the_mean_of_blocks() -> None:
    image = np.random.default_rng(0).random((512, 1024, 2))
    blocks = image.reshape(256, 2, 512, 2, 2).mean((1, 3))
    np.testing.assert_allclose(to_protocol_size(image), blocks, atol=1e-12)


@pytest.mark.parametrize(("stops", "height"), [(-2.0, 64), (0.0, 512), (1.37, 300)])
def test_the_best_exposure_undoes_a_scale(stops: float, height: int) -> None:
    truth = cosine_map(height).astype(np.float32) * 4.0  # much of it is clipped
    found = best_exposure_stops(truth * np.float32(2.0**-stops), truth)
    assert found == pytest.approx(stops, abs=1e-3)  # bounded search to 1e-4 stops


def test_a_black_prediction_keeps_its_exposure() -> None:
    truth = cosine_map(64)
    assert best_exposure_stops(np.zeros_like(truth), truth) == 0.0


def test_hdr_error_counts_stops() -> None:
    truth = cosine_map(PROTOCOL_HEIGHT) * 1000.0
    scores = region_scores(truth * 4.0, truth, EVERYWHERE).full
    assert scores.log_rmse_stops == pytest.approx(2.0, abs=1e-4)  # the floor of 1e-3 against radiance of 100
    assert scores.psnr_linear == 100.0  # both are white once clipped


def test_coverage_of_a_hemisphere_is_one_half_and_grows_by_union() -> None:
    directions = np.random.default_rng(0).normal(size=(400_000, 3))
    upper, lower = cells_of_view(directions[directions[:, 2] > 0]), cells_of_view(directions[directions[:, 2] < 0])
    assert coverage(nothing_observed().observed) == 0.0
    assert coverage(upper.observed) == pytest.approx(0.5, abs=1e-9)  # cells do not straddle the horizon
    both = upper.union(lower)
    assert coverage(both.observed) == pytest.approx(1.0)
    mask = cells_to_latlong(upper.observed, 64)
    np.testing.assert_array_equal(mask, latlong_directions(64)[..., 2] > 0)


def test_a_cell_is_resolved_by_one_view_not_by_many_coarse_ones() -> None:
    one = np.array([[1.0, 0.01, 0.01]])
    coarse = cells_of_view(np.repeat(one, 15, 0))
    assert coarse.observed.sum() == 1
    assert not coarse.union(coarse).resolved.any()
    assert cells_of_view(np.repeat(one, 16, 0)).resolved.sum() == 1


def test_the_error_of_inverse_distance_is_a_mean_over_the_mask_in_object_radii() -> None:
    """Truth 1/2 above and 0 below, radius 3: a mask of everything, of one half, and predictions that are off by 1/6."""
    upper = latlong_directions(PROTOCOL_HEIGHT)[..., 2] > 0
    truth = np.where(upper, 0.5, 0.0)
    everywhere = np.ones_like(upper)
    assert inverse_distance_error(None, truth, 3.0, everywhere) == pytest.approx(3 * 0.5 / 2)
    assert inverse_distance_error(None, truth, 3.0, upper) == pytest.approx(3 * 0.5)
    assert inverse_distance_error(None, truth, 3.0, ~upper) == 0.0
    assert inverse_distance_error(truth, truth, 3.0, everywhere) == 0.0
    assert inverse_distance_error(truth + 1 / 6, truth, 3.0, everywhere) == pytest.approx(0.5)
    coarse = np.full((4, 8), 0.25)
    assert inverse_distance_error(coarse, truth, 3.0, everywhere) == pytest.approx(3 * 0.25)
