"""Masks by the ground: a ray-traced mirror ball on a sheet of colored tiles, which knows nothing of homographies."""

from pathlib import Path

import numpy as np
import pytest

from panoless.photographs import ground
from panoless.photographs.ground import (
    evidence_of,
    gains_of,
    ground_masks,
    laid_out,
    least_variation,
    log_odds,
    pattern_of,
    sheet_about,
)
from panoless.photographs.hull import overlap
from panoless.photographs.lens import Lens
from panoless.photographs.posed import PosedView, Poses, as_rows, find_ground
from panoless.photographs.structure import upright_world
from shinypartial.core.camera import Camera
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import GroundPlane
from shinypartial.io.images import read_png, write_png
from tests.support.ball_on_tiles import CAMERAS, CENTER, GROUND, TILE, seen_by, tiles


@pytest.fixture
def photographed(tmp_path: Path) -> tuple[dict[str, Camera], list[np.ndarray], Path]:
    masks = []
    for number, camera in enumerate(CAMERAS):
        picture, mask = seen_by(camera)
        masks.append(mask)
        write_png(tmp_path / f"p{number}.png", picture)
    return {f"p{number}": camera for number, camera in enumerate(CAMERAS)}, masks, tmp_path


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are small."""
    monkeypatch.setattr(ground, "TEXELS", 200)
    monkeypatch.setattr(ground, "HULL_VOXELS", 48)


def test_a_mirror_ball_is_found_without_a_hint(photographed) -> None:
    cameras, truth, folder = photographed
    found = ground_masks(cameras, folder, GROUND, folder / "ground.png")
    overlaps = [overlap(found[name] >= 128, mask) for name, mask in zip(cameras, truth, strict=True)]
    # The ball is 56 pixels wide: a pixel of its silhouette is 7 % of it.
    assert np.median(overlaps) > 0.97
    assert min(overlaps) > 0.93
    assert read_png(folder / "ground.png").shape == (200, 200, 3)


def test_the_sheet_is_known_below_the_ball_from_views_that_look_past_it() -> None:
    pictures = [seen_by(camera)[0] for camera in CAMERAS]
    sheet = sheet_about(CAMERAS, GROUND)
    foot = np.linalg.norm([camera.position_world for camera in CAMERAS], axis=1)
    assert sheet.half_side == pytest.approx(0.5 * np.median(foot), rel=0.01)
    pattern, known = pattern_of(*laid_out(pictures, CAMERAS, sheet))
    rows, columns = np.indices(known.shape)
    places = sheet.first + rows[..., None] * sheet.down + columns[..., None] * sheet.right
    inner = np.abs((places[..., :2] / TILE) % 1 - 0.5).max(-1) < 0.2
    near = np.linalg.norm(places[..., :2] - CENTER[:2], axis=-1)
    right = np.abs(255 * pattern - tiles(places[..., :2])).max(-1) < 15
    before = places[..., 1] < 0

    def share(where: np.ndarray) -> float:
        return float((right & known)[inner & where].mean())

    # Toward the cameras, seen by all; beside the foot, hidden by the ball in some views; behind it, in most.
    assert share((near > 0.4) & (near < 0.8) & before) > 0.95
    assert share((near > 0.25) & (near < 0.35) & before) > 0.95
    assert share((near > 0.4) & (near < 0.6) & ~before) > 0.85


def test_gains_even_out_exposure_and_white_balance() -> None:
    factors = np.random.default_rng(2).uniform(0.85, 1.1, (len(CAMERAS), 3))
    pictures = [(seen_by(c)[0] * f).clip(0, 255).astype(np.uint8) for c, f in zip(CAMERAS, factors, strict=True)]
    sheet = sheet_about(CAMERAS, GROUND)
    even = factors * gains_of(*laid_out(pictures, CAMERAS, sheet))
    assert (even.std(0) / even.mean(0)).max() < 0.03
    assert (factors.std(0) / factors.mean(0)).min() > 0.05


def test_a_view_tells_ground_from_mirror() -> None:
    pictures = [seen_by(camera)[0] for camera in CAMERAS]
    sheet = sheet_about(CAMERAS, GROUND)
    pattern, known = pattern_of(*laid_out(pictures, CAMERAS, sheet))
    mask = seen_by(CAMERAS[4])[1]
    view = evidence_of(pictures[4], CAMERAS[4], np.ones(3, np.float32), sheet, pattern, known)
    assert view.shown[mask].mean() < 0.1
    bare = seen_by(CAMERAS[4], ball=False)[0]
    empty = evidence_of(bare, CAMERAS[4], np.ones(3, np.float32), sheet, pattern, known)
    assert empty.shown[empty.predicted].mean() > 0.9
    odds = log_odds(view, mask)
    assert odds[mask].mean() > 1
    assert odds[~mask & view.predicted].mean() < -1
    assert not odds[~view.predicted].any()


def test_a_region_of_least_variation_loses_specks_and_keeps_its_edge() -> None:
    rows, columns = np.indices((60, 80))
    disk = (rows - 30) ** 2 + (columns - 40) ** 2 < 20**2
    shown = disk ^ (np.random.default_rng(0).random(disk.shape) < 0.15)
    found = least_variation(np.where(shown, -1, 1).astype(np.float32), np.full(disk.shape, 1.5, np.float32)) > 0.5
    assert overlap(shown, disk) < 0.75
    assert overlap(found, disk) > 0.97
    # Where an edge costs nothing each pixel is on its own side.
    free = least_variation(np.where(shown, -1, 1).astype(np.float32), np.full(disk.shape, 1e-4, np.float32)) > 0.5
    assert (free == shown).all()


def test_a_sheet_with_nothing_on_it_is_refused(tmp_path: Path) -> None:
    for number, camera in enumerate(CAMERAS):
        write_png(tmp_path / f"p{number}.png", seen_by(camera, ball=False)[0])
    cameras = {f"p{number}": camera for number, camera in enumerate(CAMERAS)}
    with pytest.raises(InputError, match=r"stands before the ground.*--masks"):
        ground_masks(cameras, tmp_path, GROUND, tmp_path / "ground.png")


def scattered(share: float, tilt: np.ndarray) -> np.ndarray:
    """Points of which a share lies on a plane through (0, 0, 0.2) at right angles to `tilt`, the others anywhere."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (600, 3))
    on = points[: round(share * 600)]
    on -= np.outer((on - [0, 0, 0.2]) @ tilt, tilt) + 1e-4 * rng.normal(size=on.shape)
    return points


