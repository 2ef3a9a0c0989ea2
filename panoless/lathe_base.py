"""The bottom of an open vessel, which no camera sees but in its own walls.

A look into the mouth is mirrored down to the bottom and out again, three times or more. How far a bottom that starts
level at the axis and goes over smoothly into the wall rises in the middle is one number, and the photographs are
compared with the known map for each of its values.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from panoless.kernels.cubemap import sample_cubemap
from panoless.lathe import LEAVING, Lathe, followed, mirrored, pixel_rays
from panoless.views import Views, spread_pixels

DEEPEST = 10
FEWEST_PIXELS, MOST_PIXELS = 200, 2500
LOOKED_AT = 400_000
"""Pixels of all views among which those that see the bottom are searched."""
SUBPIXELS = 2
STEPS = 16
"""Heights that are tried to either side of a flat bottom, each by a 64th of its radius."""
REFINED = 6
SIDES = 24
WALL_VERTICES = 9
"""From these the slope of the wall is found where the bottom begins."""
ERROR_SCALE = 0.1
LEAST_GAIN = 0.02


@dataclass(frozen=True)
class BaseRays:
    """Rays of pixels that see the bottom, SUBPIXELS² for each pixel, and the pixels' radiance."""

    origins: Float[np.ndarray, "R 3"]
    directions: Float[np.ndarray, "R 3"]
    radiance: Float[Tensor, "P 3"]


def found_base(views: Views, lathe: Lathe, environment: Float[Tensor, "6 3 L L"]) -> Lathe:
    """An open lathe with the bottom that explains best what is seen of it; as it is if that is no better, or unseen."""
    rays = base_rays(views, lathe) if lathe.is_open and len(lathe.profile) > WALL_VERTICES + 2 else None
    if rays is None:
        return lathe
    step = float(lathe.profile[1, 0]) / (4 * STEPS)
    errors = {rise: base_error(rays, with_base(lathe, rise * step), environment) for rise in range(-STEPS, STEPS + 1)}
    best, width = float(min(errors, key=lambda rise: errors[rise])), 0.5
    least = errors[int(best)]
    for _ in range(REFINED):
        for rise in (best - width, best + width):
            error = base_error(rays, with_base(lathe, rise * step), environment)
            if error < least:
                best, least = rise, error
        width /= 2
    return with_base(lathe, best * step) if least < (1 - LEAST_GAIN) * base_error(rays, lathe, environment) else lathe


def with_base(lathe: Lathe, rise: float) -> Lathe:
    """The lathe with a bottom that is a cubic in ρ: `rise` higher on the axis than at its edge, level there, and with
    the wall's slope at the edge.
    """
    radius, height = lathe.profile[1]
    wall = lathe.profile[1 : 1 + WALL_VERTICES]
    offset = wall - wall[0]
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(offset, axis=0), axis=1)))[1:]
    powers = np.stack([length, length**2], 1)
    across, up = (np.linalg.lstsq(powers, offset[1:, k], rcond=None)[0][0] for k in (0, 1))
    slope = float(np.clip(up / max(across, 1e-3), -1.0, 1.0)) * radius
    x = np.arange(SIDES) / SIDES
    heights = height + _cubic(x, rise, slope)
    return replace(
        lathe,
        profile=np.concatenate([np.stack([radius * x, heights], 1), lathe.profile[1:]]),
        rim=lathe.rim + SIDES - 1,
    )


def _cubic(x: Float[np.ndarray, "N"], rise: float, slope: float) -> Float[np.ndarray, "N"]:
    """Hermite: (0, rise) with slope 0 to (1, 0) with that slope."""
    return rise * (2 * x**3 - 3 * x**2 + 1) + slope * (x**3 - x**2)


def base_rays(views: Views, lathe: Lathe) -> BaseRays | None:
    """Rays of pixels whose path meets the bottom; None when there are hardly any."""
    parts = []
    for view, pixels in spread_pixels(views, LOOKED_AT):
        seen = pixels.cpu().numpy()[_meets_base(lathe, *pixel_rays(view.camera, pixels.cpu().numpy()))]
        offsets = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS
        rays = [pixel_rays(view.camera, seen, (x, y)) for y in offsets for x in offsets]
        joined = [np.stack([each[k] for each in rays], 1) for k in (0, 1)]
        parts.append((*joined, view.radiance.flatten(1).T.cpu()[torch.from_numpy(seen)]))
    origins, directions = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    stride = max(1, len(origins) // MOST_PIXELS)
    if len(origins) < FEWEST_PIXELS:
        return None
    radiance = torch.cat([part[2] for part in parts])[::stride]
    return BaseRays(origins[::stride].reshape(-1, 3), directions[::stride].reshape(-1, 3), radiance)


def _meets_base(
    lathe: Lathe, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]
) -> Bool[np.ndarray, "P"]:
    found, alive = np.zeros(len(origins), bool), np.arange(len(origins))
    for _ in range(DEEPEST):
        hits = lathe.hits(origins, directions)
        found[alive[hits.side == 0]] = True
        alive, normals, directions = alive[hits.met], hits.normals[hits.met], directions[hits.met]
        directions = mirrored(directions, normals)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = hits.points[hits.met] + LEAVING * directions
    return found


def base_error(rays: BaseRays, lathe: Lathe, environment: Float[Tensor, "6 3 L L"]) -> float:
    """Mean of ‖e‖²/(‖e‖² + s²) over pixels, each the mean of its rays."""
    escapes = followed(lathe, rays.origins, rays.directions, DEEPEST)
    ways = torch.from_numpy(escapes.directions).float().to(environment.device)
    light = sample_cubemap(environment, ways).reshape(len(rays.radiance), -1, 3).mean(1).cpu()
    error = (light - rays.radiance).square().sum(1)
    return float((error / (error + ERROR_SCALE**2)).mean())
