"""What photographs get wrong, by what a geometry explains of them: exposures that differ, masks that are off, and a
focal length that is.

They are believed to be right until held-out views speak against it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.alignment.equations import PoseRows, outline_rows
from panoless.alignment.lens import FocalPull, focal_pull
from panoless.alignment.search import PosedProposal
from panoless.capture.corrections import NO_CORRECTIONS, Corrections
from panoless.capture.encoding import SATURATED, encoding_of
from panoless.capture.silhouettes import mask_distance_px
from panoless.capture.views import Views, at_most_pixels
from panoless.config import FitConfig
from panoless.environment.exposure import exposure_gains
from panoless.environment.rays import Rays
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.environment.surroundings import FAR
from panoless.geometry.base import Family, Geometry, observe_views, usable_views
from panoless.geometry.registry import FAMILIES
from panoless.kernels.cubemap import sample_cubemap
from panoless.numeric.robust import robust_weight
from panoless.selection.held_out import held_out_parts, is_clearly_lower, unexplained
from panoless.selection.options import CorrectionOptions


@dataclass(frozen=True)
class Fitted:
    """A geometry, what it was fitted from, and the corrections of the photographs that it was fitted to."""

    geometry: Geometry
    start: PosedProposal
    corrections: Corrections = NO_CORRECTIONS


PULLED_VIEWS = 8
"""From so many views at most the pull of photographs on outlines is told."""
Refit = Callable[[Views], Fitted | None]
"""Proposes and fits a kind anew to corrected views."""


def with_corrections(source: Family, views: Views, first: Fitted, config: FitConfig, refit: Refit) -> Fitted:
    """A fit, or another of corrected photographs where held-out views are clearly better explained by it.

    `source` makes the proposals of the kind. Exposures come first: they need no other geometry to be told. A kind that
    explains any outlines has only begun to be fitted, and tells nothing yet.
    """
    options, best = config.corrections, first
    if options.masks == options.exposure == options.lens == "off" or held_out_parts(views) is None:
        return first
    if source.as_proposed(first.start.proposal, config) is None:
        return first
    errors, equal = _examined(views, first, config), None
    if options.exposure == "auto" and not encoding_of(config).high_dynamic_range:
        equal = _earned_exposures(views, first, errors, config)
    if equal is not None:
        best, errors = replace(first, corrections=equal[0]), equal[1]
    if options.masks == "auto" and _masks_are_doubted(views, best.geometry, errors, config):
        best = _with_moved_masks(source, views, best, config, refit)
    if options.lens != "off" and not _another_takes_on(best.geometry, errors, config):
        best = _with_focal_length(views, best, config, refit)
    if best.corrections.gains is None:
        return best
    if best.geometry is first.geometry:
        best = _fitted_to_equal_exposures(views, best, config, refit)
    return replace(best, corrections=_equal_exposures(views, best, config))


def _halves(views: Views, fitted: Fitted, config: FitConfig) -> tuple[list[Rays], list[Rays]]:
    """What four fifths of the views observed, and what the others did."""
    most = config.corrections.examined_rays
    parts = held_out_parts(usable_views(_fewer(views, 2 * most), fitted.geometry))
    assert parts is not None
    with torch.no_grad():
        solved, tested = (list(observe_views(part, fitted.geometry, most)) for part in parts)
    return solved, tested


def _examined(views: Views, fitted: Fitted, config: FitConfig) -> Float[np.ndarray, "V"]:
    """What a fit leaves unexplained of every second pixel of each held-out view."""
    solved, tested = _halves(views, fitted, config)
    with torch.no_grad():
        environment = solve_environment(solved, config.selection.trial_resolution)
        return np.array([prediction_error([rays.every(2, 1)], environment) for rays in tested])


def _earned_exposures(
    views: Views, fitted: Fitted, errors: Float[np.ndarray, "V"], config: FitConfig
) -> tuple[Corrections, Float[np.ndarray, "V"]] | None:
    """Gains of all views by the geometry of a fit, and what is unexplained then of the pixels that `errors` are of.

    None where these are not clearly better explained.

    The map is that of the other views at equal exposure; a held-out view's other pixels tell its own gain.
    """
    corrections = _equal_exposures(views, fitted, config)
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


def _equal_exposures(views: Views, fitted: Fitted, config: FitConfig) -> Corrections:
    """The corrections of a fit with gains by its geometry."""
    bare = replace(fitted.corrections, gains=None)
    usable = _fewer(bare.applied(views, encoding_of(config)), 2 * config.corrections.rays)
    with torch.no_grad():
        seen = observe_views(usable_views(usable, fitted.geometry), fitted.geometry, config.corrections.rays)
        return replace(bare, gains=_gains(list(seen), config))


def _fitted_to_equal_exposures(views: Views, fitted: Fitted, config: FitConfig, refit: Refit) -> Fitted:
    """Fitted anew to views of equal exposure, where these are better explained by that."""
    equal = fitted.corrections.applied(views, encoding_of(config))
    again = refit(equal)
    if again is None or _error(equal, again.geometry, config).mean() > _error(equal, fitted.geometry, config).mean():
        return fitted
    return replace(again, corrections=fitted.corrections)


def is_refined(kind: str) -> bool:
    """Whether another kind takes on this one's proposal where it is refused."""
    return kind in {family.refines for family in FAMILIES.values()}


