"""The last pixels of an open wall are refined by pixels that mix its lip with what lies around it."""

from dataclasses import replace

import numpy as np
import pytest

from panoless.geometry.revolution.lip import lip_pixels, refine_lip
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.revolution.profile import resample_profile
from tests.support.mirror_revolution import around, bowl, deep_views, funnel, known_environment

SIZE = 128
LENGTH_PX = 20
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
    found = refine_lip(lip_pixels(views.train, start, 8000), start, scene, PIXEL)
    last = slice(-LENGTH_PX // 2, None)

    def errors(surface: SurfaceOfRevolution) -> tuple[float, float]:
        excluded = np.linalg.norm(surface.profile[-1] - truth.profile[-1]) / PIXEL
        return excluded, np.degrees(np.abs(surface.angles[last] - truth.angles[last]).max())

    assert errors(found)[0] < errors(start)[0] / 4
    assert errors(found)[1] < errors(start)[1] / 3


def test_a_lip_is_never_worse_than_before(truth, views, scene) -> None:
    """Steps from the truth are taken only where the pixels that they are made for cost less."""
    pixels = lip_pixels(views.train, truth, 2000)
    found = refine_lip(pixels, truth, scene, PIXEL)
    assert pixels.error(found, scene, 16, 0.1) <= pixels.error(truth, scene, 16, 0.1)
    assert np.linalg.norm(found.profile[-1] - truth.profile[-1]) < 0.1 * PIXEL


def test_a_closed_body_has_a_lip_and_its_ends_stay_on_the_axis(scene) -> None:
    """Steps move both sides of the lip and lower the cost; both ends of the profile stay where they are."""
    pixel = 2 * PIXEL
    body = resample_profile(funnel(), pixel)
    views = deep_views(body, scene, around(4, SIZE // 2))
    near = np.clip(1 - np.abs(body.arc_lengths - body.arc_lengths[body.lip]) / (6 * pixel), 0, 1)
    start = replace(body, profile=body.profile + 0.3 * pixel * near[:, None] * [1.0, 0.5])
    pixels = lip_pixels(views.train, start, 2000)
    found = refine_lip(pixels, start, scene, pixel)
    assert pixels.error(found, scene, 16, 0.1) < 0.95 * pixels.error(start, scene, 16, 0.1)
    moved = np.linalg.norm(found.profile - start.profile, axis=1)
    assert moved[body.lip - 3] > 0
    assert moved[body.lip + 3] > 0
    np.testing.assert_array_equal(found.profile[[0, -1]], body.profile[[0, -1]])
