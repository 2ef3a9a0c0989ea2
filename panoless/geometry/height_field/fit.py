"""A bent mirror from photographs: edge and frame by silhouettes, then all heights by what is mirrored, on a grid as
fine as held-out views ask for.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TypeVar, cast

import torch

from panoless.capture.views import Views, every_kth_pixel, split_held_out
from panoless.environment.rays import Rays
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.height_field.model import HeightField, flat_height_field, visible_reflections
from panoless.geometry.height_field.unknowns import HeightFieldUnknowns
from panoless.geometry.plane.model import Plane
from panoless.journal import remembered
from panoless.numeric.gauss_newton import keep_if_better
from panoless.problem.equations import Round
from panoless.problem.solve import FINISH, after_round, by_outlines_alone
from panoless.problem.solve import ROUNDS as JOINT_ROUNDS
from shinypartial.io.progress import Progress

Bent = TypeVar("Bent", bound=HeightField)
CELLS = 16
"""Cells of the spline along the longer side of the boundary, to begin with."""
HALVINGS = 1
"""How often they may be halved, where held-out views gain by it."""
JUDGED_STEPS = 2
"""Steps on a finer grid after which it is judged."""
START_SLOPES = (0.0, 0.2, 0.4, 0.6, -0.2, -0.4, -0.6)
"""Domes and bowls, by their slope at the edge, of which the one that photographs agree on best is the start."""
SLOPE_STEPS = (0.1, 0.05, 0.025)
"""By these the best of them is made steeper or flatter, unless it is flat."""
EDGE_BENDING = 1e-2
"""Weight of the bending energy in the first steps, against the mean diagonal of the data."""
ROUNDS = (*JOINT_ROUNDS, replace(FINISH, rays=200_000))
"""From coarse to fine; known cameras need fewer pixels. Only in the last do photographs determine the tilt of the
whole."""
DOMES = Round(16, 0.5, 60_000, 0)
"""The map under which domes are compared."""
CLEARANCES = (0.03, 0.06, 0.12)
"""Heights over the plane, in radii of the object, that mirrored rays may have to pass at the rim, tried in turn."""
LEAST_CLEARED = 0.1
"""Share of the held-out error by which one has to lower it."""


def fit_height_field(
    views: Views,
    plane: Plane,
    fitted: HeightField | None = None,
    *,
    cells: int = CELLS,
    halvings: int = HALVINGS,
    rounds: Sequence[Round] = ROUNDS,
) -> HeightField:
    """The heights over a plane, and the plane itself, that explain silhouettes and photographs best.

    The silhouettes alone give the plane of a frame that stands out, and the heights along the mirror's edge. Then come
    rounds of silhouettes and photographs together, with the map eliminated (see `panoless.problem.solve`).
    One that was `fitted` to almost the same views goes on in the last round, on its grid.
    """
    last = rounds[-1]
    with torch.no_grad():
        if fitted is not None:
            return refine(views, fitted, last, last)
        flat = HeightFieldUnknowns(flat_height_field(plane, cells), EDGE_BENDING)
        height_field = by_outlines_alone(views, flat).height_field
        progress = Progress("fitting a bent mirror", len(rounds) + 3)
        height_field = best_dome(views, height_field)
        progress.advance()
        for each in rounds:
            height_field = refine(views, height_field, each, last)
            progress.advance()
        height_field = on_finer_grids(views, height_field, halvings, last)
        progress.advance()
        error = held_out_error(views, last)
        if error is not None:
            cleared = _cleared(height_field, error)
            if cleared is not height_field:
                height_field = refine(views, cleared, last, last)
        progress.advance()
    return height_field


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


def _cleared(height_field: HeightField, error: Callable[[HeightField], float]) -> HeightField:
    """With the height that mirrored rays have to pass, as long as what is left out was clearly worse explained."""
    least = error(height_field)
    for height in CLEARANCES:
        higher = replace(height_field, clearance=height)
        left = error(higher)
        if left > (1 - LEAST_CLEARED) * least:
            break
        height_field, least = higher, left
    return height_field


def held_out_error(views: Views, last: Round) -> Callable[[HeightField], float] | None:
    """What a height field leaves unexplained of held-out views; None without such views."""
    kept, held_out = (replace(views, train=tuple(part)) for part in split_held_out(views.train))
    return (lambda each: _unexplained(kept, held_out, each, last)) if held_out.train else None


def on_finer_grids(views: Views, height_field: Bent, halvings: int, last: Round) -> Bent:
    """The height field on finer grids, as long as held-out views gain by them.

    The coarser one was fitted to all views, so a finer grid has to gain a little more than that.
    """
    error, kept = held_out_error(views, last), replace(views, train=tuple(split_held_out(views.train)[0]))
    for _ in range(halvings if error is not None else 0):
        assert error is not None, "views are held out"
        finer = cast(Bent, height_field.with_halved_cells())
        candidate = refine(kept, finer, replace(last, steps=JUDGED_STEPS), last)
        if keep_if_better((height_field, candidate), error) is height_field:
            return height_field
        height_field = refine(views, candidate, last, last)
    return height_field


def refine(views: Views, height_field: Bent, each: Round, last: Round = FINISH) -> Bent:
    """After one round; under the maps of the last one photographs determine the tilt."""
    return cast(Bent, after_round(views, HeightFieldUnknowns(height_field), each, last.resolution).height_field)


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
