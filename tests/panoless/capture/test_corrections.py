"""Corrections undo what was done to photographs: silhouettes that were moved, exposures that differ."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from skimage.measure import find_contours

from panoless.capture.corrections import NO_CORRECTIONS, Corrections, with_silhouette_moved
from panoless.capture.encoding import encoding_of
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from shinypartial.core.conventions import SOLID_ALPHA
from tests.support.mirror_plane import camera_at, train_view

SIZE_PX = 48


def disk(radius_px: float) -> TrainView:
    """A disk off the middle, by 8×8 samples a pixel, in front of noise."""
    places = (np.arange(8 * SIZE_PX) + 0.5) / 8
    inside = np.hypot(places[:, None] - 23.3, places[None] - 24.1) < radius_px
    view = train_view(
        camera_at(np.array([0.0, -4.0, 0.0]), SIZE_PX), inside.reshape(SIZE_PX, 8, SIZE_PX, 8).mean((1, 3))
    )
    return replace(view, radiance=torch.rand(3, SIZE_PX, SIZE_PX, generator=torch.Generator().manual_seed(1)))


def views_of(*train: TrainView) -> Views:
    return Views(tuple(train), ObjectFrame(np.zeros(3), 1.0), 0.1)


@pytest.mark.parametrize("offset_px", [-4.0, -1.3, 0.6, 3.5])
def test_a_disk_with_its_silhouette_moved_is_a_larger_or_smaller_disk(offset_px: float) -> None:
    """Its contour lies within 0.2 px of the circle's, as that of such a disk does to 0.12; its area is right to 2 %."""
    before, after = disk(12.0), disk(12.0 + offset_px)
    moved = with_silhouette_moved(before, offset_px)
    (curve,) = find_contours(moved.mask.double().numpy(), 0.5)
    radius = np.hypot(*(curve + 0.5 - [23.3, 24.1]).T)
    assert np.abs(radius - 12.0 - offset_px).max() < 0.2
    assert float((moved.mask - after.mask).sum().abs()) < 0.02 * float(after.mask.sum())
    assert torch.equal(moved.radiance, before.radiance)


@pytest.mark.parametrize("offset_px", [-2.0, 2.0])
def test_only_what_a_photograph_shows_whole_is_solid(offset_px: float) -> None:
    before = disk(12.0)
    moved = with_silhouette_moved(before, offset_px)
    assert torch.isin(moved.solid, before.solid).all()
    assert torch.equal(moved.solid, torch.nonzero(moved.mask.flatten() > SOLID_ALPHA)[:, 0])
    # Shrunk by more than the disk's radius, the mask stays.
    assert with_silhouette_moved(before, -20.0) is before


def test_gains_are_divided_out_but_for_saturated_pixels() -> None:
    """Radiance comes back exactly where neither exposure saturates, and never above the largest value."""
    view = disk(12.0)
    for config in (FitConfig(), FitConfig(tint=(0.8, 1.0, 0.5))):
        largest = encoding_of(config).saturation[:, None, None]
        radiance = view.radiance * largest
        for gain, balance in ((0.7, None), (1.4, None), (0.9, (0.7, 1.0, 1.4))):
            of_channels = gain * torch.tensor(balance or (1.0, 1.0, 1.0)).reshape(3, 1, 1)
            taken = replace(view, radiance=torch.minimum(radiance * of_channels, largest))
            balances = None if balance is None else np.array([balance])
            corrections = Corrections(gains=np.array([gain]), balances=balances)
            (found,) = corrections.applied(views_of(taken), config).train
            saturated = taken.radiance >= 0.998 * largest
            assert torch.allclose(found.radiance[~saturated], radiance[~saturated], atol=1e-6)
            assert torch.equal(found.radiance[saturated], largest.expand_as(radiance)[saturated])


def test_no_corrections_leave_views_alone() -> None:
    views = views_of(disk(12.0))
    assert NO_CORRECTIONS.applied(views, FitConfig()).train[0] is views.train[0]
    assert NO_CORRECTIONS.exposure_stops is None
    alike = Corrections(gains=np.array([0.5, 2.0]))
    assert alike.exposure_stops == pytest.approx(1.0)
    assert alike.white_balance_stops is None
    balanced = replace(alike, balances=np.array([[0.5, 1.0, 2.0], [2.0, 1.0, 0.5]]))
    assert balanced.white_balance_stops == pytest.approx((2 / 3) ** 0.5)
