"""Contrast: logarithms where most of what the object shows is dark, and radiance as it is elsewhere."""

from dataclasses import replace

import pytest
import torch

from panoless.capture.contrast import LEAST_KNEE, Contrast
from panoless.capture.views import Views
from tests.support.mirror_body import body_views, sphere


def knee_of(views: Views) -> float | None:
    """Down to any darkness."""
    return Contrast.of(views, least_knee=1e-9).knee


@pytest.fixture(scope="module")
def bright() -> Views:
    return body_views(sphere(), 3, 32)


def exposed(views: Views, power: float, gain: float = 1.0) -> Views:
    """The same views in a world of which each radiance is g cᵖ."""
    return replace(views, train=tuple(replace(view, radiance=gain * view.radiance**power) for view in views.train))


def test_views_of_usual_brightness_stay_as_they_are(bright: Views) -> None:
    assert Contrast.of(bright).applied(bright) is bright


def test_dark_views_keep_black_white_and_the_order_between() -> None:
    radiance = torch.linspace(0, 1, 101)
    shown = Contrast(0.01).shown(radiance)
    assert shown[0] == 0
    assert shown[-1] == pytest.approx(1)
    assert (shown.diff() > 0).all()


def test_far_above_the_knee_equal_ratios_are_equal_differences() -> None:
    one, two, four = Contrast(1e-5).shown(torch.tensor([0.1, 0.2, 0.4]))
    assert float(two - one) == pytest.approx(float(four - two), rel=1e-3)


@pytest.mark.parametrize("gain", [0.3, 0.01])
def test_whether_a_world_is_dark_does_not_depend_on_its_exposure(bright: Views, gain: float) -> None:
    """The knee is exposed as the views are, so that it stays at the same place of the world."""
    once = knee_of(exposed(bright, 16.0))
    assert once is not None
    assert knee_of(exposed(bright, 16.0, gain)) == pytest.approx(gain * once, rel=1e-4)
    assert knee_of(exposed(bright, 1.0, gain)) is None


def test_the_knee_stays_above_noise(bright: Views) -> None:
    assert Contrast.of(exposed(bright, 16.0, 1e-3)).knee == LEAST_KNEE
