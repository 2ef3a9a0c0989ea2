"""Camera paths: what the vase's arc looks like, even spread of both splits, and the hemisphere that holds them."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shinypartial.camera import project
from shinypartial.errors import InputError
from shinypartial.trajectory import Arc, arc, arc_angles_deg, check_hemisphere, train_indices, unit_vectors

COUNTS = st.integers(1, 60)


def test_the_default_path_has_five_level_sweeps_walked_back_and_forth() -> None:
    azimuth, elevation = arc_angles_deg(Arc(), 300).T
    np.testing.assert_allclose(elevation.reshape(5, 60), np.repeat([[-10], [5], [20], [35], [50]], 60, 1))
    forward = np.linspace(-165, -15, 60)
    np.testing.assert_allclose(azimuth.reshape(5, 60)[::2], np.tile(forward, (3, 1)))
    np.testing.assert_allclose(azimuth.reshape(5, 60)[1::2], np.tile(forward[::-1], (2, 1)))


def test_every_third_view_of_the_default_path_is_for_training() -> None:
    assert sorted(train_indices(100, 300)) == list(range(1, 300, 3))


@given(train=COUNTS, test=COUNTS)
def test_training_views_are_spread_evenly(train: int, test: int) -> None:
    chosen = sorted(train_indices(train, train + test))
    assert len(chosen) == train
    assert 0 <= chosen[0] <= chosen[-1] < train + test
    gaps = set(np.diff(chosen).tolist())
    assert not gaps or max(gaps) - min(gaps) <= 1


@given(train=COUNTS, test=COUNTS, sweeps=st.integers(1, 7), facing=st.floats(-180, 180))
def test_every_camera_is_at_the_radius_looks_at_the_target_and_stays_in_the_hemisphere(
    train: int, test: int, sweeps: int, facing: float
) -> None:
    target = (0.3, -0.2, 0.1)
    spec = Arc(train=train, test=test, sweeps=sweeps, facing_azimuth_deg=facing, target=target)
    path = arc(spec, 64)
    assert (len(path.train), len(path.test)) == (train, test)
    positions = np.stack([camera.position_world for camera in (*path.train, *path.test)])
    assert len(np.unique(positions.round(9), axis=0)) == train + test
    for camera in (*path.train, *path.test):
        offset = camera.position_world - target
        assert np.linalg.norm(offset) == pytest.approx(spec.radius)
        assert offset @ path.hemisphere_axis > 0
        # The optical axis meets the target at the image center, in front.
        np.testing.assert_allclose(project(camera, np.array([target]))[0], [32, 32, spec.radius], atol=1e-9)


def test_focal_length_follows_lens_and_sensor() -> None:
    camera = arc(Arc(lens_mm=50, sensor_mm=36), 800).train[0]
    assert camera.fx == camera.fy == pytest.approx(800 * 50 / 36)
    assert (camera.cx, camera.cy, camera.width, camera.height) == (400, 400, 800, 800)


def test_angles_turn_from_x_toward_y_and_up() -> None:
    angles = np.array([[0.0, 0.0], [90.0, 0.0], [-90.0, 0.0], [0.0, 90.0]])
    np.testing.assert_allclose(unit_vectors(angles), [[1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], atol=1e-15)


def test_a_camera_outside_the_hemisphere_is_refused() -> None:
    path = arc(Arc(azimuth_deg=(-80.0, 80.0)), 64)
    with pytest.raises(InputError, match="outside"):
        check_hemisphere(path.train, -path.hemisphere_axis, np.zeros(3))


def test_an_arc_of_180_degrees_is_refused() -> None:
    with pytest.raises(InputError, match="azimuth_deg"):
        arc(dataclasses.replace(Arc(), azimuth_deg=(-90.5, 75.0)), 64)
