"""Wrong cameras, fewer views, smaller and cut objects, turned worlds: the copy states what its pictures show."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shinypartial.core.camera import project, ray_directions_world, reflect
from shinypartial.core.conventions import FACES
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions, sample_cube, sample_latlong
from shinypartial.dataset.perturb.options import CameraErrors, Perturbation, SensorErrors, ViewChoice, World
from shinypartial.dataset.perturb.plan import make_plan
from shinypartial.dataset.perturb.worse_copy import perturb
from shinypartial.dataset.read import open_dataset, read_environment, read_view
from shinypartial.dataset.schema import MANIFEST, SPLITS, Dataset
from shinypartial.dataset.validate import validate
from shinypartial.io.images import read_exr_rgb
from tests.support.shiny_blender import make_shiny_blender_dataset
from tests.support.synthetic_dataset import environment_radiance, render_sphere


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A hundred tiny training views all around; tests only read it."""
    return make_shiny_blender_dataset(tmp_path_factory.mktemp("loop") / "ball", 300, resolution=8)


def relative_rotations(dataset: Dataset, options: Perturbation) -> np.ndarray:
    """Rᵀ R' of every view, from the matrices alone."""
    views = make_plan(dataset, options).views
    return np.stack([v.source.camera.camera_to_world[:3, :3].T @ v.camera.camera_to_world[:3, :3] for v in views])


def rotation_vectors_deg(rotations: np.ndarray) -> np.ndarray:
    """Of small rotations: the antisymmetric part, scaled to the angle."""
    across = np.stack([rotations[:, 2, 1], rotations[:, 0, 2], rotations[:, 1, 0]], -1)
    across -= np.stack([rotations[:, 1, 2], rotations[:, 2, 0], rotations[:, 0, 1]], -1)
    sine = np.linalg.norm(across / 2, axis=-1, keepdims=True)
    return np.degrees(np.arcsin(sine)) * across / 2 / sine


def test_each_camera_turns_by_the_angle_about_its_center_and_about_any_axis(loop: Dataset) -> None:
    options = Perturbation(CameraErrors(rotation_deg=3.0))
    rotations = relative_rotations(loop, options)
    angles = np.degrees(np.arccos((np.trace(rotations, axis1=1, axis2=2) - 1) / 2))
    np.testing.assert_allclose(angles, 3.0, rtol=1e-9)
    axes = rotation_vectors_deg(rotations) / 3.0
    # The mean of 100 uniform unit vectors has a length of about 1/√100, their second moments are 1/3.
    assert np.linalg.norm(axes.mean(0)) < 0.3
    np.testing.assert_allclose(axes.T @ axes / len(axes), np.eye(3) / 3, atol=0.12)
    for view in make_plan(loop, options).views:
        np.testing.assert_array_equal(view.camera.position_world, view.source.camera.position_world)


def test_gaussian_rotations_have_their_spread_about_each_axis(loop: Dataset) -> None:
    vectors = rotation_vectors_deg(relative_rotations(loop, Perturbation(CameraErrors(rotation_sigma_deg=2.0))))
    # The standard error of the deviation of 100 values is 7 %.
    np.testing.assert_allclose(vectors.std(0), 2.0, rtol=0.25)
    np.testing.assert_allclose(vectors.mean(0), 0, atol=0.7)


def test_shifts_are_a_share_of_the_distance(loop: Dataset) -> None:
    views = make_plan(loop, Perturbation(CameraErrors(position_sigma=0.05))).views
    shifts = np.stack([view.camera.position_world - view.source.camera.position_world for view in views])
    distance = np.linalg.norm(views[0].source.camera.position_world)  # The cameras look at the origin.
    np.testing.assert_allclose(shifts.std(0), 0.05 * distance, rtol=0.25)
    stated = [np.linalg.norm(view.drawn["shift"]) for view in views]
    np.testing.assert_allclose(np.linalg.norm(shifts, axis=-1), stated)


