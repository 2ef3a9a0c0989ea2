"""Axis and outer profile of a surface of revolution from masks alone.

In the half-plane of radius ρ and height h the ray of every contour point is a hyperbola that touches the profile. Those
of all views and both sides have one envelope, which is the profile, if the axis is right.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.capture.masks import MASK_LEVEL
from panoless.capture.rays import camera_rays, pose_of
from panoless.capture.silhouettes import MaskContours, mask_contours
from panoless.capture.views import Views
from panoless.geometry.revolution.model import SurfaceOfRevolution, closed_profile
from panoless.geometry.revolution.profile import ProfileSplines, apply_step, resample_profile
from panoless.kernels.revolution import closest_approach, distance_grid, envelope
from panoless.numeric.gauss_newton import accept_step, damped_step, jacobian_of_rows, normal_equations
from panoless.numeric.robust import bounded_error, robust_scale, robust_weight
from shinypartial.core.conventions import PIXEL_CENTER

START_VIEWS = 24
"""Most views whose principal axes propose an axis."""
START_POINTS = 1500
"""Contour points of a coarse fit."""
START_CELL_PX = 3.0
"""Spacing of the profile in a coarse fit (px)."""
START_SCALES_PX = (16.0, 16.0, 16.0, 16.0)
"""Robust scales of the steps of a coarse fit (px)."""
POINTS = 30_000
"""Contour points of the final fit."""
SCALES_PX = (4.0, 2.0, 1.0, 1.0, 0.5, 0.5)
"""Robust scales of its steps (px)."""
NOISE_MULTIPLE = 3.0
"""Robust scales are at least this many medians of the distances."""
RANK_SHARE = 0.02
"""Share of the rays at a height that may cut into the body by noise."""
TIP_CELLS = 1.5
"""A profile narrower than this (cells) ends in a tip."""
BLUNT_CELLS = 4.0
"""A profile wider than this (cells) may end flat, where silhouettes stop determining its slope."""
WIDEST_WITHIN = 0.6
"""The widest place of the body has a height below this (radii of the object frame)."""
EDGE_RAD = math.radians(75.0)
"""A profile that turns inward by more at one cell has an edge there…"""
MOST_BEYOND = 0.05
"""…if no more than this share of its cells lies beyond."""
LEAST_CELLS = 5
"""Fewer cells make no profile."""
GRAZING_RAD = math.radians(10.0)
"""Silhouettes don't determine slopes within this angle of the lowest camera's line of sight over an end."""
BENDING = 1e-3
"""Penalty on second differences of a step, in mean diagonals of the normal matrix."""
LARGEST_TURN_RAD = 0.1
"""Most that a step turns the axis, and shifts it in radii of the object frame."""
DAMPING = 1e-6
"""Of every step, in mean diagonals."""
JUDGED_SCALE_PX = 2.0
"""Scale s of the errors e²/(e² + s²) by which coarse fits are compared (px)."""

REACH = 1.5
TALLEST = 1.05
"""The normalized object lies in the unit ball; rays are followed a little beyond."""
EXTENTS = 3
"""How far from its widest place a body may be taken to reach, in so many ways."""


@dataclass(frozen=True)
class ContourRays:
    """Unit rays of contour points, and how long a pixel is at the object along each."""

    view: Int[np.ndarray, "P"]
    origins: Float[np.ndarray, "P 3"]
    directions: Float[np.ndarray, "P 3"]
    pixel_lengths: Float[np.ndarray, "P"]

    @cached_property
    def pixel(self) -> float:
        """The median length of a pixel at the object."""
        return float(np.median(self.pixel_lengths))

    def at_most(self, count: int) -> "ContourRays":
        """Every k-th, so that about `count` remain."""
        k = max(1, len(self.view) // count)
        rays = (self.view[::k], self.origins[::k], self.directions[::k], self.pixel_lengths[::k])
        return ContourRays(*rays)


@dataclass(frozen=True)
class SilhouetteResiduals:
    """How the contour rays meet a surface of revolution: signed distances (px, outward) and where they touch."""

    pixels: Float[np.ndarray, "P"]
    valid: Bool[np.ndarray, "P"]
    """Whether it is the outside that they touch."""
    side: Int[np.ndarray, "P"]
    along: Float[np.ndarray, "P"]
    points: Float[np.ndarray, "P 3"]
    """In the frame of the axis."""
    normals: Float[np.ndarray, "P 3"]


def contour_rays(views: Views) -> ContourRays:
    """The contours of all masks as unit rays."""
    contours: MaskContours = mask_contours(views)
    length = np.linalg.norm(contours.rays, axis=1)
    focal = np.array([view.camera.fx for view in views.train])
    distance = np.linalg.norm(contours.centers, axis=1)
    pixel = distance / (focal[contours.view] * length) if len(length) else length
    return ContourRays(contours.view, contours.centers, contours.rays / length[:, None], pixel)


def axis_starts(views: Views) -> list[SurfaceOfRevolution]:
    """Axes worth trying, without profiles: the planes through either principal axis of the masks meet in a line near
    the axis; and the principal axes of the cameras' positions through the middle.
    """
    chosen = views.train[:: max(1, len(views.train) // START_VIEWS)]
    normals: list[list[np.ndarray]] = [[], []]
    centers = []
    for view in chosen:
        mask, camera = view.mask.cpu().numpy(), view.camera
        inside = mask > MASK_LEVEL
        row, column = np.nonzero(inside if inside.any() else mask >= MASK_LEVEL)
        points = camera_rays(camera, column + PIXEL_CENTER, row + PIXEL_CENTER)[:, :2]
        middle = points.mean(0)
        _, vectors = np.linalg.eigh(np.cov((points - middle).T, ddof=int(len(points) > 1)))
        rotation, center = pose_of(camera)
        centers.append(center)
        for which in (0, 1):
            normal = np.cross(np.append(middle, 1.0), np.append(vectors[:, which], 0.0)) @ rotation
            normals[which].append(normal / np.linalg.norm(normal))
    starts = []
    for planes in (np.array(each) for each in (normals[1], normals[0])):
        _, vectors = np.linalg.eigh(planes.T @ planes)
        right = (planes * np.array(centers)).sum(1)
        origin = np.linalg.solve(planes.T @ planes + 1e-2 * len(planes) * np.eye(3), planes.T @ right)
        starts.append(_bare(origin, vectors[:, 0]))
    _, principal = np.linalg.eigh(np.cov(np.array(centers).T))
    return starts + [_bare(np.zeros(3), axis) for axis in principal.T]


def _bare(origin: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]) -> SurfaceOfRevolution:
    return SurfaceOfRevolution(origin - (origin @ axis) * axis, axis, np.zeros((0, 2)), 0)


def outer_surface(
    rays: ContourRays, start: SurfaceOfRevolution, cell: float, extent: int = 0
) -> SurfaceOfRevolution | None:
    """The envelope around an axis, closed flat at both ends, with so many of the parts that may belong to it (see
    `_ends`); None where there is none.
    """
    origins, directions = in_axis_frame(rays, start)
    cells = int(2 * TALLEST / cell)
    rank = int(RANK_SHARE * len(rays.view) / (2 * TALLEST / cell)) + 1
    smallest = envelope(origins, directions, -TALLEST, cell, cells, rank + 1, REACH)[:, rank]
    radius = np.where(np.isfinite(smallest), smallest, 0.0)
    heights = -TALLEST + (np.arange(cells) + 0.5) * cell
    ends = _ends(origins, heights, radius, cell)
    for first, last in [*ends[extent:], *reversed(ends[:extent])]:
        lowest, highest = (_uncut(radius, *each, cell) for each in ((first, last), (last, first)))
        if highest - lowest >= LEAST_CELLS:
            outer = np.stack([radius, heights], 1)[lowest : highest + 1]
            profile = closed_profile(outer)
            return resample_profile(replace(start, profile=profile, lip=len(outer)), cell)
    return None


def _ends(
    origins: Float[np.ndarray, "P 3"],
    heights: Float[np.ndarray, "C"],
    radius: Float[np.ndarray, "C"],
    cell: float,
) -> list[tuple[int, int]]:
    """Cells between which silhouettes determine the profile: beyond, it closes as fast as the most level view allows.
    One to three pairs, the nearest first.

    The widest cell belongs to the object, unless few rays pass the heights beyond its ends. The first pair ends before
    anything that falls as steeply: a cone that silhouettes leave beyond a lip, or a stem. The second ends where the
    profile does, in a tip or bluntly. The third goes on beyond tips: around an axis that is a little off, the stem
    between a goblet's cup and its foot is one.
    """
    middle = np.abs(heights) < WIDEST_WITHIN
    widest = int(np.argmax(np.where(middle, radius, 0.0)))
    across = np.hypot(origins[:, 0], origins[:, 1]) + float(radius[widest])
    pairs = []
    for outward in (-1, 1):
        elevation = np.arctan2(outward * (origins[:, 2] - heights[widest]), across).min()
        steepest = 1 / np.tan(max(elevation, 0.0) + GRAZING_RAD)
        outer = np.arange(widest, len(radius) if outward > 0 else -1, outward)
        outer = outer[np.abs(heights[outer]) < 1]
        wide = radius[outer] > TIP_CELLS * cell
        tips = [outer[len(wide) - 1 if wide.all() else wide.argmin()], outer[np.flatnonzero(wide).max(initial=0)]]
        end, beyond = (_blunt_end(radius, widest, int(tip), steepest, cell) for tip in tips)
        inward = np.arange(widest, end, outward)
        steep = radius[inward] - radius[end] > steepest * cell * np.abs(inward - end)
        pairs.append((int(inward[np.argmax(steep)]) if steep.any() else end, end, beyond))
    return list(dict.fromkeys(zip(*pairs, strict=True)))


def _uncut(radius: Float[np.ndarray, "C"], end: int, other: int, cell: float) -> int:
    """The end cell of a profile, or one of its neighbors where an edge, such as that of a mouth, lies: it cuts the end
    cell, and levels seen by few views leave a blunt cone beyond it.

    A profile through what is left there would fold as soon as the edge is fitted.
    """
    inward = 1 if other > end else -1
    if abs(other - end) < LEAST_CELLS:
        return end
    beyond = np.arange(1, 1 + max(int(MOST_BEYOND * abs(other - end)), 1))
    edges = end + inward * beyond
    toward = np.arctan2(radius[edges] - radius[edges + 2 * inward], 2 * cell)
    turns = toward - np.arctan2(radius[end] - radius[edges], beyond * cell)
    return int(edges[np.argmax(turns)]) if turns.max() > EDGE_RAD else end


def _blunt_end(radius: Float[np.ndarray, "C"], widest: int, tip: int, steepest: float, cell: float) -> int:
    """The last cell on the way from the widest to a tip that is wide, and where the profile is less steep than that."""
    outward = 1 if tip > widest else -1
    index = tip
    while abs(index - widest) > 2:
        rise = (radius[index - 2 * outward] - radius[index]) / (2 * cell)
        if radius[index] > BLUNT_CELLS * cell and rise < steepest:
            break
        index -= outward
    return index


def in_axis_frame(
    rays: ContourRays, surface: SurfaceOfRevolution
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Origins and directions in the frame of the axis."""
    return (rays.origins - surface.origin) @ surface.frame.T, rays.directions @ surface.frame.T


