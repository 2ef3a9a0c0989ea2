"""Pixels ⇄ rays, OpenGL ⇄ OpenCV axes, look-at and the poses that are refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shinypartial.core.camera import (
    Camera,
    check_pose,
    look_at,
    opencv_to_opengl,
    opengl_to_opencv,
    project,
    ray_directions_world,
    reflect,
)
from shinypartial.core.errors import InputError

coordinates = st.floats(-5, 5)
positions = st.tuples(coordinates, coordinates, coordinates).map(np.array)
seeds = st.integers(0, 10_000)


def any_camera(seed: int) -> Camera:
    """A camera with unequal focal lengths, a principal point off the center and a position away from the pole."""
    generator = np.random.default_rng(seed)
    azimuth, height = generator.uniform(-np.pi, np.pi), generator.uniform(-1, 2)
    position = np.array([3 * np.cos(azimuth), 3 * np.sin(azimuth), height])
    pose = look_at(position, generator.uniform(-0.5, 0.5, 3))
    return Camera(pose, fx=21.0, fy=17.0, cx=8.3, cy=6.1, width=16, height=12)


@given(seeds)
def test_opengl_and_opencv_poses_are_inverse(seed: int) -> None:
    pose = any_camera(seed).camera_to_world
    np.testing.assert_array_equal(opencv_to_opengl(opengl_to_opencv(pose)), pose)
    np.testing.assert_array_equal(opengl_to_opencv(opencv_to_opengl(pose)), pose)


def test_opengl_camera_looks_along_its_negative_z_with_y_up() -> None:
    opencv = opengl_to_opencv(np.eye(4))
    np.testing.assert_array_equal(opencv @ [0, 0, 1, 0], [0, 0, -1, 0])
    np.testing.assert_array_equal(opencv @ [0, 1, 0, 0], [0, -1, 0, 0])
    np.testing.assert_array_equal(opencv @ [1, 0, 0, 0], [1, 0, 0, 0])


@given(seeds, st.floats(0.1, 50))
def test_a_point_on_a_pixel_ray_projects_to_the_pixel_center(seed: int, distance: float) -> None:
    camera = any_camera(seed)
    points = camera.position_world + distance * ray_directions_world(camera).reshape(-1, 3)
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    projected = project(camera, points)
    # Measured 3e-12 px for points at 0.1 seen from 5 units off the origin, where float64 cancels most.
    np.testing.assert_allclose(projected[:, 0], column.ravel() + 0.5, atol=1e-9)
    np.testing.assert_allclose(projected[:, 1], row.ravel() + 0.5, atol=1e-9)
    assert (projected[:, 2] > 0).all()


@given(seeds)
def test_projected_depth_is_z_and_not_distance(seed: int) -> None:
    camera = any_camera(seed)
    forward = camera.camera_to_world[:3, 2]
    directions = ray_directions_world(camera).reshape(-1, 3)
    depth = project(camera, camera.position_world + 3.0 * directions)[:, 2]
    np.testing.assert_allclose(depth, 3.0 * directions @ forward, atol=1e-12)
    assert project(camera, (camera.position_world - forward)[None])[0, 2] == pytest.approx(-1.0)


@given(seeds)
def test_rays_are_unit(seed: int) -> None:
    lengths = np.linalg.norm(ray_directions_world(any_camera(seed)), axis=-1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-14)


def test_the_center_pixel_looks_along_the_camera_axis() -> None:
    pose = look_at(np.array([4.0, 1.0, 2.0]), np.zeros(3))
    camera = Camera(pose, fx=30.0, fy=30.0, cx=4.5, cy=3.5, width=9, height=7)
    np.testing.assert_allclose(ray_directions_world(camera)[3, 4], pose[:3, 2], atol=1e-15)


def test_image_right_and_down_are_the_camera_axes() -> None:
    camera = any_camera(1)
    rays = ray_directions_world(camera)
    right, down = camera.camera_to_world[:3, 0], camera.camera_to_world[:3, 1]
    assert (np.diff(rays @ right, axis=1) > 0).all()
    assert (np.diff(rays @ down, axis=0) > 0).all()


@given(positions, positions)
def test_look_at_is_rigid_faces_the_target_and_keeps_the_horizon(position: np.ndarray, target: np.ndarray) -> None:
    sight = target - position
    if np.linalg.norm(sight[:2]) < 1e-3:
        return
    pose = look_at(position, target)
    check_pose(pose, "the camera")
    right, down, forward = pose[:3, :3].T
    np.testing.assert_allclose(forward, sight / np.linalg.norm(sight), atol=1e-14)
    assert abs(right[2]) < 1e-12, "The image's horizontal axis lies in the world's horizontal plane."
    assert down[2] < 0, "World up points upward in the image."
    np.testing.assert_array_equal(pose[:3, 3], position)


@pytest.mark.parametrize("height", [3.0, -3.0])
def test_look_at_refuses_a_vertical_view(height: float) -> None:
    with pytest.raises(InputError, match="straight up or down"):
        look_at(np.array([0.0, 0.0, height]), np.zeros(3))


def _changed(index: tuple[int, int] | slice, value: float) -> np.ndarray:
    pose = np.eye(4)
    pose[index] = value
    return pose


BAD_POSES = {
    "three rows": np.eye(4)[:3],
    "flat": np.eye(4).ravel(),
    "NaN": _changed((0, 3), np.nan),
    "infinite": _changed((1, 1), np.inf),
    "too far for its square": _changed((0, 3), 1e200),
    "singular": _changed((2, 2), 0.0),
    "scaled": np.diag([2.0, 2.0, 2.0, 1.0]),
    "sheared": _changed((0, 1), 0.1),
    "mirrored": np.diag([1.0, 1.0, -1.0, 1.0]),
    "projective": _changed((3, 0), 0.5),
    "transposed": _changed((slice(0, 3), 3), 1.0).T,
}


@pytest.mark.parametrize("pose", BAD_POSES.values(), ids=BAD_POSES.keys())
def test_bad_poses_are_refused_by_name(pose: np.ndarray) -> None:
    with pytest.raises(InputError, match="train/r_007") as caught:
        check_pose(pose, "train/r_007")
    assert "transform_matrix" in caught.value.remedy


@given(seeds)
def test_world_to_camera_is_the_inverse_pose(seed: int) -> None:
    camera = any_camera(seed)
    np.testing.assert_allclose(camera.world_to_camera @ camera.camera_to_world, np.eye(4), atol=1e-13)


@given(seeds)
def test_reflection_is_an_involution_that_turns_only_the_normal_part(seed: int) -> None:
    generator = np.random.default_rng(seed)
    rays, normals = generator.normal(size=(2, 20, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    reflected = reflect(rays, normals)
    np.testing.assert_allclose(reflect(reflected, normals), rays, atol=1e-14)
    np.testing.assert_allclose(np.sum(reflected * normals, -1), -np.sum(rays * normals, -1), atol=1e-14)
    np.testing.assert_allclose(np.cross(reflected - rays, normals), 0, atol=1e-14)
    np.testing.assert_allclose(reflect(-normals, normals), normals, atol=1e-14)
