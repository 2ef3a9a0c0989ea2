"""A surface of revolution from photographs: outside by outlines, inside by search, then all by what it mirrors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.rays import pixel_rays
from panoless.capture.views import Views, every_kth_pixel
from panoless.geometry.revolution.floor import fit_floor
from panoless.geometry.revolution.footprints import refine_by_footprints
from panoless.geometry.revolution.interior import search_interior
from panoless.geometry.revolution.lip import clear_of_lip, open_at_lip, with_lip
from panoless.geometry.revolution.lip_refinement import refine_lip
from panoless.geometry.revolution.model import MAX_BOUNCES, SurfaceOfRevolution, revolution_buffers, revolution_rays
from panoless.geometry.revolution.photometric import Round, photometric_step, select_observations, solve_map
from panoless.geometry.revolution.profile import resample_profile
from panoless.geometry.revolution.silhouette import (
    ContourRays,
    axis_starts,
    contour_cost,
    contour_rays,
    fit_outer,
    refine_outer,
    silhouette_residuals,
)
from panoless.kernels.cubemap import sample_cubemap
from shinypartial.io.progress import Progress

LARGEST_START_COST = 0.6
"""Mean of e²/(e² + s²), s = 2 px, over a coarse fit: above, no axis is near."""
SCORED_VIEWS = 16
LEAST_VIEWS = 6
COARSE_ROUNDS = (Round(64, 0.3, 3.0), Round(128, 0.3, 2.0))
FINE_ROUNDS = (
    Round(128, 0.2, 1.5),
    Round(256, 0.2, 1.5),
    Round(256, 0.1, 1.0),
    Round(256, 0.1, 1.0),
)
MAP_RAYS = 600_000
SEARCHED_RESOLUTION = 128
STEP_PIXELS = 120_000
CONTOUR_POINTS = 20_000
BENDING = 1e-4
JUDGED_SCALE = 0.1


@dataclass(frozen=True)
class RevolutionProposal:
    """A surface of revolution closed by a flat lid, and how well it explains the silhouettes. Arrays hold one value a
    view.
    """

    surface: SurfaceOfRevolution
    median_px: Float[np.ndarray, "V"]
    """Median distance of the mask's contour from that of the surface."""
    iou: Float[np.ndarray, "V"]
    """Σ min(alpha, mask) / Σ max(alpha, mask), for some of the views."""