def _another_takes_on(geometry: Geometry, errors: Float[np.ndarray, "V"], config: FitConfig) -> bool:
    """Whether a geometry leaves so much unexplained that another kind is to take it on."""
    return bool(is_refined(geometry.kind) and errors.mean() > config.selection.largest_error)


def _masks_are_doubted(views: Views, geometry: Geometry, errors: Float[np.ndarray, "V"], config: FitConfig) -> bool:
    """Whether a geometry leaves much unexplained, or photographs pull its outlines off those of the masks; not where
    another kind takes it on.
    """
    options = config.corrections
    if _another_takes_on(geometry, errors, config):
        return False
    return (
        bool(errors.mean() > options.largest_error) or abs(outline_pull_px(views, geometry)) > options.doubted_pull_px
    )


def _with_moved_masks(source: Family, views: Views, fitted: Fitted, config: FitConfig, refit: Refit) -> Fitted:
    """Fitted anew to masks that are larger or smaller, if held-out views are clearly better explained by that; then
    once more where photographs pull that surface's outlines off the moved ones.
    """
    encoding, options = encoding_of(config), config.corrections

    def moved_by(offset: float) -> Fitted | None:
        corrections = replace(fitted.corrections, mask_offset_px=offset)
        again = refit(corrections.applied(views, encoding)) if offset else None
        return None if again is None else replace(again, corrections=corrections)

    found = moved_by(find_mask_offset(source, fitted.corrections.applied(views, encoding), fitted, config))
    if found is None or not _offset_is_earned(views, fitted, found, config):
        return fitted
    pull = outline_pull_px(found.corrections.applied(views, encoding), found.geometry)
    if abs(pull) < options.least_pull_px:
        return found
    nearer = moved_by(found.corrections.mask_offset_px + pull / options.pull_share)
    return nearer if nearer is not None and _explains_more(views, found, nearer, config) else found


@dataclass(frozen=True)
class _FocalTrial:
    """A fit to another focal length, the logarithm of that over the first, and what pull is left."""

    change: float
    fitted: Fitted
    pull: FocalPull

    @classmethod
    def of(cls, views: Views, change: float, fitted: Fitted, config: FitConfig) -> "_FocalTrial":
        """With the pull of the views as they are corrected for that fit."""
        options, seen = config.corrections, fitted.corrections.applied(views, encoding_of(config))
        numbers = options.focal_rays, options.focal_resolution, options.focal_scale
        alike = _looks_like_a_focal_length(seen, fitted.geometry, options)
        geometry = fitted.geometry.in_surroundings(FAR) if alike else fitted.geometry
        return cls(change, fitted, focal_pull(seen, geometry, *numbers))


