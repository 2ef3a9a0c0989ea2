"""The object's frame stays where it is when specks are added to masks, or when pictures cut the object."""

import math

import numpy as np
import pytest
import torch

from panoless.capture.masks import cut_sides, estimate_object_frame, largest_pieces, without_specks
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.silhouettes import mask_contours, mask_distance
from panoless.capture.views import Photograph, Views, cropped, views_of
from shinypartial.core.camera import Camera, look_at, ray_directions_world

SIDE = 96
CENTER, RADIUS = np.array([0.1, -0.2, 0.05]), 0.8
AROUND = 24


def camera_at(azimuth: float, elevation: float, aim: np.ndarray = CENTER) -> Camera:
    direction = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    return Camera(look_at(CENTER + 4 * direction, aim), 1.8 * SIDE, 1.8 * SIDE, SIDE / 2, SIDE / 2, SIDE, SIDE)


def mask_of(camera: Camera, axes: np.ndarray | float = RADIUS) -> np.ndarray:
    """Which pixels see the ellipsoid with these half axes, in 3×3 samples a pixel."""
    fine = Camera(camera.camera_to_world, *(3 * n for n in (camera.fx, camera.fy, camera.cx, camera.cy)), 288, 288)
    rays, origin = ray_directions_world(fine) / axes, (camera.position_world - CENTER) / axes
    hit = (rays @ origin) ** 2 > (rays**2).sum(-1) * (origin @ origin - 1)
    return hit.reshape(SIDE, 3, SIDE, 3).mean((1, 3))


def masks_around(axes: np.ndarray | float = RADIUS) -> list[tuple[Camera, np.ndarray]]:
    cameras = [camera_at(turn, (0.2, 0.6)[i % 2]) for i, turn in enumerate(np.linspace(0, 5.5, AROUND))]
    return [(camera, mask_of(camera, axes)) for camera in cameras]


def views_from(masks: list[tuple[Camera, np.ndarray]], margin_px: int = 4) -> Views:
    return views_of([cropped(camera, np.repeat(alpha[..., None], 3, 2), alpha, margin_px) for camera, alpha in masks])


def change(frame: ObjectFrame, other: ObjectFrame) -> float:
    """How far one frame is from another, as a share of the radius."""
    return max(float(np.linalg.norm(frame.center - other.center)) / other.radius, abs(frame.radius / other.radius - 1))


@pytest.fixture(scope="module")
def clean() -> list[tuple[Camera, np.ndarray]]:
    return masks_around()


@pytest.mark.parametrize("size", [1, 3, 6])
def test_stray_blobs_move_the_frame_by_less_than_a_hundredth(clean, size: int) -> None:
    damaged = []
    for index, (camera, alpha) in enumerate(clean):
        stray = alpha.copy()
        if index % 2:
            stray[:size, -size:] = 1
        damaged.append((camera, stray))
    assert max(int((alpha >= 0.5).sum()) for _, alpha in clean) > 20 * size**2
    assert change(estimate_object_frame(damaged), estimate_object_frame(clean)) < 0.01


def test_one_speck_changes_nothing(clean) -> None:
    """Neither frame nor crop: a view with one is the view without it."""
    speckled = [(camera, np.maximum(alpha, np.eye(SIDE)[0] * np.eye(SIDE)[:, [2]])) for camera, alpha in clean]
    for first, second in zip(views_from(speckled).train, views_from(clean).train, strict=True):
        torch.testing.assert_close(first.mask, second.mask, rtol=0, atol=0)
        torch.testing.assert_close(first.radiance, second.radiance, rtol=0, atol=0)
        torch.testing.assert_close(first.camera.world_to_camera, second.camera.world_to_camera, rtol=0, atol=0)


def test_a_mask_of_one_piece_or_of_large_pieces_is_left_alone() -> None:
    whole = np.zeros((30, 40))
    whole[4:20, 4:20] = 0.7
    assert without_specks(whole) is whole
    two = whole.copy()
    two[25:28, 30:38] = 1
    assert without_specks(two) is two
    assert largest_pieces(two >= 0.5, 0.05).sum() == np.count_nonzero(two)
    assert largest_pieces(two >= 0.5, 0.2).sum() == np.count_nonzero(whole)
    assert not largest_pieces(np.zeros((3, 3), bool), 0.1).any()


def test_a_faint_pixel_beside_the_object_stays() -> None:
    """The tip of an antialiased corner may be a pixel of its own."""
    mask = np.zeros((60, 60))
    mask[5:55, 5:55] = 1
    mask[3, 3] = 0.1
    assert without_specks(mask) is mask


