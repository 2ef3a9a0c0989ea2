"""A mirror sphere of surfels whose geometry is exact, and configurations small enough to fit within seconds."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.config import FitConfig
from panoless.presets import PRESETS
from panoless.splats.descent import PUBLISHED
from panoless.splats.model import Surfels
from tests.support.synthetic_dataset import environment_radiance


def sphere_surfels(count: int, radius: float = 1.0, opacity_logit: float = 6.0) -> Surfels:
    """Surfels on a Fibonacci lattice of a sphere around the origin, with its normals and curvature −1/radius."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    polar, azimuth = torch.acos(1 - 2 * index / count), np.pi * (1 + 5**0.5) * index
    normals = torch.stack([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()], 1)
    # The quaternion (1 + z·n, z × n) turns z into n.
    quats = torch.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], torch.zeros(count)], 1)
    spacing = radius * (4 * np.pi / count) ** 0.5
    return Surfels(
        means=(radius * normals).float(),
        quats=quats.float(),
        log_scales=torch.full((count, 2), float(np.log(0.8 * spacing))),
        opacity_logits=torch.full((count,), opacity_logit),
        albedo=torch.zeros(count, 3),
        curvatures=torch.tensor([-1 / radius, 0.0, -1 / radius]).expand(count, 3).clone(),
        roughness_logits=torch.zeros(count),
    )


def control_density_often(patch: pytest.MonkeyPatch) -> None:
    """Density control of all methods keeps a rhythm in a fit of some ten iterations."""
    for name, each in PUBLISHED.items():
        first, last, every, reset, propagation = (round(share * each.steps) for share in (0.1, 0.9, 0.2, 0.4, 0.3))
        often = replace(
            each,
            grows_from=first,
            grows_until=last,
            grows_every=every,
            resets_every=reset,
            propagates_every=propagation,
        )
        patch.setitem(PUBLISHED, name, often)


def clipped_environment(directions: Float[Tensor, "*S 3"]) -> Float[Tensor, "*S 3"]:
    """The environment of the synthetic dataset in given directions, clipped to [0, 1] as training views are."""
    return torch.from_numpy(environment_radiance(directions.double().numpy())).clamp(0, 1).float()


def tiny_config(preset: str = "default", iterations: int = 80, count: int = 300) -> FitConfig:
    """A preset of surfels, few, with few texels and iterations. The surroundings are far and the mirror is perfect, as
    those of the synthetic sphere are, without fits that ask whether they are.
    """
    config = PRESETS[preset]
    return replace(
        config,
        splats=replace(
            config.splats,
            iterations=iterations,
            surfels=replace(config.splats.surfels, count=count),
        ),
        model="surfels",
        first_surface=replace(config.first_surface, hull_resolution=40),
        environment=replace(config.environment, resolution=24, solve_resolution=24),
        surroundings=replace(config.surroundings, mode="off"),
        material=replace(config.material, reflectance="off", roughness="off", blur="off"),
    )
