"""Refining a surface of revolution by what it mirrors: Gauss–Newton of profile and axis against the photographs, for a
given map.

At a fixed ray with direction d a shift δ of the profile along its normal n moves the hit by δ/(n·d) along the ray and
turns the normal by −δ' τ, and by as much as it turns along the part of that way that lies in the surface:

dn = −δ' τ + δ/(n·d) (κ (d·τ) τ + (n_ρ/ρ) (d·e_φ) e_φ),

with τ the direction of the profile, κ its curvature and e_φ the direction of azimuth. A motion u = w × x + t of the
whole body does the same with δ = n·u, and turns the normal by w × n less what u slides along the surface.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.rays import reflect
from panoless.capture.views import Views, concatenated, every_kth_pixel
from panoless.environment.solve import solve_environment
from panoless.geometry.revolution.model import Hits, SurfaceOfRevolution, revolution_rays
from panoless.geometry.revolution.profile import ProfileSplines, apply_step
from panoless.geometry.revolution.silhouette import (
    ContourRays,
    accumulate_equations,
    axis_motion,
    contour_equations,
    solved,
)
from panoless.kernels.cubemap import sample_cubemap

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
    """Pixels that see the environment by way of a surface of revolution at once: rays that meet it, with where and
    what they saw.
    """

    directions: Float[np.ndarray, "P 3"]
    radiance: Float[Tensor, "P 3"]
    hits: Hits


def select_observations(views: Views, surface: SurfaceOfRevolution, most: int) -> Observations:
    """About `most` pixels of all views, evenly."""
    parts = []
    for view, pixels in every_kth_pixel(views, most):
        rays, hits = revolution_rays(surface, view, pixels)
        way = hits.points - view.position
        parts.append((way / hits.distance[:, None], rays.radiance, hits))
    directions_local, radiance, met = zip(*parts, strict=True)
    return Observations(np.concatenate(directions_local), torch.cat(radiance), concatenated(met))


def solve_map(
    views: Views, surface: SurfaceOfRevolution, most: int, resolution: int, start: Tensor | None = None
) -> Float[Tensor, "6 3 L L"]:
    """The closed-form map for a surface of revolution."""
    rays = [revolution_rays(surface, *chosen)[0] for chosen in every_kth_pixel(views, most)]
    return solve_environment(rays, resolution, start)


def photometric_equations(
    seen: Observations,
    surface: SurfaceOfRevolution,
    splines: ProfileSplines,
    environment: Float[Tensor, "6 3 L L"],
    robust: float,
    pixel: float,
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """Gradient and matrix over the axis' four numbers and the splines, in units of the radiance's deviation."""
    motion = normal_motion(seen.directions, seen.hits, surface, splines, pixel)
    radiance = seen.radiance[torch.from_numpy(motion.kept)].cpu().numpy()
    residual = motion.look_up(environment, surface) - radiance
    weights = (1 + (residual**2).sum(1) / robust**2) ** -2 / RADIANCE_SIGMA**2
    gradient, matrix = np.zeros(4 + splines.count), np.zeros((4 + splines.count, 4 + splines.count))
    rows = motion.radiance_by_parameters(environment, surface)
    for channel in range(3):
        by_axis, by_spline = rows[:, channel, :4], rows[:, channel, 4:]
        g, m = accumulate_equations(by_axis, by_spline, motion.index, residual[:, channel], weights, splines.count)
        gradient, matrix = gradient + g, matrix + m
    return gradient, matrix


@dataclass(frozen=True)
class NormalMotion:
    """How normals turn, at fixed rays, with the axis' four numbers and the four splines that act at each hit.

    For the rays that see the surface well enough, in the frame of the axis; turns are those along τ and along e_φ.
    """

    kept: Bool[np.ndarray, "P"]
    """Which of all rays these are."""
    rays: Float[np.ndarray, "Q 3"]
    normals: Float[np.ndarray, "Q 3"]
    along_profile: Float[np.ndarray, "Q 3"]
    along_azimuth: Float[np.ndarray, "Q 3"]
    turn_profile: Float[np.ndarray, "Q 8"]
    turn_azimuth: Float[np.ndarray, "Q 8"]
    index: Int[np.ndarray, "Q 4"]

    def look_up(
        self,
        environment: Float[Tensor, "6 3 L L"],
        surface: SurfaceOfRevolution,
        turned: Float[np.ndarray, "Q 3"] | None = None,
    ) -> Float[np.ndarray, "Q 3"]:
        """What rays see of a map by the normals, or by others that need not be unit."""
        normals = self.normals if turned is None else turned / np.linalg.norm(turned, axis=1, keepdims=True)
        directions = torch.from_numpy(reflect(self.rays, normals) @ surface.frame).float().to(environment.device)
        return sample_cubemap(environment, directions).cpu().numpy().astype(np.float64)

    def radiance_by_parameters(
        self, environment: Float[Tensor, "6 3 L L"], surface: SurfaceOfRevolution
    ) -> Float[np.ndarray, "Q 3 8"]:
        """Derivatives of what rays see, by differences over a texel."""
        step = np.pi / 2 / environment.shape[-1] / 2

        def derivative(way: Float[np.ndarray, "Q 3"]) -> Float[np.ndarray, "Q 3"]:
            ahead, behind = (self.look_up(environment, surface, self.normals + s * way) for s in (step, -step))
            return (ahead - behind) / (2 * step)

        by_profile, by_azimuth = derivative(self.along_profile), derivative(self.along_azimuth)
        return by_profile[:, :, None] * self.turn_profile[:, None] + by_azimuth[:, :, None] * self.turn_azimuth[:, None]


def normal_motion(
    directions: Float[np.ndarray, "P 3"],
    hits: Hits,
    surface: SurfaceOfRevolution,
    splines: ProfileSplines,
    pixel: float,
) -> NormalMotion:
    """The turns of the module's equation for rays in the normalized frame and where they meet a surface of
    revolution.
    """
    rays = directions @ surface.frame.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points, normals = (hits.points - surface.origin) @ surface.frame.T, hits.normals @ surface.frame.T
    rho = np.hypot(points[:, 0], points[:, 1])
    facing = (rays * normals).sum(1)
    kept = (np.abs(facing) > LEAST_COSINE) & (rho > LEAST_RADIUS_PX * pixel)
    rays, points, normals, rho, facing = (each[kept] for each in (rays, points, normals, rho, facing))
    side, along = hits.side[kept], hits.along[kept]
    azimuth = np.stack([-points[:, 1], points[:, 0], np.zeros_like(rho)], 1) / rho[:, None]
    profile_direction = np.cross(normals, azimuth)
    ends = surface.angles
    lengths = np.maximum(np.diff(surface.arc_lengths), 1e-12)
    # n turns along the profile as it does: dn/ds = (dθ/ds) τ, and n_ρ/ρ is that around the axis.
    bend = ((ends[:, 1] - ends[:, 0]) / lengths)[side]
    around = (normals[:, 0] * points[:, 0] + normals[:, 1] * points[:, 1]) / rho**2
    slide_profile, slide_azimuth = (rays * profile_direction).sum(1), (rays * azimuth).sum(1)
    values, index = splines.values(side, along)
    slopes, _ = splines.values(side, along, derivative=True)
    spline_profile = -slopes + values * (bend * slide_profile / facing)[:, None]
    spline_azimuth = values * (around * slide_azimuth / facing)[:, None]
    axis_profile, axis_azimuth = _axis_turns(points, normals, profile_direction, azimuth, rays, facing, bend, around)
    return NormalMotion(
        kept=kept,
        rays=rays,
        normals=normals,
        along_profile=profile_direction,
        along_azimuth=azimuth,
        turn_profile=np.concatenate([axis_profile, spline_profile], 1),
        turn_azimuth=np.concatenate([axis_azimuth, spline_azimuth], 1),
        index=index,
    )


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


def photometric_step(
    seen: Observations,
    contours: ContourRays,
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    each: Round,
    bending: float,
) -> SurfaceOfRevolution:
    """One Gauss–Newton step on photographs and contours together."""
    pixel = float(np.median(contours.pixel))
    splines = ProfileSplines.of(surface, each.knot_px * pixel)
    equations = photometric_equations(seen, surface, splines, environment, each.robust, pixel)
    return step_on_equations(equations, contours, surface, splines, bending)


def step_on_equations(
    equations: tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]],
    contours: ContourRays,
    surface: SurfaceOfRevolution,
    splines: ProfileSplines,
    bending: float,
) -> SurfaceOfRevolution:
    """The step of gradient and matrix of the photographs, with the contours and a share of their stiffness."""
    gradient, matrix = equations
    pixel = float(np.median(contours.pixel))
    by_contour, of_contours = contour_equations(contours, surface, splines, pixel, 1.0)
    gradient = gradient + by_contour / CONTOUR_SIGMA_PX**2
    matrix = matrix + of_contours / CONTOUR_SIGMA_PX**2
    matrix[4:, 4:] += splines.bending(bending * np.trace(matrix[4:, 4:]) / splines.count)
    return apply_step(surface, splines, solved(gradient, matrix))