def test_the_ground_is_the_plane_of_most_points_below_all_cameras() -> None:
    tilt = np.array([0.2, -0.3, 1.0])
    tilt /= np.linalg.norm(tilt)
    poses = np.stack([camera.camera_to_world for camera in CAMERAS])
    found = find_ground(scattered(0.5, tilt), poses)
    assert found is not None
    np.testing.assert_allclose(found.normal, tilt, atol=1e-3)
    assert found.offset == pytest.approx(0.2 * tilt[2], abs=1e-3)
    assert find_ground(scattered(0.1, tilt), poses) is None
    assert find_ground(np.zeros((0, 3)), poses) is None
    # A wall between the cameras has some on either side, and they do not look down on one before them.
    assert find_ground(scattered(0.5, np.array([1.0, 0.0, 0.0])), poses) is None
    assert find_ground(scattered(0.5, np.array([0.0, 1.0, 0.0])), poses) is None


def test_the_world_of_structure_from_motion_stands_on_its_ground() -> None:
    normal = np.array([0.1, 0.5, 0.8])
    normal /= np.linalg.norm(normal)
    lens = Lens(260.0, 260.0, 80.0, 60.0, 160, 120)
    views = tuple(
        PosedView(f"p{number}", lens, as_rows(camera.camera_to_world)) for number, camera in enumerate(CAMERAS)
    )
    ground = GroundPlane((float(normal[0]), float(normal[1]), float(normal[2])), -0.7)
    turned = upright_world(Poses("structure from motion", "unknown", views, ground=ground))
    assert turned.ground == GROUND
    before, after = (np.array([view.camera_to_world for view in poses])[:, :3, 3] for poses in (views, turned.views))
    np.testing.assert_allclose(after[:, 2], before @ normal + 0.7, atol=1e-12)
    steps = (np.linalg.norm(np.diff(centers, axis=0), axis=1) for centers in (before, after))
    np.testing.assert_allclose(*steps)