def propose_revolution(views: Views) -> RevolutionProposal | None:
    """Axis and outer profile that explain the masks best; None when none comes near."""
    rays = contour_rays(views)
    if len(np.unique(rays.view)) < LEAST_VIEWS:
        return None
    pixel = float(np.median(rays.pixel))
    start = fit_outer(rays, axis_starts(views))
    if start is None or contour_cost(rays.every(max(1, len(rays.view) // 2000)), start, pixel) > LARGEST_START_COST:
        return None
    surface = refine_outer(rays, start)
    if surface is None:
        return None
    found = silhouette_residuals(rays, surface, pixel)
    distance = np.where(found.side >= 0, np.abs(found.pixels), np.inf)
    views_seen = np.unique(rays.view)
    medians = np.array([np.median(distance[rays.view == view]) for view in views_seen])
    overlaps = []
    for view in views.train[:: max(1, len(views.train) // SCORED_VIEWS)]:
        alpha = revolution_buffers(surface, view.camera).alpha
        overlaps.append(float(alpha.minimum(view.mask).sum() / alpha.maximum(view.mask).sum().clamp(min=1e-9)))
    return RevolutionProposal(surface, medians, np.array(overlaps))


def refine_revolution(views: Views, start: SurfaceOfRevolution) -> SurfaceOfRevolution:
    """Profile and axis by what is mirrored, from the closed surface of the outlines.

    The outside gives a map; of the insides that are worth trying, the one that explains most under it is refined on. An
    open wall gets its bottom last, others their grooves and edges, and an inside searched anew between them.
    """
    rays = contour_rays(views)
    pixel = float(np.median(rays.pixel))
    contours = rays.every(max(1, len(rays.view) // CONTOUR_POINTS))
    progress = Progress("fitting a surface of revolution", len(COARSE_ROUNDS) + len(FINE_ROUNDS) + 1)
    surface, environment = start, None
    for each in COARSE_ROUNDS:
        surface, environment = _round(views, contours, surface, each, None, pixel)
        progress.advance()
    assert environment is not None
    thin = open_at_lip(contours, surface, pixel)
    searched = search_interior(views, surface, environment, pixel)
    candidates = [surface, searched] if thin is None else [surface, thin, searched]
    surface = best_interior(views, surface, environment, candidates)
    for each in FINE_ROUNDS:
        surface, environment = _round(views, contours, surface, each, environment, pixel)
        progress.advance()
    if surface.is_open:
        with torch.no_grad():
            surface = refine_lip(views, fit_floor(views, surface, environment), environment, pixel)
    else:
        surface = refine_by_footprints(views, contours, surface, pixel)
        inside = with_searched_interior(views, surface, pixel)
        if inside is not surface:
            surface = refine_by_footprints(views, contours, inside, pixel, otherwise=surface)
    progress.advance()
    return surface


def _round(
    views: Views,
    contours: ContourRays,
    surface: SurfaceOfRevolution,
    each: Round,
    environment: Tensor | None,
    pixel: float,
) -> tuple[SurfaceOfRevolution, Tensor]:
    views = clear_of_lip(views, surface)
    with torch.no_grad():
        environment = solve_map(views, surface, MAP_RAYS, each.resolution, environment)
        for _ in range(each.steps):
            seen = select_observations(views, surface, STEP_PIXELS)
            surface = with_lip(contours, photometric_step(seen, contours, surface, environment, each, BENDING), pixel)
            surface = resample_profile(surface, pixel)
    return surface, environment


def with_searched_interior(views: Views, surface: SurfaceOfRevolution, pixel: float) -> SurfaceOfRevolution:
    """The surface with an inside searched anew under its own map, unless it explains no more than the present one."""
    with torch.no_grad():
        environment = solve_map(views, surface, MAP_RAYS, SEARCHED_RESOLUTION)
        lid = [[0.0, surface.profile[surface.lip, 1]]]
        closed = replace(surface, profile=np.concatenate([surface.profile[: surface.lip + 1], lid]))
        found = search_interior(views, closed, environment, pixel)
        # The search samples the outside anew, too, which would blunt its edges.
        inner = found.profile[found.lip + 1 :]
        candidate = replace(surface, profile=np.concatenate([surface.profile[: surface.lip + 1], inner]))
        return min((surface, candidate), key=lambda each: interior_error(views, closed, environment, each))


def best_interior(
    views: Views, surface: SurfaceOfRevolution, environment: Tensor, candidates: Sequence[SurfaceOfRevolution]
) -> SurfaceOfRevolution:
    """The candidate that explains best what is seen on the lid of the closed surface, many reflections deep."""
    if len(candidates) == 1:
        return candidates[0]
    return min(candidates, key=lambda each: interior_error(views, surface, environment, each))


def interior_error(
    views: Views, closed: SurfaceOfRevolution, environment: Tensor, candidate: SurfaceOfRevolution
) -> float:
    """Mean of ‖e‖²/(‖e‖² + s²), 1 for rays that never leave, over pixels that see the lid of `closed`."""
    summed, count = 0.0, 0
    with torch.no_grad():
        for view, pixels in every_kth_pixel(views, MAP_RAYS):
            origin_hits = closed.hits(*pixel_rays(view.camera, pixels.cpu().numpy()))
            lid = pixels[torch.from_numpy(origin_hits.side >= closed.lip).to(pixels.device)]
            if not len(lid):
                continue
            rays, _ = revolution_rays(candidate, view, lid, MAX_BOUNCES)
            error = (sample_cubemap(environment, rays.directions) - rays.radiance).square().sum(1)
            summed += float((error / (error + JUDGED_SCALE**2)).sum()) + len(lid) - len(error)
            count += len(lid)
    return summed / max(count, 1)
