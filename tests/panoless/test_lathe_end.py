"""The last pixels of an open wall are refined by pixels that mix its rim with what lies around it."""

from dataclasses import replace

import numpy as np
import pytest

from panoless.lathe import Lathe
from panoless.lathe_end import LENGTH_PX, refined_end
from panoless.lathe_profile import resampled
from tests.support.mirror_lathe import around, bowl, deep_views, goblet, known_environment, lathe_views

SIZE = 128
PIXEL = 3.5 / (SIZE * 50 / 36)


def bent(lathe: Lathe, shift_px: float, extension_px: float) -> Lathe:
    """The lathe with its last pixels bent outward, growing to `shift_px` at the rim, and its last side longer."""
    place = (lathe.arc_lengths - lathe.arc_lengths[-1]) / (LENGTH_PX * PIXEL)
    growing = np.clip(1 + 2 * place, 0, 1)[:, None] ** 2
    way = lathe.profile[-1] - lathe.profile[-2]
    way /= np.linalg.norm(way)
    shift = shift_px * np.array([way[1], -way[0]]) + extension_px * way
    return replace(lathe, profile=lathe.profile + growing * shift * PIXEL)


@pytest.fixture(scope="module")
def scene():
    return known_environment()


@pytest.fixture(scope="module")
def truth() -> Lathe:
    return resampled(bowl(), PIXEL)


@pytest.fixture(scope="module")
def views(truth, scene):
    return deep_views(truth, scene, around(10, SIZE))


@pytest.mark.parametrize("bend", [(0.3, 0.2), (-0.3, -0.2)])
def test_a_bent_rim_is_straightened(truth, views, scene, bend) -> None:
    """The rim, 0.36 px off, to a quarter of that; directions of the last ten pixels, 3° off, to a third."""
    start = bent(truth, *bend)
    found = refined_end(views, start, scene, PIXEL)
    last = slice(-LENGTH_PX // 2, None)

    def errors(lathe: Lathe) -> tuple[float, float]:
        apart = np.linalg.norm(lathe.profile[-1] - truth.profile[-1]) / PIXEL
        return apart, np.degrees(np.abs(lathe.angles[last] - truth.angles[last]).max())

    assert errors(found)[0] < errors(start)[0] / 4
    assert errors(found)[1] < errors(start)[1] / 3


def test_a_right_rim_stays(truth, views, scene) -> None:
    """Where held-out pixels are not explained better, the very same lathe is returned."""
    assert refined_end(views, truth, scene, PIXEL) is truth


def test_other_lathes_are_left_alone(scene) -> None:
    """A closed one has no end, and one of a few pixels no wall before it."""
    few = lathe_views(goblet(), around(2, 32))
    closed = goblet()
    assert refined_end(few, closed, scene, PIXEL) is closed
    short = bowl()
    assert refined_end(few, short, scene, 0.2) is short
