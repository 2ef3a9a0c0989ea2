"""The bottom of an open vessel is found by way of its walls."""

import numpy as np
import pytest

from panoless.geometry.revolution.floor import fit_floor, floor_pixels, with_floor
from panoless.geometry.revolution.model import SurfaceOfRevolution
from tests.support.mirror_revolution import around, bowl, deep_views, goblet, known_environment, revolution_views

RISE = 0.04
PIXEL = 0.0078


@pytest.fixture(scope="module")
def vessel() -> SurfaceOfRevolution:
    return with_floor(bowl(), RISE, PIXEL)


def test_a_hidden_bottom_is_found_from_a_flat_one(vessel) -> None:
    """Under a known map, to a sixth of its rise; its error is that of the truth, and far below that of a flat one."""
    scene = known_environment()
    views = deep_views(vessel, scene, around(8, 64))
    seen = floor_pixels(views, bowl())
    found = fit_floor(seen, bowl(), scene, PIXEL)
    assert found.profile[0, 1] - bowl().profile[0, 1] == pytest.approx(RISE, abs=RISE / 6)
    flat, best, truth = (seen.error(each, scene, 16, 0.1) for each in (bowl(), found, vessel))
    assert best < 0.6 * flat
    assert best < 1.02 * truth


def test_a_bottom_is_level_at_the_axis_and_leaves_the_wall_alone(vessel) -> None:
    """The wall stays as it was, the middle is as high as requested, and the first side is nearly level."""
    np.testing.assert_array_equal(vessel.profile[-199:], bowl().profile[-199:])
    assert vessel.is_open
    assert vessel.profile[0, 1] == pytest.approx(bowl().profile[0, 1] + RISE)
    steps = np.diff(vessel.profile, axis=0)
    angles = np.arctan2(steps[:, 1], steps[:, 0])
    assert abs(angles[0]) < 0.25 * np.abs(angles[:24]).max()


def test_a_floor_that_no_path_meets_has_no_pixels() -> None:
    """Cameras above a closed surface never see its base."""
    views = revolution_views(goblet(), [camera for index, camera in enumerate(around(4, 32)) if index % 4 > 1])
    assert len(floor_pixels(views, goblet()).radiance) == 0
