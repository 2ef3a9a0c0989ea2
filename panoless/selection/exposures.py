"""Exposures and white balances that differ from view to view, where held-out views ask for them."""

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
from panoless.environment.exposure import EXPOSURE, WHITE_BALANCE, Groups, exposure_gains
from panoless.environment.rays import Rays
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.base import observe_views, usable_views
from panoless.journal import remembered
from panoless.kernels.cubemap import sample_cubemap
from panoless.numeric.robust import robust_weight
from panoless.selection.fitted import Fitted, Refit, fewer_pixels, held_out_errors
from panoless.selection.held_out import held_out_parts, is_clearly_lower


@remembered()
def earned_exposures(
    views: Views, fitted: Fitted, errors: Float[np.ndarray, "V"], config: FitConfig
) -> tuple[Corrections, Float[np.ndarray, "V"]] | None:
    """Gains of all views by the geometry of a fit, and what is unexplained then of the pixels that `errors` are of.

    None where these are not clearly better explained. A gain a view is asked first, then a gain a channel.

    The map is that of the other views at equal exposure; a held-out view's other pixels tell its own gains.
    """
    halves: tuple[list[Rays], list[Rays]] | None = None
    earned, seen = None, _observed(views, fitted, config)
    for groups in (EXPOSURE, WHITE_BALANCE):
        corrections = _with_gains(fitted, _gains(seen, config, groups), groups)
        if (_spread(corrections, groups) or 0.0) < config.corrections.least_stops:
            continue
        solved, tested = halves = halves or _halves(views, fitted, config)
        with torch.no_grad():
            gains = _gains(solved, config, groups)
            environment = solve_environment(_divided(solved, gains, config), config.selection.trial_resolution)
            own = [_own_gains(rays.every(2, 0), environment, config, groups) for rays in tested]
            equal = _divided([rays.every(2, 1) for rays in tested], np.array(own), config)
            free = np.array([prediction_error([rays], environment) for rays in equal])
        if is_clearly_lower(free, errors, config.selection):
            earned, errors = (corrections, free), free
    return earned


def _spread(corrections: Corrections, groups: Groups) -> float | None:
    return corrections.exposure_stops if groups == EXPOSURE else corrections.white_balance_stops


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


@remembered()
def equal_exposures(views: Views, fitted: Fitted, config: FitConfig) -> Corrections:
    """The corrections of a fit with gains found anew by its geometry, for the channels that share one in it."""
    groups = EXPOSURE if fitted.corrections.balances is None else WHITE_BALANCE
    return _with_gains(fitted, _gains(_observed(views, fitted, config), config, groups), groups)


def _observed(views: Views, fitted: Fitted, config: FitConfig) -> list[Rays]:
    """What views of unequal exposure observed of a fit, otherwise corrected as it has them."""
    bare = replace(fitted.corrections, gains=None, balances=None)
    usable = fewer_pixels(bare.applied(views, config), 2 * config.corrections.rays)
    with torch.no_grad():
        return list(observe_views(usable_views(usable, fitted.geometry), fitted.geometry, config.corrections.rays))


def _with_gains(fitted: Fitted, gains: Float[np.ndarray, "V 3"], groups: Groups) -> Corrections:
    of_views = np.exp(np.log(gains).mean(1))
    balances = None if groups == EXPOSURE else gains / of_views[:, None]
    return replace(fitted.corrections, gains=of_views, balances=balances)


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


def _divided(views: Sequence[Rays], gains: Float[np.ndarray, "V 3"], config: FitConfig) -> list[Rays]:
    encoding, seen = encoding_of(config), zip(views, torch.from_numpy(gains).float()[..., None], strict=True)
    return [
        replace(rays, radiance=encoding.without_gain(rays.radiance.T, gain.to(rays.radiance)).T.contiguous())
        for rays, gain in seen
    ]


def _gains(views: Sequence[Rays], config: FitConfig, groups: Groups) -> Float[np.ndarray, "V 3"]:
    options = config.corrections
    saturation = encoding_of(config).saturation
    return exposure_gains(views, saturation, options.resolution, options.gain_scale, options.rounds, groups)


def _own_gains(
    rays: Rays, environment: Float[Tensor, "6 3 L L"], config: FitConfig, groups: Groups
) -> Float[np.ndarray, "3"]:
    """The gains of one view under a map."""
    gains, shown = np.ones(3), sample_cubemap(environment, rays.directions)
    for group in groups:
        gains[list(group)] = _gain(rays, shown, list(group), config)
    return gains


def _gain(rays: Rays, shown: Float[Tensor, "P 3"], group: list[int], config: FitConfig) -> float:
    """Σ w m c/Σ w m² of colors c and what a map predicts, m, with weights by the residuals under the gain before; 1
    where no pixel tells. Saturated pixels have no say.
    """
    gain, radiance, shown = 1.0, rays.radiance[:, group], shown[:, group]
    clear = (radiance < SATURATED * encoding_of(config).saturation.to(shown)[group]).all(1) * rays.initial_weight()
    for _ in range(config.corrections.rounds):
        weight = clear * robust_weight(radiance - gain * shown, config.corrections.gain_scale)
        products, squares = ((weight * (shown * each).sum(1)).sum().item() for each in (radiance, shown))
        gain = products / squares if products > 0 else 1.0
    return gain
