"""Pixel → ray and point → pixel are inverse to each other, and reflection is a self-adjoint involution."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import camera_rays, pixel_rays, pose_of, project, raster_camera, reflect, unit_rays_camera
from panoless.kernels.camera import RasterCamera
from shinypartial.core.camera import Camera, look_at, ray_directions_world
from shinypartial.core.camera import project as project_world

CAMERA = Camera(look_at(np.array([2.0, -3.0, 1.0]), np.array([0.1, 0.2, 0.3])), 50.0, 60.0, 11.3, 8.7, 24, 18)
FRAME = ObjectFrame(np.array([0.2, -0.1, 0.4]), 1.7)
seeds = st.integers(0, 2**32 - 1)


def normalized() -> RasterCamera:
    return raster_camera(CAMERA, FRAME, 0.1)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@given(seeds, st.floats(0.2, 50))
def test_a_point_on_the_ray_of_a_pixel_is_seen_there(seed: int, depth: float) -> None:
    x, y = np.random.default_rng(seed).uniform(-30, 60, (2, 4, 5))
    points = depth * camera_rays(CAMERA, x, y)
    for places in (project(normalized(), points), project(normalized(), torch.from_numpy(points))):
        np.testing.assert_allclose(np.stack([np.asarray(place) for place in places]), [x, y], atol=1e-10)


def test_indices_count_from_the_first_center_and_what_is_too_near_is_moved_to_the_near_plane() -> None:
    center = camera_rays(CAMERA, np.array([0.5]), np.array([0.5]))
    np.testing.assert_allclose(np.stack(project(normalized(), center, first_center=0)), 0, atol=1e-12)
    behind = np.array([[0.03, 0.02, -5.0]])
    np.testing.assert_array_equal(
        project(normalized(), behind), project(normalized(), behind * [1, 1, 0] + [0, 0, 0.1])
    )


def test_pixel_rays_are_those_of_the_benchmark() -> None:
    """To single precision, in which the rasterizer keeps its pose, and so are those in the camera frame."""
    everything = np.arange(CAMERA.width * CAMERA.height)
    expected = ray_directions_world(CAMERA).reshape(-1, 3)
    origins, directions = pixel_rays(normalized(), everything)
    np.testing.assert_allclose(unit(directions), expected, atol=1e-6)
    np.testing.assert_allclose(
        origins * FRAME.radius + FRAME.center, CAMERA.position_world[None] + 0 * origins, atol=1e-6
    )
    rotation, _ = pose_of(normalized())
    rays = unit_rays_camera(normalized()).numpy().reshape(3, -1)
    np.testing.assert_allclose(rays.T @ rotation, expected, atol=1e-6)


def test_projection_is_that_of_the_benchmark() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3))
    rotation, center = pose_of(normalized())
    places = project(normalized(), ((points - FRAME.center) / FRAME.radius - center) @ rotation.T)
    np.testing.assert_allclose(np.stack(places, 1), project_world(CAMERA, points)[:, :2], atol=1e-4)


@given(seeds)
def test_reflection_is_a_self_adjoint_isometric_involution(seed: int) -> None:
    v, w, n = np.random.default_rng(seed).normal(size=(3, 7, 3))
    n = unit(n)
    np.testing.assert_allclose((reflect(v, n) * w).sum(-1), (v * reflect(w, n)).sum(-1), atol=1e-12)
    np.testing.assert_allclose(reflect(reflect(v, n), n), v, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(reflect(v, n), axis=-1), np.linalg.norm(v, axis=-1), atol=1e-13)
    np.testing.assert_allclose(reflect(n, n), -n, atol=1e-14)
    np.testing.assert_allclose(reflect(v, -n), reflect(v, n), atol=1e-14)
    np.testing.assert_array_equal(reflect(torch.from_numpy(v), torch.from_numpy(n)).numpy(), reflect(v, n))
