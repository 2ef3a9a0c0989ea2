"""A focal length that is wrong by one factor, where held-out views ask for another."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from panoless.alignment.lens import FocalPull, focal_pull
from panoless.capture.corrections import Corrections
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.surroundings import FAR
from panoless.geometry.base import Geometry
from panoless.geometry.registry import FAMILIES
from panoless.selection.fitted import Fitted, Refit, errors_in_common, outline_distance_px
from panoless.selection.held_out import is_clearly_lower
from panoless.selection.options import CorrectionOptions


@dataclass(frozen=True)
class _FocalTrial:
    """A fit to another focal length, the logarithm of that over the first, and what pull is left."""

    change: float
    fitted: Fitted
    pull: FocalPull

    @classmethod
    def of(cls, views: Views, change: float, fitted: Fitted, config: FitConfig) -> "_FocalTrial":
        """With the pull of the views as they are corrected for that fit."""
        options, seen = config.corrections, fitted.corrections.applied(views, config)
        numbers = options.focal_rays, options.focal_resolution, options.focal_scale
        alike = _looks_like_a_focal_length(seen, fitted.geometry, options)
        geometry = fitted.geometry.in_surroundings(FAR) if alike else fitted.geometry
        return cls(change, fitted, focal_pull(seen, geometry, *numbers))


def with_focal_length(views: Views, fitted: Fitted, config: FitConfig, refit: Refit) -> Fitted:
    """Fitted anew to other focal lengths until photographs pull no more, which is found by secants. Of the trials the
    one nearest to the zero of a line through all pulls is kept, if held-out views are clearly better explained by it
    and the factor is told better than it is known. A kind that finds it beside its shape takes more steps for that, so
    it is compared with a fit after as many without.
    """
    options = config.corrections
    family, corrected = FAMILIES[fitted.geometry.kind], fitted.corrections.applied(views, config)
    jointly = family.with_focal_length(corrected, fitted.geometry, config)
    if jointly is not None:
        geometry, change = jointly
        told = replace(fitted, geometry=geometry, corrections=_corrected(fitted, change, options.focal_error))
        if options.lens == "on":
            return told
        if not _is_likely(told, change, options):
            return fitted
        settled = replace(fitted, geometry=family.after_as_many_steps(corrected, fitted.geometry, config))
        return told if _focal_length_is_earned(views, settled, told, config) else settled
    trials = [_FocalTrial.of(views, 0.0, fitted, config)]
    pull = trials[0].pull
    least = options.least_focal_pull if fitted.geometry.poses is None else options.least_posed_focal_pull
    if abs(pull.step) < max(least, options.focal_sigmas * pull.sigma):
        return fitted
    following: float | None = _step_from(trials[0], options.focal_share, options.largest_focal_step)
    for _ in range(options.focal_trials):
        if following is None or any(abs(each.change - following) < options.settled_focal for each in trials):
            break
        corrections = _corrected(fitted, following, 0.0)
        again = refit(corrections.applied(views, config), trials[-1].fitted, anew=False)
        if again is None:
            break
        trials.append(_FocalTrial.of(views, following, replace(again, corrections=corrections), config))
        following = _following(trials, options.largest_focal_step)
    if len(trials) == 1:
        return fitted
    slope, offset = np.polyfit([each.change for each in trials], [each.pull.step for each in trials], 1)
    share = -float(slope)
    if share <= 0:
        return fitted
    found = min(trials, key=lambda each: abs(each.change - offset / share))
    if found.fitted is fitted:
        return fitted
    # What is left where the focal length is right is no less than half of what raises doubt.
    uncertainty = max(found.pull.sigma, options.least_focal_pull / 2) / share
    told = replace(found.fitted, corrections=_corrected(fitted, found.change, uncertainty))
    return told if _is_believed(views, fitted, told, found.change, config) else fitted


def _corrected(fitted: Fitted, change: float, uncertainty: float) -> Corrections:
    """The corrections with another logarithm of the focal length."""
    factor = fitted.corrections.focal_factor * float(np.exp(change))
    return replace(fitted.corrections, focal_factor=factor, focal_uncertainty=factor * uncertainty)


def _is_believed(views: Views, before: Fitted, after: Fitted, change: float, config: FitConfig) -> bool:
    options = config.corrections
    if options.lens == "on":
        return True
    return _is_likely(after, change, options) and _focal_length_is_earned(views, before, after, config)


def _is_likely(told: Fitted, change: float, options: CorrectionOptions) -> bool:
    """Whether a change is told better than it is expected, larger than its uncertainty, and not too large."""
    uncertainty = (told.corrections.focal_uncertainty or 0.0) / told.corrections.focal_factor
    nearest, farthest = options.nearest_focal * uncertainty, options.farthest_focal * options.focal_prior
    return uncertainty < options.focal_prior and nearest < abs(change) < farthest


def _looks_like_a_focal_length(views: Views, geometry: Geometry, options: CorrectionOptions) -> bool:
    """Whether surroundings are so little near that a focal length may show the same: a flat mirror at the distance d
    from its cameras shows a sphere of the radius d/s as it shows a far world through a lens that is wrong by s.
    """
    coefficients, cameras = geometry.surroundings.coefficients, [np.linalg.norm(view.position) for view in views.train]
    return len(coefficients) > 0 and bool(coefficients[0] * np.median(cameras) < 3 * options.focal_prior)


def _step_from(trial: _FocalTrial, share: float, largest: float) -> float:
    """Where nothing would pull if that were the share of a change that pulls."""
    return trial.change + float(np.clip(trial.pull.step / share, -largest, largest))


def _following(trials: Sequence[_FocalTrial], largest: float) -> float | None:
    """The zero of the secant through the two trials of least pull; None where the pull grows with the change."""
    one, other = sorted(trials, key=lambda each: abs(each.pull.step))[:2]
    share = (other.pull.step - one.pull.step) / (one.change - other.change)
    return _step_from(one, share, largest) if share > 0 else None


def _focal_length_is_earned(views: Views, before: Fitted, after: Fitted, config: FitConfig) -> bool:
    """Whether held-out views are clearly better explained; or, by a lens in place of near surroundings, no worse, and
    outlines are.
    """
    errors = errors_in_common(views, before, after, config)
    limits = replace(config.selection, least_gain=config.corrections.least_focal_gain)
    if is_clearly_lower(errors[1], errors[0], limits):
        return True
    in_place = after.geometry.surroundings.is_far and not before.geometry.surroundings.is_far
    distances = [
        outline_distance_px(each.corrections.applied(views, config), each.geometry) for each in (before, after)
    ]
    nearer = distances[1] <= (1 - config.corrections.least_outline_fall) * distances[0]
    return bool(in_place and nearer and errors[1].mean() <= (1 + config.selection.least_gain) * errors[0].mean())
