"""Views: cropping moves no ray, the normalized frame does not depend on the world's, and broken captures are named."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from panoless.capture.masks import SPARE
from panoless.capture.poses import StatedCameras
from panoless.capture.views import TrainView, Views, load_views
from shinypartial.core.camera import project, ray_directions_world
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import Dataset
from shinypartial.dataset.write import write_view
from tests.support.synthetic_dataset import make_plain_sphere_dataset

WHOLE = -1


def moved(dataset: Dataset, change: Callable[[np.ndarray], np.ndarray]) -> Dataset:
    """The dataset with other training poses."""
    train = tuple(
        replace(frame, camera=replace(frame.camera, camera_to_world=change(frame.camera.camera_to_world)))
        for frame in dataset.train
    )
    return replace(dataset, train=train)


def corner(crop: TrainView, whole: TrainView) -> tuple[int, int]:
    """Row and column where a crop begins, from the principal points."""
    top, left = whole.camera.cy - crop.camera.cy, whole.camera.cx - crop.camera.cx
    assert top == int(top) >= 0
    assert left == int(left) >= 0
    return int(top), int(left)


def test_a_crop_is_a_region_of_the_whole_image(sphere_dataset: Dataset) -> None:
    cropped, whole = load_views(sphere_dataset, 2), load_views(sphere_dataset, WHOLE)
    for crop, full in zip(cropped.train, whole.train, strict=True):
        (top, left), height, width = corner(crop, full), crop.camera.height, crop.camera.width
        assert height * width < full.mask.numel()
        region = np.s_[..., top : top + height, left : left + width]
        for name in ("radiance", "mask"):
            torch.testing.assert_close(getattr(crop, name), getattr(full, name)[region], rtol=0, atol=0)
        # Subtracting the corner from the principal point rounds differently: 1e-7 of a unit vector.
        torch.testing.assert_close(crop.rays_camera, full.rays_camera[region], rtol=0, atol=1e-6)
        rows, columns = crop.solid // width + top, crop.solid % width + left
        assert torch.equal(rows * full.camera.width + columns, full.solid)
        assert full.mask.sum() == crop.mask.sum()


@pytest.mark.parametrize("margin", [WHOLE, 0, 2])
def test_a_world_point_lands_on_its_pixel(sphere_dataset: Dataset, margin: int) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    views, whole = load_views(sphere_dataset, margin), load_views(sphere_dataset, WHOLE)
    normalized = (points - views.object_frame.center) / views.object_frame.radius
    for view, full, frame in zip(views.train, whole.train, sphere_dataset.train, strict=True):
        matrix = view.camera.world_to_camera.double().numpy()
        seen = normalized @ matrix[:3, :3].T + matrix[:3, 3]
        top, left = corner(view, full)
        x = seen[:, 0] / seen[:, 2] * view.camera.fx + view.camera.cx + left
        y = seen[:, 1] / seen[:, 2] * view.camera.fy + view.camera.cy + top
        expected = project(frame.camera, points)
        # World to camera is stored in single precision: 1e-5 px at this size.
        np.testing.assert_allclose(np.stack([x, y], 1), expected[:, :2], atol=1e-4)
        np.testing.assert_allclose(seen[:, 2] * views.object_frame.radius, expected[:, 2], rtol=1e-5)


def test_rays_are_those_of_the_dataset(sphere_dataset: Dataset) -> None:
    for view, frame in zip(load_views(sphere_dataset, WHOLE).train, sphere_dataset.train, strict=True):
        world = torch.einsum("ij,jhw->hwi", view.camera_to_world_rotation, view.rays_camera)
        np.testing.assert_allclose(world.numpy(), ray_directions_world(frame.camera), atol=1e-6)


def test_blocks_are_smaller_where_the_object_would_be_too_small(sphere_dataset: Dataset) -> None:
    whole = load_views(sphere_dataset, WHOLE)
    across = np.median([float(view.mask.sum()) ** 0.5 for view in whole.train])
    for least, side in ((0.0, 4), (across / 4.01, 4), (across / 2.5, 2), (across * 2, 1)):
        views = load_views(sphere_dataset, WHOLE, downscale=4, least_object_px=least)
        assert views.train[0].mask.shape[0] == whole.train[0].mask.shape[0] // side


def test_the_normalized_frame_holds_the_sphere(views: Views) -> None:
    # A sphere of radius 1 at the origin; masks of 40 px place it within half a pixel, 0.03 units.
    np.testing.assert_allclose(views.object_frame.center, 0, atol=0.03)
    assert 1.0 < views.object_frame.radius < 1.25


@pytest.mark.parametrize(("scale", "shift"), [(7.5, (100.0, -3.0, 20.0)), (0.02, (0.0, 1.0, -0.5))])
def test_the_scale_and_origin_of_the_world_do_not_matter(sphere_dataset: Dataset, scale: float, shift) -> None:
    def change(pose: np.ndarray) -> np.ndarray:
        result = pose.copy()
        result[:3, 3] = scale * pose[:3, 3] + shift
        return result

    original, other = load_views(sphere_dataset, 2), load_views(moved(sphere_dataset, change), 2)
    assert other.object_frame.radius == pytest.approx(scale * original.object_frame.radius, rel=1e-6)
    expected = scale * original.object_frame.center + np.array(shift)
    np.testing.assert_allclose(other.object_frame.center, expected, atol=1e-6 * scale)
    assert other.near == pytest.approx(original.near, rel=1e-6)
    for first, second in zip(original.train, other.train, strict=True):
        torch.testing.assert_close(first.camera.world_to_camera, second.camera.world_to_camera, rtol=0, atol=1e-5)


def test_the_camera_extent_counts_from_the_middle_of_the_cameras(views: Views) -> None:
    shifted = replace(views, train=tuple(view for view in views.train[:2]))
    excluded = float(np.linalg.norm(shifted.train[0].position - shifted.train[1].position))
    assert shifted.camera_extent == pytest.approx(1.1 * excluded / 2)


def test_radiance_is_premultiplied_and_clipped(sphere_dataset: Dataset) -> None:
    truth = read_view(sphere_dataset.train[0])
    assert truth.radiance.max() > 1
    view = load_views(sphere_dataset, WHOLE).train[0]
    np.testing.assert_array_equal(view.radiance.permute(1, 2, 0).numpy(), np.clip(truth.radiance, 0, 1))


def test_a_plain_folder_of_pictures_loads(tmp_path: Path, sphere_dataset: Dataset) -> None:
    plain = load_views(make_plain_sphere_dataset(tmp_path / "plain"), 2)
    full = load_views(sphere_dataset, 2)
    assert plain.object_frame.radius == pytest.approx(full.object_frame.radius, rel=1e-6)
    for first, second in zip(plain.train, full.train, strict=True):
        # Eight bits of sRGB: half a step is 0.2 %, at the bright end 0.5 % of linear light.
        torch.testing.assert_close(first.radiance, second.radiance, rtol=0, atol=0.01)


def test_all_empty_masks_are_named_at_once(damaged_dataset: Path) -> None:
    dataset = open_dataset(damaged_dataset)
    for frame in dataset.train[2::2]:
        view = read_view(frame)
        write_view(frame, replace(view, radiance=view.radiance * 0, alpha=view.alpha * 0))
    with pytest.raises(InputError, match="2 of 6 masks empty: train/r_002, train/r_004"):
        load_views(dataset, 2)


def test_views_along_one_line_leave_the_depth_open(sphere_dataset: Dataset) -> None:
    """The ball of radius 1 about the origin is taken to be there; known to be twice as large, it is farther away."""
    first = sphere_dataset.train[0].camera.camera_to_world
    along = moved(sphere_dataset, lambda pose: first.copy())
    frames = [load_views(along, 2, known_radius=radius).object_frame for radius in (0.0, 2.0)]
    assert all(frame.depth_is_open for frame in frames)
    assert not load_views(sphere_dataset, 2).object_frame.depth_is_open
    # Half a pixel of 32: masks count the pixels that they cover at least by half.
    np.testing.assert_allclose(frames[0].center, 0, atol=0.1)
    np.testing.assert_allclose([frame.radius / SPARE for frame in frames], [1.0, 2.0], rtol=0.05)


def test_cameras_that_look_away_are_refused(sphere_dataset: Dataset) -> None:
    with pytest.raises(InputError, match="behind one of the cameras"):
        load_views(moved(sphere_dataset, lambda pose: pose @ np.diag([-1.0, 1.0, -1.0, 1.0])), 2)


def test_stated_covariances_come_in_units_of_the_frame(sphere_dataset: Dataset) -> None:
    """Turns keep their radians; shifts are in radii of the object. Where none is stated, the usual prior stands."""
    root = np.random.default_rng(0).normal(size=(6, 6))
    first = replace(sphere_dataset.train[0], pose_covariance=root @ root.T)
    views = load_views(replace(sphere_dataset, train=(first, *sphere_dataset.train[1:])), WHOLE)
    scaled = root / np.repeat([1.0, views.object_frame.radius], 3)[:, None]
    np.testing.assert_allclose(views.train[0].pose_covariance, scaled @ scaled.T)
    prior = StatedCameras.of(views).prior(0.5, 0.25, 0.1)
    np.testing.assert_allclose(prior[1], np.diag([4.0] * 3 + [16.0] * 3))
    floor = np.diag([0.05**2] * 3 + [0.025**2] * 3)
    np.testing.assert_allclose(np.linalg.inv(prior[0]), scaled @ scaled.T + floor, rtol=1e-6, atol=1e-9)
