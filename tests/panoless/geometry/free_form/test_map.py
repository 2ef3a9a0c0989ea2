"""How residuals count under a map."""

import numpy as np
import pytest

from panoless.geometry.free_form.map import direction_gain

NOISE, TURN = 0.004, np.radians(0.3)


@pytest.fixture
def slopes() -> np.ndarray:
    """Of a world whose contrast spans three orders of magnitude."""
    rng = np.random.default_rng(4)
    return rng.normal(size=(20_000, 3, 3)) * np.exp(rng.normal(-2, 2, (20_000, 1, 1)))


def seen(slopes: np.ndarray, noise: float = NOISE, turn: float = TURN) -> np.ndarray:
    """Residuals of rays that are wrong by independent turns, and of pixels with noise."""
    rng = np.random.default_rng(5)
    turns = rng.normal(0, turn, (len(slopes), 3))
    return np.einsum("pck,pk->pc", slopes, turns) + rng.normal(0, noise, (len(slopes), 3))


def test_residuals_are_alike_wherever_the_map_changes(slopes: np.ndarray) -> None:
    residual, all_clear = seen(slopes), np.ones(len(slopes), dtype=bool)
    weighed = np.linalg.norm(residual, axis=1) * direction_gain(residual, slopes, all_clear)
    steepness = np.linalg.norm(slopes, axis=(1, 2))
    parts = np.array_split(weighed[np.argsort(steepness)], 10)
    medians = np.array([np.median(part) for part in parts])
    assert medians.max() < 1.6 * medians.min()


def test_only_pixels_that_err_by_more_than_a_stated_noise_count_less(slopes: np.ndarray) -> None:
    residual, all_clear = seen(slopes), np.ones(len(slopes), dtype=bool)
    gain = direction_gain(residual, slopes, all_clear, least_noise=0.02)
    by_turns = TURN * np.linalg.norm(slopes, axis=(1, 2))
    assert gain[by_turns < 0.002].min() > 0.98
    assert gain[by_turns > 0.2].max() < 0.3


def test_rays_that_do_not_err_count_alike(slopes: np.ndarray) -> None:
    all_clear = np.ones(len(slopes), dtype=bool)
    gain = direction_gain(seen(slopes, turn=0.0), slopes, all_clear)
    assert np.median(gain) > 0.98


def test_pixels_that_see_nothing_have_no_part_in_what_rays_err_by(slopes: np.ndarray) -> None:
    residual, clear = seen(slopes), np.arange(len(slopes)) % 2 == 0
    wrong = np.where(clear[:, None], residual, 5.0)
    np.testing.assert_array_equal(
        direction_gain(wrong, slopes, clear)[clear], direction_gain(residual, slopes, clear)[clear]
    )
    assert (direction_gain(residual, slopes, np.zeros(len(slopes), dtype=bool)) == 1).all()


def test_a_map_without_contrast_leaves_all_pixels_their_weight() -> None:
    flat, residual = np.zeros((50, 3, 3)), np.random.default_rng(6).normal(size=(50, 3))
    assert (direction_gain(residual, flat, np.ones(50, dtype=bool)) == 1).all()
