"""Masks that are too small or too large by one distance, where held-out views ask for it."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from panoless.capture.corrections import Corrections
from panoless.capture.silhouettes import silhouette_distance_px
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.geometry.base import Family, Geometry
from panoless.journal import remembered
from panoless.selection.fitted import (
    Fitted,
    Refit,
    another_takes_on,
    errors_in_common,
    held_out_errors,
    outline_pull_px,
    pixels_inside,
    with_solid,
)
from panoless.selection.held_out import is_clearly_lower


def masks_are_doubted(views: Views, geometry: Geometry, errors: Float[np.ndarray, "V"], config: FitConfig) -> bool:
    """Whether a geometry leaves much unexplained, or photographs pull its outlines off those of the masks; not where
    another kind takes it on.
    """
    options = config.corrections
    if another_takes_on(geometry, errors, config):
        return False
    if errors.mean() > options.largest_error:
        return True
    return _is_doubted(outline_pull_px(views, geometry), config)


def _is_doubted(pull_px: float, config: FitConfig) -> bool:
    """Whether photographs pull outlines farther off the masks than off right ones."""
    return not -config.corrections.doubted_inward_px <= pull_px <= config.corrections.doubted_outward_px


def with_moved_masks(source: Family, views: Views, fitted: Fitted, config: FitConfig, refit: Refit) -> Fitted:
    """Fitted anew to masks that are larger or smaller, if held-out views are clearly better explained by that; then
    once more where photographs pull that surface's outlines off the moved ones.
    """
    options = config.corrections
    offset = find_mask_offset(source, fitted.corrections.applied(views, config), fitted, config)
    found = _moved_by(offset, views, fitted, config, refit) if offset else None
    if found is None or not _offset_is_earned(views, fitted, found, config):
        return fitted
    pull = outline_pull_px(found.corrections.applied(views, config), found.geometry)
    if abs(pull) < options.least_pull_px:
        return found
    nearer_px = _within_largest(found.corrections.mask_offset_px + pull / options.pull_share, config)
    nearer = _moved_by(nearer_px, views, found, config, refit)
    return nearer if nearer is not None and _explains_more(views, found, nearer, config) else found


def _within_largest(offset_px: float, config: FitConfig) -> float:
    return float(np.clip(offset_px, -config.corrections.largest_px, config.corrections.largest_px))


def _moved_by(offset_px: float, views: Views, before: Fitted, config: FitConfig, refit: Refit) -> Fitted | None:
    """Fitted from scratch to masks that are moved outward by so much in all."""
    corrections = replace(before.corrections, mask_offset_px=offset_px)
    again = refit(corrections.applied(views, config), before, anew=True)
    return None if again is None else replace(again, corrections=corrections)


@remembered()
def find_mask_offset(source: Family, views: Views, fitted: Fitted, config: FitConfig) -> float:
    """By how much all masks are too small, in pixels: where proposals of moved outlines leave least unexplained.

    Counted are the pixels that all trials have in common, and all that each has: those beside an outline that lies too
    far outside show no object. The least of a parabola through the best offset and its neighbors. Zero where all
    of them leave too much unexplained to tell anything, as flat mirrors do of a convex one.
    """
    options, poses = config.corrections, fitted.geometry.poses
    inner = [pixels_inside(view.mask, options.largest_px) for view in views.train]
    depth = float(np.median([-float(silhouette_distance_px(view.mask).min()) for view in views.train]))

    def disagreement(offset: float) -> float:
        if -offset > depth / 4:
            return np.inf
        moved = Corrections(offset).applied(views, config)
        proposal = source.propose(moved if poses is None else poses.moved(moved), config, asked=False)
        if proposal is None:
            return np.inf
        outline, common = source.as_proposed(proposal, config), with_solid(moved, inner)
        return float(sum(held_out_errors(each, outline.with_poses(poses), config).mean() for each in (moved, common)))

    step = options.step_px
    tried = {offset: disagreement(offset) for offset in (-step, 0.0, step)}
    while (best := min(tried, key=tried.__getitem__)) in (min(tried), max(tried)) and abs(best) < options.largest_px:
        beyond = _within_largest(best + np.copysign(step, best), config)
        tried[beyond] = disagreement(beyond)
    if tried[best] > 2 * config.selection.largest_error:
        return 0.0
    for _ in range(options.halvings):
        step /= 2
        beside = (each for each in (best - step, best + step) if abs(each) <= options.largest_px)
        tried |= {offset: disagreement(offset) for offset in beside}
        best = min(tried, key=tried.__getitem__)
    before, least, after = (tried.get(best + shift, np.inf) for shift in (-step, 0, step))
    if not np.isfinite([before, least, after]).all():
        return best
    return best + step / 2 * (before - after) / max(before - 2 * least + after, 1e-12)


def _offset_is_earned(views: Views, before: Fitted, after: Fitted, config: FitConfig) -> bool:
    """Whether held-out views are clearly better explained after masks were moved, on the pixels that both have; or, of
    masks that were too large, on those that each has, and no worse on the common ones.
    """
    common = errors_in_common(views, before, after, config)
    if is_clearly_lower(common[1], common[0], config.selection):
        return True
    seen = [each.corrections.applied(views, config) for each in (before, after)]
    own = [held_out_errors(part, each.geometry, config) for part, each in zip(seen, (before, after), strict=True)]
    no_worse = common[1].mean() <= (1 + config.selection.least_gain) * common[0].mean()
    return bool(no_worse and is_clearly_lower(own[1], own[0], config.selection))


def _explains_more(views: Views, before: Fitted, after: Fitted, config: FitConfig) -> bool:
    errors = errors_in_common(views, before, after, config)
    return bool(errors[1].mean() < errors[0].mean())
