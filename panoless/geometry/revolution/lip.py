"""The lip of a vessel: where silhouettes put it, how the profile gets there, and what photographs add.

A contour ray that passes over the lip of a wall without thickness touches that circle alone. In the half-plane of
radius ρ and height h it is a hyperbola through the tip q of the profile, with unit normal m where it comes nearest, so
m·q is known; rays of several elevations and both sides of the lip have different m, and q is their common point.

Silhouettes place the lip to a twentieth of a pixel, but over the last pixels of the wall that is a degree, and rays
that leave a vessel pass them twice or more. So pixels that mix the lip with what lies around it refine it: each is the
mean of some rays, followed as deep as they go. How that changes with a few numbers, shifts of the profile near the lip
along its normals and an extension of a thin wall, is found by differences. Pixels that are very sensitive to these
numbers count less, because they are as sensitive to what is not fitted:

w = (1 + ‖e‖²/9v)⁻²/v, v = σ² + τ² mean_c ‖∂c/∂θ‖².
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from panoless.capture.rays import pixel_rays, pose_of, project
from panoless.capture.views import TrainView, Views
from panoless.geometry.revolution.model import MAX_BOUNCES, SurfaceOfRevolution, trace_reflections
from panoless.geometry.revolution.photometric import RADIANCE_SIGMA
from panoless.geometry.revolution.pixels import JUDGED_SCALE, PixelBundles
from panoless.geometry.revolution.profile import resample_profile
from panoless.geometry.revolution.silhouette import ContourRays, adapted_scale, in_axis_frame, silhouette_residuals
from panoless.kernels.camera import RasterCamera
from panoless.numeric.bspline import cubic_bspline
from panoless.numeric.gauss_newton import accept_step, damped_step
from panoless.numeric.robust import robust_weight
from shinypartial.core.conventions import PIXEL_CENTER

LEAST_RAYS = 20
"""Fewer contour rays over the lip leave it where it is."""
FARTHEST_PX = 6.0
"""Contour rays that pass the lip farther away (px) touch something else."""
STEPS = 6
"""Of placing the lip by silhouettes."""
TIP_DAMPING = 2e-3
"""Of each of these steps, in mean diagonals."""
SPOILED_PX = 7.0
"""Length of the wall below a flat lid (px) that the lid's corner bends."""
FITTED_PX = 16.0
"""Length of the wall (px) from which a cubic is led on to the lip."""
TIP_WEIGHT = 4.0
"""Of the lip in that cubic, in vertices of the wall."""
END_PX = 4.0
"""Length of a thin wall below its lip (px) that no pixel sees alone."""
CLEARANCE_PX = 2
"""Pixels nearer to the image of a thin wall's lip may show what lies before and behind it."""
LENGTH_PX = 20.0
"""Length of the wall (px) that is refined by mixed pixels."""
KNOT_PX = 3.0
"""Spacing of its B-splines (px)."""
REACH_PX = 5
"""Mixed pixels are nearer to the image of the lip than this, or mirrored more than once."""
REFINED_STEPS = 3
"""Most Gauss–Newton steps of the refinement."""
LENGTHS = (4.0, 2.0, 1.0, 0.5)
"""Of a step, tried in turn: radiance that changes by leaps makes steps too short."""
DIFFERENCE_PX = 0.05
"""Of the derivatives (px)."""
LARGEST_STEP_PX = 0.5
"""Most that a parameter changes in a step of length one (px)."""
PARAMETER_SIGMA_PX = 0.05
"""Standard deviation of what is not fitted (px): pixels that change much with the parameters count less."""
DAMPING = 1e-3
"""Of the refinement, in mean diagonals."""

RING_POINTS = 2000
"""Around the lip's image: more than its pixels."""


