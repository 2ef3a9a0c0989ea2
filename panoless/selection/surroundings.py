"""How near the surroundings are, before a shape is fitted in them.

A shape that believes in a far world bends until it agrees with a near one as well as it can, and then hides how near
that is. A shape from silhouettes alone knows of no light, so it tells the distance at once.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.views import Views, every_kth_pixel, split_held_out
from panoless.config import FitConfig
from panoless.environment.nearness import LeavingRays, Linearized, found_surroundings
from panoless.environment.options import SurroundingsOptions
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.environment.surroundings import FAR, SHARPEST, Surroundings
from panoless.geometry.base import Family, Geometry, Proposal, usable_views
from panoless.selection.held_out import is_clearly_lower

NEARER = 1e-2
"""By which 1/D is changed to tell where a ray leaves the object; not tuned."""


def proposed_surroundings(family: Family, views: Views, proposal: Proposal, config: FitConfig) -> Surroundings:
    """A sphere around the proposed shape, if held-out views ask for one clearly; else a far world.

    Far worlds pay for one linearized step under a coarse map. A wrong shape may ask for a sphere, too, so a fit in it
    has to prove itself (see `explains_clearly_more`).
    """
    options, geometry = config.surroundings, family.as_proposed(proposal, config)
    if options.mode == "off" or geometry is None or not np.isfinite(proposal.silhouette_px):
        return FAR
    start = FAR.with_degree(0)
    with torch.no_grad():
        if options.mode == "auto" and not _is_pulled(views, geometry, options):
            return FAR
        kept, held_out = split_held_out(leaving_rays(views, geometry, options.rays))
        if not kept or not held_out:
            return FAR
        found = found_surroundings(joined(kept), start, options)
        near, far = (_errors(kept, held_out, each, options) for each in (found, FAR))
    if options.mode == "auto" and not is_clearly_lower(near, far, config.selection):
        return FAR
    if found.coefficients[0] <= 0:
        return FAR
    return (
        found if options.degree == 0 else found_surroundings(joined(kept), found.with_degree(options.degree), options)
    )


def brought_near(
    views: Views, far: Geometry, follow: Callable[[Geometry, Surroundings], Geometry | None], config: FitConfig
) -> Geometry:
    """The fit of a kind in a far world, or in near surroundings that a shape from silhouettes did not tell.

    A shape that bent until it agreed with a far world hides most of how near it is, but not all. Where rays ask for
    near surroundings, `follow` takes the fit on in a wide sphere and then in one half as wide, as long as held-out
    views are explained clearly better.
    """
    options, best = config.surroundings, far
    inverse = options.first_inverse_distance
    if options.mode == "off":
        return far
    with torch.no_grad():
        if not _is_pulled(views if far.poses is None else far.poses.moved(views), far, options):
            return far
    while inverse < SHARPEST:
        near = follow(best, Surroundings(np.array([inverse])))
        if near is None or near.surroundings.is_far or not explains_clearly_more(views, near, best, config):
            break
        best, inverse = near, 2 * inverse
    return best


def _is_pulled(views: Views, geometry: Geometry, options: SurroundingsOptions) -> bool:
    """Whether a step toward near surroundings, under a coarse map and from some of the views, promises enough."""
    some = replace(views, train=views.train[:: -(-len(views.train) // options.checked_views)])
    rays = joined(leaving_rays(some, geometry, options.checked_rays))
    step = Linearized.at(rays, FAR.with_degree(0), options.checked_resolution, options)
    return step.pull(options.least_share) >= options.least_pull


def explains_clearly_more(views: Views, near: Geometry, far: Geometry, config: FitConfig) -> bool:
    """Whether held-out views, under the map of the others, are explained clearly better by one fit than by another.

    Both have seen all views, one of them with one number more.
    """
    options, errors = config.surroundings, []
    for geometry in (near, far):
        with torch.no_grad():
            seen = usable_views(views, geometry)
            rays = [geometry.observe(*chosen) for chosen in every_kth_pixel(seen, options.judged_rays)]
            kept, held_out = split_held_out(rays)
            if not kept or not held_out:
                return False
            environment = solve_environment(kept, options.judged_resolution)
        errors.append(np.array([prediction_error([batch], environment) for batch in held_out]))
    return is_clearly_lower(errors[0], errors[1], config.selection)


def leaving_rays(views: Views, geometry: Geometry, count: int) -> list[LeavingRays]:
    """Of about so many usable pixels: what each view saw by them. Points are given across their rays only.

    A ray that leaves at x looks by κ x⊥ elsewhere into the map of a sphere with a small κ.
    """
    far, near = geometry.in_surroundings(FAR), geometry.in_surroundings(Surroundings(np.array([NEARER])))
    found = []
    for view, chosen in every_kth_pixel(views, count):
        pixels = far.usable_pixels(replace(view, solid=chosen))
        rays = far.observe(view, pixels)
        directions, moved = (
            each.directions.cpu().numpy().astype(np.float64) for each in (rays, near.observe(view, pixels))
        )
        radiance = rays.radiance.cpu().numpy().astype(np.float64)
        found.append(LeavingRays((moved - directions) / NEARER, directions, radiance))
    return found


def joined(parts: list[LeavingRays]) -> LeavingRays:
    """All of them in one."""
    points, directions, radiance = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("points", "directions", "radiance")
    )
    return LeavingRays(points, directions, radiance)


def _errors(
    kept: list[LeavingRays], held_out: list[LeavingRays], surroundings: Surroundings, options: SurroundingsOptions
) -> Float[np.ndarray, "V"]:
    """Mean ‖e‖²/(‖e‖² + s²) of each held-out view under the map of the others."""
    environment = solve_environment([each.rays(surroundings) for each in kept], options.judged_resolution)
    return np.array([prediction_error([each.rays(surroundings)], environment) for each in held_out])
