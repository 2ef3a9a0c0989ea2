"""The level set that a fit starts from: of a few plates between contacts and what they descend to, the one that makes
pixels agree best.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.first_surface.completion import completed, trusted_hull
from panoless.first_surface.mesh import TriangleMesh
from panoless.first_surface.visual_hull import carve_hull
from panoless.geometry.free_form.concave import Scored
from panoless.geometry.free_form.fit import coarse_stage
from panoless.geometry.free_form.observations import solid_pixels
from panoless.geometry.free_form.options import FreeFormOptions, FreeFormRound
from panoless.geometry.free_form.surface import LevelSet, level_set_of
from panoless.numeric.gauss_newton import keep_if_better
from shinypartial.io.progress import Progress


def first_level_set(views: Views, config: FitConfig) -> LevelSet:
    """The first surface as a level set, under the tension of the plate that leaves least disagreement, or what it
    descends to.

    Outlines don't tell how far an object bulges between their contacts: a stone does, a box does not. Candidates are
    solved once, without what holds them inside the hull, which hardly changes their disagreement.
    """
    options, first = config.free_form, config.first_surface
    known = trusted_hull(
        carve_hull(views, config.surfels.hull_resolution, config.surfels.hull_votes, first), views, first
    )

    def level_set(mesh: TriangleMesh) -> LevelSet:
        return level_set_of(mesh, options.start_cells, options.margin)

    pixels = solid_pixels(views, options.start_pixels)
    inner = pixels.inner_px > options.inner_px
    scored = Scored(pixels.rays.chosen(inner), pixels.radiance[inner], options.concave)

    def disagreement(surface: LevelSet) -> float:
        return scored(surface, options.concave.resolutions[-1])

    if not inner.any():
        return level_set(completed(known, first, options.start_tensions[0]))
    candidates = {tension: level_set(completed(known, first, tension, rounds=1)) for tension in options.start_tensions}
    order = sorted(candidates, key=lambda tension: disagreement(candidates[tension]))
    plain = level_set(completed(known, first, order[0]))
    starts = [candidates[tension] for tension in order[: options.descent.followed]]
    return started(views, plain, starts, disagreement, options)


def started(
    views: Views,
    plain: LevelSet,
    candidates: Sequence[LevelSet],
    disagreement: Callable[[LevelSet], float],
    options: FreeFormOptions,
) -> LevelSet:
    """What the best of the candidates descends to, if pixels agree better under it than under a plain start, both after
    the first round of the fit.
    """
    descent = options.descent
    if not descent.rounds:
        return plain
    short = replace(options, outline_points=min(descent.outline_points, options.outline_points), poses="off")
    tried, rest = descent.rounds[: descent.tried], descent.rounds[descent.tried :]
    steps = [each.steps for each in (*tried * len(candidates), *rest, *options.rounds[:1] * 2)]
    progress = Progress("looking for a start", sum(steps))

    def taken(surface: LevelSet, rounds: Sequence[FreeFormRound], options: FreeFormOptions) -> LevelSet:
        return coarse_stage(views, surface, rounds, options, progress).surface

    with torch.no_grad():
        best = min((taken(each, tried, short) for each in candidates), key=disagreement)
        descended = taken(best, rest, short)
        return keep_if_better(
            (plain, descended), lambda each: disagreement(taken(each, options.rounds[:1], options)), descent.least_gain
        )
