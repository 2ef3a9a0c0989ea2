"""Masks: their hull judges them, and a rectangle is enough where the object stands out."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from panoless.photographs import masks as masks_module
from panoless.photographs.hull import carve, nearest_point, overlap, silhouette
from panoless.photographs.make import contour_sigma_px
from panoless.photographs.masks import (
    MORE_HINTS,
    Hint,
    find_masks,
    masks_beside,
    moved_mask,
    overlaps_of,
    read_clicks,
)
from shinypartial.core.camera import Camera, ray_directions_world
from shinypartial.core.errors import InputError
from shinypartial.io.files import write_json
from shinypartial.io.images import read_png, write_png
from tests.support.photographed_planes import arc

CENTER, RADIUS = np.array([0.1, -0.05, 0.2]), 0.4
CAMERAS = arc(9, 3.0, (96, 96), 200.0)


def ball(camera: Camera, center=CENTER, radius: float = RADIUS) -> np.ndarray:
    """Pixels whose ray meets a ball: the distance of the center from the ray is less than the radius."""
    directions = ray_directions_world(camera)
    away = center - camera.position_world
    return (away @ away - (directions @ away) ** 2) < radius**2


TRUTH = [ball(camera) for camera in CAMERAS]


def named(cameras: Sequence[Camera], masks: Sequence[np.ndarray]) -> dict[str, tuple[Camera, np.ndarray]]:
    return {f"v_{i}": (c, m.astype(float)) for i, (c, m) in enumerate(zip(cameras, masks, strict=True))}


def test_the_hull_of_true_masks_has_their_silhouette() -> None:
    overlaps = overlaps_of(named(CAMERAS, TRUTH))
    assert min(overlaps) > 0.95  # A voxel is 1.5 pixels.


def test_one_wrong_mask_of_many_is_left_out() -> None:
    cameras = arc(12, 3.0, (96, 96), 200.0)
    masks = [ball(camera) for camera in cameras]
    masks[4] = np.roll(masks[4], 30, 1)
    overlaps = overlaps_of(named(cameras, masks))
    assert np.argmin(overlaps) == 4
    assert np.median(overlaps) > 0.9


def test_hull_points_are_those_that_all_masks_contain() -> None:
    """In the middle of the ball all are, two radii away none, and a point that one mask lacks only by allowance."""
    seen = list(zip(CAMERAS, TRUTH, strict=True))
    points = carve(seen, CENTER, 2 * RADIUS, 32)
    distances = np.linalg.norm(points - CENTER, axis=1)
    grid = carve([], CENTER, 2 * RADIUS, 32)
    within = np.linalg.norm(grid - CENTER, axis=1) < 0.9 * RADIUS
    assert within.sum() == (distances < 0.9 * RADIUS).sum()
    seen[0] = (seen[0][0], np.zeros_like(seen[0][1]))
    left = carve(seen, CENTER, 2 * RADIUS, 32)
    assert np.linalg.norm(left - CENTER, axis=1).min() > RADIUS  # Beyond that picture, where it shows nothing.
    assert len(carve(seen, CENTER, 2 * RADIUS, 32, 1)) >= len(points)
    spacing = 4 * RADIUS / 32
    assert overlap(silhouette(CAMERAS[0], grid[within], spacing), ball(CAMERAS[0], radius=0.9 * RADIUS)) > 0.9


def test_the_point_that_cameras_look_at() -> None:
    np.testing.assert_allclose(nearest_point(CAMERAS), 0, atol=1e-9)


def test_a_mask_moves_to_a_neighboring_view() -> None:
    moved = moved_mask(TRUTH[2], CAMERAS[2], CAMERAS[4], (CENTER, RADIUS))
    assert overlap(moved, TRUTH[4]) > 0.91
    assert overlap(TRUTH[2], TRUTH[4]) < 0.9


@pytest.mark.parametrize(
    ("change", "message"), [(np.logical_not, "white on the object"), (np.zeros_like, "that are empty")]
)
def test_masks_of_the_background_and_empty_ones_are_refused(change, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        overlaps_of(named(CAMERAS, [change(mask) for mask in TRUTH]))
    assert "v_0, v_1" in error.value.found
    assert "invert them" in error.value.remedy


def test_masks_that_were_found_are_not_blamed_on_the_user() -> None:
    """The view whose mask is empty is named, and where a rectangle would help."""
    masks = [mask & (index != 3) for index, mask in enumerate(TRUTH)]
    with pytest.raises(InputError, match="1 of 9 that are empty: v_3") as error:
        overlaps_of(named(CAMERAS, masks), MORE_HINTS)
    assert "--box-in v_3" in error.value.remedy
    assert "nvert" not in error.value.remedy


def test_masks_that_contradict_the_poses_are_refused() -> None:
    masks = [np.roll(mask, (17 * i % 48 - 24, 29 * i % 48 - 24), (0, 1)) for i, mask in enumerate(TRUTH)]
    with pytest.raises(InputError, match="agree on an object"):
        overlaps_of(named(CAMERAS, masks))


def write_pictures(folder: Path) -> None:
    """A bright ball with bands before a dark ground, both with noise."""
    random = np.random.default_rng(0)
    for index, (camera, truth) in enumerate(zip(CAMERAS, TRUTH, strict=True)):
        bands = 150 + 60 * np.sin(np.arange(96) / 4)[:, None, None]
        image = np.where(truth[..., None], bands, 60) + random.normal(0, 6, (camera.height, camera.width, 3))
        write_png(folder / f"p_{index}.png", np.clip(image, 0, 255).astype(np.uint8))


def box_of(mask: np.ndarray, margin: int = 3) -> tuple[float, float, float, float]:
    rows, columns = np.nonzero(mask)
    low, high = (columns.min() - margin, rows.min() - margin), (columns.max() + 1 + margin, rows.max() + 1 + margin)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def test_one_rectangle_gives_all_masks(tmp_path: Path) -> None:
    """Where the object stands out. An overlap of 0.98 is a quarter of a pixel along the edge."""
    write_pictures(tmp_path)
    cameras = {f"p_{index}": camera for index, camera in enumerate(CAMERAS)}
    masks = find_masks(cameras, tmp_path, {"p_4": Hint(box_of(TRUTH[4]))})
    assert list(masks) == list(cameras)
    for mask, truth in zip(masks.values(), TRUTH, strict=True):
        assert overlap(mask > 127, truth) > 0.98


def test_rectangles_without_a_view_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--box-in"):
        find_masks({"p_0": CAMERAS[0]}, tmp_path, {"other": Hint((0.0, 0.0, 9.0, 9.0))})


def test_masks_of_large_pictures_are_found_in_small_ones(tmp_path: Path) -> None:
    write_pictures(tmp_path)
    cameras = {f"p_{index}": camera for index, camera in enumerate(CAMERAS)}
    masks = find_masks(cameras, tmp_path, {"p_4": Hint(box_of(TRUTH[4]))})
    for mask, truth in zip(masks.values(), TRUTH, strict=True):
        assert overlap(mask > 127, truth) > 0.97


def test_five_clicks_give_all_masks(tmp_path: Path) -> None:
    """One on the object and four around it, in one picture: overlaps as from a rectangle."""
    write_pictures(tmp_path)
    cameras = {f"p_{index}": camera for index, camera in enumerate(CAMERAS)}
    rows, columns = np.nonzero(TRUTH[4])
    x, y, (left, top, right, bottom) = float(columns.mean()), float(rows.mean()), box_of(TRUTH[4], 6)
    clicks = {"p_4": {"on": [[x, y]], "off": [[left, y], [right, y], [x, top], [x, bottom]]}}
    write_json(tmp_path / "clicks.json", clicks)
    masks = find_masks(cameras, tmp_path, read_clicks(tmp_path / "clicks.json"))
    for mask, truth in zip(masks.values(), TRUTH, strict=True):
        assert overlap(mask > 127, truth) > 0.98


def test_clicks_are_believed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A patch of the ground's colors in the middle of the ball: what is clicked stays as it was clicked."""
    write_pictures(tmp_path)
    rows, columns = np.nonzero(TRUTH[4])
    x, y = round(columns.mean()), round(rows.mean())
    image = read_png(tmp_path / "p_4.png").copy()
    image[y - 6 : y + 6, x - 6 : x + 6] = image[:12, :12]
    write_png(tmp_path / "p_4.png", image)
    cameras = {f"p_{index}": CAMERAS[index] for index in (3, 4, 5)}
    middle = ((float(x), float(y)),)
    monkeypatch.setattr(masks_module, "ROUNDS", 1)
    for hint, covered in ((Hint(box_of(TRUTH[4]), on=middle), True), (Hint(box_of(TRUTH[4]), off=middle), False)):
        mask = find_masks(cameras, tmp_path, {"p_4": hint})["p_4"] > 127
        assert mask[y - 1 : y + 1, x - 1 : x + 1].all() == covered
        assert mask[y - 1 : y + 1, x - 1 : x + 1].any() == covered
        assert mask[y, x - 12]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"p_0": {"on": [[9, 9]]}}, "all of its sides"),
        ({"p_0": {"off": [[9, 9], [80, 9]]}}, "all of its sides"),
        ({"p_0": {"on": [[9]]}}, "p_0"),
        ({"p_0": {"inside": [[9, 9]]}}, "inside"),
        ([1], "table of photographs"),
    ],
)
def test_clicks_that_tell_nothing_are_refused(tmp_path: Path, content: object, message: str) -> None:
    write_pictures(tmp_path)
    write_json(tmp_path / "clicks.json", content)
    with pytest.raises(InputError, match=message):
        find_masks({"p_0": CAMERAS[0]}, tmp_path, read_clicks(tmp_path / "clicks.json"))


def test_masks_beside_photographs_or_a_video_are_found_where_all_are_there(tmp_path: Path) -> None:
    masks, names = tmp_path / "masks", ["a", "b"]
    masks.mkdir()
    (masks / "a.png").touch()
    assert masks_beside(tmp_path / "film.mp4", names) is None
    (masks / "b_mask.png").touch()
    for source in (tmp_path, tmp_path / "frames", tmp_path / "film.mp4"):
        assert masks_beside(source, names) == masks


def test_contours_are_off_by_what_overlaps_lack_of_a_disk() -> None:
    rows, columns = np.indices((200, 200))
    away = np.hypot(rows - 100, columns - 100)
    for off_px in (1.0, 2.0, 4.0):
        mask, hull = (away < 60).astype(float), away < 60 - off_px
        overlap_of_both = overlap(mask > 0.5, hull)
        assert contour_sigma_px({"a": mask}, [overlap_of_both]) == pytest.approx(off_px, rel=0.15)
