"""Refining a surface of revolution by what it mirrors: Gauss–Newton of profile and axis against the photographs, for a
given map.

At a fixed ray with direction d a shift δ of the profile along its normal n moves the hit by δ/(n·d) along the ray and
turns the normal by −δ' τ, and by as much as it turns along the part of that way that lies in the surface:

dn = −δ' τ + δ/(n·d) (κ (d·τ) τ + (n_ρ/ρ) (d·e_φ) e_φ),

with τ the direction of the profile, κ its curvature and e_φ the direction of azimuth. A motion u = w × x + t of the
whole body does the same with δ = n·u, and turns the normal by w × n less what u slides along the surface. A pixel's
prediction is the mean over its rays, and so are its derivatives.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.views import Views, every_kth_pixel
from panoless.environment.mirrored import MirroredRays
from panoless.environment.solve import solve_environment
from panoless.geometry.revolution.model import Hits, ReflectionPaths, SurfaceOfRevolution, revolution_rays
from panoless.geometry.revolution.pixels import PixelBundles
from panoless.geometry.revolution.profile import ProfileSplines, apply_step
from panoless.geometry.revolution.silhouette import (
    DAMPING,
    LARGEST_TURN_RAD,
    ContourRays,
    SilhouetteResiduals,
    adapted_scale,
    axis_motion,
    contour_cost,
    contour_equations,
    parameter_columns,
    silhouette_residuals,
)
from panoless.numeric.gauss_newton import accept_step, damped_step, jacobian_of_rows, normal_equations
from panoless.numeric.robust import bounded_error, robust_weight

CONTOUR_SCALE_PX = 1.0
"""Robust scale of the contours (px)."""
CONTOUR_SIGMA_PX = 0.15
"""Standard deviation of contours (px), which weighs them against radiance."""
RADIANCE_SIGMA = 0.05
"""Standard deviation of radiance under a right map."""
LEAST_COSINE = 0.05
"""Rays that graze the surface more than this have no vote: they amplify every error."""
LEAST_RADIUS_PX = 1.0
"""Nearer to the axis (px), azimuth is not determined."""
LEAST_FALL = 1e-3
"""A round ends with a step that lowers its cost by a smaller share."""


@dataclass(frozen=True)
class Round:
    """Steps under one map."""

    resolution: int
    """Texels along a face side of the map."""
    robust: float
    """Robust scale of radiance."""
    knot_px: float
    """Spacing of the splines (px)."""
    steps: int
    bending: float = 1e-4
    """Penalty on second differences, in mean diagonals of the normal matrix."""


def solve_map(
    views: Views,
    surface: SurfaceOfRevolution,
    rays: int,
    resolution: int,
    start: Tensor | None = None,
    max_bounces: int = 1,
) -> Float[Tensor, "6 3 L L"]:
    """The closed-form map for a surface of revolution, from about that many rays that leave it in time."""
    chosen = every_kth_pixel(views, rays)
    traced = [revolution_rays(surface, *each, max_bounces=max_bounces)[0] for each in chosen]
    return solve_environment(traced, resolution, start)


@dataclass(frozen=True)
class Photometry:
    """How pixels disagree with what a surface shows of a map."""

    paths: ReflectionPaths
    residual: Float[np.ndarray, "P 3"]
    """Prediction less photograph; zero for pixels that are not whole."""
    whole: Bool[np.ndarray, "P"]
    """Whether all rays of a pixel leave."""

    @classmethod
    def of(
        cls,
        pixels: PixelBundles,
        surface: SurfaceOfRevolution,
        environment: Float[Tensor, "6 3 L L"],
        max_bounces: int = 1,
    ) -> "Photometry":
        """Pixels under a map in a surface."""
        paths = pixels.trace(surface, max_bounces)
        whole = (paths.bounces > 0).reshape(-1, pixels.rays_per_pixel).all(1)
        residual = pixels.mean_light(paths, environment) - pixels.radiance
        return cls(paths, np.where(whole[:, None], residual, 0.0), whole)

    def cost(self, scale: float) -> float:
        """Σ ‖e‖²/(‖e‖² + s²), 1 for pixels that are not whole."""
        return float(np.where(self.whole, bounded_error(self.residual, scale), 1.0).sum())


def photometric_equations(
    pixels: PixelBundles,
    found: Photometry,
    surface: SurfaceOfRevolution,
    splines: ProfileSplines,
    environment: Float[Tensor, "6 3 L L"],
    robust: float,
    pixel: float,
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """Gradient and matrix over the axis' four numbers and the splines, in units of the radiance's deviation.

    Every row is the mean of those of a pixel's rays. Rays that are mirrored more than once have no derivative.
    """
    from scipy.sparse import csr_matrix

    count, each = len(pixels.radiance), pixels.rays_per_pixel
    once = np.flatnonzero((found.paths.bounces == 1) & np.repeat(found.whole, each))
    motion = normal_motion(pixels.directions[once], found.paths.first.of(once), surface, splines, pixel)
    rows, ray, columns = (
        motion.radiance_by_parameters(environment),
        once[motion.kept],
        parameter_columns(motion.index),
    )
    mean = csr_matrix((np.full(len(ray), 1 / each), (ray // each, np.arange(len(ray)))), (count, len(ray)))
    weights = robust_weight(found.residual, robust) / RADIANCE_SIGMA**2
    gradient, matrix = np.zeros(4 + splines.count), np.zeros((4 + splines.count, 4 + splines.count))
    for channel in range(3):
        jacobian = mean @ jacobian_of_rows(rows[:, channel], columns, 4 + splines.count)
        g, m = normal_equations(jacobian, found.residual[:, channel], weights)
        gradient, matrix = gradient + g, matrix + m
    return gradient, matrix


@dataclass(frozen=True)
class NormalMotion:
    """How normals turn along τ and e_φ, at fixed rays, with the axis' four numbers and the four splines that act at
    each hit, for the rays that see the surface well enough.
    """

    kept: Bool[np.ndarray, "P"]
    """Which of all rays these are."""
    mirrored: MirroredRays
    along: Float[np.ndarray, "Q 3 2"]
    """τ and e_φ."""
    bends: Float[np.ndarray, "Q 2"]
    """Principal curvatures in these directions: how the normal turns along them."""
    turns: Float[np.ndarray, "Q 2 8"]
    index: Int[np.ndarray, "Q 4"]

    def radiance_by_parameters(self, environment: Float[Tensor, "6 3 L L"]) -> Float[np.ndarray, "Q 3 8"]:
        """Derivatives of what rays see."""
        return np.matmul(self.mirrored.light_by_turns(environment, self.along), self.turns)


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
    turn_profile = np.concatenate([axis_profile, spline_profile], 1)
    turn_azimuth = np.concatenate([axis_azimuth, spline_azimuth], 1)
    chosen = hits.of(kept)
    return NormalMotion(
        kept=kept,
        mirrored=MirroredRays(rays @ surface.frame, chosen.normals, chosen.points, surface.surroundings),
        along=np.stack([profile_direction @ surface.frame, azimuth @ surface.frame], 2),
        bends=np.stack([bend, around], 1),
        turns=np.stack([turn_profile, turn_azimuth], 1),
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


@dataclass(frozen=True)
class _Evaluation:
    """A surface under a map: photometry, contours and the cost of both."""

    surface: SurfaceOfRevolution
    photometry: Photometry
    contours: SilhouetteResiduals
    cost: float


def refine_round(
    pixels: PixelBundles,
    contours: ContourRays,
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    each: Round,
    settle: Callable[[SurfaceOfRevolution], SurfaceOfRevolution],
    max_bounces: int = 1,
) -> SurfaceOfRevolution:
    """Gauss–Newton steps on photographs and contours together; each is taken if it lowers the cost of both.

    The cost is Σ s²ρ(e/s)/2σ² over pixels and contour rays, ρ the bounded error. `settle` follows every step: it
    samples the profile evenly and keeps a thin wall's lip where contours have it.
    """
    cell = contours.pixel
    touched = silhouette_residuals(contours, surface, cell)
    scale = adapted_scale(contours, touched.pixels[touched.valid], CONTOUR_SCALE_PX)
    of_contours, of_pixels = (
        (scale / CONTOUR_SIGMA_PX) ** 2 / 2,
        (each.robust / RADIANCE_SIGMA) ** 2 / 2,
    )

    def evaluate(tried: SurfaceOfRevolution) -> _Evaluation:
        photometry = Photometry.of(pixels, tried, environment, max_bounces)
        found = silhouette_residuals(contours, tried, cell)
        cost = of_pixels * photometry.cost(each.robust)
        return _Evaluation(
            tried, photometry, found, cost + of_contours * len(found.pixels) * contour_cost(found, scale)
        )

    def advance(here: _Evaluation) -> _Evaluation:
        splines, evaluations = ProfileSplines.of(here.surface, each.knot_px * cell), [here]
        gradient, matrix = photometric_equations(
            pixels, here.photometry, here.surface, splines, environment, each.robust, cell
        )
        by_contour, contour_matrix = contour_equations(contours, here.contours, splines, scale)
        gradient = gradient + by_contour / CONTOUR_SIGMA_PX**2
        matrix = matrix + contour_matrix / CONTOUR_SIGMA_PX**2
        matrix[4:, 4:] += splines.bending(each.bending * np.trace(matrix[4:, 4:]) / splines.count)

        def cost(tried: SurfaceOfRevolution) -> float:
            if tried is not evaluations[-1].surface:
                evaluations.append(evaluate(tried))
            return evaluations[-1].cost

        moved = accept_step(
            here.surface,
            damped_step(gradient, matrix, DAMPING, LARGEST_TURN_RAD, slice(4)),
            lambda surface, step: settle(apply_step(surface, splines, step)),
            cost,
        )
        return here if moved is here.surface else evaluations[-1]

    here: _Evaluation | None = None
    for _ in range(each.steps):
        settled = settle(surface)
        before = here if here is not None and settled is here.surface else evaluate(settled)
        here = advance(before)
        surface = here.surface
        if here.cost > (1 - LEAST_FALL) * before.cost:
            break
    return surface