def test_a_draw_depends_on_the_seed_and_on_nothing_else(loop: Dataset) -> None:
    some = Perturbation(CameraErrors(rotation_deg=1.0), views=ViewChoice(keep=10), seed=4)
    more = replace(some, cameras=CameraErrors(rotation_deg=1.0, position_sigma=0.1), views=ViewChoice())
    drawn = [{view.index: view.drawn["rotation_deg"] for view in make_plan(loop, each).views} for each in (some, more)]
    common = drawn[0].keys() & drawn[1].keys()
    assert common
    assert all(drawn[0][index] == drawn[1][index] for index in common)
    other = make_plan(loop, replace(some, seed=5)).views
    assert all(view.drawn["rotation_deg"] != drawn[0][view.index] for view in other)


def test_a_wrong_lens_is_stated_and_the_test_cameras_stay(sphere_dataset: Dataset, tmp_path: Path) -> None:
    errors = CameraErrors(focal_factor=1.1, principal_point_px=(2.0, -1.0))
    perturb(sphere_dataset.root, tmp_path / "copy", Perturbation(errors))
    copy, before = open_dataset(tmp_path / "copy"), sphere_dataset.train[0].camera
    for frame in copy.train:
        camera = frame.camera
        found = (camera.fx, camera.fy, camera.cx, camera.cy)
        expected = (1.1 * before.fx, 1.1 * before.fy, before.cx + 2, before.cy - 1)
        np.testing.assert_allclose(found, expected)
    stated = json.loads((tmp_path / "copy/transforms_train.json").read_text())
    assert stated["fl_x"] == pytest.approx(1.1 * before.fx)
    assert stated["camera_angle_x"] == pytest.approx(2 * np.arctan(before.width / (2.2 * before.fx)))
    assert copy.test[0].camera.fx == sphere_dataset.test[0].camera.fx


def test_views_are_kept_evenly(loop: Dataset) -> None:
    def kept(**options) -> list[int]:
        return [view.index for view in make_plan(loop, Perturbation(views=ViewChoice(**options), seed=3)).views]

    assert kept() == list(range(100))
    even = kept(keep=7)
    assert len(even) == 7
    assert set(np.diff(even)) <= {14, 15}


def test_an_arc_holds_exactly_the_cameras_near_its_middle(sphere_dataset: Dataset) -> None:
    # Azimuths are evenly spaced from −60° to 60° about +X, six of them.
    for arc_deg, expected in ((130.0, [0, 1, 2, 3, 4, 5]), (73.0, [1, 2, 3, 4]), (25.0, [2, 3])):
        views = make_plan(sphere_dataset, Perturbation(views=ViewChoice(arc_deg=arc_deg))).views
        assert [view.index for view in views] == expected
    with pytest.raises(InputError, match="arc-deg"):
        make_plan(sphere_dataset, Perturbation(views=ViewChoice(arc_deg=10.0)))


@pytest.mark.parametrize("views", [ViewChoice(object_scale=0.6), ViewChoice(object_scale=0.8, cut=0.3)])
def test_the_stated_camera_sees_what_a_smaller_or_cut_picture_shows(
    sphere_dataset: Dataset, tmp_path: Path, views: ViewChoice
) -> None:
    perturb(sphere_dataset.root, tmp_path / "copy", Perturbation(views=views))
    for frame in open_dataset(tmp_path / "copy").train:
        found, traced = read_view(frame), render_sphere(frame.camera)
        assert np.abs(found.alpha - traced.alpha).max() < 0.25  # Averages of pixels have softer edges; measured 0.18.
        assert np.abs(found.alpha - traced.alpha).mean() < 0.015
        solid = (found.alpha > 0.99) & (traced.alpha > 0.99)
        facing = np.degrees(np.arccos(np.clip((found.normals_world * traced.normals_world).sum(-1)[solid], -1, 1)))
        assert np.median(facing) < 1
        np.testing.assert_allclose(found.depth[solid], traced.depth[solid], atol=0.1)


def test_a_point_stays_on_its_picture_when_that_shrinks(loop: Dataset) -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    for view in make_plan(loop, Perturbation(views=ViewChoice(object_scale=0.5, keep=3))).views:
        before, after = (project(camera, points) for camera in (view.source.camera, view.camera))
        middle = np.array([4.0, 4.0])
        np.testing.assert_allclose(after[:, :2] - middle, 0.5 * (before[:, :2] - middle))


