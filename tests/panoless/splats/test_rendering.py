"""Deferred shading, equation by equation (paper Eqs. 2, 3, 5, 6 and 8)."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn.functional import normalize

from panoless.kernels.camera import RasterCamera
from panoless.splats.kernels.reference.rasterize import rotation_matrices
from panoless.splats.model import Surfels
from panoless.splats.rendering import compose, rasterize_surfels, reflection_directions_world, surface_buffers
from shinypartial.core.camera import reflect
from tests.support.mirror_sphere import sphere_surfels

IDENTITY = torch.eye(3, dtype=torch.float64)
seeds = st.integers(0, 10_000)


def unit(seed: int, count: int = 20) -> torch.Tensor:
    """Random unit vectors, as columns."""
    generator = torch.Generator().manual_seed(seed)
    return normalize(torch.randn(3, count, generator=generator, dtype=torch.float64), dim=0)


def random_rotation(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return rotation_matrices(torch.randn(1, 4, generator=generator, dtype=torch.float64))[0]


def camera_before(distance: float) -> RasterCamera:
    """Looks along +z at the origin."""
    matrix = torch.eye(4)
    matrix[2, 3] = distance
    return RasterCamera(matrix, 40.0, 40.0, 16.0, 16.0, 32, 32)


def buffers_of(surfels: Surfels, depth_blend: float):
    return surface_buffers(surfels, camera_before(3.0), curved=True, depth_blend=depth_blend)


@pytest.mark.parametrize("depth_blend", [0.0, 0.3, 0.5, 1.0])
def test_surface_depth_blends_expected_and_median(depth_blend: float) -> None:
    """Eq. 3."""
    surfels = sphere_surfels(300, opacity_logit=0.0)
    buffers, expected, median = (buffers_of(surfels, blend) for blend in (depth_blend, 0.0, 1.0))
    inside = buffers.alpha > 0.5
    assert inside.any()
    assert (expected.depth - median.depth)[inside].abs().max() > 0.01
    torch.testing.assert_close(buffers.depth, (1 - depth_blend) * expected.depth + depth_blend * median.depth)


def test_depths_of_an_opaque_sphere_are_those_of_its_surface() -> None:
    # The ray through (16.5, 16.5) meets the near pole at depth 2; flat disks of 0.045 lie within 0.01 of it.
    for blend in (0.0, 1.0, 0.5):
        buffers = buffers_of(sphere_surfels(4000), blend)
        assert float(buffers.depth[16, 16]) == pytest.approx(2.0, abs=0.01)
    assert float(buffers.alpha[16, 16]) == pytest.approx(1.0, abs=1e-3)
    torch.testing.assert_close(
        normalize(buffers.normals_camera[:, 16, 16], dim=0), torch.tensor([0.0, 0.0, -1.0]), rtol=0, atol=0.03
    )


def test_an_attribute_takes_the_place_of_the_albedo() -> None:
    surfels = sphere_surfels(300, opacity_logit=0.0)
    ones = torch.ones(surfels.count, 3)
    buffers = rasterize_surfels(surfels, camera_before(3.0), curved=False, attribute=ones)
    torch.testing.assert_close(buffers.colors, buffers.alpha.expand(3, -1, -1))
    assert float(buffers_of(surfels, 0.0).albedo.abs().max()) == 0.0


@given(seeds)
def test_reflection_obeys_the_law_of_reflection(seed: int) -> None:
    """Eq. 5: unit, in the plane of ray and normal, equal angles on both sides of the normal."""
    rays, normals = unit(seed), unit(seed + 1)
    reflected = reflection_directions_world(normals, rays, IDENTITY).T
    torch.testing.assert_close(reflected.norm(dim=0), torch.ones(20, dtype=torch.float64))
    torch.testing.assert_close((reflected * normals).sum(0), -(rays * normals).sum(0))
    volume = (torch.linalg.cross(rays, normals, dim=0) * reflected).sum(0)
    torch.testing.assert_close(volume, torch.zeros_like(volume), rtol=0, atol=1e-12)
    along_surface = rays - (rays * normals).sum(0) * normals
    assert ((reflected * along_surface).sum(0) >= 0).all()


@given(seeds, st.floats(1e-3, 1e3))
def test_length_and_sign_of_the_normal_do_not_matter(seed: int, factor: float) -> None:
    rays, normals = unit(seed), unit(seed + 1)
    expected = reflection_directions_world(normals, rays, IDENTITY)
    torch.testing.assert_close(reflection_directions_world(-factor * normals, rays, IDENTITY), expected)


@given(seeds)
def test_reflection_commutes_with_rotation(seed: int) -> None:
    rays, normals, rotation = unit(seed), unit(seed + 1), random_rotation(seed)
    in_camera = reflection_directions_world(normals, rays, rotation)
    torch.testing.assert_close(reflection_directions_world(rotation @ normals, rotation @ rays, IDENTITY), in_camera)
    expected = reflect((rotation @ rays).T.numpy(), (rotation @ normals).T.numpy())
    np.testing.assert_allclose(in_camera.numpy(), expected, atol=1e-12)


def test_a_normal_of_zero_reflects_nothing_and_stays_finite() -> None:
    normals = torch.zeros(3, 5, dtype=torch.float64, requires_grad=True)
    reflected = reflection_directions_world(normals, unit(0, 5), IDENTITY)
    reflected.sum().backward()
    assert torch.isfinite(reflected).all()
    assert torch.isfinite(normals.grad).all()


@given(seeds, st.floats(1e-6, 1e-4))
def test_a_small_error_of_the_normal_is_amplified_at_most_as_eq_6_says(seed: int, size: float) -> None:
    rays, normals = unit(seed), unit(seed + 1)
    tangent = torch.linalg.cross(normals, unit(seed + 2), dim=0)
    error = size * normalize(tangent, dim=0)
    before = reflection_directions_world(normals, rays, IDENTITY).T
    change = reflection_directions_world(normals + error, rays, IDENTITY).T - before
    cosine = (rays * normals).sum(0)
    first_order = -2 * (cosine * error + (rays * error).sum(0) * normals)
    # What Eq. 6 drops is of second order: at most 8 size².
    assert ((change - first_order).norm(dim=0) <= 8 * size**2).all()
    assert (change.norm(dim=0) <= 2 * (cosine.abs() + 1) * size + 8 * size**2).all()


def test_composition_by_hand() -> None:
    """Eq. 8: a blended albedo holds alpha already, the specular term does not."""
    albedo = torch.tensor([[0.1], [0.2], [0.0]])
    specular = torch.tensor([[1.0], [0.5], [0.25]])
    alpha = torch.tensor([0.5])
    once = compose(albedo, specular, alpha, "once")
    torch.testing.assert_close(once, torch.tensor([[0.6], [0.45], [0.125]]))
    paper = compose(albedo, specular, alpha, "paper")
    torch.testing.assert_close(paper, torch.tensor([[0.55], [0.35], [0.125]]))


@pytest.mark.parametrize("alpha_applied", ["once", "paper"])
def test_both_compositions_agree_where_the_surface_is_opaque(alpha_applied: str) -> None:
    albedo, specular = torch.rand(3, 4, 5), torch.rand(3, 4, 5)
    torch.testing.assert_close(compose(albedo, specular, torch.ones(4, 5), alpha_applied), albedo + specular)


def test_rotation_columns_are_a_right_handed_frame() -> None:
    turn = math.sqrt(0.5)
    matrix = rotation_matrices(torch.tensor([[turn, 0.0, 0.0, turn]]) * 3.0)[0]
    # A quarter turn about z: x to y, y to −x.
    torch.testing.assert_close(matrix, torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert float(torch.linalg.det(random_rotation(3))) == pytest.approx(1.0)
