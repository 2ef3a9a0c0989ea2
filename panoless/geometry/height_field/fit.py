"""A bent mirror beside its joint solve: the dome that it starts from, and what its rim hides."""

from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar, cast

import torch

from panoless.capture.views import Views, every_kth_pixel, held_out_parts
from panoless.environment.rays import Rays
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.height_field.model import HeightField, visible_reflections
from panoless.geometry.height_field.unknowns import HeightFieldUnknowns
from panoless.journal import remembered
from panoless.problem.equations import Round
from panoless.problem.solve import FINISH, after_round

Bent = TypeVar("Bent", bound=HeightField)
CELLS = 16
"""Cells of the spline along the longer side of the boundary, to begin with."""
START_SLOPES = (0.0, 0.2, 0.4, 0.6, -0.2, -0.4, -0.6)
"""Domes and bowls, by their slope at the edge, of which the one that photographs agree on best is the start."""
SLOPE_STEPS = (0.1, 0.05, 0.025)
"""By these the best of them is made steeper or flatter, unless it is flat."""
LAST = replace(FINISH, rays=200_000)
"""The round of known cameras, which need fewer pixels."""
DOMES = Round(16, 0.5, 60_000, 0)
"""The map under which domes are compared."""
CLEARANCES = (0.03, 0.06, 0.12)
"""Heights over the plane, in radii of the object, that mirrored rays may have to pass at the rim, tried in turn."""
LEAST_CLEARED = 0.1
"""Share of the held-out error by which one has to lower it."""


@remembered()
def best_dome(views: Views, height_field: HeightField) -> HeightField:
    """The heights with the dome or bowl more under which photographs agree best: of those to begin with, and then of
    others that are a little steeper or flatter.
    """
    errors: dict[float, float] = {}

    def best_of(slopes: Iterable[float]) -> float:
        for slope in slopes:
            if slope not in errors:
                errors[slope] = _unexplained(views, views, height_field.domed(slope), DOMES)
        return min(errors, key=errors.__getitem__)

    slope = best_of(START_SLOPES)
    for step in SLOPE_STEPS if slope else ():
        slope = best_of((slope - step, slope + step))
    return height_field.domed(slope)


def cleared(views: Views, height_field: HeightField) -> HeightField:
    """With the height that mirrored rays have to pass, as long as what is left out was clearly worse explained, and
    after one more round if there is any.
    """
    parts = held_out_parts(views)
    if parts is None:
        return height_field
    with torch.no_grad():
        found, least = height_field, _unexplained(*parts, height_field, LAST)
        for height in CLEARANCES:
            higher = replace(height_field, clearance=height)
            left = _unexplained(*parts, higher, LAST)
            if left > (1 - LEAST_CLEARED) * least:
                break
            found, least = higher, left
        return found if found is height_field else refined(views, found)


def refined(views: Views, height_field: Bent, settings: Round = LAST) -> Bent:
    """After a round in which nothing else is unknown."""
    with torch.no_grad():
        found = after_round(views, HeightFieldUnknowns(height_field), settings, FINISH.resolution)
    return cast(Bent, found.height_field)


def _unexplained(solved: Views, tested: Views, height_field: HeightField, each: Round) -> float:
    """The mean bounded error of some views under the map of others; 1 where nothing is seen."""
    known = _seen(solved, height_field, each.rays)
    shown = known if tested is solved else _seen(tested, height_field, each.rays)
    return prediction_error(shown, solve_environment(known, each.resolution), each.robust_scale)


def _seen(views: Views, height_field: HeightField, count: int) -> list[Rays]:
    """What about `count` pixels of all views see of the surroundings."""
    rays = []
    for view, pixels in every_kth_pixel(views, count):
        found = visible_reflections(height_field, view, pixels)
        rays.append(Rays(torch.from_numpy(found.outgoing).to(view.radiance), view.radiance_at(found.pixels)))
    return rays
