"""Numbers of the steps: rates of Adam, when surfels are edited, and the map before the first step.

Ours, and what the compared methods published; where methods differ, their numbers stand side by side.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.config import FitConfig
from panoless.environment.cubemap import GRAY, NOISE, initial_environment

MATERIAL_RATES = {
    "albedo": 2.5e-3,
    "curvatures": 3e-2,
    "roughness_logits": 1e-2,
    "harmonics": 2.5e-3,
    "strength_logits": 6e-3,
    "base_color_logits": 7.5e-3,
    "normal_residuals": 5e-3,
    "indirect_harmonics": 7.5e-3,
}
"""Rates by parameter, in the normalized frame, unless a method states another."""
OUR_RATES = {"means": 1e-4, "quats": 2e-3, "log_scales": 3e-3, "opacity_logits": 2e-2, "environment": 3e-2}
"""Rates of shapes and map; that of the means in radii of the object."""
PUBLISHED_RATES = {"means": 1.6e-4, "quats": 1e-3, "log_scales": 5e-3, "opacity_logits": 5e-2}
"""The same of all compared methods; that of the means in units of the cameras' extent (Kerbl et al. 2023)."""
OUR_SQUARE_MEMORY = 0.99
"""β₂ of Adam, the decay of the mean squared gradient that steps are divided by."""
PUBLISHED_SQUARE_MEMORY = 0.999


@dataclass(frozen=True)
class Published:
    """A method's numbers. Times are in steps of its schedule; a fit of another length scales them."""

    steps: int
    """Length of the schedule."""
    rates: Mapping[str, float]
    """Of the map, and of materials where they differ from `MATERIAL_RATES`."""
    grows_until: int
    """Step from which surfels are no longer cloned, split and pruned…"""
    grows_every: int
    """…and steps between two such rounds."""
    least_opacity: float
    """Surfels below this opacity are pruned."""
    propagates_from: int = 0
    """Normals are propagated from this step on…"""
    propagates_until: int = 0
    """…until this one: each round widens outlines, which only the silhouette term undoes."""
    opacities_rest: int = 0
    """Steps after each propagation in which opacities are constant."""
    means_fall_until: int = 30_000
    """Steps over which the means' rate falls to a hundredth."""
    grows_from: int = 500
    resets_every: int = 3_000
    """Steps between two opacity resets."""
    propagates_every: int = 1_000
    gray: float = GRAY
    """Radiance of the first map."""
    noise: float = NOISE
    """Half the width of the uniform noise on its logits, where a sigmoid takes them to radiance."""


_REF_GAUSSIAN_RATES = {"environment": 1e-2, "harmonics": 7.5e-3, "strength_logits": 5e-3, "roughness_logits": 5e-3}
PUBLISHED: dict[str, Published] = {
    "mirror": Published(45_000, {"environment": 2e-2}, 12_000, 100, 0.1, propagates_until=3_000),
    "3dgs-dr": Published(61_000, {"environment": 5e-2}, 30_000, 500, 0.005, 3_000, 24_000, 200),
    "gaussian-shader": Published(
        30_000,
        {"environment": 5e-3, "harmonics": 5e-3, "base_color_logits": 5e-3, "roughness_logits": 5e-3},
        15_000,
        100,
        0.005,
        gray=0.8,
    ),
    "ref-gaussian": Published(50_000, _REF_GAUSSIAN_RATES, 25_000, 500, 0.05, 0, 25_000, 200, noise=0.0),
    "material-refgs": Published(50_000, _REF_GAUSSIAN_RATES, 30_000, 500, 0.05, 3_000, 30_000, 200, noise=0.0),
}
"""By `surfels.shading`: the paper's method, 3DGS-DR, GaussianShader, Ref-Gaussian and MaterialRefGS."""


def published(config: FitConfig) -> Published:
    """The numbers of the method that a configuration shades by."""
    return PUBLISHED[config.splats.surfels.shading]


@dataclass(frozen=True)
class Rates:
    """Learning rates of Adam by parameter."""

    by_name: Mapping[str, float] = field(default_factory=lambda: {**MATERIAL_RATES, **OUR_RATES})
    square_memory: float = OUR_SQUARE_MEMORY

    @classmethod
    def of(cls, config: FitConfig, unit: float) -> "Rates":
        """Those of a configuration; `unit` is that of the means."""
        if config.splats.rates == "ours":
            rates, memory = OUR_RATES, OUR_SQUARE_MEMORY
        else:
            rates = {**PUBLISHED_RATES, **published(config).rates}
            memory = PUBLISHED_SQUARE_MEMORY
        return cls({**MATERIAL_RATES, **rates, "means": rates["means"] * unit}, memory)


def first_map(config: FitConfig, generator: torch.Generator) -> Float[Tensor, "6 3 L L"]:
    """The map before the first step, as its method starts it."""
    method = published(config)
    return initial_environment(config.environment, generator, method.gray, method.noise)
