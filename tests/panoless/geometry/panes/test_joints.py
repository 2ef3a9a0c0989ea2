"""Panes from photographs: where slopes jump, where joints lie, and what is no front of panes."""

import numpy as np
import pytest

from panoless.capture.masks import MASK_LEVEL, joined
from panoless.capture.silhouettes import without_gaps
from panoless.geometry.panes.joints import jumps, panes_over, with_bars
from panoless.geometry.panes.model import flat_panes
from panoless.geometry.plane.fit import fit_plane
from tests.support.mirror_height_field import bumpy, height_field_views
from tests.support.mirror_panes import grid_of, panes_views, slopes_at
from tests.support.mirror_plane import RECTANGLE, arc, plane_of

PLANE = plane_of(RECTANGLE)


def test_jumps_of_lines_are_found_and_none_in_one_line() -> None:
    """Three lines with noise of a tenth of the jumps, in two channels; then one line."""
    random, at = np.random.default_rng(0), np.arange(24)
    noise = 0.1 * random.normal(size=(24, 2))
    steps = np.select([at < 7, at < 15], [0.1 * at, 2 - 0.1 * at], -1.0)
    assert jumps(steps[:, None] + noise) == [7, 15]
    assert jumps(0.3 * at[:, None] + noise) == []


def test_bent_panes_are_found_where_they_are() -> None:
    """3 × 2 panes: joints within half a pixel, slopes to a tenth of those at the sides of panes."""
    truth = grid_of(PLANE, 3, 2)
    views = panes_views(truth, arc(16, size=96))
    found = panes_over(views, PLANE)
    assert found is not None
    pixel = 3.0 / views.train[0].camera.fx
    for cuts, expected in zip(found.plane.cuts, truth.cuts, strict=True):
        assert len(cuts) == len(expected)
        assert np.abs(cuts - expected)[1:-1].max() < 0.5 * pixel
    places = np.random.default_rng(1).uniform(0.9 * RECTANGLE.min(0), 0.9 * RECTANGLE.max(0), (500, 2))
    places = places[found.joint_distance(places) > pixel]
    error = found.heights(places, 1)[1:].T - slopes_at(truth, places)
    assert np.degrees(np.median(np.linalg.norm(error - np.median(error, 0), axis=1))) < 0.18
    assert np.degrees(np.median(np.linalg.norm(slopes_at(truth, places), axis=1))) > 1.0


def test_smooth_waves_are_no_panes() -> None:
    assert panes_over(height_field_views(bumpy(PLANE, 0.008), arc(12, size=64)), PLANE) is None


def test_bars_in_masks_are_as_wide_as_they_are_and_leave_the_plane() -> None:
    """Masks in pieces are joined for the plane; bars of two pixels are measured to a fifth of one."""
    pixel = 3.0 / arc(1, size=128)[0].fx
    truth = grid_of(PLANE, 3, 2, 2 * pixel)
    views = panes_views(truth, arc(12, size=128))
    assert (joined(views.train[0].mask) >= MASK_LEVEL).sum() > (views.train[0].mask >= MASK_LEVEL).sum()
    plane = fit_plane(without_gaps(views), thorough=False)
    assert np.median(plane.median_px) < 0.2
    assert np.degrees(np.arccos(plane.plane.normal @ PLANE.normal)) < 0.3
    assert with_bars(views, flat_panes(grid_of(PLANE, 3, 2))).plane.width == pytest.approx(truth.width, abs=0.2 * pixel)