def test_cut_sides_are_left_top_right_bottom() -> None:
    for side, line in enumerate((np.s_[:, 0], np.s_[0], np.s_[:, -1], np.s_[-1])):
        mask = np.zeros((5, 7))
        mask[line][2] = 0.5
        assert cut_sides(mask) == tuple(index == side for index in range(4))


def aimed_beside(every: int, aside: float) -> list[tuple[Camera, np.ndarray]]:
    """Masks of which every k-th is cut, because its camera looks past the object, to either side or up or down."""
    masks = []
    for index, (camera, alpha) in enumerate(masks_around()):
        if index % every == 0:
            axis = camera.camera_to_world[:3, (index // every) % 2] * (1, -1)[(index // every) // 2 % 2]
            beside = Camera(look_at(camera.position_world, CENTER + aside * axis), *_intrinsics(camera))
            camera, alpha = beside, mask_of(beside)
            assert sum(cut_sides(alpha)) == 1
        masks.append((camera, alpha))
    return masks


def _intrinsics(camera: Camera) -> tuple:
    return camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height


@pytest.mark.parametrize("every", [3, 1])
def test_pictures_that_cut_the_object_keep_its_frame(clean, every: int) -> None:
    """Within half a percent if a third are cut, and 5 % if all are."""
    frame = estimate_object_frame(aimed_beside(every, 0.9))
    assert change(frame, estimate_object_frame(clean)) < (0.005 if every == 3 else 0.05)


def test_a_long_object_reaches_out_of_the_ball_of_the_median(clean) -> None:
    assert estimate_object_frame(clean).reach < 1
    axes = np.array([1.0, 0.25, 0.25])
    turns = [*np.linspace(-0.4, 0.4, 20), 1.5, -1.5]
    frame = estimate_object_frame([(camera, mask_of(camera, axes)) for camera in (camera_at(t, 0.3) for t in turns)])
    assert frame.radius < 0.8
    assert frame.reach * frame.radius > 0.95


def test_beyond_the_border_that_cuts_a_mask_nothing_is_known_and_beyond_others_there_is_no_object() -> None:
    camera, alpha = aimed_beside(3, 0.9)[0]
    others = masks_around()[1::4]
    view = views_from([(camera, alpha), *others]).train[0]
    frame = views_from([(camera, alpha), *others]).object_frame
    distance = mask_distance(view)
    assert distance.cut == cut_sides(alpha)
    side = distance.cut.index(True)
    right, down = camera.camera_to_world[:3, 0], camera.camera_to_world[:3, 1]
    outward = (-right, -down, right, down)[side]

    def at(points: np.ndarray) -> np.ndarray:
        return distance.distances(torch.from_numpy((points - frame.center) / frame.radius).float()).numpy()

    ahead = camera.position_world + 4 * camera.camera_to_world[:3, 2]
    assert np.isneginf(at(ahead + np.array([1.3, 2.0, 5.0])[:, None] * outward)).all()
    assert (at(ahead - np.array([1.3, 2.0, 5.0])[:, None] * outward) > 0).all()
    # Within the picture the border is no silhouette: the mask's inside is as deep there as the next curve is far.
    border = (view.mask[:, 0], view.mask[0], view.mask[:, -1], view.mask[-1])[side] > 0.99
    line = (distance.distance_px[:, 0], distance.distance_px[0], distance.distance_px[:, -1], distance.distance_px[-1])
    assert float(line[side][border].min()) < -5


def test_no_contour_runs_along_a_border() -> None:
    masks = aimed_beside(3, 0.9)
    blurred = []
    for camera, alpha in masks:
        faint = alpha.copy()
        if any(cut := cut_sides(alpha)):
            # As a resampled mask is, a little less than full in the last line, but for one pixel.
            line = (faint[:, 0], faint[0], faint[:, -1], faint[-1])[cut.index(True)]
            line[np.flatnonzero(line > 0.9)[3:]] = 0.4
        blurred.append((camera, faint))
    views = views_from(blurred)
    contours = mask_contours(views)
    for index, view in enumerate(views.train):
        rays = contours.rays[contours.view == index] @ view.camera.world_to_camera[:3, :3].double().numpy().T
        x, y = (rays[:, :2] * [view.camera.fx, view.camera.fy] + [view.camera.cx, view.camera.cy]).T
        gaps = (x, y, view.camera.width - x, view.camera.height - y)
        assert len(x) > 50
        for gap, cut in zip(gaps, cut_sides(view.mask.numpy()), strict=True):
            assert not cut or gap.min() > 1


def test_a_crop_without_margin_does_not_cut_the_mask(clean) -> None:
    photograph: Photograph = cropped(clean[0][0], np.ones((SIDE, SIDE, 3)), clean[0][1], 0)
    assert not any(cut_sides(photograph.mask.numpy()))
