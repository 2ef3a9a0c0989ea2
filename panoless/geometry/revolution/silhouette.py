"""Axis and outer profile of a surface of revolution from masks alone.

In the half-plane of radius ρ and height h the ray of every contour point is a hyperbola that touches the profile. Those
of all views and both sides have one envelope, which is the profile, if the axis is right.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.capture.rays import camera_rays, pose_of
from panoless.capture.silhouettes import MaskContours, mask_contours
from panoless.capture.views import Views
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.revolution.profile import ProfileSplines, apply_step, resample_profile
from panoless.kernels.cpu.profile import closest_approach, distance_grid, envelope
from shinypartial.core.conventions import PIXEL_CENTER

REACH = 1.5
TALLEST = 1.05
"""The normalized object lies in the unit ball; rays are followed a little beyond."""
START_VIEWS = 24
START_POINTS = 1500
START_CELL_PX = 3.0
START_STEPS = 4
MOST_POINTS = 30_000
RANK_SHARE = 0.02
"""Of the rays that could touch a height, this share may be wrong by noise."""
TIP_CELLS, BLUNT_CELLS = 1.5, 4.0
WIDEST_WITHIN = 0.6
LEAST_CELLS = 5
GRAZING_RAD = np.radians(10.0)
"""Silhouettes don't tell slopes within this of those under which the lowest camera looks over the lip."""
NOISE_SCALE = 3.0
BENDING = 1e-3
FINAL_SCALES_PX = (4.0, 2.0, 1.0, 1.0, 0.5, 0.5)
LARGEST_TURN_RAD = 0.1


