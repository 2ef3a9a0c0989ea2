"""Masks of a ring that is traced analytically: its own gap stays, and what no other view confirms is mended."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.masks import MASK_LEVEL
from panoless.capture.poses import Poses
from panoless.capture.repair import with_repaired_masks
from panoless.capture.views import MaskRepairs, TrainView, Views
from shinypartial.core.conventions import SOLID_ALPHA
from tests.support.mirror_body import body_views, torus


@pytest.fixture(scope="module")
def ring() -> Views:
    return body_views(torus(), 24, 64)


def painted(views: Views, index: int, row: int, column: int, radius: int, alpha: float) -> Views:
    """A disk of that alpha in the mask of one view."""
    view = views.train[index]
    rows, columns = np.indices(view.mask.shape)
    mask = view.mask.clone()
    mask[torch.from_numpy(np.hypot(rows - row, columns - column) <= radius)] = alpha
    solid = torch.nonzero(mask.flatten() > SOLID_ALPHA)[:, 0]
    train = (*views.train[:index], replace(view, mask=mask, solid=solid), *views.train[index + 1 :])
    return replace(views, train=train)


def solid_middle(view: TrainView) -> tuple[int, int]:
    """The pixel deepest inside the mask."""
    from scipy.ndimage import distance_transform_edt

    depth = distance_transform_edt(view.mask.numpy() >= MASK_LEVEL)
    row, column = np.unravel_index(depth.argmax(), depth.shape)
    return int(row), int(column)


def test_a_gap_of_the_object_stays(ring: Views) -> None:
    assert any(_has_hole(view) for view in ring.train)
    assert with_repaired_masks(ring).repairs == MaskRepairs()


def _has_hole(view: TrainView) -> bool:
    from scipy.ndimage import label

    return bool(label(view.mask.numpy() < MASK_LEVEL)[1] > 1)


def test_a_hole_in_one_mask_is_filled_and_tells_no_color(ring: Views) -> None:
    row, column = solid_middle(ring.train[5])
    wrong = painted(ring, 5, row, column, 4, 0.0)
    mended = with_repaired_masks(wrong)
    assert mended.repairs == MaskRepairs(holes=1, pieces=0, views=1)
    assert (mended.train[5].mask >= MASK_LEVEL).equal(ring.train[5].mask >= MASK_LEVEL)
    assert mended.train[5].solid.equal(wrong.train[5].solid)
    assert all(
        after is before for k, (after, before) in enumerate(zip(mended.train, wrong.train, strict=True)) if k != 5
    )


@pytest.mark.parametrize("attached", [False, True])
def test_a_stray_piece_is_left_out(ring: Views, attached: bool) -> None:
    """But for two pixels beside the silhouette where it hangs on the object; with the half pixels of its rim."""
    before = ring.train[9].mask
    rows, columns = np.nonzero(before.numpy() >= MASK_LEVEL)
    row, column = (int(rows[columns.argmin()]), int(columns.min()) - 6) if attached else (7, 7)
    wrong = painted(ring, 9, row, column, 6, 1.0)
    mended = with_repaired_masks(wrong)
    assert mended.repairs == MaskRepairs(holes=0, pieces=1, views=1)
    added = int((wrong.train[9].mask - before > 0.5).sum())
    left = int((mended.train[9].mask - before > 0.5).sum())
    assert left <= (0.5 * added if attached else 0)
    assert (mended.train[9].mask < MASK_LEVEL)[before < MASK_LEVEL].float().mean() > 0.98


@pytest.mark.parametrize("turn_deg", [0.5, 1.0])
def test_masks_of_turned_cameras_stay(ring: Views, turn_deg: float) -> None:
    """They contradict each other along whole silhouettes."""
    turns = np.random.default_rng(1).normal(size=(len(ring.train), 3))
    turns *= np.radians(turn_deg) / np.linalg.norm(turns, axis=1, keepdims=True)
    assert with_repaired_masks(Poses(turns, 0 * turns).moved(ring)).repairs == MaskRepairs()


def test_few_views_contradict_nothing(ring: Views) -> None:
    row, column = solid_middle(ring.train[5])
    few = replace(painted(ring, 5, row, column, 4, 0.0), train=ring.train[:6])
    assert with_repaired_masks(few) is few


def test_a_finer_grid_fills_a_dent_up_to_the_silhouette(ring: Views) -> None:
    """A coarse one with 4 px between its points leaves a third of it."""
    before = ring.train[5].mask >= MASK_LEVEL
    rows, columns = np.nonzero(before.numpy())
    dented = painted(ring, 5, int(rows[columns.argmin()]), int(columns.min()), 9, 0.0)

    def lacking(views: Views) -> int:
        return int((before & (views.train[5].mask < MASK_LEVEL)).sum())

    coarse, fine = (with_repaired_masks(dented, grids=(20, cells)) for cells in (20, 40))
    assert lacking(fine) < 0.05 * lacking(dented) < 0.2 * lacking(dented) < lacking(coarse)
