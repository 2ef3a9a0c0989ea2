"""A surface of revolution from photographs: outside by silhouettes, then all by what it mirrors.

Every profile goes through the same steps. Which end is open, what is inside, and whether areas of pixels and a floor
help is decided by held-out views: every fifth view takes no part in what it judges.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.views import TrainView, Views, split_held_out
from panoless.geometry.base import overlap
from panoless.geometry.revolution.floor import fit_floor, floor_pixels
from panoless.geometry.revolution.footprints import ROUNDS, has_edges, informative_pixels, refine_by_footprints
from panoless.geometry.revolution.interior import end_pixels, search_interior
from panoless.geometry.revolution.lip import LENGTH_PX, clear_of_lip, lip_pixels, open_at_lip, place_lip, refine_lip
from panoless.geometry.revolution.model import FITTED_BOUNCES, MAX_BOUNCES, SurfaceOfRevolution, revolution_buffers
from panoless.geometry.revolution.photometric import Round, refine_round, solve_map
from panoless.geometry.revolution.pixels import CENTER, JUDGED_SCALE, PixelBundles, evenly
from panoless.geometry.revolution.profile import resample_profile
from panoless.geometry.revolution.silhouette import (
    EXTENTS,
    JUDGED_SCALE_PX,
    START_POINTS,
    ContourRays,
    axis_starts,
    contour_cost,
    contour_rays,
    fit_outer,
    refine_outer,
    silhouette_residuals,
)
from panoless.geometry.revolution.unknowns import RevolutionUnknowns
from panoless.journal import remembered
from panoless.numeric.gauss_newton import keep_if_better
from panoless.problem.solve import by_silhouettes_alone
from shinypartial.io.progress import Progress

LARGEST_START_COST = 0.6
"""Mean of e²/(e² + s²) over the contours of a coarse fit above which no axis is near."""
LEAST_VIEWS = 6
"""Fewer views with a contour propose nothing."""
SUFFICIENT_OVERLAP = 0.98
"""Intersection over union of the closed body with the masks from which no stem is looked for."""
SCORED_VIEWS = 16
"""Most views over which the overlap of a proposal is measured."""
COARSE = Round(128, 0.3, 2.0, 2)
"""The round on single rays before the mouth is opened."""
FINE = (Round(128, 0.2, 1.5, 2), Round(256, 0.2, 1.5, 2), Round(256, 0.1, 1.0, 2))
"""Rounds after."""
MOST_ROUNDS = 4
"""Rounds of each series."""
PIXELS = 120_000
"""Pixels of a step on single rays; half as many are taken as areas, a quarter under the coarsest maps."""
MAP_RAYS = 600_000
"""Rays that a round's map is solved from; a quarter of them under the coarsest."""
CONTOUR_POINTS = 20_000
"""Contour points of a step."""
END_PIXELS = 100_000
"""Pixels among which those are counted that see an end of the closed surface."""
UNCLEAR_SHARE = 0.1
"""Both ends are tried if the one that fewer pixels see is seen by more than this share of the other's."""
JUDGED_PIXELS = 120_000
"""Pixels of the held-out views among which those that see an end judge what is inside."""
SETTLED_SHARE = 0.05
"""Share of all pixels that the ends may leave unexplained before candidates descend under coarse maps."""
DESCENDING = 1.25
"""Those descend whose error is within so many times the least."""
DESCENT = (
    Round(8, 0.5, 6.0, 4),
    Round(16, 0.5, 4.0, 4),
    Round(32, 0.4, 3.0, 4),
    Round(64, 0.3, 2.0, 4),
)
"""Rounds of that descent."""
LEAST_FLOOR_PIXELS = 200
"""Fewer pixels whose paths meet the floor determine nothing."""
LIP_PIXELS = 8_000
"""Mixed pixels that refine the lip."""
LEAST_LIP_PIXELS = 500
"""Fewer determine nothing."""
FINEST_MAP_RAYS = 2_000_000
"""Rays of the map that has the resolution of the last round."""
LEAST_GAIN = 0.02
"""Share of the held-out error by which what is inside has to be better, and areas of pixels and a floor."""