def silhouette_profile(surface: SurfaceOfRevolution) -> Float[np.ndarray, "M 2"]:
    """The profile with the mouth closed: what is inside below the lip has no silhouette."""
    inner = surface.profile[surface.lip :]
    above = inner[inner[:, 1] >= inner[0, 1] - 1e-9] if len(inner) > 1 else inner
    end = above[-1] if len(above) else surface.profile[surface.lip]
    return np.concatenate([surface.profile[: surface.lip], above, [[0.0, end[1]]]])


def silhouette_residuals(rays: ContourRays, surface: SurfaceOfRevolution, cell: float) -> SilhouetteResiduals:
    """Where the contour rays touch a surface of revolution."""
    polyline = silhouette_profile(surface)
    lowest = polyline[:, 1].min() - 8 * cell
    rows = int((np.ptp(polyline[:, 1]) + 16 * cell) / cell) + 1
    columns = int(polyline[:, 0].max() / cell) + 9
    grid = distance_grid(polyline, lowest, cell, rows, columns)
    origins, directions = in_axis_frame(rays, surface)
    where, signed, side, along = closest_approach(origins, directions, polyline, grid, lowest, cell, REACH)
    points = origins + where[:, None] * directions
    step = np.diff(polyline, axis=0)[side]
    step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12)
    rho = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-9)
    normals = np.stack([step[:, 1] * points[:, 0] / rho, step[:, 1] * points[:, 1] / rho, -step[:, 0]], 1)
    valid = (side >= 0) & (side < surface.lip)
    if surface.is_open:
        # Beyond the end of a wall without thickness the lip alone is touched: no shift along normals mends that.
        valid &= (side < surface.lip - 1) | (along < 1)
    return SilhouetteResiduals(signed / rays.pixel_lengths, valid, side, along, points, normals)


