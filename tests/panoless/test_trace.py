"""Reflected rays that meet the object again: who sees whom is known for spheres, a bowl and parallel mirrors."""

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.kernels.cpu.trace import Picture
from panoless.trace import (
    HALF_SIDE,
    TracedSurface,
    first_hits,
    fuse_pictures,
    fuse_surface,
    leaving_directions,
    sees_itself,
)
from panoless.views import Views
from tests.panoless.test_observation import exact_sphere

RESOLUTION = 96
VOXEL = 2 * HALF_SIDE / (RESOLUTION - 1)


def grid_points() -> Float[np.ndarray, "N N N 3"]:
    line = np.linspace(-HALF_SIDE, HALF_SIDE, RESOLUTION)
    return np.stack(np.meshgrid(line, line, line, indexing="ij"), -1)


def traced(distance: Float[np.ndarray, "N N N"]) -> TracedSurface:
    """The surface of an exact distance in scene units, with the distance's own gradient for normals."""
    normals = np.stack(np.gradient(distance, VOXEL), -1).astype(np.float32)
    return TracedSurface((distance / VOXEL).astype(np.float32), normals, VOXEL)


def unit(vectors: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def random_unit(count: int, seed: int) -> Float[np.ndarray, "P 3"]:
    return unit(np.random.default_rng(seed).normal(size=(count, 3)))


def tensors(*arrays: np.ndarray) -> list[Tensor]:
    return [torch.from_numpy(np.ascontiguousarray(array)).float() for array in arrays]


def test_a_sphere_never_sees_itself_and_the_inside_of_one_always_does() -> None:
    normals, directions = random_unit(20_000, 0), random_unit(20_000, 1)
    directions *= np.sign((directions * normals).sum(1, keepdims=True))
    radius = 0.6
    outside = np.linalg.norm(grid_points(), axis=-1) - radius
    leaving = tensors(radius * normals, normals, directions)
    assert not first_hits(traced(outside), *leaving).found.any()
    # A bowl: what is farther from the center than the radius is solid, and normals point inward.
    bowl = first_hits(traced(-outside), *tensors(-radius * normals, normals, directions))
    # A chord of a sphere is 2 r cos θ long; those shorter than a few voxels aren't told from the start.
    cosine = (directions * normals).sum(1)
    long = torch.from_numpy(2 * radius * cosine > 8 * VOXEL)
    assert bowl.found[long].all()
    ends = -radius * normals + 2 * radius * cosine[:, None] * directions
    error = (bowl.points - torch.from_numpy(ends).float()).norm(dim=1)[long & torch.from_numpy(cosine > 0.5)]
    assert error.max() < VOXEL


def test_two_spheres_see_each_other_as_a_quadratic_equation_says() -> None:
    """Rays in random directions from one sphere meet the other where |o + t d − c|² = r² has a root t > 0."""
    radius, center = 0.35, np.array([0.5, 0.0, 0.0])
    points = grid_points()
    distance = np.minimum(*(np.linalg.norm(points - side * center, axis=-1) - radius for side in (-1, 1)))
    normals, directions = random_unit(40_000, 2), random_unit(40_000, 3)
    directions *= np.sign((directions * normals).sum(1, keepdims=True))
    origins = -center + radius * normals
    found = first_hits(traced(distance), *tensors(origins, normals, directions)).found.numpy()
    toward = origins - center
    along = (toward * directions).sum(1)
    root = along**2 - (toward**2).sum(1) + radius**2
    true = (along < 0) & (root > 0)
    assert true.mean() > 0.03
    assert (found & true).sum() / found.sum() > 0.95
    assert (found & true).sum() / true.sum() > 0.95


@pytest.mark.parametrize("angle_deg", [35.0, 50.0])
def test_between_parallel_mirrors_a_ray_bounces_as_often_as_the_gap_allows(angle_deg: float) -> None:
    """Each crossing of the gap g moves the ray by g tan θ; it leaves where that ends beyond the mirrors' edge."""
    gap, edge, thickness = 0.4, 0.7, 0.3
    points = grid_points()
    beyond = [np.abs(points[..., 0]) - edge, np.abs(points[..., 1]) - edge]
    beyond.append(np.abs(np.abs(points[..., 2]) - (gap + thickness) / 2) - thickness / 2)
    outside = np.stack(beyond)
    distance = np.linalg.norm(np.maximum(outside, 0), axis=0) + np.minimum(outside.max(0), 0)
    angle = np.radians(angle_deg)
    starts = np.linspace(-0.65, 0.65, 200)
    origins = np.stack([starts, 0 * starts, 0 * starts - gap / 2], 1)
    normals = np.tile([0.0, 0.0, 1.0], (200, 1))
    directions = np.tile([np.sin(angle), 0.0, np.cos(angle)], (200, 1))
    crossings = np.floor((edge - starts) / (gap * np.tan(angle)))
    for bounces in (1, 3):
        found = leaving_directions(traced(distance), *tensors(origins, normals, directions), bounces=bounces)
        expected = np.where(np.minimum(crossings, bounces) % 2 == 0, 1, -1) * np.cos(angle)
        share = (edge - starts) / (gap * np.tan(angle)) % 1
        clear = (np.minimum(share, 1 - share) > 0.25) | (crossings > bounces)
        assert clear.sum() > 60
        np.testing.assert_allclose(found[clear, 2].numpy(), expected[clear], atol=0.03)
        np.testing.assert_allclose(found[clear, 0].numpy(), np.sin(angle), atol=0.03)


def test_depth_maps_of_a_sphere_give_its_distance() -> None:
    """Twelve cameras around the sphere; distances agree within the band to a tenth of a voxel."""
    radius, away, size = 0.7, 4.0, 200
    focal = float(size)
    pixels = (np.indices((size, size))[::-1] + 0.5 - size / 2) / focal
    rays = np.stack([pixels[0], pixels[1], np.ones_like(pixels[0])], -1)
    half = rays[..., 2] * away
    root = half**2 - (rays**2).sum(-1) * (away**2 - radius**2)
    depth = np.where(root > 0, (half - np.sqrt(np.maximum(root, 0))) / (rays**2).sum(-1), 0)
    normals = np.where(root[..., None] > 0, (rays * depth[..., None] - [0, 0, away]) / radius, 0)
    pictures = []
    for towards in random_unit(12, 4):
        # The camera's third axis looks at the origin from `away`.
        first = unit(np.cross(towards, [0.3, 0.5, 0.8])[None])[0]
        pose = np.eye(4)
        pose[:3, :3] = np.stack([first, np.cross(towards, first), towards])
        pose[2, 3] = away
        arrays = (np.ascontiguousarray(each, np.float32) for each in (depth, normals, pose))
        pictures.append(Picture(*arrays, tuple(np.float32(x) for x in (focal, focal, size / 2, size / 2))))
    surface = fuse_pictures(pictures, RESOLUTION)
    exact = (np.linalg.norm(grid_points(), axis=-1) - radius) / VOXEL
    near = np.abs(exact) < 2
    # A pixel's tangent plane stands in for the surface within a pixel.
    assert np.abs(surface.distance - exact)[near].mean() < 0.1
    assert (surface.distance[exact > 4] > 2).all()
    assert (surface.distance[exact < -4] < 0).all()
    near = (np.abs(exact) < 0.5) & surface.normals_world.any(-1)
    cosine = (unit(surface.normals_world[near]) * unit(grid_points()[near])).sum(1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 1


def test_a_sphere_of_surfels_is_not_seen_in_itself(views: Views) -> None:
    surfels = exact_sphere(views)
    surface = fuse_surface(views, surfels, curved=True)
    pixels = sum(len(view.solid) for view in views.train)
    assert sum(int(sees_itself(surface, view, surfels, curved=True).sum()) for view in views.train) < 0.01 * pixels
