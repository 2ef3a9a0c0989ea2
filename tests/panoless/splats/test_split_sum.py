"""The split sum against integrals by other samples, against its limits, and its gradients by finite differences."""

import numpy as np
import pytest
import torch

from panoless.kernels.cubemap import cubemap_directions, sample_cubemap
from panoless.splats.split_sum import (
    LEVELS,
    brdf_table,
    hat_weights,
    look_up_rough,
    prefiltered,
    specular_share,
    split_sum_factors,
)


def directions_about_z(samples: int, seed: int) -> np.ndarray:
    """Uniform over the upper hemisphere."""
    rng = np.random.default_rng(seed)
    z, turn = rng.random(samples), 2 * np.pi * rng.random(samples)
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], 1)


@pytest.mark.parametrize(("cosine", "roughness"), [(0.9, 0.5), (0.5, 0.7), (0.25, 0.6), (1.0, 1.0)])
@pytest.mark.parametrize("at_normal", [0.04, 1.0])
def test_share_of_light_is_that_of_the_model_of_facets(cosine: float, roughness: float, at_normal: float) -> None:
    """∫ D F G / (4 n·v n·l) n·l dω over light drawn evenly, written from the model's parts."""
    light = directions_about_z(100_000, 1)
    view = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    half = light + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    alpha = roughness**2
    facets = alpha**2 / (np.pi * (half[:, 2] ** 2 * (alpha**2 - 1) + 1) ** 2)
    fresnel = at_normal + (1 - at_normal) * (1 - half @ view) ** 5
    seen, lit = (z / (z * (1 - alpha / 2) + alpha / 2) for z in (cosine, light[:, 2]))
    integral = (facets * fresnel * seen * lit / (4 * cosine * light[:, 2]) * light[:, 2]).mean() * 2 * np.pi
    found = specular_share(torch.full((1, 3), at_normal), torch.tensor([cosine]), torch.tensor([roughness]))
    # Measured: within 0.009, most of it the steps of the table.
    assert found[0].numpy() == pytest.approx(integral, abs=0.015)


def test_a_smooth_surface_is_schlicks_mirror() -> None:
    cosines = torch.linspace(0.05, 1, 9)
    share = specular_share(torch.full((9, 3), 0.3), cosines, torch.zeros(9))
    assert share[:, 0].numpy() == pytest.approx((0.3 + 0.7 * (1 - cosines) ** 5).numpy(), abs=0.02)
    world = torch.rand(6, 3, 16, 16, generator=torch.Generator().manual_seed(3))
    directions = torch.randn(50, 3, generator=torch.Generator().manual_seed(4))
    shown = look_up_rough(prefiltered(world), directions, torch.zeros(50))
    assert torch.equal(shown, sample_cubemap(world, directions))


def test_no_surface_shows_more_light_than_there_is() -> None:
    table = brdf_table()
    assert (table >= 0).all()
    assert table.sum(-1).max() <= 1.001


@pytest.mark.parametrize("roughness", LEVELS[1:])
def test_a_blurred_map_is_the_mean_over_facets(roughness: float) -> None:
    """Light mirrored by facets drawn from D, seen from the front and weighed by its cosine, of a world of two tones."""
    axis = np.array([0.6, 0.0, 0.8])
    world = (cubemap_directions(64) @ torch.from_numpy(axis).float() > 0.9).float()[:, None].expand(-1, 3, -1, -1)
    rng = np.random.default_rng(5)
    height, turn = rng.random(30_000), 2 * np.pi * rng.random(30_000)
    tilt = np.arctan(roughness**2 * np.sqrt(height / (1 - height)))
    facets = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], 1)
    light = 2 * facets[:, 2:] * facets - np.array([0.0, 0.0, 1.0])
    weight = light[:, 2].clip(0)
    expected = (weight * (light @ axis > 0.9)).sum() / weight.sum()
    found = look_up_rough(prefiltered(world.contiguous()), torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([roughness]))
    # Measured: within 0.021.
    assert found[0].numpy() == pytest.approx(expected, abs=0.03)


def test_gradients() -> None:
    """To directions, roughness and cosines by finite differences in float64, to the map because it is linear in it."""
    generator = torch.Generator().manual_seed(6)
    world = torch.rand(6, 3, 4, 4, generator=generator, dtype=torch.float64)
    directions = torch.randn(4, 3, generator=generator, dtype=torch.float64).requires_grad_()
    roughness, cosines = (torch.rand(4, generator=generator, dtype=torch.float64).requires_grad_() for _ in range(2))
    light = prefiltered(world)
    assert torch.autograd.gradcheck(lambda *at: look_up_rough(light, *at), (directions, roughness), atol=1e-5)
    assert torch.autograd.gradcheck(split_sum_factors, (cosines, roughness), atol=1e-5)
    first, second = (torch.rand(6, 3, 32, 32, generator=generator) for _ in range(2))
    first.requires_grad_()
    there, rough = torch.randn(200, 3, generator=generator), torch.rand(200, generator=generator)
    weights = torch.rand(200, 3, generator=generator)
    total = (look_up_rough(prefiltered(first), there, rough) * weights).sum()
    (gradient,) = torch.autograd.grad(total, first)
    expected = (look_up_rough(prefiltered(second), there, rough) * weights).sum()
    assert float((gradient * second).sum()) == pytest.approx(float(expected), rel=1e-5)


def test_hats_reproduce_straight_lines() -> None:
    places = torch.tensor([-1.0, 0.0, 0.04, 0.08, 0.3, 1.0, 2.0])
    weights = hat_weights(places, LEVELS)
    assert weights.sum(1).numpy() == pytest.approx(1)
    assert (weights @ torch.tensor(LEVELS)).numpy() == pytest.approx(places.clamp(0, 1).numpy(), abs=1e-6)