@dataclass(frozen=True)
class RevolutionProposal:
    """A surface of revolution closed flat at both ends, and how well it explains the silhouettes. Arrays hold one value
    a view.
    """

    surface: SurfaceOfRevolution
    """Its lid is the end that more pixels see."""
    median_px: Float[np.ndarray, "V"]
    """Median distance of the mask's contour from that of the surface."""
    iou: Float[np.ndarray, "V"]
    """Σ min(alpha, mask) / Σ max(alpha, mask), for some of the views."""


def propose_revolution(views: Views) -> RevolutionProposal | None:
    """Axis and outer profile that explain the masks best; None when none comes near.

    What may be a stem below the body, or a cone that silhouettes leave beyond its lip, and then what lies beyond a
    narrow place, is accepted only where the body without it misses the masks.
    """
    rays = contour_rays(views)
    if len(np.unique(rays.view)) < LEAST_VIEWS:
        return None
    best, starts = None, axis_starts(views)
    for extent in range(EXTENTS):
        found = _propose(views, rays, starts, extent)
        if found is not None and (best is None or np.median(found.iou) > np.median(best.iou)):
            best = found
        if best is not None and np.median(best.iou) >= SUFFICIENT_OVERLAP:
            break
    return best


def _propose(
    views: Views, rays: ContourRays, starts: list[SurfaceOfRevolution], extent: int
) -> RevolutionProposal | None:
    start = fit_outer(rays, starts, extent)
    if start is None:
        return None
    residuals = silhouette_residuals(rays.at_most(START_POINTS), start, rays.pixel)
    if contour_cost(residuals, JUDGED_SCALE_PX) > LARGEST_START_COST:
        return None
    base, lid = (_count(end) for end in end_pixels(views, start, END_PIXELS))
    surface = refine_outer(rays, start if lid >= base else start.turned_over(), extent)
    if surface is None:
        return None
    surface = by_silhouettes_alone(views, RevolutionUnknowns(surface, rays.pixel)).settled().surface
    found = silhouette_residuals(rays, surface, rays.pixel)
    distance = np.where(found.side >= 0, np.abs(found.pixels), np.inf)
    medians = np.array([np.median(distance[rays.view == view]) for view in np.unique(rays.view)])
    overlaps = []
    for view in views.train[:: max(1, len(views.train) // SCORED_VIEWS)]:
        alpha = revolution_buffers(surface, view.camera).alpha
        overlaps.append(overlap(alpha, view.mask))
    return RevolutionProposal(surface, medians, np.array(overlaps))


def _count(chosen: list[tuple[TrainView, Int[np.ndarray, "_"]]]) -> int:
    return sum(len(pixels) for _, pixels in chosen)


def refine_revolution(views: Views, start: SurfaceOfRevolution, *, rounds: int = MOST_ROUNDS) -> SurfaceOfRevolution:
    """Profile and axis by what is mirrored, from the closed surface of the joint solve.

    It gives a map, under which the mouth is opened. Rounds on single rays follow, and after them areas of
    pixels, where there are edges, the floor and the lip.
    """
    with torch.no_grad():
        return Refinement(views, start, rounds=rounds).run()


def follow_views(views: Views, fitted: SurfaceOfRevolution) -> SurfaceOfRevolution:
    """A fitted surface after one more round on single rays, to views that changed a little."""
    with torch.no_grad():
        return Refinement(views, fitted).refine_by_centers(fitted, FINE[-1], None)[0]


@dataclass(frozen=True)
class _Judged:
    """A surface, a map of its own, and the error of held-out pixels under both."""

    surface: SurfaceOfRevolution
    environment: Float[Tensor, "6 3 L L"]
    error: float
    going_on: Float[Tensor, "6 3 L L"] | None = None
    """The map that the next round starts from; None: from nothing."""


class Refinement:
    """The data of a fit, and its steps."""

    def __init__(
        self,
        views: Views,
        start: SurfaceOfRevolution,
        *,
        rounds: int = MOST_ROUNDS,
        pixels: int = PIXELS,
        map_rays: int = MAP_RAYS,
    ) -> None:
        self.views, self.start = views, start
        self.rounds, self.pixels, self.map_rays = rounds, pixels, map_rays
        kept, held_out = split_held_out(views.train)
        self.kept, self.held_out = (replace(views, train=tuple(part)) for part in (kept, held_out))
        self.contours = contour_rays(views).at_most(CONTOUR_POINTS)
        self.pixel = self.contours.pixel

    def run(self) -> SurfaceOfRevolution:
        """All of them, in order."""
        fine = FINE[: self.rounds]
        progress = Progress("fitting a surface of revolution", 4 + len(fine))
        surface, environment = self.open_mouth()
        progress.advance()
        for each in fine:
            surface, environment = self.refine_by_centers(surface, each, environment)
            progress.advance()
        assert environment is not None, "there is a fine round"
        known, mapped = environment, None
        for refine in (self.by_areas, self.by_floor, self.by_lip):
            if surface is not mapped:
                known, mapped = self._finest_map(surface, environment), surface
            surface = refine(surface, known)
            progress.advance()
        return surface

    def _error(self, pixels: PixelBundles, surface: SurfaceOfRevolution, environment: Tensor) -> float:
        return pixels.error(surface, environment, MAX_BOUNCES, JUDGED_SCALE)

    def open_mouth(self) -> tuple[SurfaceOfRevolution, Tensor | None]:
        """The outside after a round, with what is inside its lid, or inside its base if that is unclear; and the map of
        the outside, unless what is inside shows more: a thin wall, or what its map or a descent led to.

        Every candidate is judged under a map of its own: that of a wide bowl's flat lid says nothing of its inside.
        """
        base, lid = (_count(end) for end in end_pixels(self.views, self.start, END_PIXELS))
        every = _count(evenly(self.views, END_PIXELS))
        starts = [self.start, self.start.turned_over()] if base > UNCLEAR_SHARE * lid else [self.start]
        seen = self._held_out_ends(self.start)
        opened = []
        for surface in starts:
            surface, environment = self.refine_by_centers(surface, COARSE, None)
            flat = self._judged(surface, seen, environment)
            within = list(self._walls(surface, environment, flat, seen))
            best = self._best(flat, *within)
            if best.error * (base + lid) > SETTLED_SHARE * every:
                near = [each for each in within if each.error < DESCENDING * best.error]
                best = self._best(best, *(self._descended(each, seen) for each in near))
            opened.append(best)
        best = min(opened, key=lambda each: each.error)
        return best.surface, best.going_on

    def _walls(
        self, closed: SurfaceOfRevolution, environment: Tensor, flat: _Judged, seen: PixelBundles
    ) -> Iterator[_Judged]:
        """What may be inside: a wall without thickness, and interiors that are searched under the map of the outside,
        and under that of such a wall if it explains more than the flat lid.
        """
        maps = [environment]
        if (opened := open_at_lip(self.contours, closed)) is not None:
            thin = self._judged(opened, seen)
            yield thin
            if self._best(flat, thin) is thin:
                maps.append(thin.environment)
        for known in maps:
            searched = search_interior(self.kept, closed, known, self.pixel)
            yield self._judged(searched, seen, environment if known is environment else None)

    def _descended(self, start: _Judged, seen: PixelBundles) -> _Judged:
        """A surface after steps under maps so coarse that its inside may be wrong by many degrees."""
        surface = start.surface
        for each in DESCENT[: self.rounds]:
            surface, _ = self.refine_by_centers(surface, each, None, share=4)
        return self._judged(surface, seen)

    @remembered()
    def _judged(self, surface: SurfaceOfRevolution, seen: PixelBundles, going_on: Tensor | None = None) -> _Judged:
        """A surface under its own map of the views that are not held out, from nothing, since others' leave traces;
        with rays that are mirrored often, since some directions are seen by way of the walls only.
        """
        environment = solve_map(self.kept, surface, self.map_rays, COARSE.resolution, max_bounces=FITTED_BOUNCES)
        return _Judged(surface, environment, self._error(seen, surface, environment), going_on)

    def _best(self, *candidates: _Judged) -> _Judged:
        """The last that is clearly better than the best before it."""

        def better(best: _Judged, candidate: _Judged) -> _Judged:
            return keep_if_better((best, candidate), lambda each: each.error, LEAST_GAIN)

        return reduce(better, candidates)

    def _held_out_ends(self, closed: SurfaceOfRevolution) -> PixelBundles:
        base, lid = end_pixels(self.held_out, closed, JUDGED_PIXELS)
        return PixelBundles.of([*base, *lid], CENTER)

    @remembered()
    def refine_by_centers(
        self,
        surface: SurfaceOfRevolution,
        each: Round,
        environment: Tensor | None,
        share: int = 1,
    ) -> tuple[SurfaceOfRevolution, Tensor]:
        """The surface after one round on single rays, and the map before it; of one in `share` pixels and rays."""
        views = clear_of_lip(self.views, surface)
        environment = solve_map(views, surface, self.map_rays // share, each.resolution, environment)
        surface = refine_round(
            PixelBundles.of(evenly(views, self.pixels // share), CENTER),
            self.contours,
            surface,
            environment,
            each,
            lambda moved: resample_profile(place_lip(self.contours, moved, self.pixel), self.pixel),
        )
        return surface, environment

    @remembered()
    def by_areas(self, surface: SurfaceOfRevolution, environment: Tensor) -> SurfaceOfRevolution:
        """With grooves and edges of the outside by pixels as areas, where there are any and held-out views gain; else
        itself.
        """
        views = clear_of_lip(self.kept, surface)
        if not has_edges(views, surface, self.pixel):
            return surface
        pixels, rounds = self.pixels // 2, ROUNDS[: self.rounds]
        areas = refine_by_footprints(views.train, self.contours, surface, environment, pixels=pixels, rounds=rounds)
        held_out = informative_pixels(self.held_out.train, surface, self.pixels // 8, self.pixel)
        return self._kept(surface, areas, PixelBundles.of(held_out), environment)

    @remembered()
    def by_floor(self, surface: SurfaceOfRevolution, environment: Tensor) -> SurfaceOfRevolution:
        """With its floor, where enough pixels see it by way of the walls or from below and held-out views gain."""
        seen, judging = (floor_pixels(part, surface) for part in (self.kept, self.held_out))
        if len(seen.radiance) < LEAST_FLOOR_PIXELS or not len(judging.radiance):
            return surface
        return self._kept(surface, fit_floor(seen, surface, environment, self.pixel), judging, environment)

    def _kept(
        self, surface: SurfaceOfRevolution, refined: SurfaceOfRevolution, judging: PixelBundles, environment: Tensor
    ) -> SurfaceOfRevolution:
        """The refined surface, if it explains pixels of held-out views better."""
        return keep_if_better((surface, refined), lambda each: self._error(judging, each, environment), LEAST_GAIN)

    @remembered()
    def by_lip(self, surface: SurfaceOfRevolution, environment: Tensor) -> SurfaceOfRevolution:
        """With its lip by pixels that mix it with what lies around it, where the wall is long enough."""
        if surface.arc_lengths[surface.lip] < 2 * LENGTH_PX * self.pixel:
            return surface
        mixed = lip_pixels(self.views.train, surface, LIP_PIXELS)
        if len(mixed.radiance) < LEAST_LIP_PIXELS:
            return surface
        return refine_lip(mixed, surface, environment, self.pixel)

    def _finest_map(self, surface: SurfaceOfRevolution, environment: Tensor) -> Float[Tensor, "6 3 L L"]:
        """The map of many rays in the resolution of the last round on areas."""
        views = clear_of_lip(self.views, surface)
        return solve_map(views, surface, FINEST_MAP_RAYS, ROUNDS[: self.rounds][-1].resolution, environment)
