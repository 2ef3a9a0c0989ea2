"""Grooves and edges no wider than some pixels: a surface of revolution refined by pixels as areas, coarse to fine.

Where the profile turns within a pixel, that pixel shows the mean of what several normals mirror, and no single ray
tells it. Here a pixel is the mean of a few rays, each followed to the environment,

c = 1/K Σₖ E(ωₖ),

and so are its derivatives. Blurred maps come first: their basins are as wide as the normals are wrong.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d

from panoless.capture.rays import pixel_rays
from panoless.capture.views import TrainView, Views, concatenated, split_held_out
from panoless.geometry.revolution.model import MAX_BOUNCES, Hits, SurfaceOfRevolution, trace_reflections
from panoless.geometry.revolution.photometric import RADIANCE_SIGMA, Round, normal_motion, solve_map, step_on_equations
from panoless.geometry.revolution.profile import ProfileSplines, resample_profile
from panoless.geometry.revolution.render import SUBRAYS, bounded_error
from panoless.geometry.revolution.silhouette import ContourRays
from panoless.kernels.cubemap import sample_cubemap

SPACING_PX = 1 / 3
"""Of the vertices: an edge is as sharp as they are dense."""
ROUNDS = (Round(32, 0.5, 1.5, 4), Round(64, 0.4, 1.5, 4), Round(128, 0.3, 1.0, 4), Round(256, 0.2, 0.7, 4))
BENDING = (1e-4, 1e-4, 1e-4, 1e-5)
MAP_RAYS = 2_000_000
MAP_RESOLUTION = 256
PIXELS, LARGEST_SHARE = 60_000, 1 / 3
LOOKED_AT = 2_000_000
CURVED_RAD = np.radians(2.0)
"""Where the profile turns by more within two pixels a pixel is taken preferably: elsewhere one ray tells as much."""
CURVED_SHARE = 0.75
LEAST_GAIN = 0.02
"""Of the error on held-out views: a smooth profile is told as well by single rays, with less noise."""


@dataclass(frozen=True)
class TracedFootprints:
    """Pixels of which all rays leave for the environment; the R rays are those of `SUBRAYS`, pixel after pixel."""

    directions: Float[np.ndarray, "R 3"]
    hits: Hits
    outgoing: Float[np.ndarray, "R 3"]
    once: Bool[np.ndarray, "R"]
    """Whether a ray is mirrored once; what is mirrored more often is followed, but has no derivative."""
    radiance: Float[np.ndarray, "P 3"]

    def shown(self, environment: Float[Tensor, "6 3 L L"]) -> Float[np.ndarray, "P 3"]:
        """The mean of what the rays of each pixel see of a map."""
        directions = torch.from_numpy(self.outgoing).float().to(environment.device)
        seen = sample_cubemap(environment, directions).cpu().numpy().astype(np.float64)
        return seen.reshape(-1, len(SUBRAYS), 3).mean(1)


def trace_footprints(
    views: Sequence[TrainView], surface: SurfaceOfRevolution, pixels: Sequence[Int[np.ndarray, "_"]]
) -> TracedFootprints:
    """The given pixels of each view (flat indices) as areas of a surface of revolution."""
    parts = [_areas_of(view, surface, chosen) for view, chosen in zip(views, pixels, strict=True)]
    names = ("directions", "outgoing", "once", "radiance")
    return TracedFootprints(
        hits=concatenated([part.hits for part in parts]),
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names},
    )


def _areas_of(view: TrainView, surface: SurfaceOfRevolution, pixels: Int[np.ndarray, "_"]) -> TracedFootprints:
    rays = [pixel_rays(view.camera, pixels, shift) for shift in SUBRAYS]
    escapes = [trace_reflections(surface, *each, MAX_BOUNCES) for each in rays]
    whole = np.all([each.bounces > 0 for each in escapes], axis=0)

    def merged(values: Sequence[np.ndarray]) -> np.ndarray:
        chosen = np.stack([each[whole] for each in values], 1)
        return chosen.reshape(-1, *chosen.shape[2:])

    hits = Hits(**{name: merged([getattr(each.first, name) for each in escapes]) for name in vars(escapes[0].first)})
    radiance = view.radiance.flatten(1).T[torch.from_numpy(pixels[whole]).to(view.radiance.device)]
    return TracedFootprints(
        directions=merged([each[1] for each in rays]),
        hits=hits,
        outgoing=merged([each.directions for each in escapes]),
        once=merged([each.bounces for each in escapes]) == 1,
        radiance=radiance.cpu().numpy().astype(np.float64),
    )


def informative_pixels(
    views: Sequence[TrainView], surface: SurfaceOfRevolution, most: int, pixel: float
) -> list[Int[np.ndarray, "_"]]:
    """About `most` pixels of all views, three quarters of them where the profile turns within two pixels."""
    curved = _curved_sides(surface, pixel)
    generator = np.random.default_rng(0)
    share = min(1.0, LOOKED_AT / max(sum(len(view.solid) for view in views), 1))
    found = []
    for view in views:
        pixels = view.solid.cpu().numpy()
        pixels = pixels[generator.random(len(pixels)) < share]
        hits = surface.hits(*pixel_rays(view.camera, pixels))
        found.append((pixels, hits.met & curved[hits.side]))
    counts = sum(int(turns.sum()) for _, turns in found), sum(int((~turns).sum()) for _, turns in found)
    kept = CURVED_SHARE * most / max(counts[0], 1), (1 - CURVED_SHARE) * most / max(counts[1], 1)
    return [pixels[generator.random(len(pixels)) < np.where(turns, kept[0], kept[1])] for pixels, turns in found]


def _curved_sides(surface: SurfaceOfRevolution, pixel: float) -> Bool[np.ndarray, "S"]:
    """Whether the profile turns near a side, by its direction a pixel before and behind."""
    length, angle = surface.arc_lengths, np.unwrap(np.append(surface.angles[0, 0], surface.angles[:, 1]))
    middle = (length[1:] + length[:-1]) / 2
    ahead, behind = (np.interp(middle + way, length, angle) for way in (pixel, -pixel))
    return np.asarray(np.abs(ahead - behind) > CURVED_RAD)


def footprint_equations(
    areas: TracedFootprints,
    surface: SurfaceOfRevolution,
    splines: ProfileSplines,
    environment: Float[Tensor, "6 3 L L"],
    robust: float,
    pixel: float,
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """As `photometric_equations`, of pixels that are means of rays: every row is the mean of those of its rays."""
    from scipy import sparse

    count, subrays = len(areas.radiance), len(SUBRAYS)
    residual = areas.shown(environment) - areas.radiance
    weights = (1 + (residual**2).sum(1) / robust**2) ** -2 / RADIANCE_SIGMA**2
    motion = normal_motion(areas.directions, areas.hits, surface, splines, pixel)
    single = areas.once[motion.kept]
    rows = motion.radiance_by_parameters(environment, surface)[single]
    ray = np.flatnonzero(motion.kept)[single]
    columns = np.concatenate([np.broadcast_to(np.arange(4), (len(ray), 4)), 4 + motion.index[single]], 1)
    mean = sparse.csr_matrix((np.full(len(ray), 1 / subrays), (ray // subrays, np.arange(len(ray)))), (count, len(ray)))
    size = 4 + splines.count
    gradient, matrix = np.zeros(size), np.zeros((size, size))
    for channel in range(3):
        of_rays = sparse.csr_matrix(
            (rows[:, channel].ravel(), columns.ravel(), np.arange(len(ray) + 1) * columns.shape[1]), (len(ray), size)
        )
        jacobian = mean @ of_rays
        weighted = jacobian.multiply(weights[:, None]).tocsr()
        gradient += weighted.T @ residual[:, channel]
        matrix += (weighted.T @ jacobian).toarray()
    return gradient, matrix


def footprint_error(areas: TracedFootprints, environment: Float[Tensor, "6 3 L L"]) -> float:
    """Mean of ‖e‖²/(‖e‖² + s²) over pixels."""
    return bounded_error(areas.shown(environment) - areas.radiance)


def refine_by_footprints(
    views: Views,
    contours: ContourRays,
    surface: SurfaceOfRevolution,
    pixel: float,
    otherwise: SurfaceOfRevolution | None = None,
) -> SurfaceOfRevolution:
    """The surface with vertices a third of a pixel apart, after rounds of Gauss–Newton on pixels as areas.

    `otherwise`, or the surface as it was, is returned unless the pixels of every fifth view, which take no part, are
    explained clearly better than by that.
    """
    otherwise = surface if otherwise is None else otherwise
    kept, held_out = split_held_out(views.train)
    with torch.no_grad():
        finest = solve_map(views, surface, MAP_RAYS, MAP_RESOLUTION)
        most = min(PIXELS, int(LARGEST_SHARE * sum(len(view.solid) for view in kept)))
        chosen = informative_pixels(kept, surface, most, pixel)
        found = resample_profile(surface, SPACING_PX * pixel)
        for each, bending in zip(ROUNDS, BENDING, strict=True):
            environment = avg_pool2d(finest, MAP_RESOLUTION // each.resolution)
            for _ in range(each.steps):
                splines = ProfileSplines.of(found, each.knot_px * pixel)
                areas = trace_footprints(kept, found, chosen)
                equations = footprint_equations(areas, found, splines, environment, each.robust, pixel)
                found = resample_profile(
                    step_on_equations(equations, contours, found, splines, bending), SPACING_PX * pixel
                )
        tested = informative_pixels(held_out, surface, PIXELS // 4, pixel)
        before, after = (
            footprint_error(trace_footprints(held_out, each, tested), finest) for each in (otherwise, found)
        )
    return found if after < (1 - LEAST_GAIN) * before else otherwise
