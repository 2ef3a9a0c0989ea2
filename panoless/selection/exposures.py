"""Exposures that differ from view to view, where held-out views ask for them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.corrections import Corrections
from panoless.capture.encoding import SATURATED, encoding_of
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.exposure import exposure_gains
from panoless.environment.rays import Rays
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.base import observe_views, usable_views
from panoless.kernels.cubemap import sample_cubemap
from panoless.numeric.robust import robust_weight
from panoless.selection.fitted import Fitted, Refit, fewer_pixels, held_out_errors
from panoless.selection.held_out import held_out_parts, is_clearly_lower


def earned_exposures(
    views: Views, fitted: Fitted, errors: Float[np.ndarray, "V"], config: FitConfig
) -> tuple[Corrections, Float[np.ndarray, "V"]] | None:
    """Gains of all views by the geometry of a fit, and what is unexplained then of the pixels that `errors` are of.

    None where these are not clearly better explained.

    The map is that of the other views at equal exposure; a held-out view's other pixels tell its own gain.
    """
    corrections = equal_exposures(views, fitted, config)
    if (corrections.exposure_stops or 0.0) < config.corrections.least_stops:
        return None
    solved, tested = _halves(views, fitted, config)
    with torch.no_grad():
        gains = _gains(solved, config)
        environment = solve_environment(_divided(solved, gains, config), config.selection.trial_resolution)
        own = [_gain(rays.every(2, 0), environment, config) for rays in tested]
        equal = _divided([rays.every(2, 1) for rays in tested], np.array(own), config)
        free = np.array([prediction_error([rays], environment) for rays in equal])
    return (corrections, free) if is_clearly_lower(free, errors, config.selection) else None


def fitted_to_equal_exposures(views: Views, fitted: Fitted, config: FitConfig, refit: Refit) -> Fitted:
    """Fitted anew to views of equal exposure, where these are better explained by that."""
    equal = fitted.corrections.applied(views, config)
    again = refit(equal, fitted, anew=False)
    if (
        again is None
        or held_out_errors(equal, again.geometry, config).mean()
        > held_out_errors(equal, fitted.geometry, config).mean()
    ):
        return fitted
    return replace(again, corrections=fitted.corrections)


def equal_exposures(views: Views, fitted: Fitted, config: FitConfig) -> Corrections:
    """The corrections of a fit with gains by its geometry."""
    bare = replace(fitted.corrections, gains=None)
    usable = fewer_pixels(bare.applied(views, config), 2 * config.corrections.rays)
    with torch.no_grad():
        seen = observe_views(usable_views(usable, fitted.geometry), fitted.geometry, config.corrections.rays)
        return replace(bare, gains=_gains(list(seen), config))


def examined(views: Views, fitted: Fitted, config: FitConfig) -> Float[np.ndarray, "V"]:
    """What a fit leaves unexplained of every second pixel of each held-out view."""
    solved, tested = _halves(views, fitted, config)
    with torch.no_grad():
        environment = solve_environment(solved, config.selection.trial_resolution)
        return np.array([prediction_error([rays.every(2, 1)], environment) for rays in tested])


def _halves(views: Views, fitted: Fitted, config: FitConfig) -> tuple[list[Rays], list[Rays]]:
    """What four fifths of the views observed, and what the others did."""
    most = config.corrections.examined_rays
    parts = held_out_parts(usable_views(fewer_pixels(views, 2 * most), fitted.geometry))
    assert parts is not None
    with torch.no_grad():
        solved, tested = (list(observe_views(part, fitted.geometry, most)) for part in parts)
    return solved, tested


def _divided(views: Sequence[Rays], gains: Float[np.ndarray, "V"], config: FitConfig) -> list[Rays]:
    encoding, seen = encoding_of(config), zip(views, gains.tolist(), strict=True)
    return [replace(rays, radiance=encoding.without_gain(rays.radiance.T, gain).T.contiguous()) for rays, gain in seen]


def _gains(views: Sequence[Rays], config: FitConfig) -> Float[np.ndarray, "V"]:
    options = config.corrections
    saturation = encoding_of(config).saturation
    return exposure_gains(views, saturation, options.resolution, options.gain_scale, options.rounds)


def _gain(rays: Rays, environment: Float[Tensor, "6 3 L L"], config: FitConfig) -> float:
    """Σ w m c/Σ w m² of colors c and what a map predicts, m, with weights by the residuals under the gain before; 1
    where no pixel tells. Saturated pixels have no say.
    """
    gain, shown = 1.0, sample_cubemap(environment, rays.directions)
    clear = (rays.radiance < SATURATED * encoding_of(config).saturation.to(shown)).all(1) * rays.initial_weight()
    for _ in range(config.corrections.rounds):
        weight = clear * robust_weight(rays.radiance - gain * shown, config.corrections.gain_scale)
        products, squares = ((weight * (shown * each).sum(1)).sum().item() for each in (rays.radiance, shown))
        gain = products / squares if products > 0 else 1.0
    return gain
