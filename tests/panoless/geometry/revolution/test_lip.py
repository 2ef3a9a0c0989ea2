"""The lip of a wall without thickness is where silhouettes put it."""

import numpy as np
import pytest

from panoless.geometry.revolution.lip import open_at_lip, place_lip, tip_shift
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.revolution.profile import resample_profile
from panoless.geometry.revolution.silhouette import contour_rays, silhouette_residuals
from tests.support.mirror_revolution import around, bowl, revolution_views

PIXEL = 3.5 / (96 * 50 / 36)


@pytest.fixture(scope="module")
def contours():
    return contour_rays(revolution_views(bowl(), around(12)))


def test_the_silhouettes_place_the_rim(contours) -> None:
    """From a lip two pixels off in radius and height: to a tenth of a pixel."""
    truth = bowl()
    for shift in ([2.0, -1.0], [0.5, 1.5]):
        profile = truth.profile.copy()
        profile[-1] += np.array(shift) * PIXEL
        surface = SurfaceOfRevolution(truth.origin, truth.axis, profile, truth.lip)
        for _ in range(6):
            profile = surface.profile.copy()
            profile[-1] += tip_shift(contours, surface, 1.0)
            surface = SurfaceOfRevolution(truth.origin, truth.axis, profile, truth.lip)
        assert np.linalg.norm(surface.profile[-1] - truth.profile[-1]) < 0.1 * PIXEL


def test_a_wall_that_ends_too_early_grows_to_its_rim(contours) -> None:
    """Two pixels cut off come back, to a tenth of a pixel, and along the wall."""
    truth = bowl()
    spacing = float(np.linalg.norm(truth.profile[-1] - truth.profile[-2]))
    kept = len(truth.profile) - round(2 * PIXEL / spacing)
    surface = SurfaceOfRevolution(truth.origin, truth.axis, truth.profile[:kept], kept - 1)
    for _ in range(8):
        surface = place_lip(contours, surface, PIXEL)
    assert np.linalg.norm(surface.profile[-1] - truth.profile[-1]) < 0.1 * PIXEL


def test_a_closed_surface_opens_where_it_should(contours) -> None:
    """A lid that cuts five pixels of the wall off, behind a blunt corner: opened, lip and direction are the truth's."""
    truth = resample_profile(bowl(), PIXEL)
    corner = truth.profile[truth.lip - 5] + np.array([[1.5, 0.2], [2.5, 0.3]]) * PIXEL
    profile = np.concatenate([truth.profile[: truth.lip - 4], corner, [[0.0, corner[-1, 1]]]])
    closed = SurfaceOfRevolution(truth.origin, truth.axis, profile, truth.lip - 3)
    found = open_at_lip(contours, closed)
    assert found is not None
    assert found.is_open
    assert np.linalg.norm(found.profile[-1] - truth.profile[-1]) < 0.1 * PIXEL
    assert np.degrees(abs(found.angles[-1, 1] - truth.angles[-1, 1])) < 2


def test_rays_over_the_rim_say_nothing_about_the_wall(contours) -> None:
    """A wall that is two pixels short takes no distances from the rays that pass beyond its end."""
    truth = bowl()
    spacing = float(np.linalg.norm(truth.profile[-1] - truth.profile[-2]))
    kept = len(truth.profile) - round(2 * PIXEL / spacing)
    short = SurfaceOfRevolution(truth.origin, truth.axis, truth.profile[:kept], kept - 1)
    found = silhouette_residuals(contours, short, PIXEL)
    assert float(np.abs(found.pixels[found.valid]).max()) < 0.5
    assert float(np.abs(found.pixels).max()) > 1
