"""How near the surroundings are, before a shape is fitted in them.

A shape that assumes a far world bends until it agrees with a near one as well as it can, and then hides how near
that is. A shape from silhouettes alone knows of no light, so it determines the distance at once.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.views import Views, every_kth_pixel, split_held_out
from panoless.config import FitConfig
from panoless.environment.nearness import LeavingRays, Linearized, found_surroundings, upward, with_floor
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.environment.surroundings import FAR, Surroundings
from panoless.geometry.base import Family, Geometry, Proposal, usable_views
from panoless.journal import remembered
from panoless.selection.held_out import LEAST_GAIN, is_clearly_lower

RAYS = 60_000
"""About so many pixels of all views determine how near they are."""
CHECKED_VIEWS = 10
"""So many views determine whether to look closer…"""
CHECKED_RAYS = 20_000
"""…by about so many pixels…"""
CHECKED_RESOLUTION = 8
"""…and a first step under a map of so many texels along a face side."""
LEAST_PULL = 0.0003
"""Share of the cost that this step has to promise: 0.02 to 0.06 in rooms, up to 0.0001 in far worlds."""
LARGEST_FLOOR_COST = 0.99
"""Share of the cost in a far world that a floor may leave where it is looked at closer."""
LEAST_FLOOR_GAIN = 0.02
"""Share of the cost of walls alone by which a floor before walls has to be below it."""
JUDGED_RAYS = 400_000
"""About so many pixels of all views determine whether a fit in near surroundings explains more than a far one."""
JUDGED_RESOLUTION = 64
"""Texels along a face side of the map that predicts held-out views, and under which a floor is compared."""

NEARER = 1e-2
"""By which 1/D is changed to determine where a ray leaves the object; not tuned."""


@remembered()
def proposed_surroundings(
    family: Family, views: Views, proposal: Proposal, config: FitConfig, *, rays_taken: int = RAYS
) -> Surroundings:
    """A sphere around the proposed shape, or a floor below it before a sphere, where one lowers the cost; else a far
    world. A ground that is stated is the floor.

    Far worlds pay for one linearized step and a few floors under coarse maps. A wrong shape may show either, too: walls
    are a block that is removed where it is not needed, and a fit above a floor is compared with one in a far world.
    """
    options = config.surroundings
    if options.mode == "off" or not np.isfinite(proposal.silhouette_px):
        return FAR
    with torch.no_grad():
        geometry = family.before_steps(views, proposal, config)
        if views.ground is not None and options.floor == "auto":
            rays = joined(leaving_rays(views, geometry, rays_taken))
            level, _ = with_floor(rays, views.ground.up, (views.ground.depth,))
            return found_surroundings(rays, level.with_degree(options.degree), known_floor=True)
        some = replace(views, train=views.train[:: -(-len(views.train) // CHECKED_VIEWS)])
        few = joined(leaving_rays(some, geometry, CHECKED_RAYS))
        near = Linearized.at(few, FAR.with_degree(0), CHECKED_RESOLUTION).pull() >= LEAST_PULL
        floored = options.floor == "auto" and with_floor(few, _up(views))[1] < LARGEST_FLOOR_COST
        if options.mode == "auto" and not near and not floored:
            return FAR
        rays = joined(leaving_rays(views, geometry, rays_taken))
        best = found_surroundings(rays, FAR.with_degree(0))
        if options.degree > 0:
            best = found_surroundings(rays, best.with_degree(options.degree))
        best = best if best.coefficients[0] > 0 else FAR
        if floored:
            level, _ = with_floor(rays, _up(views))
            above = found_surroundings(rays, level.with_degree(options.degree))
            costs = [Linearized.at(rays, each, JUDGED_RESOLUTION).cost for each in (above, best)]
            best = above if costs[0] < (1 - LEAST_FLOOR_GAIN) * costs[1] else best
    return best


def _up(views: Views) -> Float[np.ndarray, "3"]:
    """Where up is, if cameras were held level."""
    rotations = np.stack([view.camera.world_to_camera[:3, :3].cpu().numpy().astype(np.float64) for view in views.train])
    return upward(rotations[:, 0], -rotations[:, 1])


def explains_clearly_more(views: Views, near: Geometry, far: Geometry, least_gain: float = LEAST_GAIN) -> bool:
    """Whether held-out views, under the map of the others, are explained clearly better by one fit than by another.

    Both have seen all views, one of them with one number more.
    """
    errors = []
    for geometry in (near, far):
        with torch.no_grad():
            seen = usable_views(views, geometry)
            rays = [geometry.observe(*chosen) for chosen in every_kth_pixel(seen, JUDGED_RAYS)]
            kept, held_out = split_held_out(rays)
            if not kept or not held_out:
                return False
            environment = solve_environment(kept, JUDGED_RESOLUTION)
        errors.append(np.array([prediction_error([batch], environment) for batch in held_out]))
    return is_clearly_lower(errors[0], errors[1], least_gain)


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
