"""Held-out views: how much of them a geometry explains, and whether another explains more."""

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.contrast import Contrast
from panoless.capture.views import Views, held_out_parts
from panoless.config import FitConfig
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.base import Geometry, observe_views, usable_views
from panoless.geometry.places import WithoutMirror, surfaces_of

LEAST_GAIN = 0.05
"""Share by which what is preferred lowers the held-out error."""
STANDARD_ERRORS = 2.0
"""And by so many standard errors of the paired differences."""
COMPARED_RAYS = 1_000_000
"""Most rays that held-out errors are computed from."""
COMPARED_RESOLUTION = 128
"""Most texels along a face side of the maps by which they are computed."""

MATTE_SHARE = 0.6
"""Error under one color a place, in that under other models, below which an object is matte."""
MATTE_VIEWS = 24
"""Views by which that is judged, of those that determine the colors and of the others."""
LEAST_COLORS = 0.01
"""Error under one color a view from which photographs distinguish places."""


def held_out_errors(views: Views, config: FitConfig, geometry: Geometry) -> Float[np.ndarray, "V"] | None:
    """Mean ‖e‖²/(‖e‖² + s²) of each held-out view; None where there are too few views.

    Every fifth view is held out from the map.
    """
    parts, resolution = held_out_parts(views), config.environment.trial_resolution(COMPARED_RESOLUTION)
    return None if parts is None else unexplained(*parts, geometry, COMPARED_RAYS, resolution)


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
        kept, held_out = surfaces_of(usable, geometry, MATTE_VIEWS)
        if not kept or not held_out:
            return False
        plain = WithoutMirror.of(usable, kept, held_out, Contrast.of(usable), COMPARED_RAYS)
    if plain.one_color < LEAST_COLORS or plain.matte > MATTE_SHARE * plain.one_color:
        return False
    errors = held_out_errors(usable, config, geometry)
    return errors is not None and plain.matte < MATTE_SHARE * float(errors.mean())


def is_clearly_lower(
    errors: Float[np.ndarray, "V"], of: Float[np.ndarray, "V"], least_gain: float = LEAST_GAIN
) -> bool:
    """Whether `errors` lie below those `of` another by the least gain, and by two standard errors."""
    gain = of - errors
    noise = STANDARD_ERRORS * float(gain.std(ddof=1)) / len(gain) ** 0.5 if len(gain) > 1 else np.inf
    return bool(gain.mean() > max(noise, least_gain * of.mean()))
