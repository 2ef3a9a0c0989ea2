"""The bottom of an open vessel, which no camera sees but in its own walls.

A look into the mouth is mirrored down to the bottom and out again, three times or more. How far a bottom that starts
level at the axis and goes over smoothly into the wall rises in the middle is one number, and the photographs are
compared with the known map for each of its values.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from panoless.capture.rays import pixel_rays, reflect
from panoless.capture.views import Views, concatenated, every_kth_pixel
from panoless.geometry.revolution.model import RAY_EPSILON, SurfaceOfRevolution
from panoless.geometry.revolution.render import MAX_RENDER_BOUNCES, MultiBouncePixels

FEWEST_PIXELS, MOST_PIXELS = 200, 2500
LOOKED_AT = 400_000
"""Pixels of all views among which those that see the bottom are searched."""
STEPS = 16
"""Heights that are tried to either side of a flat bottom, each by a 64th of its radius."""
REFINED = 6
SIDES = 24
WALL_VERTICES = 9
"""From these the slope of the wall is found where the bottom begins."""
LEAST_GAIN = 0.02


def fit_floor(views: Views, surface: SurfaceOfRevolution, environment: Float[Tensor, "6 3 L L"]) -> SurfaceOfRevolution:
    """An open surface with the bottom that explains best what is seen of it; as it is if that is no better, or
    unseen.
    """
    seen = floor_pixels(views, surface) if surface.is_open and len(surface.profile) > WALL_VERTICES + 2 else None
    if seen is None:
        return surface
    step = float(surface.profile[1, 0]) / (4 * STEPS)
    errors = {rise: seen.error(with_floor(surface, rise * step), environment) for rise in range(-STEPS, STEPS + 1)}
    best, width = float(min(errors, key=lambda rise: errors[rise])), 0.5
    least = errors[int(best)]
    for _ in range(REFINED):
        for rise in (best - width, best + width):
            error = seen.error(with_floor(surface, rise * step), environment)
            if error < least:
                best, least = rise, error
        width /= 2
    return with_floor(surface, best * step) if least < (1 - LEAST_GAIN) * seen.error(surface, environment) else surface


def with_floor(surface: SurfaceOfRevolution, rise: float) -> SurfaceOfRevolution:
    """The surface with a bottom that is a cubic in ρ: `rise` higher on the axis than at its edge, level there, and with
    the wall's slope at the edge.
    """
    radius, height = surface.profile[1]
    wall = surface.profile[1 : 1 + WALL_VERTICES]
    offset = wall - wall[0]
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(offset, axis=0), axis=1)))[1:]
    powers = np.stack([length, length**2], 1)
    across, up = (np.linalg.lstsq(powers, offset[1:, k], rcond=None)[0][0] for k in (0, 1))
    slope = float(np.clip(up / max(across, 1e-3), -1.0, 1.0)) * radius
    x = np.arange(SIDES) / SIDES
    heights = height + _cubic(x, rise, slope)
    return replace(
        surface,
        profile=np.concatenate([np.stack([radius * x, heights], 1), surface.profile[1:]]),
        lip=surface.lip + SIDES - 1,
    )


def _cubic(x: Float[np.ndarray, "N"], rise: float, slope: float) -> Float[np.ndarray, "N"]:
    """Hermite: (0, rise) with slope 0 to (1, 0) with that slope."""
    return rise * (2 * x**3 - 3 * x**2 + 1) + slope * (x**3 - x**2)


def floor_pixels(views: Views, surface: SurfaceOfRevolution) -> MultiBouncePixels | None:
    """Pixels whose path meets the bottom; None when there are hardly any."""
    parts = []
    for view, pixels in every_kth_pixel(views, LOOKED_AT):
        places = pixels.cpu().numpy()
        parts.append(MultiBouncePixels.of(view, places[_meets_base(surface, *pixel_rays(view.camera, places))]))
    found = concatenated(parts)
    if len(found.radiance) < FEWEST_PIXELS:
        return None
    return found.every(max(1, len(found.radiance) // MOST_PIXELS))


def _meets_base(
    surface: SurfaceOfRevolution, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]
) -> Bool[np.ndarray, "P"]:
    found, alive = np.zeros(len(origins), bool), np.arange(len(origins))
    for _ in range(MAX_RENDER_BOUNCES):
        hits = surface.hits(origins, directions)
        found[alive[hits.side == 0]] = True
        alive, normals, directions = alive[hits.met], hits.normals[hits.met], directions[hits.met]
        directions = reflect(directions, normals)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = hits.points[hits.met] + RAY_EPSILON * directions
    return found
