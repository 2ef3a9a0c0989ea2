"""The level set that a fit starts from: of a few plates between contacts and what they descend to, the one that makes
pixels agree best.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from panoless.capture.poses import StatedCameras
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.surroundings import FAR, Surroundings
from panoless.first_surface.completion import completed, trusted_hull
from panoless.first_surface.mesh import TriangleMesh
from panoless.first_surface.visual_hull import carve_hull
from panoless.geometry.free_form.concave import Scored
from panoless.geometry.free_form.fit import FitStage, coarse_stage
from panoless.geometry.free_form.options import FreeFormOptions, FreeFormRound
from panoless.geometry.free_form.surface import LevelSet, level_set_of
from panoless.numeric.gauss_newton import keep_if_better
from panoless.problem.nuisance import NO_NUISANCE, Nuisance
from panoless.problem.observations import solid_pixels
from shinypartial.io.progress import Progress


@dataclass(frozen=True)
class FirstSurfaces:
    """What a fit may start from, in one world: the plate whose pixels disagree least, held inside the hull, the hull
    itself, and the plates, which descend as the hull does.
    """

    plain: LevelSet
    hull: LevelSet
    plates: tuple[LevelSet, ...]
    surroundings: Surroundings = FAR

    @property
    def surface(self) -> LevelSet:
        """The plain one there."""
        return replace(self.plain, surroundings=self.surroundings)


def first_surfaces(views: Views, config: FitConfig) -> FirstSurfaces:
    """First surfaces as level sets, under the tensions of the plate that leave least disagreement.

    Outlines don't tell how far an object bulges between their contacts: a stone does, a box does not. Plates are
    solved once, without what holds them inside the hull, which hardly changes their disagreement.
    """
    options, carved = config.free_form, config.first_surface
    known = trusted_hull(carve_hull(views, carved.hull_resolution, carved.hull_votes), views)

    def level_set(mesh: TriangleMesh) -> LevelSet:
        return level_set_of(mesh, options.start_cells, options.margin)

    disagreement = _disagreement(views, options, options.start_pixels, options.start_resolution)
    plates = {tension: level_set(completed(known, tension, rounds=1)) for tension in options.start_tensions}
    best = min(plates, key=lambda tension: disagreement(FitStage.begun(plates[tension], options)))
    plain, hull = level_set(completed(known, best)), level_set(known.surface)
    return FirstSurfaces(plain, hull, tuple(plates.values()))


def started(
    views: Views, first: FirstSurfaces, options: FreeFormOptions, nuisance: Nuisance = NO_NUISANCE
) -> tuple[LevelSet, Nuisance]:
    """What a first surface descends to with its nuisance blocks, if pixels agree better under that than under the plain
    surface, both after the first round of the fit.

    Where they agree well enough under the plain surface, it alone descends, held by outlines. Elsewhere each plate and
    the hull do, held and not; after the first round of that, pixels tell which ways go on to the end.
    """
    descent, plain = options.descent, first.surface
    if not descent.rounds:
        return plain, nuisance
    short = replace(options, outline_points=min(descent.outline_points, options.outline_points))
    ways = {held: [replace(each, held=held) for each in descent.rounds] for held in (True, False)}
    begin, *onward = (each.steps for each in (*descent.rounds, options.rounds[0]))
    disagreement = _disagreement(views, options, options.start_pixels, options.start_resolution)
    judged = _disagreement(views, options, descent.judged_pixels, descent.judged_resolution)

    def taken(stage: FitStage, rounds: Sequence[FreeFormRound], progress: Progress) -> FitStage:
        return coarse_stage(views, stage.surface, rounds, short, progress, stage.nuisance)

    def settled(stage: FitStage, progress: Progress | None = None) -> FitStage:
        return coarse_stage(views, stage.surface, options.rounds[:1], options, progress, stage.nuisance)

    def begun(surface: LevelSet) -> FitStage:
        return FitStage.begun(surface, options, nuisance)

    with torch.no_grad():
        known = settled(begun(plain))
        if disagreement(known) < descent.least_disagreement:
            progress = Progress("looking for a start", begin + sum(onward))
            ended = [taken(begun(plain), ways[True], progress)]
        else:
            starts = [replace(each, surroundings=first.surroundings) for each in (*first.plates, first.hull)]
            progress = Progress("looking for a start", len(starts) * len(ways) * begin + descent.followed * sum(onward))
            tried = [
                (held, taken(begun(each), rounds[:1], progress)) for each in starts for held, rounds in ways.items()
            ]
            tried.sort(key=lambda way: disagreement(way[1]))
            ended = [taken(stage, ways[held][1:], progress) for held, stage in tried[: descent.followed]]
        best = min(((each, judged(settled(each, progress))) for each in ended), key=lambda each: each[1])
        found = keep_if_better(((begun(plain), judged(known)), best), lambda each: each[1], descent.least_gain)[0]
        return found.surface, found.nuisance


def _disagreement(views: Views, options: FreeFormOptions, pixels: int, resolution: int) -> Callable[[FitStage], float]:
    """How badly about so many pixels of all views agree under a surface, compared in cells of that resolution."""
    chosen, cameras = solid_pixels(views, pixels), StatedCameras.of(views)
    inner = chosen.inner_px > options.inner_px
    rays, radiance = chosen.rays.chosen(inner), chosen.radiance[inner]

    def measured(stage: FitStage) -> float:
        if not inner.any():
            return 1.0
        moved, equal = stage.nuisance.moved(rays, cameras), stage.nuisance.equalized(radiance, rays.view)
        return Scored(moved, equal, options.concave)(stage.surface, resolution)

    return measured
