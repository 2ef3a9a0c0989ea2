"""The map of a finished geometry, and how well each of its directions was observed."""

from dataclasses import replace

import torch

from panoless.capture.encoding import encoding_of
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.resolution import count_rays
from panoless.environment.visibility import agreement, visibility_from_agreement, visibility_from_evidence
from panoless.geometry.base import observe_views, usable_views
from panoless.reconstruct.state import FitState
from panoless.selection.material import as_perfect_mirror, earned_reflectance

GRAY = 0.5


def complete(state: FitState, views: Views, config: FitConfig) -> Views:
    """Set reflectance, environment and visibility of a state from its geometry and corrected photographs. These are
    returned as a perfect mirror would have shown them.

    The map is solved in closed form, unless the configuration keeps that of an iterative fit, which knows no material.
    """
    usable = usable_views(views, state.geometry)
    if config.environment.solve or state.training is None:
        state.reflectance = earned_reflectance(usable, state.geometry, config)
    if state.reflectance is not None:
        views = as_perfect_mirror(views, usable, state.geometry, state.reflectance)
        shown = zip(usable.train, views.train, strict=True)
        usable = replace(usable, train=tuple(replace(part, radiance=view.radiance) for part, view in shown))
        config = replace(config, tint=state.reflectance.tint)
    _solve(state, usable, config)
    return views


def _solve(state: FitState, views: Views, config: FitConfig) -> None:
    """Environment and visibility from usable pixels."""
    encoding, training = encoding_of(config), state.training
    with torch.no_grad():
        if config.environment.solve or training is None:
            environment, rays = state.geometry.solve_map(views, config)
            if not config.environment.fill:
                environment = torch.where(count_rays(rays, environment.shape[-1]) > 0, environment, GRAY)
        else:
            rays = list(observe_views(views, state.geometry, config.environment.rays))
            sigmoid = config.environment.activation == "sigmoid"
            environment = torch.sigmoid(training.environment) if sigmoid else training.environment
        if config.visibility == "online" and training is not None:
            state.visibility = visibility_from_evidence(training.evidence)
        else:
            agreed = agreement(rays, environment, encoding.saturation, config.confidence)
            state.visibility = visibility_from_agreement(agreed, config.confidence)
        state.environment = encoding.decoded(environment)