def _with_focal_length(views: Views, fitted: Fitted, config: FitConfig, refit: Refit) -> Fitted:
    """Fitted anew to other focal lengths until photographs pull no more, which is found by secants. Of the trials the
    one nearest to the zero of a line through all pulls is kept, if held-out views are clearly better explained by it
    and the factor is told better than it is known.
    """
    options, encoding = config.corrections, encoding_of(config)
    trials = [_FocalTrial.of(views, 0.0, fitted, config)]
    if abs(trials[0].pull.step) < options.least_focal_pull:
        return fitted
    following: float | None = _step_from(trials[0], options.focal_share, options.largest_focal_step)
    for _ in range(options.focal_trials):
        if following is None or any(abs(each.change - following) < options.settled_focal for each in trials):
            break
        factor = fitted.corrections.focal_factor * float(np.exp(following))
        corrections = replace(fitted.corrections, focal_factor=factor)
        again = refit(corrections.applied(views, encoding))
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
    if options.lens == "auto" and not (
        uncertainty < options.focal_prior and _focal_length_is_earned(views, fitted, found.fitted, config)
    ):
        return fitted
    factor = found.fitted.corrections.focal_factor
    told = replace(found.fitted.corrections, focal_uncertainty=factor * uncertainty)
    return replace(found.fitted, corrections=told)


def _looks_like_a_focal_length(views: Views, geometry: Geometry, options: CorrectionOptions) -> bool:
    """Whether surroundings are so little near that a focal length may show the same: a flat mirror at the distance d
    from its cameras shows a sphere of the radius d/s as it shows a far world through a lens that is wrong by s.
    """
    coefficients, cameras = geometry.surroundings.coefficients, [np.linalg.norm(view.position) for view in views.train]
    return len(coefficients) > 0 and bool(coefficients[0] * np.median(cameras) < 3 * options.focal_prior)


def _step_from(trial: _FocalTrial, share: float, largest: float) -> float:
    """Where nothing would pull if that were the share of a change that pulls."""
    return trial.change + float(np.clip(trial.pull.step / share, -largest, largest))


def _by_pull(trials: Sequence[_FocalTrial]) -> list[_FocalTrial]:
    return sorted(trials, key=lambda each: abs(each.pull.step))


def _share(one: _FocalTrial, other: _FocalTrial) -> float:
    """By how much the pull falls with the change."""
    return (other.pull.step - one.pull.step) / (one.change - other.change)


def _following(trials: Sequence[_FocalTrial], largest: float) -> float | None:
    """The zero of the secant through the two trials of least pull; None where the pull grows with the change."""
    one, other = _by_pull(trials)[:2]
    share = _share(one, other)
    return _step_from(one, share, largest) if share > 0 else None


def _focal_length_is_earned(views: Views, before: Fitted, after: Fitted, config: FitConfig) -> bool:
    """Whether held-out views are clearly better explained; or, by a lens in place of near surroundings, no worse, and
    outlines are.
    """
    errors = _errors_in_common(views, before, after, config)
    limits = replace(config.selection, least_gain=config.corrections.least_focal_gain)
    if is_clearly_lower(errors[1], errors[0], limits):
        return True
    in_place = after.geometry.surroundings.is_far and not before.geometry.surroundings.is_far
    encoding = encoding_of(config)
    distances = [
        _outline_distance_px(each.corrections.applied(views, encoding), each.geometry) for each in (before, after)
    ]
    nearer = distances[1] <= (1 - config.corrections.least_outline_fall) * distances[0]
    return bool(in_place and nearer and errors[1].mean() <= (1 + config.selection.least_gain) * errors[0].mean())


def outline_pull_px(views: Views, geometry: Geometry) -> float:
    """How far outside the masks the outlines of a geometry lie: the median over views of the median.

    A fit weighs outlines against photographs, so its outlines give way a little where masks are off.
    """
    found = [np.median(each.residual) for each in _outlines(views, geometry)]
    return float(np.median(found)) if found else 0.0


def _outline_distance_px(views: Views, geometry: Geometry) -> float:
    """The same of distances without a sign."""
    found = [each.typical for each in _outlines(views, geometry)]
    return float(np.median(found)) if found else 0.0


