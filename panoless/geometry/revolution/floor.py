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
from panoless.geometry.revolution.model import MAX_BOUNCES, RAY_EPSILON, SurfaceOfRevolution
from panoless.geometry.revolution.pixels import JUDGED_SCALE, PixelBundles, evenly

PIXELS = 2500
"""Pixels whose paths meet the floor that judge heights."""
SEARCHED_PIXELS = 400_000
"""Pixels of all views among which those are searched."""
HEIGHTS = 16
"""Tried to either side of a flat floor, in steps of a 64th of its radius."""
HALVINGS = 6
"""Of the step around the best height."""
SIDES = 24
"""Of the profile's polyline along the floor."""
WALL_PX = 9.0
"""Length of the wall (px) from which its slope is found where the floor begins."""


def fit_floor(
    pixels: PixelBundles,
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    pixel: float,
) -> SurfaceOfRevolution:
    """The surface with the floor that explains best what `floor_pixels` see under a map."""

    def error(rise: float) -> float:
        tried = with_floor(surface, rise * step, pixel)
        return pixels.error(tried, environment, MAX_BOUNCES, JUDGED_SCALE)

    step = float(surface.profile[1, 0]) / (4 * HEIGHTS)
    errors = {float(rise): error(rise) for rise in range(-HEIGHTS, HEIGHTS + 1)}
    best = min(errors, key=lambda rise: errors[rise])
    least, width = errors[best], 0.5
    for _ in range(HALVINGS):
        for rise in (best - width, best + width):
            found = error(rise)
            if found < least:
                best, least = rise, found
        width /= 2
    return with_floor(surface, best * step, pixel)


def with_floor(surface: SurfaceOfRevolution, rise: float, pixel: float) -> SurfaceOfRevolution:
    """The surface with a floor that is a cubic in ρ: `rise` higher on the axis than at its edge, level there, and with
    the wall's slope at the edge.
    """
    radius, height = surface.profile[1]
    lengths = surface.arc_lengths[1 : surface.lip + 1] - surface.arc_lengths[1]
    near = max(int((lengths < WALL_PX * pixel).sum()), 3)
    offset, length = surface.profile[2 : 1 + near] - surface.profile[1], lengths[1:near]
    powers = np.stack([length, length**2], 1)
    across, up = (np.linalg.lstsq(powers, offset[:, k], rcond=None)[0][0] for k in (0, 1))
    slope = float(np.clip(up / max(across, 1e-3), -1.0, 1.0)) * radius
    x = np.arange(SIDES) / SIDES
    # Hermite: (0, rise) with slope 0 to (1, 0) with that slope.
    heights = height + rise * (2 * x**3 - 3 * x**2 + 1) + slope * (x**3 - x**2)
    return replace(
        surface,
        profile=np.concatenate([np.stack([radius * x, heights], 1), surface.profile[1:]]),
        lip=surface.lip + SIDES - 1,
    )


def floor_pixels(views: Views, surface: SurfaceOfRevolution) -> PixelBundles:
    """Pixels whose path meets the floor."""
    chosen = [
        (view, pixels[_meets_floor(surface, *pixel_rays(view.camera, pixels), MAX_BOUNCES)])
        for view, pixels in evenly(views, SEARCHED_PIXELS)
    ]
    return PixelBundles.of(chosen).at_most(PIXELS)


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
