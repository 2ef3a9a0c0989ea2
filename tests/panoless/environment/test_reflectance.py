"""A metal's reflectance comes back from directions that are seen at different angles, and only from these."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.environment.rays import Rays
from panoless.environment.reflectance import (
    Reflectance,
    cosines_of_incidence,
    find_reflectance,
    lamp_light,
    left_unexplained,
    unsaturated,
)
from panoless.kernels.cubemap import cubemap_directions
from shinypartial.core.sphere import cube_solid_angles, flat_texels

GOLD = np.array([1.0, 0.77, 0.34])
PALE = 0.75 * GOLD
RESOLUTION = 8
OUTGOING = cubemap_directions(8).reshape(-1, 3).double()
LIGHT = torch.rand(len(OUTGOING), 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64) / 2 + 0.1


def rays_at(angle_deg: float) -> Rays:
    """The center of each texel, mirrored at that angle of incidence by gold: v = ω − 2 cos θ n."""
    helper = torch.tensor([0.3, 0.5, 0.8], dtype=torch.float64)
    across = torch.linalg.cross(OUTGOING, helper.expand_as(OUTGOING))
    across = across / across.norm(dim=1, keepdim=True)
    cosine = float(np.cos(np.radians(angle_deg)))
    normals = cosine * OUTGOING + (1 - cosine**2) ** 0.5 * across
    share = GOLD + (1 - GOLD) * (1 - cosine) ** 5
    incoming = OUTGOING - 2 * cosine * normals
    return Rays(OUTGOING.float(), (LIGHT * torch.from_numpy(share)).float(), incoming=incoming.float())


def joined(*parts: Rays) -> Rays:
    assert all(part.incoming is not None for part in parts)
    directions, radiance, incoming = (
        torch.cat([getattr(part, name) for part in parts]) for name in ("directions", "radiance", "incoming")
    )
    return Rays(directions, radiance, incoming=incoming)


def test_two_rays_tell_the_angle_at_which_they_were_mirrored() -> None:
    assert cosines_of_incidence(rays_at(60)) == pytest.approx(0.5, abs=1e-6)


def test_two_angles_tell_all_of_a_metal() -> None:
    """Without noise exactly, brightness included: light that grazes is mirrored whole."""
    rays = joined(rays_at(20), rays_at(75))
    found = find_reflectance(rays, RESOLUTION)
    assert found.at_normal == pytest.approx(GOLD, abs=2e-3)
    assert np.abs(left_unexplained(rays, Reflectance(GOLD), RESOLUTION)).max() < 1e-6


def test_one_angle_tells_nothing() -> None:
    """Color of the light and of the mirror are one product."""
    rays = rays_at(50)
    assert find_reflectance(rays, RESOLUTION).tint == (1, 1, 1)
    for each in (Reflectance(np.ones(3)), Reflectance(GOLD)):
        assert np.abs(left_unexplained(rays, each, RESOLUTION)).max() < 1e-6


def test_some_wrong_rays_change_little() -> None:
    """Every tenth is of another color."""
    rays = joined(rays_at(20), rays_at(50), rays_at(75), rays_at(80))
    rays.radiance[::10] = 0.9
    assert find_reflectance(rays, RESOLUTION).at_normal == pytest.approx(GOLD, abs=0.03)


def test_rays_without_trust_are_predicted_only() -> None:
    """However wrong they are, the map is that of the others."""
    known, unknown = joined(rays_at(20), rays_at(75)), rays_at(60)
    wrong = replace(unknown, radiance=unknown.radiance + 0.2)
    rays = joined(known, wrong)
    rays = replace(rays, trust=torch.cat([torch.ones(len(known.radiance)), torch.zeros(len(wrong.radiance))]))
    residual = left_unexplained(rays, Reflectance(GOLD), RESOLUTION)
    assert residual[: len(known.radiance)] == pytest.approx(0, abs=1e-6)
    assert residual[len(known.radiance) :] == pytest.approx(0.2, abs=1e-6)


def scattering_rays(albedo: np.ndarray, lamp: float) -> Rays:
    """Random normals and cameras of one side, pale gold: c = F E + ρ ∫ E (n·ω)₊ dω/π by sums over the texels of E, one
    of which is a lamp whose radiance is `lamp` and shown as 1.
    """
    random = np.random.default_rng(7)
    normals, toward = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in random.normal(size=(2, 8000, 3)))
    toward[:, 2] = np.abs(toward[:, 2])
    seen = (normals * toward).sum(1) > 0.1
    normals, incoming = normals[seen], -toward[seen]
    cosines = -(normals * incoming).sum(1, keepdims=True)
    outgoing = incoming + 2 * cosines * normals
    light = LIGHT.numpy().copy()
    light[40] = lamp
    area = np.broadcast_to(cube_solid_angles(8), (6, 8, 8)).reshape(-1, 1)
    scattered = np.maximum(normals @ OUTGOING.numpy().T, 0) @ (area * light) / np.pi
    share = PALE + (1 - PALE) * (1 - cosines) ** 5
    shown = np.minimum(share * np.minimum(light, 1)[flat_texels(outgoing, 8)] + albedo * scattered, 1)
    shown[flat_texels(outgoing, 8) == 40] = 1
    directions, radiance, came = (torch.from_numpy(each).float() for each in (outgoing, shown, incoming))
    return Rays(directions, radiance, incoming=came)


@pytest.mark.parametrize("lamp", [1.0, 60.0])
def test_what_is_scattered_is_told_beside_what_is_mirrored(lamp: float) -> None:
    """Though a lamp lights the surface by more than photographs show of it."""
    albedo, saturation = np.array([0.2, 0.1, 0.05]), torch.ones(3)
    rays = scattering_rays(albedo, lamp)
    lamps, known = lamp_light(rays, saturation, 8), unsaturated(rays, saturation)
    found = find_reflectance(known, RESOLUTION, lamps)
    assert found.at_normal == pytest.approx(PALE, abs=0.03)
    assert found.albedo == pytest.approx(albedo, abs=0.03)
    mirror = find_reflectance(known, RESOLUTION)
    errors = (np.abs(left_unexplained(known, each, RESOLUTION)).mean() for each in (found, mirror))
    assert next(errors) < 0.5 * next(errors)


def test_a_perfect_metal_scatters_nothing() -> None:
    """Where light may be scattered, too, the metal comes out as without."""
    rays = joined(rays_at(20), rays_at(50), rays_at(75))
    found = find_reflectance(rays, RESOLUTION, np.zeros(9))
    assert found.at_normal == pytest.approx(GOLD, abs=0.01)
    assert found.scattered_share is None or max(found.scattered_share) < 0.01