def _outlines(views: Views, geometry: Geometry) -> Iterator[PoseRows]:
    """Of a geometry against the masks of a few views that see it."""
    train = geometry.corrected(views).train
    for view in train[:: -(-len(train) // PULLED_VIEWS)]:
        distance = mask_distance_px(view.mask.cpu().numpy()).astype(np.float64)
        rows = outline_rows(view, distance, geometry.buffers(view.camera))
        if len(rows.residual):
            yield rows


def find_mask_offset(source: Family, views: Views, fitted: Fitted, config: FitConfig) -> float:
    """By how much all masks are too small, in pixels: where proposals of moved outlines leave least unexplained.

    Counted are the pixels that all trials have in common, and all that each has: those beside an outline that lies too
    far outside show no object. The least of a parabola through the best offset and its neighbors.
    """
    options, poses = config.corrections, fitted.geometry.poses
    inner = [_pixels_inside(view.mask, options.largest_px) for view in views.train]
    depth = float(np.median([-mask_distance_px(view.mask.cpu().numpy()).min() for view in views.train]))

    def disagreement(offset: float) -> float:
        if -offset > depth / 4:
            return np.inf
        moved = Corrections(offset).applied(views, encoding_of(config))
        proposal = source.propose(moved if poses is None else poses.moved(moved), config, asked=False)
        outline = None if proposal is None else source.as_proposed(proposal, config)
        if outline is None:
            return np.inf
        common = _with_solid(moved, inner)
        return float(sum(_error(each, outline.with_poses(poses), config).mean() for each in (moved, common)))

    step = options.step_px
    tried = {offset: disagreement(offset) for offset in (-step, 0.0, step)}
    while (best := min(tried, key=tried.__getitem__)) in (min(tried), max(tried)) and abs(best) < options.largest_px:
        beyond = best + float(np.copysign(step, best))
        tried[beyond] = disagreement(beyond)
    before, least, after = (tried.get(best + shift, np.inf) for shift in (-step, 0, step))
    if not np.isfinite([before, least, after]).all():
        return best
    return best + step / 2 * (before - after) / max(before - 2 * least + after, 1e-12)


def _pixels_inside(mask: Float[Tensor, "H W"], depth_px: float) -> Int[Tensor, "P"]:
    """Flat indices of the pixels that lie deeper inside a mask."""
    distance = torch.from_numpy(mask_distance_px(mask.cpu().numpy())).to(mask.device)
    return torch.nonzero(distance.flatten() < -depth_px)[:, 0]


def _with_solid(views: Views, pixels: Sequence[Int[Tensor, "_"]]) -> Views:
    chosen = zip(views.train, pixels, strict=True)
    return replace(views, train=tuple(replace(view, solid=solid) for view, solid in chosen))


def _fewer(views: Views, most: int) -> Views:
    """The views with no more than so many solid pixels. Every other of them is observed, so that none is weighed by the
    area beside it."""
    return _with_solid(views, [pixels for _, pixels in at_most_pixels(views, most)])


def _error(views: Views, geometry: Geometry, config: FitConfig) -> Float[np.ndarray, "V"]:
    """What a geometry leaves unexplained of each held-out view."""
    parts = held_out_parts(usable_views(_fewer(views, 2 * config.corrections.rays), geometry))
    assert parts is not None
    return unexplained(*parts, geometry, config.corrections.rays, config.corrections.resolution)


def _offset_is_earned(views: Views, before: Fitted, after: Fitted, config: FitConfig) -> bool:
    """Whether held-out views are clearly better explained after masks were moved, on the pixels that both have; or, of
    masks that were too large, on those that each has, and no worse on the common ones.
    """
    common = _errors_in_common(views, before, after, config)
    if is_clearly_lower(common[1], common[0], config.selection):
        return True
    seen = [each.corrections.applied(views, encoding_of(config)) for each in (before, after)]
    own = [_error(part, each.geometry, config) for part, each in zip(seen, (before, after), strict=True)]
    no_worse = common[1].mean() <= (1 + config.selection.least_gain) * common[0].mean()
    return bool(no_worse and is_clearly_lower(own[1], own[0], config.selection))


def _explains_more(views: Views, before: Fitted, after: Fitted, config: FitConfig) -> bool:
    errors = _errors_in_common(views, before, after, config)
    return bool(errors[1].mean() < errors[0].mean())


def _errors_in_common(
    views: Views, before: Fitted, after: Fitted, config: FitConfig
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """What two fits leave unexplained of the pixels that are solid for both."""
    said, moved = (each.corrections.applied(views, encoding_of(config)) for each in (before, after))
    solid = [one.solid[torch.isin(one.solid, other.solid)] for one, other in zip(said.train, moved.train, strict=True)]
    errors = [
        _error(_with_solid(seen, solid), each.geometry, config) for seen, each in ((said, before), (moved, after))
    ]
    return errors[0], errors[1]
