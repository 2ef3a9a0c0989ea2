"""The level set that a fit starts from: of a few plates between contacts and what they descend to, the one that makes
pixels agree best.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from panoless.capture.poses import StatedCameras
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.deadline import improving
from panoless.environment.surroundings import FAR, Surroundings
from panoless.first_surface.completion import completed, trusted_hull
from panoless.first_surface.mesh import TriangleMesh
from panoless.first_surface.visual_hull import carve_hull
from panoless.geometry.free_form.concave import Scored
from panoless.geometry.free_form.fit import FitStage, coarse_stage
from panoless.geometry.free_form.photometric import INNER_PX
from panoless.geometry.free_form.schedule import Round, Schedule
from panoless.geometry.free_form.surface import LevelSet, level_set_of
from panoless.problem.nuisance import NO_NUISANCE, Nuisance
from panoless.problem.observations import solid_pixels
from shinypartial.io.progress import Progress

TENSIONS = (0.0, 10.0, 30.0, 100.0)
"""Tensions τ of the plate between contacts (1/length² in the normalized frame) among which the pixels choose."""
CELLS = 40
"""Cells along the longest side of the first surface, before its first round."""
MARGIN = 0.175
"""Between the start and the sides of its box, in its longest side: the support of a spline on the first grid, and
some room to move."""
PIXELS, RESOLUTION = 8000, 12
"""Pixels of all views by which first surfaces are compared, in so many cells of directions along a face side."""
JUDGED_PIXELS, JUDGED_RESOLUTION = 40_000, 24
"""The same for what descended. Finer, as surfaces that end well and badly differ by little then."""
DESCENTS = 3
"""First surfaces that go on after the first round of a descent: the best one then may not be the best in the end."""
LEAST_DISAGREEMENT = 0.15
"""Of pixels under the plain surface, after the first round of the fit, from which all first surfaces descend; below it
the plain one does."""


@dataclass(frozen=True)
class FirstSurfaces:
    """What a fit may start from, in one world: the plate whose pixels disagree least, kept inside the hull, the hull
    itself, and the plates, which descend as the hull does.
    """

    plain: LevelSet
    hull: LevelSet
    plates: tuple[LevelSet, ...]
    surroundings: Surroundings = FAR

    @property
    def surface(self) -> LevelSet:
        """The plain one in these surroundings."""
        return replace(self.plain, surroundings=self.surroundings)


def first_surfaces(views: Views, config: FitConfig) -> FirstSurfaces:
    """First surfaces as level sets, under the tensions of the plate that leave least disagreement.

    Silhouettes do not show how far an object bulges between their contacts: a stone does, a box does not. Plates are
    solved once, without the bound of the hull, which hardly changes their disagreement.
    """
    carved = config.first_surface
    known = trusted_hull(carve_hull(views, carved.hull_resolution, carved.hull_votes), views)

    def level_set(mesh: TriangleMesh) -> LevelSet:
        return level_set_of(mesh, CELLS, MARGIN)

    disagreement = _disagreement(views, PIXELS, RESOLUTION)
    plates = {tension: level_set(completed(known, tension, rounds=1)) for tension in TENSIONS}
    best = min(plates, key=lambda tension: disagreement(FitStage.begun(plates[tension])))
    plain, hull = level_set(completed(known, best)), level_set(known.surface)
    return FirstSurfaces(plain, hull, tuple(plates.values()))


def started(
    views: Views, first: FirstSurfaces, schedule: Schedule, nuisance: Nuisance = NO_NUISANCE
) -> tuple[LevelSet, Nuisance]:
    """What a first surface descends to with its nuisance blocks, if pixels agree better under that than under the plain
    surface, both after the first round of the fit.

    Where they agree well enough under the plain surface, it alone descends, dominated by silhouettes. Elsewhere each
    plate and the hull do, with and without that; after the first round, those with the least disagreement go on to the
    end. Without a descent, the plain surface is the start.
    """
    plain = first.surface
    if not schedule.descent:
        return plain, nuisance
    ways = {
        dominated: [replace(each, silhouette_dominated=dominated) for each in schedule.descent]
        for dominated in (True, False)
    }
    begin, *onward = (each.steps for each in (*schedule.descent, schedule.coarse[0]))
    disagreement = _disagreement(views, PIXELS, RESOLUTION)
    judged = _disagreement(views, JUDGED_PIXELS, JUDGED_RESOLUTION)

    def taken(stage: FitStage, rounds: Sequence[Round], progress: Progress | None = None) -> FitStage:
        return coarse_stage(views, stage.surface, rounds, progress, stage.nuisance)

    def settled(stage: FitStage, progress: Progress | None = None) -> FitStage:
        return taken(stage, schedule.coarse[:1], progress)

    with torch.no_grad(), improving():
        begun = FitStage.begun(plain, nuisance)
        known = settled(begun)
        if disagreement(known) < LEAST_DISAGREEMENT:
            progress = Progress("looking for a start", begin + sum(onward))
            ended = [taken(begun, ways[True], progress)]
        else:
            starts = [replace(each, surroundings=first.surroundings) for each in (*first.plates, first.hull)]
            progress = Progress("looking for a start", len(starts) * len(ways) * begin + DESCENTS * sum(onward))
            tried = [
                (dominated, taken(FitStage.begun(each, nuisance), rounds[:1], progress))
                for each in starts
                for dominated, rounds in ways.items()
            ]
            tried.sort(key=lambda way: disagreement(way[1]))
            ended = [taken(stage, ways[dominated][1:], progress) for dominated, stage in tried[:DESCENTS]]
        compared = [(begun, judged(known)), *((each, judged(settled(each, progress))) for each in ended)]
        found = min(compared, key=lambda each: each[1])[0]
        return found.surface, found.nuisance
    return plain, nuisance


def _disagreement(views: Views, pixels: int, resolution: int) -> Callable[[FitStage], float]:
    """How badly about so many pixels of all views agree under a surface, compared in cells of that resolution."""
    chosen, cameras = solid_pixels(views, pixels), StatedCameras.of(views)
    inner = chosen.inner_px > INNER_PX
    rays, radiance = chosen.rays.chosen(inner), chosen.radiance[inner]

    def measured(stage: FitStage) -> float:
        if not inner.any():
            return 1.0
        moved, equal = stage.nuisance.moved(rays, cameras), stage.nuisance.equalized(radiance, rays.view)
        return Scored(moved, equal)(stage.surface, resolution)

    return measured
