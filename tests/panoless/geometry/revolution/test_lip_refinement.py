"""The last pixels of an open wall are refined by pixels that mix its lip with what lies around it."""

from dataclasses import replace

import numpy as np
import pytest

from panoless.geometry.revolution.lip_refinement import LENGTH_PX, refine_lip
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.revolution.profile import resample_profile
from tests.support.mirror_revolution import around, bowl, deep_views, goblet, known_environment, revolution_views

SIZE = 128
PIXEL = 3.5 / (SIZE * 50 / 36)


def bent(surface: SurfaceOfRevolution, shift_px: float, extension_px: float) -> SurfaceOfRevolution:
    """The surface with its last pixels bent outward, growing to `shift_px` at the lip, and its last side longer."""
    place = (surface.arc_lengths - surface.arc_lengths[-1]) / (LENGTH_PX * PIXEL)
    growing = np.clip(1 + 2 * place, 0, 1)[:, None] ** 2
    way = surface.profile[-1] - surface.profile[-2]
    way /= np.linalg.norm(way)
    shift = shift_px * np.array([way[1], -way[0]]) + extension_px * way
    return replace(surface, profile=surface.profile + growing * shift * PIXEL)


@pytest.fixture(scope="module")
def scene():
    return known_environment()


@pytest.fixture(scope="module")
def truth() -> SurfaceOfRevolution:
    return resample_profile(bowl(), PIXEL)


@pytest.fixture(scope="module")
def views(truth, scene):
    return deep_views(truth, scene, around(10, SIZE))


@pytest.mark.parametrize("bend", [(0.3, 0.2), (-0.3, -0.2)])
def test_a_bent_rim_is_straightened(truth, views, scene, bend) -> None:
    """The lip, 0.36 px off, to a quarter of that; directions of the last ten pixels, 3° off, to a third."""
    start = bent(truth, *bend)
    found = refine_lip(views, start, scene, PIXEL)
    last = slice(-LENGTH_PX // 2, None)

    def errors(surface: SurfaceOfRevolution) -> tuple[float, float]:
        excluded = np.linalg.norm(surface.profile[-1] - truth.profile[-1]) / PIXEL
        return excluded, np.degrees(np.abs(surface.angles[last] - truth.angles[last]).max())

    assert errors(found)[0] < errors(start)[0] / 4
    assert errors(found)[1] < errors(start)[1] / 3


def test_a_right_rim_stays(truth, views, scene) -> None:
    """Where held-out pixels are not explained better, the very same surface is returned."""
    assert refine_lip(views, truth, scene, PIXEL) is truth


def test_other_surfaces_are_left_alone(scene) -> None:
    """A closed one has no end, and one of a few pixels no wall before it."""
    few = revolution_views(goblet(), around(2, 32))
    closed = goblet()
    assert refine_lip(few, closed, scene, PIXEL) is closed
    short = bowl()
    assert refine_lip(few, short, scene, 0.2) is short
