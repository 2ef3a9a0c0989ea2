"""The floor of a vessel, which cameras see by way of its walls alone.

A look into the mouth is mirrored down to the floor and out again, three times or more. How far a floor that starts
level at the axis and goes over smoothly into the wall rises in the middle is one number, and the photographs are
compared with the known map for each of its values.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from panoless.capture.rays import pixel_rays, reflect
from panoless.capture.views import Views
from panoless.geometry.revolution.model import RAY_EPSILON, SurfaceOfRevolution
from panoless.geometry.revolution.options import DEFAULTS, RevolutionOptions
from panoless.geometry.revolution.pixels import PixelBundles, evenly


def fit_floor(
    pixels: PixelBundles,
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    pixel: float,
    options: RevolutionOptions = DEFAULTS,
) -> SurfaceOfRevolution:
    """The surface with the floor that explains best what `floor_pixels` see under a map."""
    own = options.floor

    def error(rise: float) -> float:
        tried = with_floor(surface, rise * step, pixel, options)
        return pixels.error(tried, environment, options.rendering.max_bounces, options.judged_scale)

    step = float(surface.profile[1, 0]) / (4 * own.heights)
    errors = {float(rise): error(rise) for rise in range(-own.heights, own.heights + 1)}
    best = min(errors, key=lambda rise: errors[rise])
    least, width = errors[best], 0.5
    for _ in range(own.halvings):
        for rise in (best - width, best + width):
            found = error(rise)
            if found < least:
                best, least = rise, found
        width /= 2
    return with_floor(surface, best * step, pixel, options)


def with_floor(
    surface: SurfaceOfRevolution, rise: float, pixel: float, options: RevolutionOptions = DEFAULTS
) -> SurfaceOfRevolution:
    """The surface with a floor that is a cubic in ρ: `rise` higher on the axis than at its edge, level there, and with
    the wall's slope at the edge.
    """
    radius, height = surface.profile[1]
    lengths = surface.arc_lengths[1 : surface.lip + 1] - surface.arc_lengths[1]
    near = max(int((lengths < options.floor.wall_px * pixel).sum()), 3)
    offset, length = surface.profile[2 : 1 + near] - surface.profile[1], lengths[1:near]
    powers = np.stack([length, length**2], 1)
    across, up = (np.linalg.lstsq(powers, offset[:, k], rcond=None)[0][0] for k in (0, 1))
    slope = float(np.clip(up / max(across, 1e-3), -1.0, 1.0)) * radius
    sides = options.floor.sides
    x = np.arange(sides) / sides
    # Hermite: (0, rise) with slope 0 to (1, 0) with that slope.
    heights = height + rise * (2 * x**3 - 3 * x**2 + 1) + slope * (x**3 - x**2)
    return replace(
        surface,
        profile=np.concatenate([np.stack([radius * x, heights], 1), surface.profile[1:]]),
        lip=surface.lip + sides - 1,
    )


def floor_pixels(views: Views, surface: SurfaceOfRevolution, options: RevolutionOptions = DEFAULTS) -> PixelBundles:
    """Pixels whose path meets the floor."""
    own = options.floor
    chosen = [
        (view, pixels[_meets_floor(surface, *pixel_rays(view.camera, pixels), options.rendering.max_bounces)])
        for view, pixels in evenly(views, own.searched_pixels)
    ]
    return PixelBundles.of(chosen).at_most(own.pixels)


def _meets_floor(
    surface: SurfaceOfRevolution,
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    max_bounces: int,
) -> Bool[np.ndarray, "P"]:
    found, alive = np.zeros(len(origins), bool), np.arange(len(origins))
    for _ in range(max_bounces):
        hits = surface.hits(origins, directions)
        found[alive[hits.side == 0]] = True
        alive, normals, directions = alive[hits.met], hits.normals[hits.met], directions[hits.met]
        directions = reflect(directions, normals)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = hits.points[hits.met] + RAY_EPSILON * directions
    return found
