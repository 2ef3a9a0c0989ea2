"""A focal length that is wrong by one factor, and a radial distortion, where held-out views ask for another lens."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from panoless.alignment.lens import DISTORTION, FOCAL_LENGTH, LensPull, LensUnknown, lens_pull
from panoless.capture.corrections import Corrections
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.surroundings import FAR
from panoless.geometry.base import Geometry
from panoless.selection.fitted import Fitted, Refit, errors_in_common, held_out_errors, outline_distance_px
from panoless.selection.held_out import is_clearly_lower
from panoless.selection.options import CorrectionOptions, LensLimits


@dataclass(frozen=True)
class _Trial:
    """A fit through another lens, by how much that differs from the first, and what pull is left."""

    unknown: LensUnknown
    change: float
    fitted: Fitted
    pull: LensPull

    @classmethod
    def of(cls, views: Views, unknown: LensUnknown, change: float, fitted: Fitted, config: FitConfig) -> "_Trial":
        """With the pull of the views as they are corrected for that fit."""
        options, seen = config.corrections, fitted.corrections.applied(views, config)
        alike = unknown is FOCAL_LENGTH and _looks_like_a_focal_length(seen, fitted.geometry, options)
        geometry = fitted.geometry.in_surroundings(FAR) if alike else fitted.geometry
        numbers = options.lens_rays, options.lens_resolution, options.lens_scale
        return cls(unknown, change, fitted, lens_pull(seen, geometry, unknown, *numbers))

    def is_doubted(self, options: CorrectionOptions) -> bool:
        """Whether photographs ask for another lens."""
        limits = _limits(self.unknown, options)
        least = limits.least_pull if self.fitted.geometry.poses is None else limits.least_posed_pull
        return abs(self.pull.step) >= max(least, options.lens_sigmas * self.pull.sigma)


def with_lens(views: Views, fitted: Fitted, config: FitConfig, refit: Refit) -> Fitted:
    """Fitted anew through another lens, where held-out views are clearly better explained by it and it is told better
    than it is known.

    It is fitted through several lenses, of other focal lengths and of other distortions. Either pulls at the other:
    where photographs ask for both, that is found first which explains more by itself.
    """
    longer = _by_trials(FOCAL_LENGTH, views, fitted, config, refit)
    bent = _by_trials(DISTORTION, views, fitted, config, refit)
    if bent is fitted:
        return longer
    if longer is not fitted:
        by_longer, by_bent = _errors(views, longer, bent, config)
        if by_longer.mean() < by_bent.mean():
            return _by_trials(DISTORTION, views, longer, config, refit)
    return _by_trials(FOCAL_LENGTH, views, bent, config, refit)


def _by_trials(unknown: LensUnknown, views: Views, fitted: Fitted, config: FitConfig, refit: Refit) -> Fitted:
    """Fitted anew with other values of an unknown until photographs pull no more, which is found by secants. Of the
    trials the one nearest to the zero of a line through all pulls is kept, if it is believed.
    """
    options, limits = config.corrections, _limits(unknown, config.corrections)
    trials = [_Trial.of(views, unknown, 0.0, fitted, config)]
    if not trials[0].is_doubted(options):
        return fitted
    following: float | None = _step_from(trials[0], limits.share, limits.largest_step)
    for _ in range(options.lens_trials):
        if following is None or any(abs(each.change - following) < limits.settled for each in trials):
            break
        corrections = _changed(fitted.corrections, unknown, following, 0.0)
        again = refit(corrections.applied(views, config), trials[-1].fitted, anew=False)
        if again is None:
            break
        trials.append(_Trial.of(views, unknown, following, replace(again, corrections=corrections), config))
        following = _following(trials, limits.largest_step)
    if len(trials) == 1:
        return fitted
    slope, offset = np.polyfit([each.change for each in trials], [each.pull.step for each in trials], 1)
    share = -float(slope)
    if share == 0 or (share < 0 and not unknown.is_radial):
        return fitted
    found = min(trials, key=lambda each: abs(each.change - offset / share))
    if found.fitted is fitted:
        return fitted
    # What is left where the lens is right is no less than half of what raises doubt.
    sigma = max(found.pull.sigma, limits.least_pull / 2) / abs(share)
    told = replace(found.fitted, corrections=_changed(fitted.corrections, unknown, found.change, sigma))
    if options.lens == "on":
        return told
    is_likely = _is_likely(told.corrections, unknown, options)
    return told if is_likely and _is_earned(views, fitted, told, unknown, config) else fitted


def _limits(unknown: LensUnknown, options: CorrectionOptions) -> LensLimits:
    return options.focal if unknown is FOCAL_LENGTH else options.k1


def _changed(corrections: Corrections, unknown: LensUnknown, change: float, sigma: float) -> Corrections:
    """With another logarithm of the focal length, or another distortion."""
    if unknown is DISTORTION:
        return replace(corrections, k1=corrections.k1 + change, k1_uncertainty=sigma)
    factor = corrections.focal_factor * float(np.exp(change))
    return replace(corrections, focal_factor=factor, focal_uncertainty=factor * sigma)


def _is_likely(corrections: Corrections, unknown: LensUnknown, options: CorrectionOptions) -> bool:
    """Whether it is told better than it is expected, off by more than its uncertainty, and not by too much."""
    limits, off, sigma = _limits(unknown, options), corrections.k1, corrections.k1_uncertainty or 0.0
    if unknown is FOCAL_LENGTH:
        off = float(np.log(corrections.focal_factor))
        sigma = (corrections.focal_uncertainty or 0.0) / corrections.focal_factor
    return sigma < limits.prior and options.nearest_lens * sigma < abs(off) < options.farthest_lens * limits.prior


def _looks_like_a_focal_length(views: Views, geometry: Geometry, options: CorrectionOptions) -> bool:
    """Whether surroundings are so little near that a focal length may show the same: a flat mirror at the distance d
    from its cameras shows a sphere of the radius d/s as it shows a far world through a lens that is wrong by s.
    """
    coefficients, cameras = geometry.surroundings.coefficients, [np.linalg.norm(view.position) for view in views.train]
    return (
        geometry.surroundings.floor is None
        and len(coefficients) > 0
        and bool(coefficients[0] * np.median(cameras) < options.farthest_lens * options.focal.prior)
    )


def _step_from(trial: _Trial, share: float, largest: float) -> float:
    """Where nothing would pull if that were the share of a change that pulls."""
    return trial.change + float(np.clip(trial.pull.step / share, -largest, largest))


def _following(trials: Sequence[_Trial], largest: float) -> float | None:
    """The zero of the secant through the two trials of least pull; None where the pull grows with the change: but a
    distortion pulls a shape that can't bend the other way.
    """
    one, other = sorted(trials, key=lambda each: abs(each.pull.step))[:2]
    share = (other.pull.step - one.pull.step) / (one.change - other.change)
    return _step_from(one, share, largest) if share > 0 or (share < 0 and one.unknown.is_radial) else None


def _errors(
    views: Views, before: Fitted, after: Fitted, config: FitConfig
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """Held-out errors of two fits by many rays, under maps as fine as explain the first one best: a wrong lens blurs
    what views share, which maps of few rays do as well.
    """
    options = config.corrections

    def finer(resolution: int) -> FitConfig:
        return replace(config, corrections=replace(options, rays=options.lens_compared_rays, resolution=resolution))

    seen, resolutions = before.corrections.applied(views, config), [options.resolution * 2**k for k in range(3)]
    best = min(resolutions, key=lambda each: held_out_errors(seen, before.geometry, finer(each)).mean())
    return errors_in_common(views, before, after, finer(best))


def _is_earned(views: Views, before: Fitted, after: Fitted, unknown: LensUnknown, config: FitConfig) -> bool:
    """Whether held-out views are clearly better explained; or, by a focal length in place of near surroundings, no
    worse, and outlines are.
    """
    errors = _errors(views, before, after, config)
    least_gain = _limits(unknown, config.corrections).least_gain
    if is_clearly_lower(errors[1], errors[0], replace(config.selection, least_gain=least_gain)):
        return True
    in_place = after.geometry.surroundings.is_far and not before.geometry.surroundings.is_far
    if unknown is not FOCAL_LENGTH or not in_place:
        return False
    distances = [
        outline_distance_px(each.corrections.applied(views, config), each.geometry) for each in (before, after)
    ]
    nearer = distances[1] <= (1 - config.corrections.least_outline_fall) * distances[0]
    return bool(nearer and errors[1].mean() <= (1 + config.selection.least_gain) * errors[0].mean())
