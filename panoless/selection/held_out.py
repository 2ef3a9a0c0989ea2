"""Held-out views: how much of them a geometry explains, and whether another explains more."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.contrast import Contrast
from panoless.capture.views import Views, split_held_out
from panoless.config import FitConfig
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.base import Geometry, observe_views, usable_views
from panoless.geometry.places import WithoutMirror, surfaces_of
from panoless.selection.options import SelectionOptions

MATTE_SHARE = 0.6
"""Error under one color a place, in that under other models, below which an object is matte."""
MATTE_VIEWS = 24
"""Views by which that is judged, of those that tell the colors and of the others."""
LEAST_COLORS = 0.01
"""Error under one color a view from which photographs tell places apart."""


def held_out_errors(views: Views, config: FitConfig, geometry: Geometry) -> Float[np.ndarray, "V"] | None:
    """Mean ‖e‖²/(‖e‖² + s²) of each held-out view; None where there are too few views.

    Every fifth view is held out from the map.
    """
    parts, options = held_out_parts(views), config.selection
    return None if parts is None else unexplained(*parts, geometry, options.compared_rays, options.trial_resolution)


def held_out_parts(views: Views) -> tuple[Views, Views] | None:
    """Four fifths of the views, and the others; None where there are too few."""
    kept, held_out = split_held_out(views.train)
    if not kept or not held_out:
        return None
    return replace(views, train=tuple(kept)), replace(views, train=tuple(held_out))


def unexplained(solved: Views, tested: Views, geometry: Geometry, rays: int, resolution: int) -> Float[np.ndarray, "V"]:
    """Mean ‖e‖²/(‖e‖² + s²) of each tested view under the map of the solved ones, at most `rays` of either."""
    with torch.no_grad():
        environment = solve_environment(list(observe_views(solved, geometry, rays)), resolution)
        return np.array([prediction_error([batch], environment) for batch in observe_views(tested, geometry, rays)])


def is_matte(views: Views, geometry: Geometry, config: FitConfig) -> bool:
    """Whether one color a place on a surface explains most of what neither one color a view nor a mirror does.

    A place on a mirror shows other surroundings to each camera, also where the surface is a visual hull; a place on a
    matte object shows one color.
    """
    usable = usable_views(views, geometry)
    with torch.no_grad():
        parts = surfaces_of(usable, geometry, MATTE_VIEWS)
        if not all(parts):
            return False
        plain = WithoutMirror.of(usable, *parts, Contrast.of(usable, config.contrast), config.selection.compared_rays)
    if plain.one_color < LEAST_COLORS or plain.matte > MATTE_SHARE * plain.one_color:
        return False
    errors = held_out_errors(usable, config, geometry)
    return errors is not None and plain.matte < MATTE_SHARE * float(errors.mean())


def is_clearly_lower(errors: Float[np.ndarray, "V"], of: Float[np.ndarray, "V"], options: SelectionOptions) -> bool:
    """Whether `errors` lie below those `of` another by the least gain and the standard errors of the options."""
    gain = of - errors
    noise = options.standard_errors * float(gain.std(ddof=1)) / len(gain) ** 0.5 if len(gain) > 1 else np.inf
    return bool(gain.mean() > max(noise, options.least_gain * of.mean()))
