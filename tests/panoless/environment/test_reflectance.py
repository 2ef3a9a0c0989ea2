"""A metal's reflectance comes back from directions that are seen at different angles, and only from these."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.environment.options import MaterialOptions
from panoless.environment.rays import Rays
from panoless.environment.reflectance import Reflectance, cosines_of_incidence, find_reflectance, left_unexplained
from panoless.kernels.cubemap import cubemap_directions

GOLD = np.array([1.0, 0.77, 0.34])
OPTIONS = MaterialOptions(resolution=8)
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
    found = find_reflectance(rays, OPTIONS)
    assert found.at_normal == pytest.approx(GOLD, abs=2e-3)
    assert np.abs(left_unexplained(rays, Reflectance(GOLD), OPTIONS)).max() < 1e-6


def test_one_angle_tells_nothing() -> None:
    """Color of the light and of the mirror are one product."""
    rays = rays_at(50)
    assert find_reflectance(rays, OPTIONS).tint == (1, 1, 1)
    for each in (Reflectance(np.ones(3)), Reflectance(GOLD)):
        assert np.abs(left_unexplained(rays, each, OPTIONS)).max() < 1e-6


def test_some_wrong_rays_change_little() -> None:
    """Every tenth is of another color."""
    rays = joined(rays_at(20), rays_at(50), rays_at(75), rays_at(80))
    rays.radiance[::10] = 0.9
    assert find_reflectance(rays, OPTIONS).at_normal == pytest.approx(GOLD, abs=0.03)


def test_rays_without_trust_are_predicted_only() -> None:
    """However wrong they are, the map is that of the others."""
    known, unknown = joined(rays_at(20), rays_at(75)), rays_at(60)
    wrong = replace(unknown, radiance=unknown.radiance + 0.2)
    rays = joined(known, wrong)
    rays = replace(rays, trust=torch.cat([torch.ones(len(known.radiance)), torch.zeros(len(wrong.radiance))]))
    residual = left_unexplained(rays, Reflectance(GOLD), OPTIONS)
    assert residual[: len(known.radiance)] == pytest.approx(0, abs=1e-6)
    assert residual[len(known.radiance) :] == pytest.approx(0.2, abs=1e-6)
