"""A surface of revolution from photographs: outside by outlines, inside by search, then all by what it mirrors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.kernels.cubemap import sample_cubemap
from panoless.lathe import BOUNCES, Lathe, lathe_buffers, lathe_rays, pixel_rays
from panoless.lathe_base import found_base
from panoless.lathe_contours import (
    ContourRays,
    axis_starts,
    contour_cost,
    contour_rays,
    fit_outer,
    refine_outer,
    touches,
)
from panoless.lathe_end import refined_end
from panoless.lathe_inside import searched_inside
from panoless.lathe_photometric import Round, observations, photometric_step, solved_map
from panoless.lathe_pixels import refined_in_pixels
from panoless.lathe_profile import resampled
from panoless.lathe_rim import clear_of_rim, open_lathe, with_rim
from panoless.views import Views, spread_pixels
from shinypartial.progress import Progress

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
class LatheFit:
    """A lathe closed by a flat lid, and how well it explains the silhouettes. Arrays hold one value a view."""

    lathe: Lathe
    median_px: Float[np.ndarray, "V"]
    """Median distance of the mask's contour from that of the lathe."""
    iou: Float[np.ndarray, "V"]
    """Σ min(alpha, mask) / Σ max(alpha, mask), for some of the views."""


def fit_lathe(views: Views) -> LatheFit | None:
    """Axis and outer profile that explain the masks best; None when none comes near."""
    rays = contour_rays(views)
    if len(np.unique(rays.view)) < LEAST_VIEWS:
        return None
    pixel = float(np.median(rays.pixel))
    start = fit_outer(rays, axis_starts(views))
    if start is None or contour_cost(rays.every(max(1, len(rays.view) // 2000)), start, pixel) > LARGEST_START_COST:
        return None
    lathe = refine_outer(rays, start)
    if lathe is None:
        return None
    found = touches(rays, lathe, pixel)
    distance = np.where(found.side >= 0, np.abs(found.pixels), np.inf)
    views_seen = np.unique(rays.view)
    medians = np.array([np.median(distance[rays.view == view]) for view in views_seen])
    overlaps = []
    for view in views.train[:: max(1, len(views.train) // SCORED_VIEWS)]:
        alpha = lathe_buffers(lathe, view.camera).alpha
        overlaps.append(float(alpha.minimum(view.mask).sum() / alpha.maximum(view.mask).sum().clamp(min=1e-9)))
    return LatheFit(lathe, medians, np.array(overlaps))


def refine_lathe(views: Views, start: Lathe) -> Lathe:
    """Profile and axis by what is mirrored, from the closed lathe of the outlines.

    The outside gives a map; of the insides that are worth trying, the one that explains most under it is refined on. An
    open wall gets its bottom last, others their grooves and edges, and an inside searched anew between them.
    """
    rays = contour_rays(views)
    pixel = float(np.median(rays.pixel))
    contours = rays.every(max(1, len(rays.view) // CONTOUR_POINTS))
    progress = Progress("fitting a surface of revolution", len(COARSE_ROUNDS) + len(FINE_ROUNDS) + 1)
    lathe, environment = start, None
    for each in COARSE_ROUNDS:
        lathe, environment = _round(views, contours, lathe, each, None, pixel)
        progress.advance()
    assert environment is not None
    thin = open_lathe(contours, lathe, pixel)
    searched = searched_inside(views, lathe, environment, pixel)
    candidates = [lathe, searched] if thin is None else [lathe, thin, searched]
    lathe = best_inside(views, lathe, environment, candidates)
    for each in FINE_ROUNDS:
        lathe, environment = _round(views, contours, lathe, each, environment, pixel)
        progress.advance()
    if lathe.is_open:
        with torch.no_grad():
            lathe = refined_end(views, found_base(views, lathe, environment), environment, pixel)
    else:
        lathe = refined_in_pixels(views, contours, lathe, pixel)
        inside = with_searched_inside(views, lathe, pixel)
        if inside is not lathe:
            lathe = refined_in_pixels(views, contours, inside, pixel, otherwise=lathe)
    progress.advance()
    return lathe


def _round(
    views: Views, contours: ContourRays, lathe: Lathe, each: Round, environment: Tensor | None, pixel: float
) -> tuple[Lathe, Tensor]:
    views = clear_of_rim(views, lathe)
    with torch.no_grad():
        environment = solved_map(views, lathe, MAP_RAYS, each.resolution, environment)
        for _ in range(each.steps):
            seen = observations(views, lathe, STEP_PIXELS)
            lathe = with_rim(contours, photometric_step(seen, contours, lathe, environment, each, BENDING), pixel)
            lathe = resampled(lathe, pixel)
    return lathe, environment


def with_searched_inside(views: Views, lathe: Lathe, pixel: float) -> Lathe:
    """The lathe with an inside searched anew under its own map, unless it explains no more than the present one."""
    with torch.no_grad():
        environment = solved_map(views, lathe, MAP_RAYS, SEARCHED_RESOLUTION)
        lid = [[0.0, lathe.profile[lathe.rim, 1]]]
        closed = replace(lathe, profile=np.concatenate([lathe.profile[: lathe.rim + 1], lid]))
        found = searched_inside(views, closed, environment, pixel)
        # The search samples the outside anew, too, which would blunt its edges.
        inner = found.profile[found.rim + 1 :]
        candidate = replace(lathe, profile=np.concatenate([lathe.profile[: lathe.rim + 1], inner]))
        return min((lathe, candidate), key=lambda each: inside_error(views, closed, environment, each))


def best_inside(views: Views, lathe: Lathe, environment: Tensor, candidates: Sequence[Lathe]) -> Lathe:
    """The candidate that explains best what is seen on the lid of the closed lathe, many reflections deep."""
    if len(candidates) == 1:
        return candidates[0]
    return min(candidates, key=lambda each: inside_error(views, lathe, environment, each))


def inside_error(views: Views, closed: Lathe, environment: Tensor, candidate: Lathe) -> float:
    """Mean of ‖e‖²/(‖e‖² + s²), 1 for rays that never leave, over pixels that see the lid of `closed`."""
    summed, count = 0.0, 0
    with torch.no_grad():
        for view, pixels in spread_pixels(views, MAP_RAYS):
            origin_hits = closed.hits(*pixel_rays(view.camera, pixels.cpu().numpy()))
            lid = pixels[torch.from_numpy(origin_hits.side >= closed.rim).to(pixels.device)]
            if not len(lid):
                continue
            rays, _ = lathe_rays(candidate, view, lid, BOUNCES)
            error = (sample_cubemap(environment, rays.directions) - rays.radiance).square().sum(1)
            summed += float((error / (error + JUDGED_SCALE**2)).sum()) + len(lid) - len(error)
            count += len(lid)
    return summed / max(count, 1)
