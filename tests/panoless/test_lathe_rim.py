"""The rim of a wall without thickness is where outlines put it."""

import numpy as np
import pytest

from panoless.lathe import Lathe
from panoless.lathe_contours import contour_rays, touches
from panoless.lathe_profile import resampled
from panoless.lathe_rim import open_lathe, tip_shift, with_rim
from tests.support.mirror_lathe import around, bowl, lathe_views

PIXEL = 3.5 / (96 * 50 / 36)


@pytest.fixture(scope="module")
def contours():
    return contour_rays(lathe_views(bowl(), around(12)))


def test_the_outlines_place_the_rim(contours) -> None:
    """From a rim two pixels off in radius and height: to a tenth of a pixel."""
    truth = bowl()
    for shift in ([2.0, -1.0], [0.5, 1.5]):
        profile = truth.profile.copy()
        profile[-1] += np.array(shift) * PIXEL
        lathe = Lathe(truth.origin, truth.axis, profile, truth.rim)
        for _ in range(6):
            profile = lathe.profile.copy()
            profile[-1] += tip_shift(contours, lathe, 1.0)
            lathe = Lathe(truth.origin, truth.axis, profile, truth.rim)
        assert np.linalg.norm(lathe.profile[-1] - truth.profile[-1]) < 0.1 * PIXEL


def test_a_wall_that_ends_too_early_grows_to_its_rim(contours) -> None:
    """Two pixels cut off come back, to a tenth of a pixel, and along the wall."""
    truth = bowl()
    spacing = float(np.linalg.norm(truth.profile[-1] - truth.profile[-2]))
    kept = len(truth.profile) - round(2 * PIXEL / spacing)
    lathe = Lathe(truth.origin, truth.axis, truth.profile[:kept], kept - 1)
    for _ in range(8):
        lathe = with_rim(contours, lathe, PIXEL)
    assert np.linalg.norm(lathe.profile[-1] - truth.profile[-1]) < 0.1 * PIXEL


def test_a_closed_lathe_opens_where_it_should(contours) -> None:
    """A lid that cuts five pixels of the wall off, behind a blunt corner: opened, rim and direction are the truth's."""
    truth = resampled(bowl(), PIXEL)
    corner = truth.profile[truth.rim - 5] + np.array([[1.5, 0.2], [2.5, 0.3]]) * PIXEL
    profile = np.concatenate([truth.profile[: truth.rim - 4], corner, [[0.0, corner[-1, 1]]]])
    closed = Lathe(truth.origin, truth.axis, profile, truth.rim - 3)
    found = open_lathe(contours, closed, PIXEL)
    assert found is not None
    assert found.is_open
    assert np.linalg.norm(found.profile[-1] - truth.profile[-1]) < 0.1 * PIXEL
    assert np.degrees(abs(found.angles[-1, 1] - truth.angles[-1, 1])) < 2


def test_rays_over_the_rim_say_nothing_about_the_wall(contours) -> None:
    """A wall that is two pixels short takes no distances from the rays that pass beyond its end."""
    truth = bowl()
    spacing = float(np.linalg.norm(truth.profile[-1] - truth.profile[-2]))
    kept = len(truth.profile) - round(2 * PIXEL / spacing)
    short = Lathe(truth.origin, truth.axis, truth.profile[:kept], kept - 1)
    found = touches(contours, short, PIXEL)
    assert float(np.abs(found.pixels[found.valid]).max()) < 0.5
    assert float(np.abs(found.pixels).max()) > 1
