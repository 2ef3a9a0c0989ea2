"""Refining a lathe by what it mirrors: Gauss–Newton of profile and axis against the photographs, for a given map.

At a fixed ray with direction d a shift δ of the profile along its normal n moves the hit by δ/(n·d) along the ray and
turns the normal by −δ' τ, and by as much as it turns along the part of that way that lies in the surface:

dn = −δ' τ + δ/(n·d) (κ (d·τ) τ + (n_ρ/ρ) (d·e_φ) e_φ),

with τ the direction of the profile, κ its curvature and e_φ the direction of azimuth. A motion u = w × x + t of the
whole body does the same with δ = n·u, and turns the normal by w × n less what u slides along the surface.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.cubemap import solve_environment
from panoless.kernels.cubemap import sample_cubemap
from panoless.lathe import Hits, Lathe, lathe_rays, mirrored
from panoless.lathe_contours import (
    ContourRays,
    accumulated,
    axis_motion,
    contour_equations,
    solved,
)
from panoless.lathe_profile import ProfileSplines, moved
from panoless.views import Views

LEAST_COSINE = 0.05
"""Rays that graze the surface more than this say little and amplify every error."""
CONTOUR_SIGMA_PX = 0.15
RADIANCE_SIGMA = 0.05
LEAST_RADIUS_PX = 1.0


@dataclass(frozen=True)
class Round:
    """One alternation: a map of that resolution, then steps with that robust scale and spacing of the splines."""

    resolution: int
    robust: float
    knot_px: float
    steps: int = 2


@dataclass(frozen=True)
class Observations:
    """Pixels that see the environment by way of a lathe at once: rays that meet it, with where and what they saw."""

    directions: Float[np.ndarray, "P 3"]
    radiance: Float[Tensor, "P 3"]
    hits: Hits


def observations(views: Views, lathe: Lathe, most: int) -> Observations:
    """About `most` pixels of all views, evenly."""
    stride = max(1, sum(len(view.solid) for view in views.train) // most)
    parts = []
    for index, view in enumerate(views.train):
        pixels = view.solid[index % stride :: stride]
        rays, hits = lathe_rays(lathe, view, pixels)
        way = hits.points - view.position
        parts.append((way / hits.distance[:, None], rays.radiance, hits))
    joined = Hits(**{name: np.concatenate([getattr(part[2], name) for part in parts]) for name in vars(parts[0][2])})
    return Observations(np.concatenate([part[0] for part in parts]), torch.cat([part[1] for part in parts]), joined)


def solved_map(
    views: Views, lathe: Lathe, most: int, resolution: int, start: Tensor | None = None
) -> Float[Tensor, "6 3 L L"]:
    """The closed-form map for a lathe."""
    stride = max(1, sum(len(view.solid) for view in views.train) // most)
    rays = [lathe_rays(lathe, view, view.solid[i % stride :: stride])[0] for i, view in enumerate(views.train)]
    return solve_environment(rays, resolution, start)


def photometric_equations(
    seen: Observations,
    lathe: Lathe,
    splines: ProfileSplines,
    environment: Float[Tensor, "6 3 L L"],
    robust: float,
    pixel: float,
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """Gradient and matrix over the axis' four numbers and the splines, in units of the radiance's deviation."""
    hits, rays = seen.hits, seen.directions @ lathe.frame.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points, normals = (hits.points - lathe.origin) @ lathe.frame.T, hits.normals @ lathe.frame.T
    rho = np.hypot(points[:, 0], points[:, 1])
    facing = (rays * normals).sum(1)
    kept = (np.abs(facing) > LEAST_COSINE) & (rho > LEAST_RADIUS_PX * pixel)
    rays, points, normals, rho, facing = (each[kept] for each in (rays, points, normals, rho, facing))
    side, along, radiance = hits.side[kept], hits.along[kept], seen.radiance[torch.from_numpy(kept)]
    azimuth = np.stack([-points[:, 1], points[:, 0], np.zeros_like(rho)], 1) / rho[:, None]
    profile_direction = np.cross(normals, azimuth)
    residual, by_turn, by_azimuth = _residuals(rays, normals, profile_direction, azimuth, radiance, environment, lathe)
    ends = lathe.angles
    lengths = np.maximum(np.diff(lathe.arc_lengths), 1e-12)
    # n turns along the profile as it does: dn/ds = (dθ/ds) τ, and n_ρ/ρ is that around the axis.
    bend = ((ends[:, 1] - ends[:, 0]) / lengths)[side]
    around = (normals[:, 0] * points[:, 0] + normals[:, 1] * points[:, 1]) / rho**2
    slide_profile, slide_azimuth = (rays * profile_direction).sum(1), (rays * azimuth).sum(1)
    values, index = splines.values(side, along)
    slopes, _ = splines.values(side, along, derivative=True)
    spline_profile = -slopes + values * (bend * slide_profile / facing)[:, None]
    spline_azimuth = values * (around * slide_azimuth / facing)[:, None]
    axis_profile, axis_azimuth = _axis_turns(points, normals, profile_direction, azimuth, rays, facing, bend, around)
    weights = (1 + (residual**2).sum(1) / robust**2) ** -2 / RADIANCE_SIGMA**2
    gradient, matrix = np.zeros(4 + splines.count), np.zeros((4 + splines.count, 4 + splines.count))
    for channel in range(3):
        a, b = by_turn[:, channel, None], by_azimuth[:, channel, None]
        g, m = accumulated(
            a * axis_profile + b * axis_azimuth,
            a * spline_profile + b * spline_azimuth,
            index,
            residual[:, channel],
            weights,
            splines.count,
        )
        gradient, matrix = gradient + g, matrix + m
    return gradient, matrix


def _axis_turns(points, normals, profile_direction, azimuth, rays, facing, bend, around):
    """Turn of the normal along τ and e_φ, at a fixed ray, by turns about and shifts along e₁ and e₂."""
    shift = axis_motion(points, normals) / facing[:, None]
    along_profile, along_azimuth = axis_motion(points, profile_direction), axis_motion(points, azimuth)
    slide_profile = shift * (rays * profile_direction).sum(1)[:, None] - along_profile
    slide_azimuth = shift * (rays * azimuth).sum(1)[:, None] - along_azimuth
    turns = np.zeros((len(points), 3, 2))
    for k, unit in enumerate(np.eye(3)[:2]):
        turns[:, :, k] = np.cross(unit, normals)
    still = np.zeros((len(points), 2))
    turn_profile = np.concatenate([np.einsum("pck,pc->pk", turns, profile_direction), still], 1)
    turn_azimuth = np.concatenate([np.einsum("pck,pc->pk", turns, azimuth), still], 1)
    return turn_profile + bend[:, None] * slide_profile, turn_azimuth + around[:, None] * slide_azimuth


def _residuals(rays, normals, profile_direction, azimuth, radiance, environment, lathe):
    """E(ω) − c, and its derivatives by turns of the normal along τ and e_φ: differences over a texel."""
    step = np.pi / 2 / environment.shape[-1] / 2

    def look(turned: np.ndarray) -> np.ndarray:
        unit = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        directions = torch.from_numpy(mirrored(rays, unit) @ lathe.frame).float().to(environment.device)
        return sample_cubemap(environment, directions).cpu().numpy().astype(np.float64)

    residual = look(normals) - radiance.cpu().numpy()
    derivatives = [
        (look(normals + step * direction) - look(normals - step * direction)) / (2 * step)
        for direction in (profile_direction, azimuth)
    ]
    return residual, derivatives[0], derivatives[1]


def photometric_step(
    seen: Observations,
    contours: ContourRays,
    lathe: Lathe,
    environment: Float[Tensor, "6 3 L L"],
    each: Round,
    bending: float,
) -> Lathe:
    """One Gauss–Newton step on photographs and contours together."""
    pixel = float(np.median(contours.pixel))
    splines = ProfileSplines.of(lathe, each.knot_px * pixel)
    gradient, matrix = photometric_equations(seen, lathe, splines, environment, each.robust, pixel)
    by_contour, of_contours = contour_equations(contours, lathe, splines, pixel, 1.0)
    gradient += by_contour / CONTOUR_SIGMA_PX**2
    matrix += of_contours / CONTOUR_SIGMA_PX**2
    matrix[4:, 4:] += splines.bending(bending * np.trace(matrix[4:, 4:]) / splines.count)
    return moved(lathe, splines, solved(gradient, matrix))