def tip_shift(contours: ContourRays, surface: SurfaceOfRevolution, scale_px: float) -> Float[np.ndarray, "2"]:
    """How (ρ, h) of the lip has to move for the silhouettes: one robust Gauss–Newton step; 0 if few see it."""
    found = silhouette_residuals(contours, surface, contours.pixel)
    tip = surface.profile[surface.lip]
    radius = np.maximum(np.hypot(found.points[:, 0], found.points[:, 1]), 1e-9)
    away = np.stack([radius, found.points[:, 2]], 1) - tip
    near = np.linalg.norm(away, axis=1) < FARTHEST_PX * contours.pixel
    over = (found.side >= 0) & ~found.valid & near
    if int(over.sum()) < LEAST_RAYS:
        return np.zeros(2)
    directions = in_axis_frame(contours, surface)[1][over]
    outward = (found.points[over, :2] * directions[:, :2]).sum(1) / radius[over]
    normals = np.stack([directions[:, 2], -outward], 1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    distance = (normals * away[over]).sum(1)
    in_pixels = distance / contours.pixel_lengths[over]
    weights = robust_weight(in_pixels, adapted_scale(contours, in_pixels, scale_px))
    weighted = normals * weights[:, None]
    return damped_step(-weighted.T @ distance, weighted.T @ normals, TIP_DAMPING)


def open_at_lip(contours: ContourRays, closed: SurfaceOfRevolution) -> SurfaceOfRevolution | None:
    """The outside of a closed surface as a wall without thickness that ends where silhouettes put its lip.

    Up to there the profile goes on as a cubic through its last good vertex, fitted to those before it and to the lip.
    None where the outside is no longer than what is fitted, or doesn't rise to its lip.
    """
    pixel = contours.pixel
    kept = _vertex_below_lip(closed, SPOILED_PX * pixel)
    first = _vertex_below_lip(closed, (SPOILED_PX + FITTED_PX) * pixel)
    if first < 1:
        return None
    last = closed.profile[kept]
    rise = last - closed.profile[first]
    if rise[1] < 0.1 * np.linalg.norm(rise):
        return None
    tip = last + rise * max((closed.profile[closed.lip, 1] - last[1]) / rise[1], 0.0)
    ended = _end_at(closed, kept, tip, pixel, pixel)
    for step in range(STEPS):
        shift = tip_shift(contours, ended, max(4.0 / 2**step, 0.5))
        ended = _end_at(closed, kept, ended.profile[-1] + shift, pixel, pixel)
    return ended


def _vertex_below_lip(surface: SurfaceOfRevolution, distance: float) -> int:
    """The last vertex of the outside that is that far from the lip along the profile; 0 for none."""
    below = surface.arc_lengths[surface.lip] - surface.arc_lengths[1 : surface.lip + 1]
    return int((below > distance - 0.5 * np.median(-np.diff(below))).sum())


def _end_at(
    surface: SurfaceOfRevolution,
    kept: int,
    tip: Float[np.ndarray, "2"],
    pixel: float,
    spacing: float,
) -> SurfaceOfRevolution:
    """The outside up to the vertex `kept`, and a cubic from there to the tip."""
    below = surface.arc_lengths[kept] - surface.arc_lengths[1:kept]
    start, points = surface.profile[kept], surface.profile[1:kept][below < (FITTED_PX + 0.5) * pixel]
    way = tip - start
    length = float(np.linalg.norm(way))
    if length < pixel:
        profile = np.concatenate([surface.profile[: kept + 1], tip[None]])
        return replace(surface, profile=profile, lip=len(profile) - 1)
    along, across = way / length, np.array([-way[1], way[0]]) / length
    x = np.append((points - start) @ along, length)
    y = np.append((points - start) @ across, 0.0)
    weights = np.append(np.full(len(points), (spacing / pixel) ** 0.5), TIP_WEIGHT)
    powers = np.stack([x, x**2, x**3], 1) / length ** np.arange(1, 4)
    coefficients = np.linalg.lstsq(powers * weights[:, None], y * weights, rcond=None)[0]
    t = np.arange(1, max(int(np.ceil(length / spacing)), 1) + 1) / max(int(np.ceil(length / spacing)), 1)
    # What the fit misses the tip by is made up for along the way.
    bend = np.stack([t, t**2, t**3], 1) @ coefficients - t**2 * coefficients.sum()
    new = start + t[:, None] * way + bend[:, None] * across
    profile = np.concatenate([surface.profile[: kept + 1], new])
    return resample_profile(replace(surface, profile=profile, lip=len(profile) - 1), spacing)


def place_lip(contours: ContourRays, surface: SurfaceOfRevolution, spacing: float) -> SurfaceOfRevolution:
    """A thin wall with its lip where silhouettes put it, and its last pixels led there as the wall before them goes.

    Others are returned as they are, and so is a wall that is no longer than what the end is fitted to.
    """
    pixel = contours.pixel
    if not surface.is_open or _vertex_below_lip(surface, (END_PX + FITTED_PX) * pixel) < 1:
        return surface
    kept = _vertex_below_lip(surface, END_PX * pixel)
    shift = tip_shift(contours, surface, 1.0)
    shift *= min(1.0, pixel / max(float(np.linalg.norm(shift)), 1e-12))
    return _end_at(surface, kept, surface.profile[-1] + shift, pixel, spacing)


def clear_of_lip(views: Views, surface: SurfaceOfRevolution) -> Views:
    """The views without the pixels beside the lip of an open surface, which mix two surfaces: a lid's doesn't
    matter.
    """
    if not surface.is_open:
        return views
    return replace(views, train=tuple(_clear(view, surface, CLEARANCE_PX) for view in views.train))


def _clear(view: TrainView, surface: SurfaceOfRevolution, clearance_px: int) -> TrainView:
    mixed = beside_lip(view.camera, surface, clearance_px).ravel()
    return replace(view, solid=view.solid[torch.from_numpy(~mixed).to(view.solid.device)[view.solid]])


def beside_lip(camera: RasterCamera, surface: SurfaceOfRevolution, reach_px: int) -> Bool[np.ndarray, "H W"]:
    """Pixels whose center is nearer than that to the image of the lip."""
    turn = 2 * np.pi * np.arange(RING_POINTS) / RING_POINTS
    radius, height = surface.profile[surface.lip]
    ring = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(RING_POINTS, height)], 1) @ surface.frame
    rotation, center = pose_of(camera)
    seen = (ring + surface.origin - center) @ rotation.T
    x, y = project(camera, seen)
    reach = np.arange(-reach_px, reach_px + 1)
    column, row = np.floor(x)[:, None, None] + reach, np.floor(y)[:, None, None] + reach[:, None]
    distance = np.hypot(column + PIXEL_CENTER - x[:, None, None], row + PIXEL_CENTER - y[:, None, None])
    near = (distance < reach_px) & (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    beside = np.zeros(camera.height * camera.width, bool)
    beside[(row * camera.width + column)[near].astype(np.int64)] = True
    return beside.reshape(camera.height, camera.width)


def refine_lip(
    pixels: PixelBundles,
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    pixel: float,
) -> SurfaceOfRevolution:
    """The surface with its profile near the lip where `lip_pixels` put it under a map, by Gauss–Newton."""
    for _ in range(REFINED_STEPS):
        moved = _lip_step(pixels, surface, environment, pixel)
        if moved is surface:
            break
        surface = moved
    return surface


def _lip_step(
    pixels: PixelBundles,
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    pixel: float,
) -> SurfaceOfRevolution:
    shifts = _shifts(surface, pixel)

    def shown(shift: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "P 3"]:
        return pixels.shown(_shifted(surface, shift), environment, MAX_BOUNCES)

    residual = shown(np.zeros_like(surface.profile)) - pixels.radiance
    small = DIFFERENCE_PX * pixel * shifts
    jacobian = np.stack([shown(shift) - shown(-shift) for shift in small], -1) / (2 * DIFFERENCE_PX)
    variance = RADIANCE_SIGMA**2 + PARAMETER_SIGMA_PX**2 * (jacobian**2).sum(-1).mean(1)
    weighted = jacobian * (robust_weight(residual, 3 * variance**0.5) / variance)[:, None, None]
    matrix = np.tensordot(weighted, jacobian, ((0, 1), (0, 1)))
    gradient = np.tensordot(weighted, residual, ((0, 1), (0, 1)))
    return accept_step(
        surface,
        damped_step(gradient, matrix, DAMPING, LARGEST_STEP_PX),
        lambda each, step: _shifted(each, pixel * np.tensordot(step, shifts, 1)),
        lambda each: pixels.error(each, environment, MAX_BOUNCES, JUDGED_SCALE),
        LENGTHS,
    )


def _shifts(surface: SurfaceOfRevolution, pixel: float) -> Float[np.ndarray, "D N 2"]:
    """Unit shifts of the profile's vertices: cubic B-splines along the normals on both sides of the lip, and an
    extension along a thin wall.
    """
    place = (surface.arc_lengths - surface.arc_lengths[surface.lip]) / pixel
    last = min(float(place[-1]), LENGTH_PX)
    places = place - np.arange(-LENGTH_PX, last + KNOT_PX + 1, KNOT_PX)[:, None]
    splines = cubic_bspline(places / KNOT_PX)
    along = np.gradient(surface.profile, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    shifts = splines[..., None] * np.stack([along[:, 1], -along[:, 0]], 1)
    if surface.is_open:
        extension = np.clip(1 + place / LENGTH_PX, 0, 1)[:, None] ** 2 * along
        shifts = np.concatenate([shifts, extension[None]])
    # The ends stay on the axis.
    shifts[:, surface.profile[:, 0] < 1e-9] = 0
    return shifts


def _shifted(surface: SurfaceOfRevolution, shift: Float[np.ndarray, "N 2"]) -> SurfaceOfRevolution:
    return replace(surface, profile=surface.profile + shift)


def lip_pixels(
    views: Sequence[TrainView],
    surface: SurfaceOfRevolution,
    count: int,
) -> PixelBundles:
    """About `count` pixels: half of them near the lip, half mirrored more than once."""
    generator = np.random.default_rng(0)
    near = [np.flatnonzero(beside_lip(view.camera, surface, REACH_PX)) for view in views]
    deep = []
    for view in views:
        pixels = view.solid.cpu().numpy()
        paths = trace_reflections(surface, *pixel_rays(view.camera, pixels), max_bounces=MAX_BOUNCES)
        deep.append(pixels[paths.bounces != 1])
    shares = [count / 2 / max(sum(map(len, group)), 1) for group in (near, deep)]
    chosen = []
    for view, *groups in zip(views, near, deep, strict=True):
        drawn = [group[generator.random(len(group)) < share] for group, share in zip(groups, shares, strict=True)]
        chosen.append((view, np.unique(np.concatenate(drawn))))
    return PixelBundles.of(chosen)
