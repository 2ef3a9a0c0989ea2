"""Exposures of one place become one picture, and all views are brought to one exposure."""

from dataclasses import replace

import numpy as np
import pytest

from panoless.photographs.ball.brackets import exposed, same_pose
from panoless.photographs.shot import Shot
from tests.panoless.photographs.ball.conftest import Taken, shot_of

EXPOSURES = (0.12, 0.5, 2.0)
"""Two stops apart; lamps of radiance 6 are right in the shortest one alone."""


@pytest.fixture(scope="module")
def brackets(far: Taken) -> list[list[Shot]]:
    """Two places, three exposures each, without noise."""
    return [
        [shot_of(light, f"v{view}", exposure, stated=True, noise=0) for exposure in EXPOSURES]
        for view, light in enumerate(far.radiances[:2])
    ]


def test_exposures_of_one_place_are_a_group(brackets: list[list[Shot]]) -> None:
    """In any order; of equal exposures each is a view of its own."""
    (a, b, c), (d, e, f) = brackets
    assert same_pose([a, d, b, e, c, f]) == [[0, 2, 4], [1, 3, 5]]
    assert same_pose([a, a]) == [[0], [1]]


def test_so_they_are_by_their_pixels(brackets: list[list[Shot]]) -> None:
    """Where EXIF states no exposure."""
    shots = [replace(shot, exposure=None) for shot in brackets[0]]
    assert same_pose(shots) == [[0, 1, 2]]


def test_two_places_are_no_group(brackets: list[list[Shot]]) -> None:
    """Whatever their exposures: pictures differ."""
    assert same_pose([brackets[0][0], brackets[1][1]]) == [[0], [1]]


@pytest.mark.parametrize("stated", [True, False])
def test_merged_light_is_proportional_to_the_truth(brackets: list[list[Shot]], far: Taken, stated: bool) -> None:
    """One factor for all views, within 2 %, where codes of 8 bits are fine enough: lamps come from the shortest."""
    groups = [[shot if stated else replace(shot, exposure=None) for shot in group] for group in brackets]
    factors = []
    for view, truth in zip(exposed(groups), far.radiances, strict=False):
        assert view.high_dynamic_range
        assert not view.unknown.any()
        ratio = view.radiance[truth > 0.05] / truth[truth > 0.05]
        assert np.percentile(np.abs(ratio / np.median(ratio) - 1), 99) < 0.02
        lamps = truth > 3
        assert lamps.sum() > 100
        assert np.median(view.radiance[lamps] / truth[lamps]) == pytest.approx(np.median(ratio), rel=0.02)
        factors.append(np.median(ratio))
    assert factors[0] == pytest.approx(factors[1], rel=0.01)


def test_clipped_light_is_unknown_where_another_view_was_exposed_less(brackets: list[list[Shot]], far: Taken) -> None:
    """In the view without it; the other one is known everywhere."""
    known, cut = exposed([brackets[0][:1], brackets[1][1:2]])
    assert not known.unknown.any()
    clipped = (0.5 * far.radiances[1] > 1).any(-1)
    assert cut.unknown[clipped].all()
    # Beside a lamp pixels are clipped in part; the limit lies at 0.985 of the largest code.
    assert not cut.unknown[(0.5 * far.radiances[1] < 0.9).all(-1)].any()
    ratio = [
        float(np.median((each.radiance / truth)[(truth > 0.2) & (truth < 1)]))
        for each, truth in zip((known, cut), far.radiances, strict=False)
    ]
    assert ratio[0] == pytest.approx(ratio[1], rel=0.02)


def test_photographs_of_one_exposure_stay_as_they_are(far: Taken) -> None:
    for view in exposed([[shot] for shot in far.shots]):
        assert not view.high_dynamic_range
        assert not view.unknown.any()