def test_the_cut_takes_its_share_of_the_object(sphere_dataset: Dataset, tmp_path: Path) -> None:
    perturb(sphere_dataset.root, tmp_path / "copy", Perturbation(views=ViewChoice(cut=0.25)))

    def size(dataset: Dataset) -> np.ndarray:
        """Columns of the object and of the picture."""
        masks = [read_view(frame).alpha >= 0.5 for frame in dataset.train]
        return np.array([[np.ptp(np.nonzero(mask)[1]) + 1, mask.shape[1]] for mask in masks])

    before, after = size(sphere_dataset), size(open_dataset(tmp_path / "copy"))
    # The sphere is 21 pixels wide: a crop at a whole pixel is off by up to half of one.
    np.testing.assert_allclose((before - after)[:, 0] / before[:, 0], 0.25, atol=0.6 / 21)
    assert len(set((before - after)[:, 1])) == 1, "All pictures are cropped equally."
    drawn = json.loads((tmp_path / "copy" / MANIFEST).read_text())["statistics"]["drawn"]
    np.testing.assert_allclose([each["cut"] for each in drawn.values()], 0.25, atol=0.6 / 21)


def test_a_turned_world_shows_the_same_reflections(sphere_dataset: Dataset, tmp_path: Path) -> None:
    options = Perturbation(world=World((20.0, -30.0, 50.0), random_turn=True))
    turn = perturb(sphere_dataset.root, tmp_path / "copy", options).plan.turn
    assert turn is not None
    copy = open_dataset(tmp_path / "copy")
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    for split in SPLITS:
        for frame, original in zip(copy.split(split), sphere_dataset.split(split), strict=True):
            view, before = read_view(frame), read_view(original)
            np.testing.assert_array_equal(view.radiance, before.radiance)
            solid = view.alpha > 0.99
            seen = reflect(ray_directions_world(frame.camera), view.normals_world)[solid]
            np.testing.assert_allclose(environment_radiance(seen @ turn), view.radiance[solid], rtol=2e-3)
    assert [each for each in validate(tmp_path / "copy") if not each.warning] == []


def test_a_turned_environment_answers_turned_directions(sphere_dataset: Dataset, tmp_path: Path) -> None:
    turn = perturb(sphere_dataset.root, tmp_path / "copy", Perturbation(world=World((0.0, 0.0, 90.0)))).plan.turn
    np.testing.assert_allclose(turn, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    before, after = read_environment(sphere_dataset), read_environment(open_dataset(tmp_path / "copy"))
    # A quarter turn about +Z moves the map by a quarter of its width: azimuth grows to the left.
    np.testing.assert_allclose(after, np.roll(before, -before.shape[1] // 4, axis=1), rtol=2e-3)
    cube = np.stack([read_exr_rgb(tmp_path / f"copy/environment/cube/{name}.exr") for name in FACES])
    directions = latlong_directions(12)
    turned = sample_cube(cube, directions @ turn.T)
    np.testing.assert_allclose(turned, sample_latlong(before, directions), rtol=0.15, atol=0.05)


def test_a_world_turned_twice_differs_by_seed_only(loop: Dataset) -> None:
    turns = [make_plan(loop, Perturbation(world=World(random_turn=True), seed=seed)).turn for seed in (0, 0, 1)]
    np.testing.assert_array_equal(turns[0], turns[1])
    assert np.abs(turns[0] - turns[2]).max() > 0.1


def test_exposure_and_white_balance_have_their_spread(loop: Dataset) -> None:
    views = make_plan(loop, Perturbation(sensor=SensorErrors(exposure_sigma_stops=0.5))).views
    stops = np.stack([view.stops for view in views])
    assert np.ptp(stops, axis=1).max() == 0, "The exposure is that of all channels."
    assert abs(stops[:, 0].std() - 0.5) < 0.12
    balance = make_plan(loop, Perturbation(sensor=SensorErrors(white_balance_sigma_stops=0.3))).views
    stops = np.stack([view.stops for view in balance])
    np.testing.assert_allclose(stops.std(0), 0.3, rtol=0.25)
    assert np.abs(np.corrcoef(stops.T) - np.eye(3)).max() < 0.35