def contour_equations(
    rays: ContourRays, found: SilhouetteResiduals, splines: ProfileSplines, scale_px: float
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """Gradient Jᵀ W e and matrix Jᵀ W J of the distances in pixels: four numbers of the axis, then the splines'.

    A shift δ of the profile along its normal takes δ from the distance, a motion u = w × x + t of the body n·u.
    """
    kept = found.valid
    inverse = 1 / rays.pixel_lengths[kept, None]
    values, index = splines.values(found.side[kept], found.along[kept])
    rows = np.concatenate([-axis_motion(found.points[kept], found.normals[kept]), -values], 1) * inverse
    jacobian = jacobian_of_rows(rows, parameter_columns(index), 4 + splines.count)
    return normal_equations(jacobian, found.pixels[kept], robust_weight(found.pixels[kept], scale_px))


def adapted_scale(rays: ContourRays, pixels: Float[np.ndarray, "P"], scale_px: float) -> float:
    """The scale, or a multiple of the median distance if that is larger, so that all views keep a say."""
    return robust_scale(pixels, scale_px, NOISE_MULTIPLE)


def parameter_columns(index: Int[np.ndarray, "P 4"]) -> Int[np.ndarray, "P 8"]:
    """Columns of the axis' four numbers and of the four splines of each row."""
    return np.concatenate([np.broadcast_to(np.arange(4), (len(index), 4)), 4 + index], 1)


def axis_motion(points: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 4"]:
    """n·u for turns about e₁ and e₂ and shifts along them."""
    x, y, z = points.T
    a, b, c = normals.T
    return np.stack([y * c - z * b, z * a - x * c, a, b], 1)


def contour_cost(found: SilhouetteResiduals, scale_px: float) -> float:
    """Mean of e²/(e² + s²) over contour rays, e the distance (px); 1 for those that pass far away."""
    return float(np.where(found.side >= 0, bounded_error(found.pixels, scale_px), 1.0).mean())


def contour_step(
    rays: ContourRays, surface: SurfaceOfRevolution, cell: float, scale_px: float, knot: float
) -> SurfaceOfRevolution:
    """One robust Gauss–Newton step of axis and profile together; the surface as it is where its cost does not fall."""
    splines = ProfileSplines.of(surface, knot)
    found = silhouette_residuals(rays, surface, cell)
    scale = adapted_scale(rays, found.pixels[found.valid], scale_px)
    gradient, matrix = contour_equations(rays, found, splines, scale)
    matrix[4:, 4:] += splines.bending(BENDING * np.trace(matrix[4:, 4:]) / splines.count)

    def cost(each: SurfaceOfRevolution) -> float:
        return contour_cost(found if each is surface else silhouette_residuals(rays, each, cell), scale)

    return accept_step(
        surface,
        damped_step(gradient, matrix, DAMPING, LARGEST_TURN_RAD, slice(4)),
        lambda each, step: resample_profile(apply_step(each, splines, step), cell),
        cost,
    )


def fit_outer(rays: ContourRays, starts: Sequence[SurfaceOfRevolution], extent: int = 0) -> SurfaceOfRevolution | None:
    """Axis and outer profile of the best of several starts, coarse to fine; None when no start has an envelope."""
    sparse = rays.at_most(START_POINTS)
    cell = START_CELL_PX * rays.pixel
    best, least = None, np.inf
    for start in starts:
        surface = _refine(sparse, start, cell, START_SCALES_PX, extent)
        if surface is not None:
            cost = contour_cost(silhouette_residuals(sparse, surface, cell), JUDGED_SCALE_PX)
            if cost < least:
                best, least = surface, cost
    return best


def refine_outer(rays: ContourRays, start: SurfaceOfRevolution, extent: int = 0) -> SurfaceOfRevolution | None:
    """Axis and profile at a pixel's spacing."""
    return _refine(rays.at_most(POINTS), start, rays.pixel, SCALES_PX, extent)


def _refine(
    rays: ContourRays, start: SurfaceOfRevolution, cell: float, scales_px: Sequence[float], extent: int
) -> SurfaceOfRevolution | None:
    """The envelope around an axis after steps at those scales; None when there is none."""
    surface = outer_surface(rays, start, cell, extent)
    if surface is None:
        return None
    for scale in scales_px:
        surface = contour_step(rays, surface, cell, scale, 2 * cell)
    return surface
