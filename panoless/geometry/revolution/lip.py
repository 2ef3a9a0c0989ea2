"""The end of a wall without thickness, which is a circle: where outlines put it, and how the profile gets there.

A contour ray that passes over the lip touches that circle alone. In the half-plane of radius ρ and height h it is a
hyperbola through the tip q of the profile, with unit normal m where it comes nearest, so m·q is known; rays of several
elevations and both sides of the lip have different m, and q is their common point.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from panoless.capture.rays import pose_of, project
from panoless.capture.views import TrainView, Views
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.revolution.profile import resample_profile
from panoless.geometry.revolution.silhouette import ContourRays, in_axis_frame, robust_scale, silhouette_residuals
from panoless.kernels.rasterize import RasterCamera

FEWEST_RAYS = 20
STEPS = 6
FARTHEST_PX = 6.0
"""Rays whose nearest point lies farther from the tip than this touch something else."""
SPOILED_PX = 7
"""So much of a closed surface's outside, before its lid, is bent by the corner that it was given there."""
FITTED_PX = 16
"""The part before that, from which the profile goes on to the tip."""
TIP_WEIGHT = 4.0
END_PX = 4
"""So much of an open wall before its lip has no pixels that see it alone."""
CLEARANCE_PX = 2
"""Pixels nearer than this to the lip's image may show what lies before and behind it."""
AROUND = 2000


def tip_shift(contours: ContourRays, surface: SurfaceOfRevolution, scale_px: float) -> Float[np.ndarray, "2"]:
    """How (ρ, h) of the lip has to move for the outlines: one robust Gauss–Newton step; zero when hardly any see it."""
    pixel = float(np.median(contours.pixel))
    found = silhouette_residuals(contours, surface, pixel)
    tip = surface.profile[surface.lip]
    radius = np.maximum(np.hypot(found.points[:, 0], found.points[:, 1]), 1e-9)
    excluded = np.stack([radius, found.points[:, 2]], 1) - tip
    over = (found.side >= 0) & ~found.valid & (np.linalg.norm(excluded, axis=1) < FARTHEST_PX * pixel)
    if int(over.sum()) < FEWEST_RAYS:
        return np.zeros(2)
    directions = in_axis_frame(contours, surface)[1][over]
    outward = (found.points[over, :2] * directions[:, :2]).sum(1) / radius[over]
    normals = np.stack([directions[:, 2], -outward], 1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    distance = (normals * excluded[over]).sum(1)
    in_pixels = distance / contours.pixel[over]
    weights = (1 + (in_pixels / robust_scale(in_pixels, scale_px)) ** 2) ** -2
    matrix = (normals * weights[:, None]).T @ normals
    return np.linalg.solve(matrix + 1e-3 * np.trace(matrix) * np.eye(2), normals.T @ (weights * distance))


def open_at_lip(contours: ContourRays, closed: SurfaceOfRevolution, pixel: float) -> SurfaceOfRevolution | None:
    """The outside of a closed surface as a wall without thickness that ends where outlines put its lip.

    Up to there the profile goes on as a cubic through its last good vertex, fitted to those before it and to the lip.
    None where the outside is no longer than what is fitted, or doesn't rise to its lip.
    """
    kept = closed.lip - SPOILED_PX
    first = kept - FITTED_PX
    if first < 1:
        return None
    last = closed.profile[kept]
    rise = last - closed.profile[first]
    if rise[1] < 0.1 * np.linalg.norm(rise):
        return None
    ended = _ended(closed, kept, last + rise * max((closed.profile[closed.lip, 1] - last[1]) / rise[1], 0.0), pixel)
    for step in range(STEPS):
        shift = tip_shift(contours, ended, max(4.0 / 2**step, 0.5))
        ended = _ended(closed, kept, ended.profile[-1] + shift, pixel)
    return ended


def _ended(closed: SurfaceOfRevolution, kept: int, tip: Float[np.ndarray, "2"], pixel: float) -> SurfaceOfRevolution:
    """The outside up to the vertex `kept`, and a cubic from there to the tip."""
    start, points = closed.profile[kept], closed.profile[kept - FITTED_PX : kept]
    way = tip - start
    length = float(np.linalg.norm(way))
    if length < pixel:
        profile = np.concatenate([closed.profile[: kept + 1], tip[None]])
        return replace(closed, profile=profile, lip=len(profile) - 1)
    along, across = way / length, np.array([-way[1], way[0]]) / length
    x = np.append((points - start) @ along, length)
    y = np.append((points - start) @ across, 0.0)
    weights = np.append(np.ones(len(points)), TIP_WEIGHT)
    powers = np.stack([x, x**2, x**3], 1) / length ** np.arange(1, 4)
    coefficients = np.linalg.lstsq(powers * weights[:, None], y * weights, rcond=None)[0]
    t = np.arange(1, max(int(np.ceil(length / pixel)), 1) + 1) / max(int(np.ceil(length / pixel)), 1)
    # What the fit misses the tip by is made up for along the way.
    bend = np.stack([t, t**2, t**3], 1) @ coefficients - t**2 * coefficients.sum()
    new = start + t[:, None] * way + bend[:, None] * across
    profile = np.concatenate([closed.profile[: kept + 1], new])
    return resample_profile(replace(closed, profile=profile, lip=len(profile) - 1), pixel)


def clear_of_lip(views: Views, surface: SurfaceOfRevolution) -> Views:
    """The views without the pixels beside the lip of an open surface, which mix two surfaces: a lid's doesn't
    matter.
    """
    return replace(views, train=tuple(_clear(view, surface) for view in views.train)) if surface.is_open else views


def _clear(view: TrainView, surface: SurfaceOfRevolution) -> TrainView:
    mixed = beside_lip(view.camera, surface, CLEARANCE_PX).ravel()
    return replace(view, solid=view.solid[torch.from_numpy(~mixed).to(view.solid.device)[view.solid]])


def beside_lip(camera: RasterCamera, surface: SurfaceOfRevolution, reach_px: int) -> Bool[np.ndarray, "H W"]:
    """Pixels whose center is nearer than that to the image of the lip."""
    turn = 2 * np.pi * np.arange(AROUND) / AROUND
    radius, height = surface.profile[surface.lip]
    ring = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(AROUND, height)], 1) @ surface.frame
    rotation, center = pose_of(camera)
    seen = (ring + surface.origin - center) @ rotation.T
    x, y = project(camera, seen)
    reach = np.arange(-reach_px, reach_px + 1)
    column, row = np.floor(x)[:, None, None] + reach, np.floor(y)[:, None, None] + reach[:, None]
    excluded = np.hypot(column + 0.5 - x[:, None, None], row + 0.5 - y[:, None, None])
    near = (excluded < reach_px) & (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    beside = np.zeros(camera.height * camera.width, bool)
    beside[(row * camera.width + column)[near].astype(np.int64)] = True
    return beside.reshape(camera.height, camera.width)


def with_lip(contours: ContourRays, surface: SurfaceOfRevolution, pixel: float) -> SurfaceOfRevolution:
    """An open surface with its lip where outlines put it, and its last pixels led there as the wall before them goes.

    Others are returned as they are, and so is a wall that is no longer than what the end is fitted to.
    """
    kept = surface.lip - END_PX
    if not surface.is_open or kept - FITTED_PX < 1:
        return surface
    shift = tip_shift(contours, surface, 1.0)
    shift *= min(1.0, pixel / max(float(np.linalg.norm(shift)), 1e-12))
    return _ended(surface, kept, surface.profile[-1] + shift, pixel)