@dataclass(frozen=True)
class ContourRays:
    """Unit rays of contour points, and how long a pixel is at the object along each."""

    view: Int[np.ndarray, "P"]
    origins: Float[np.ndarray, "P 3"]
    directions: Float[np.ndarray, "P 3"]
    pixel: Float[np.ndarray, "P"]

    def every(self, stride: int) -> "ContourRays":
        """Every stride-th."""
        return ContourRays(*(values[::stride] for values in vars(self).values()))

    def of(self, chosen: Bool[np.ndarray, "P"]) -> "ContourRays":
        """The chosen ones."""
        return ContourRays(*(values[chosen] for values in vars(self).values()))


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
    the axis; and the world's axes through the middle.
    """
    chosen = views.train[:: max(1, len(views.train) // START_VIEWS)]
    normals: list[list[np.ndarray]] = [[], []]
    centers = []
    for view in chosen:
        mask, camera = view.mask.cpu().numpy(), view.camera
        row, column = np.nonzero(mask > 0.5)
        points = camera_rays(camera, column + PIXEL_CENTER, row + PIXEL_CENTER)[:, :2]
        middle = points.mean(0)
        _, vectors = np.linalg.eigh(np.cov((points - middle).T))
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
    return starts + [_bare(np.zeros(3), axis) for axis in np.eye(3)[[2, 1, 0]]]


def _bare(origin: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]) -> SurfaceOfRevolution:
    return SurfaceOfRevolution(origin - (origin @ axis) * axis, axis, np.zeros((0, 2)), 0)


def outer_surface(rays: ContourRays, start: SurfaceOfRevolution, cell: float) -> SurfaceOfRevolution | None:
    """The envelope around an axis, closed flat at both ends; None when there is none."""
    origins, directions = in_axis_frame(rays, start)
    cells = int(2 * TALLEST / cell)
    rank = int(RANK_SHARE * len(rays.view) / (2 * TALLEST / cell)) + 1
    smallest = envelope(origins, directions, -TALLEST, cell, cells, rank + 1, REACH)[:, rank]
    radius = np.where(np.isfinite(smallest), smallest, 0.0)
    heights = -TALLEST + (np.arange(cells) + 0.5) * cell
    lowest, highest = _ends(origins, heights, radius, cell)
    if highest - lowest < LEAST_CELLS:
        return None
    outer = np.stack([radius, heights], 1)[lowest : highest + 1]
    profile = np.concatenate([[[0.0, outer[0, 1]]], outer, [[0.0, outer[-1, 1]]]])
    return resample_profile(replace(start, profile=profile, lip=len(outer)), cell)


def _ends(
    origins: Float[np.ndarray, "P 3"], heights: Float[np.ndarray, "C"], radius: Float[np.ndarray, "C"], cell: float
) -> tuple[int, int]:
    """Cells between which silhouettes tell the profile: beyond, it closes as fast as the most level view allows.

    The widest cell belongs to the object, unless few rays pass the heights beyond its ends.
    """
    middle = np.abs(heights) < WIDEST_WITHIN
    widest = int(np.argmax(np.where(middle, radius, 0.0)))
    across = np.hypot(origins[:, 0], origins[:, 1]) + float(radius[widest])
    ends = []
    for outward in (-1, 1):
        elevation = np.arctan2(outward * (origins[:, 2] - heights[widest]), across).min()
        steepest = 1 / np.tan(max(elevation, 0.0) + GRAZING_RAD)
        index = widest
        while 0 < index < len(radius) - 1 and radius[index] > TIP_CELLS * cell:
            index += outward
        while abs(index - widest) > 2:
            rise = (radius[index - 2 * outward] - radius[index]) / (2 * cell)
            if radius[index] > BLUNT_CELLS * cell and rise < steepest:
                break
            index -= outward
        ends.append(index)
    return ends[0], ends[1]


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
    return SilhouetteResiduals(signed / rays.pixel, valid, side, along, points, normals)


def robust_scale(pixels: Float[np.ndarray, "P"], scale_px: float) -> float:
    """The scale, or a multiple of the median distance if that is larger, so that all views keep a say."""
    return max(scale_px, NOISE_SCALE * float(np.median(np.abs(pixels)))) if len(pixels) else scale_px


def contour_equations(
    rays: ContourRays, surface: SurfaceOfRevolution, splines: ProfileSplines, cell: float, scale_px: float
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """Gradient Jᵀ W e and matrix Jᵀ W J of the distances in pixels: four numbers of the axis, then the splines'.

    A shift δ of the profile along its normal takes δ from the distance, a motion u = w × x + t of the body n·u.
    """
    found = silhouette_residuals(rays, surface, cell)
    kept = found.valid
    scale = robust_scale(found.pixels[kept], scale_px)
    weights = (1 + (found.pixels[kept] / scale) ** 2) ** -2
    inverse = 1 / rays.pixel[kept]
    by_axis = -axis_motion(found.points[kept], found.normals[kept]) * inverse[:, None]
    values, index = splines.values(found.side[kept], found.along[kept])
    return accumulate_equations(by_axis, -values * inverse[:, None], index, found.pixels[kept], weights, splines.count)


def axis_motion(points: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 4"]:
    """n·u for turns about e₁ and e₂ and shifts along them."""
    x, y, z = points.T
    a, b, c = normals.T
    return np.stack([y * c - z * b, z * a - x * c, a, b], 1)


def accumulate_equations(
    by_axis: Float[np.ndarray, "P 4"],
    by_spline: Float[np.ndarray, "P 4"],
    index: Int[np.ndarray, "P 4"],
    residual: Float[np.ndarray, "P"],
    weights: Float[np.ndarray, "P"],
    count: int,
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """Jᵀ W e and Jᵀ W J of rows with eight entries."""
    from scipy import sparse

    rows = len(residual)
    columns = np.concatenate([np.broadcast_to(np.arange(4), (rows, 4)), 4 + index], 1)
    jacobian = sparse.csr_matrix(
        (np.concatenate([by_axis, by_spline], 1).ravel(), columns.ravel(), np.arange(rows + 1) * 8),
        shape=(rows, 4 + count),
    )
    weighted = jacobian.multiply(weights[:, None]).tocsr()
    return weighted.T @ residual, (weighted.T @ jacobian).toarray()


def contour_step(
    rays: ContourRays, surface: SurfaceOfRevolution, cell: float, scale_px: float, knot: float
) -> SurfaceOfRevolution:
    """One robust Gauss–Newton step of axis and profile together."""
    splines = ProfileSplines.of(surface, knot)
    gradient, matrix = contour_equations(rays, surface, splines, cell, scale_px)
    matrix[4:, 4:] += splines.bending(BENDING * np.trace(matrix[4:, 4:]) / splines.count)
    return apply_step(surface, splines, solved(gradient, matrix))


def solved(gradient: Float[np.ndarray, "D"], matrix: Float[np.ndarray, "D D"]) -> Float[np.ndarray, "D"]:
    """−(M + ε)⁻¹ g, cut where the axis would turn by more than a tenth."""
    damped = matrix + np.diag(1e-6 * np.diag(matrix) + 1e-9 * np.trace(matrix) / len(matrix) + 1e-12)
    step = -np.linalg.solve(damped, gradient)
    return step * min(1.0, LARGEST_TURN_RAD / max(float(np.abs(step[:4]).max()), 1e-12))


def contour_cost(rays: ContourRays, surface: SurfaceOfRevolution, cell: float, scale_px: float = 2.0) -> float:
    """Mean of e²/(e² + s²)."""
    found = silhouette_residuals(rays, surface, cell)
    squared = (found.pixels / scale_px) ** 2
    return float(np.where(found.side >= 0, squared / (1 + squared), 1.0).mean())


def fit_outer(rays: ContourRays, starts: Sequence[SurfaceOfRevolution]) -> SurfaceOfRevolution | None:
    """Axis and outer profile of the best of several starts, coarse to fine; None when no start has an envelope."""
    pixel = float(np.median(rays.pixel))
    sparse = rays.every(max(1, len(rays.view) // START_POINTS))
    cell = START_CELL_PX * pixel
    best, least = None, np.inf
    for start in starts:
        surface = _refined(sparse, start, cell, (16.0,) * START_STEPS)
        cost = np.inf if surface is None else contour_cost(sparse, surface, cell)
        if surface is not None and cost < least:
            best, least = surface, cost
    return best


def refine_outer(rays: ContourRays, start: SurfaceOfRevolution) -> SurfaceOfRevolution | None:
    """Axis and profile at a pixel's spacing."""
    pixel = float(np.median(rays.pixel))
    dense = rays.every(max(1, len(rays.view) // MOST_POINTS))
    return _refined(dense, start, pixel, FINAL_SCALES_PX)


def _refined(
    rays: ContourRays, start: SurfaceOfRevolution, cell: float, scales_px: Sequence[float]
) -> SurfaceOfRevolution | None:
    surface = outer_surface(rays, start, cell)
    if surface is None:
        return None
    for scale in scales_px:
        surface = resample_profile(contour_step(rays, surface, cell, scale, 2 * cell), cell)
    return surface
