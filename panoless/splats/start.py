"""What a fit of surfels begins with: surfels on the first surface, and the map that fits them best."""

import torch

from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.cubemap import resample
from panoless.environment.solve import solve_environment
from panoless.geometry.base import observe_views
from panoless.journal import remembered
from panoless.splats.descent import first_map
from panoless.splats.mirror import SurfelMirror
from panoless.splats.placement import initial_surfels
from panoless.splats.shading.geometry import ShadedMirror
from panoless.splats.training import Training

INITIAL_RAYS = 1_000_000
"""Most rays of the map that steps begin with."""


@remembered(lambda *_: "Stage 1 of 1: surfels")
def first_mirror(views: Views, config: FitConfig) -> SurfelMirror:
    """Surfels on the first surface or at random, as the configured method shades them."""
    surfels = initial_surfels(views, config.splats.surfels, config.seed, config.first_surface)
    return ShadedMirror.begun(SurfelMirror.of(surfels, config), config)


def first_training(views: Views, mirror: SurfelMirror, config: FitConfig) -> Training:
    """The map that fits the first surfels best; the configured one where maps are not solved."""
    device = views.train[0].mask.device
    environment = first_map(config, torch.Generator().manual_seed(config.seed)).to(device)
    length = environment.shape[-1]
    if config.environment.solve and config.environment.activation == "clamp":
        with torch.no_grad():
            rays = list(observe_views(views, mirror, INITIAL_RAYS))
            environment = resample(solve_environment(rays, length // 2), length)
    return Training(environment, environment.new_zeros(6, length, length))
