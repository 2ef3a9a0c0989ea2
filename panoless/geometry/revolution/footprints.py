"""Grooves and edges no wider than some pixels: a surface of revolution refined by pixels as areas, coarse to fine.

Where the profile turns within a pixel, that pixel shows the mean of what several normals mirror, and no single ray
determines it. Blurred maps come first, because blurring widens the basin of convergence to the size of the initial
normal errors.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d

from panoless.capture.rays import pixel_rays
from panoless.capture.views import TrainView, Views, every_kth_pixel
from panoless.geometry.revolution.lip import place_lip
from panoless.geometry.revolution.model import FITTED_BOUNCES, SurfaceOfRevolution
from panoless.geometry.revolution.photometric import Round, refine_round
from panoless.geometry.revolution.pixels import PixelBundles
from panoless.geometry.revolution.profile import resample_profile
from panoless.geometry.revolution.silhouette import ContourRays

SPACING_PX = 1 / 3
"""Of the vertices (px): an edge is as sharp as they are dense."""
ROUNDS = (
    Round(32, 0.5, 1.5, 4),
    Round(64, 0.4, 1.5, 4),
    Round(128, 0.3, 1.0, 4),
    Round(256, 0.2, 0.7, 4, 1e-5),
)
"""Blurred maps first: their basins are as wide as the normals are wrong."""
LARGEST_SHARE = 1 / 3
"""Of all pixels that are taken."""
SEARCHED_PIXELS = 2_000_000
"""Pixels among which those are searched that see the profile turn."""
CURVED_RAD = math.radians(2.0)
"""Where the profile turns by more within two pixels, single rays determine less than areas."""
CURVED_SHARE = 0.75
"""Of the pixels taken that see such a place."""
EDGE_RAD = math.radians(8.0)
"""Where the profile turns by more within two pixels, there is an edge or a groove."""
LEAST_EDGE_SHARE = 0.01
"""Of the pixels that see one: with fewer, areas are not worth their time."""
COUNTED_PIXELS = 100_000
"""Pixels among which those are counted."""


def informative_pixels(
    views: Sequence[TrainView],
    surface: SurfaceOfRevolution,
    count: int,
    pixel: float,
) -> list[tuple[TrainView, Int[np.ndarray, "_"]]]:
    """About `count` pixels of all views, three quarters of them where the profile turns within two pixels."""
    curved = _curved_sides(surface, pixel, CURVED_RAD)
    generator = np.random.default_rng(0)
    share = min(1.0, SEARCHED_PIXELS / max(sum(len(view.solid) for view in views), 1))
    found = []
    for view in views:
        pixels = view.solid.cpu().numpy()
        pixels = pixels[generator.random(len(pixels)) < share]
        hits = surface.hits(*pixel_rays(view.camera, pixels))
        found.append((view, pixels, hits.met & curved[hits.side]))
    counts = sum(int(turns.sum()) for *_, turns in found), sum(int((~turns).sum()) for *_, turns in found)
    shares = (CURVED_SHARE, 1 - CURVED_SHARE)
    kept = [each * count / max(total, 1) for each, total in zip(shares, counts, strict=True)]
    return [(view, pixels[generator.random(len(pixels)) < np.where(turns, *kept)]) for view, pixels, turns in found]


def has_edges(views: Views, surface: SurfaceOfRevolution, pixel: float) -> bool:
    """Whether enough pixels see an edge or a groove."""
    edges, count, total = _curved_sides(surface, pixel, EDGE_RAD), 0, 0
    for view, pixels in every_kth_pixel(views, COUNTED_PIXELS):
        hits = surface.hits(*pixel_rays(view.camera, pixels.cpu().numpy()))
        count, total = count + int((hits.met & edges[hits.side]).sum()), total + int(hits.met.sum())
    return count > LEAST_EDGE_SHARE * total


def _curved_sides(surface: SurfaceOfRevolution, pixel: float, curved_rad: float) -> Bool[np.ndarray, "S"]:
    """Whether the profile turns near a side, by its direction a pixel before and behind."""
    length, angle = surface.arc_lengths, np.unwrap(np.append(surface.angles[0, 0], surface.angles[:, 1]))
    middle = (length[1:] + length[:-1]) / 2
    ahead, behind = (np.interp(middle + way, length, angle) for way in (pixel, -pixel))
    return np.asarray(np.abs(ahead - behind) > curved_rad)


def refine_by_footprints(
    views: Sequence[TrainView],
    contours: ContourRays,
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    *,
    pixels: int,
    rounds: Sequence[Round] = ROUNDS,
) -> SurfaceOfRevolution:
    """The surface with vertices a third of a pixel apart, after rounds of Gauss–Newton on at most so many
    pixels as areas.
    """
    pixel = contours.pixel
    count = min(pixels, int(LARGEST_SHARE * sum(len(view.solid) for view in views)))
    bundles = PixelBundles.of(informative_pixels(views, surface, count, pixel))
    spacing = SPACING_PX * pixel
    surface = resample_profile(surface, spacing)
    for each in rounds:
        blurred = avg_pool2d(environment, max(environment.shape[-1] // each.resolution, 1))
        surface = refine_round(
            bundles,
            contours,
            surface,
            blurred,
            each,
            lambda moved: resample_profile(place_lip(contours, moved, spacing), spacing),
            FITTED_BOUNCES,
        )
    return surface
