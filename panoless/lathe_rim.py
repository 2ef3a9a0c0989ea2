"""The end of a wall without thickness, which is a circle: where outlines put it, and how the profile gets there.

A contour ray that passes over the rim touches that circle alone. In the half-plane of radius ρ and height h it is a
hyperbola through the tip q of the profile, with unit normal m where it comes nearest, so m·q is known; rays of several
elevations and both sides of the rim have different m, and q is their common point.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from panoless.lathe import Lathe
from panoless.lathe_contours import ContourRays, in_axis_frame, robust_scale, touches
from panoless.lathe_profile import resampled

FEWEST_RAYS = 20
STEPS = 6
FARTHEST_PX = 6.0
"""Rays whose nearest point lies farther from the tip than this touch something else."""
SPOILED_PX = 7
"""So much of a closed lathe's outside, before its lid, is bent by the corner that it was given there."""
FITTED_PX = 16
"""The part before that, from which the profile goes on to the tip."""
TIP_WEIGHT = 4.0


def tip_shift(contours: ContourRays, lathe: Lathe, scale_px: float) -> Float[np.ndarray, "2"]:
    """How (ρ, h) of the rim has to move for the outlines: one robust Gauss–Newton step; zero when hardly any see it."""
    pixel = float(np.median(contours.pixel))
    found = touches(contours, lathe, pixel)
    tip = lathe.profile[lathe.rim]
    radius = np.maximum(np.hypot(found.points[:, 0], found.points[:, 1]), 1e-9)
    apart = np.stack([radius, found.points[:, 2]], 1) - tip
    over = (found.side >= 0) & ~found.valid & (np.linalg.norm(apart, axis=1) < FARTHEST_PX * pixel)
    if int(over.sum()) < FEWEST_RAYS:
        return np.zeros(2)
    directions = in_axis_frame(contours, lathe)[1][over]
    outward = (found.points[over, :2] * directions[:, :2]).sum(1) / radius[over]
    normals = np.stack([directions[:, 2], -outward], 1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    distance = (normals * apart[over]).sum(1)
    in_pixels = distance / contours.pixel[over]
    weights = (1 + (in_pixels / robust_scale(in_pixels, scale_px)) ** 2) ** -2
    matrix = (normals * weights[:, None]).T @ normals
    return np.linalg.solve(matrix + 1e-3 * np.trace(matrix) * np.eye(2), normals.T @ (weights * distance))


def open_lathe(contours: ContourRays, closed: Lathe, pixel: float) -> Lathe | None:
    """The outside of a closed lathe as a wall without thickness that ends where outlines put its rim.

    Up to there the profile goes on as a cubic through its last good vertex, fitted to those before it and to the rim.
    None where the outside is no longer than what is fitted, or doesn't rise to its rim.
    """
    kept = closed.rim - SPOILED_PX
    first = kept - FITTED_PX
    if first < 1:
        return None
    last = closed.profile[kept]
    rise = last - closed.profile[first]
    if rise[1] < 0.1 * np.linalg.norm(rise):
        return None
    ended = _ended(closed, kept, last + rise * max((closed.profile[closed.rim, 1] - last[1]) / rise[1], 0.0), pixel)
    for step in range(STEPS):
        shift = tip_shift(contours, ended, max(4.0 / 2**step, 0.5))
        ended = _ended(closed, kept, ended.profile[-1] + shift, pixel)
    return ended


def _ended(closed: Lathe, kept: int, tip: Float[np.ndarray, "2"], pixel: float) -> Lathe:
    """The outside up to the vertex `kept`, and a cubic from there to the tip."""
    start, points = closed.profile[kept], closed.profile[kept - FITTED_PX : kept]
    way = tip - start
    length = float(np.linalg.norm(way))
    if length < pixel:
        profile = np.concatenate([closed.profile[: kept + 1], tip[None]])
        return replace(closed, profile=profile, rim=len(profile) - 1)
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
    return resampled(replace(closed, profile=profile, rim=len(profile) - 1), pixel)


def with_rim(contours: ContourRays, lathe: Lathe, pixel: float) -> Lathe:
    """An open lathe made longer or shorter, along its own end, to where outlines put its rim; others as they are."""
    if not lathe.is_open:
        return lathe
    angle = lathe.angles[-1, 1]
    direction = np.array([np.cos(angle), np.sin(angle)])
    longer = float(np.clip(tip_shift(contours, lathe, 1.0) @ direction, -pixel, pixel))
    profile = lathe.profile.copy()
    profile[-1] += max(longer, -0.5 * float(np.linalg.norm(profile[-1] - profile[-2]))) * direction
    return replace(lathe, profile=profile)
