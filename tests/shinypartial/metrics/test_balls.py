"""Balls lit by maps whose light is known in closed form."""

import numpy as np
import pytest

from shinypartial.core.sphere import latlong_directions
from shinypartial.metrics.balls import ball_normals, ball_scores, balls

DIRECTIONS = latlong_directions(128)
VIEW = np.array([0.48, -0.6, 0.64])


def world(seed: int = 3) -> np.ndarray:
    """Smooth radiance in (0, 1) with colors."""
    axes = np.random.default_rng(seed).normal(size=(3, 3))
    return 0.5 + 0.4 * np.tanh(DIRECTIONS @ axes)


def test_a_white_world_gives_white_balls() -> None:
    for lit in balls(np.ones((64, 128, 3)), VIEW):
        assert lit == pytest.approx(1.0, abs=1e-6)


def test_light_of_first_degree_falls_on_a_diffuse_ball_by_two_thirds() -> None:
    """∫ (a + b·ω) (n·ω)₊ dω/π = a + ⅔ b·n (Ramamoorthi and Hanrahan 2001)."""
    slope = np.array([0.3, -0.2, 0.4])
    radiance = np.repeat((1 + DIRECTIONS @ slope)[..., None], 3, -1)
    diffuse = balls(radiance, VIEW)[2]
    assert diffuse[:, 0] == pytest.approx(1 + 2 / 3 * ball_normals(VIEW) @ slope, abs=2e-3)


def test_a_mirror_ball_shows_what_lies_in_the_mirrored_direction() -> None:
    normals = ball_normals(VIEW)
    mirrored = VIEW - 2 * (normals @ VIEW)[:, None] * normals
    radiance = np.repeat((2 + DIRECTIONS[..., 2])[..., None], 3, -1)
    assert balls(radiance, VIEW)[0][:, 1] == pytest.approx(2 + mirrored[:, 2], abs=0.02)


def test_another_exposure_changes_neither_scores_nor_the_peak() -> None:
    found = ball_scores(3 * world(), world(), VIEW)
    for errors in (found.mirror, found.glossy, found.diffuse):
        assert [*vars(errors).values()] == pytest.approx([0, 0, 0], abs=1e-4)
    assert found.peak_error_deg == 0


def test_other_light_is_wrong_most_on_the_mirror() -> None:
    found = ball_scores(world(5), world(), VIEW)
    assert found.mirror.si_rmse > found.glossy.si_rmse > found.diffuse.si_rmse > 0.01


@pytest.mark.parametrize("angle", [10.0, 75.0])
def test_the_peak_is_off_by_the_angle_between_two_lamps(angle: float) -> None:
    def lamp(deg: float) -> np.ndarray:
        toward = np.array([np.sin(np.radians(deg)), 0.0, np.cos(np.radians(deg))])
        return np.repeat(np.exp(800 * (DIRECTIONS @ toward - 1))[..., None], 3, -1)

    assert ball_scores(lamp(40 + angle), lamp(40), VIEW).peak_error_deg == pytest.approx(angle, abs=1.0)


def test_the_angle_between_colors_is_that_between_their_vectors() -> None:
    red, grey = (np.broadcast_to(color, (64, 128, 3)) for color in ([1.0, 0.0, 0.0], [1.0, 1.0, 0.0]))
    assert ball_scores(red, grey, VIEW).diffuse.color_error_deg == pytest.approx(45, abs=1e-4)
