"""One plane from silhouettes alone: the boundary, carried from view to view through it, has to stay the boundary.

Tilting a planar mirror and turning the environment the other way leaves every picture as it was, so no color can tell
the tilt of a mirror (see docs/method.md); its boundary can. The plane's three numbers, the boundary's vertices and the
height of a frame that hides part of the mirror are found together, by robust Gauss–Newton on the distances, in pixels,
of each view's contour from the boundary that it should see.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from panoless.capture.rays import pose_of, project
from panoless.capture.silhouettes import MaskContours, mask_contours
from panoless.capture.views import TrainView, Views
from panoless.geometry.plane.model import Plane, plane_buffers
from panoless.geometry.plane.silhouette import (
    CORNER_DEG,
    apply_plane_step,
    back_project,
    boundary_residuals,
    normal_equations,
    robust_weights,
)
from shinypartial.core.errors import InputError

LEAST_VIEWS = 3
LEAST_BASELINE = 0.02
"""Distance between two cameras, as a share of their distance from the object, that makes them distinct views."""

START_DIRECTIONS = 200
START_OFFSETS = (-0.2, 0.0, 0.2)
START_COSINE = 0.15
START_GRID = 32
START_VIEWS = 16
START_HALF_SIDE = 1.2
STARTS = 3

MAX_POINTS = 40_000
MAX_VERTICES = 128
VOTING_VIEWS = 32
LARGEST_STEP = 0.2
CHAMFER_PX = 6.0
"""Shorter sides that cut a corner of longer ones are what a vote makes of it."""
SIMPLE_PX = 0.25
"""A vertex goes if the boundary without it is nowhere further away than this."""
HOPELESS_PX = 2.0
FINAL_SCALE_PX = 0.5
SIMPLIFICATIONS = 2
FINAL_STEPS = 3
CLEAR_PX = 1.0
FRAME_SIGMAS = 3.0
"""A frame is kept if it is this many standard deviations high."""


@dataclass(frozen=True)
class PlaneFit:
    """A plane and how well it explains the silhouettes. Arrays hold one value a view.

    A planar boundary does not prove a planar surface: a bent mirror in a flat frame fits as well. Colors decide that.
    """

    plane: Plane
    normal_sigma_deg: float
    """Standard deviation of the normal's angle in its least certain direction: the Gauss–Newton covariance with views,
    not contour points, as independent observations where that is larger. Systematic errors of all views add to it.
    """
    median_px: Float[np.ndarray, "V"]
    """Median distance of the mask's contour from the projected boundary and frame; infinite for a view from behind."""
    rms_px: Float[np.ndarray, "V"]
    """Root mean square of the same distances, over all of the contour."""
    iou: Float[np.ndarray, "V"]
    """Σ min(alpha, mask) / Σ max(alpha, mask), with the frame."""
    share_inside: float
    """Share of contour points more than a pixel inside: something other than the frame stands in front of the
    mirror.
    """
    share_outside: float
    """Share of contour points more than a pixel outside: wrong masks or poses, or no plane."""


@dataclass(frozen=True)
class _Round:
    """An boundary by vote on a grid, then one Gauss–Newton step on plane and boundary for each scale."""

    grid: int
    level: float
    tolerance_cells: float
    scales_px: tuple[float, ...]


FIRST_ROUND = _Round(96, 0.5, 1.0, (16.0, 8.0, 8.0))
LATER_ROUNDS = (_Round(128, 0.5, 1.0, (4.0, 4.0, 2.0, 2.0)), _Round(256, 0.4, 0.7, (1.0, 1.0, 0.5, 0.5, 0.5)))


def fit_plane(views: Views, *, thorough: bool = True) -> PlaneFit:
    """The plane and boundary that explain the masks best, from several starts; never a failure because none is good.

    Unless `thorough`, a plane that the first round leaves hopelessly far from the contours is returned as it is then,
    with no idea of its normal's error.

    Raises InputError when masks have an boundary in fewer than three views taken from distinct places.
    """
    contours = mask_contours(views)
    _require_distinct_views(contours)
    sparse = contours.every(max(1, len(contours.view) // MAX_POINTS))
    starts = [_refine(views, sparse, start, FIRST_ROUND) for start in _starts(views)]
    plane = min(starts, key=lambda start: _cost(sparse, start))
    if not thorough and _hopeless(sparse, plane):
        return _score(views, contours, plane, math.inf)
    for each in LATER_ROUNDS:
        plane = _refine(views, sparse, plane, each)
    for _ in range(SIMPLIFICATIONS):
        plane = _simplified(plane, sparse)
        for _ in range(FINAL_STEPS):
            plane = _step(sparse, plane, FINAL_SCALE_PX)
    frame = plane.frame_height > FRAME_SIGMAS * float(np.sqrt(max(_covariance(sparse, plane, frame=True)[2, 2], 0.0)))
    if not frame:
        plane = replace(plane, frame_height=0.0)
        for _ in range(FINAL_STEPS):
            plane = _step(sparse, plane, FINAL_SCALE_PX, frame=False)
    tilt = np.linalg.eigvalsh(_covariance(sparse, plane, frame)[:2, :2])[-1]
    return _score(views, contours, plane, float(np.degrees(np.sqrt(max(tilt, 0.0)))))


def _require_distinct_views(contours: MaskContours) -> None:
    distinct: list[np.ndarray] = []
    for center in contours.centers[np.unique(contours.view, return_index=True)[1]]:
        if all(np.linalg.norm(center - other) > LEAST_BASELINE * np.linalg.norm(center) for other in distinct):
            distinct.append(center)
    if len(distinct) < LEAST_VIEWS:
        raise _too_few_views(len(distinct))


def _too_few_views(found: int) -> InputError:
    return InputError(
        expected=f"masks with an boundary, seen from at least {LEAST_VIEWS} distinct places",
        found=f"{found} such views",
        remedy="Add views from other directions, and check that masks end within the images.",
    )


def _starts(views: Views) -> list[Plane]:
    """The best few of many planes through the object that face as many cameras as a plane can."""
    centers = np.stack([view.position for view in views.train])
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    index = np.arange(START_DIRECTIONS) + 0.5
    height, azimuth = 1 - 2 * index / START_DIRECTIONS, np.pi * (1 + 5**0.5) * index
    level = np.sqrt(1 - height**2)
    # The mean view direction joins the lattice: with few cameras it can be the only one that all of them face.
    directions = np.concatenate(
        [centers.mean(0, keepdims=True), np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], 1)]
    )
    facing = (directions @ centers.T > START_COSINE).sum(1)
    voters = _spread(views.train, START_VIEWS)
    planes = [_plane(n, offset) for n in directions[facing == facing.max()] for offset in START_OFFSETS]
    planes.sort(key=lambda plane: -_agreement(plane, voters))
    return planes[:STARTS]


def _plane(direction: Float[np.ndarray, "3"], offset: float) -> Plane:
    normal = direction / np.linalg.norm(direction)
    tangent_u = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    tangent_u /= np.linalg.norm(tangent_u)
    return Plane(normal, offset, tangent_u, np.cross(normal, tangent_u), np.zeros((0, 2)))


def _spread(views: Sequence[TrainView], count: int) -> Sequence[TrainView]:
    return views[:: max(1, len(views) // count)]


def _agreement(plane: Plane, voters: Sequence[TrainView]) -> float:
    """Mean intersection over union, on the plane, of each mask with the majority of all."""
    line = np.linspace(-START_HALF_SIDE, START_HALF_SIDE, START_GRID)
    votes = _votes(plane, line, line, voters).reshape(len(voters), -1) > 0.5
    majority = votes.mean(0) > 0.5
    return float(((votes & majority).sum(1) / np.maximum((votes | majority).sum(1), 1)).mean())


def _votes(
    plane: Plane, u: Float[np.ndarray, "A"], v: Float[np.ndarray, "B"], voters: Sequence[TrainView]
) -> Float[np.ndarray, "V A B"]:
    """Each mask at the grid points of the plane; zero outside a picture and behind a camera."""
    from scipy.ndimage import map_coordinates

    points = plane.points(np.stack(np.meshgrid(u, v, indexing="ij"), -1).reshape(-1, 2))
    result = np.zeros((len(voters), len(u), len(v)))
    for index, view in enumerate(voters):
        camera = view.camera
        rotation, center = pose_of(camera)
        seen = (points - center) @ rotation.T
        x, y = project(camera, seen, first_center=0)
        inside = map_coordinates(view.mask.cpu().numpy(), [y, x], order=1, cval=0.0) * (seen[:, 2] > camera.near)
        result[index] = inside.reshape(len(u), len(v))
    return result


def _refine(views: Views, contours: MaskContours, plane: Plane, settings: _Round) -> Plane:
    plane = replace(plane, boundary=_voted_outline(views, contours, plane, settings))
    for scale in settings.scales_px:
        plane = _step(contours, plane, scale)
    return plane


def _voted_outline(views: Views, contours: MaskContours, plane: Plane, settings: _Round) -> Float[np.ndarray, "N 2"]:
    """The level set of the mean of all masks on the plane, simplified; a box where they have no point in common."""
    from skimage.measure import find_contours

    coordinates, valid = back_project(contours, plane)
    low, high = np.percentile(coordinates[valid], (2, 98), axis=0) if valid.any() else (-np.ones(2), np.ones(2))
    low, high = (low - 0.1 * (high - low), high + 0.1 * (high - low)) if (high > low).all() else (low - 1, high + 1)
    u, v = (np.linspace(low[axis], high[axis], settings.grid) for axis in (0, 1))
    votes = _votes(plane, u, v, _spread(views.train, VOTING_VIEWS)).mean(0)
    votes[[0, -1]], votes[:, [0, -1]] = 0, 0
    found = find_contours(votes, settings.level * votes.max()) if votes.max() > 0 else []
    if not found:
        return np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    cells = _simplify(max(found, key=len)[:-1], settings.tolerance_cells)
    return _counterclockwise(low + cells / (settings.grid - 1) * (high - low))


def _simplify(boundary: Float[np.ndarray, "N 2"], tolerance: float) -> Float[np.ndarray, "M 2"]:
    """Fewer vertices, at most `tolerance` from the boundary, or more where that many would not do."""
    from skimage.measure import approximate_polygon

    # The first vertex always stays, so it has to be a corner.
    start = np.argmax(((boundary - boundary.mean(0)) ** 2).sum(1))
    closed = np.roll(boundary, -start, 0)
    closed = np.concatenate([closed, closed[:1]])
    simple = approximate_polygon(closed, tolerance)[:-1]
    while len(simple) > MAX_VERTICES:
        tolerance *= 1.5
        simple = approximate_polygon(closed, tolerance)[:-1]
    return simple if len(simple) >= 3 else boundary


def _counterclockwise(boundary: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    x, y = boundary.T
    return boundary if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() > 0 else boundary[::-1].copy()


def _cost(contours: MaskContours, plane: Plane) -> float:
    """Mean of the robust loss e²/(e² + s²) at the scale of the last step of the first round."""
    distances = boundary_residuals(contours, plane)
    squared = (distances.pixels / FIRST_ROUND.scales_px[-1]) ** 2
    return float(np.where(distances.valid, squared / (1 + squared), 1.0).mean())


def _hopeless(contours: MaskContours, plane: Plane) -> bool:
    """Whether half of the contour points are more than a cell of the first round's grid, and 2 px, from the boundary.

    That boundary follows the vote to a cell before it is moved. Planes were within a tenth of a cell, a vase and a can
    two to four cells away.
    """
    distances = boundary_residuals(contours, plane)
    size = np.where(distances.valid, np.abs(distances.pixels), np.inf)
    pixels_per_unit = float(np.median(np.linalg.norm(distances.outward, axis=1)))
    cell = float(np.ptp(plane.boundary, axis=0).max()) * pixels_per_unit / FIRST_ROUND.grid
    return float(np.median(size)) > max(cell, HOPELESS_PX)


def _step(contours: MaskContours, plane: Plane, scale_px: float, frame: bool = True) -> Plane:
    """One robust Gauss–Newton step of plane and boundary together, no longer than `LARGEST_STEP`."""
    distances = boundary_residuals(contours, plane)
    gradients, matrix = normal_equations(contours, distances, scale_px, len(plane.boundary), frame)
    step = -np.linalg.lstsq(matrix, gradients.sum(0), rcond=None)[0]
    step *= min(1.0, LARGEST_STEP / max(float(np.abs(step).max()), 1e-12))
    step[3] *= frame
    return apply_plane_step(plane, step)


def _simplified(plane: Plane, contours: MaskContours) -> Plane:
    """The plane with sharp corners and as few vertices as a quarter of a pixel allows."""
    distances = boundary_residuals(contours, plane)
    pixel = 1 / max(float(np.median(np.linalg.norm(distances.outward, axis=1))), 1e-9)
    return replace(plane, boundary=_sharpened(_simplify(plane.boundary, SIMPLE_PX * pixel), CHAMFER_PX * pixel))


def _sharpened(boundary: Float[np.ndarray, "N 2"], reach: float) -> Float[np.ndarray, "M 2"]:
    """Where short sides lead from one long side to the next, their common corner instead, if it is within `reach`."""
    sides = np.roll(boundary, -1, 0) - boundary
    lengths = np.linalg.norm(sides, axis=1)
    long = np.nonzero(lengths >= reach)[0]
    parts = [] if len(long) >= 3 else [boundary]
    for index, following in zip(long, np.roll(long, -1), strict=True) if len(long) >= 3 else ():
        between = np.arange(index + 1, following + 1 + (len(boundary) if following <= index else 0)) % len(boundary)
        incoming, outgoing, gap = sides[index], sides[following], boundary[between[-1]] - boundary[between[0]]
        across = incoming[0] * outgoing[1] - incoming[1] * outgoing[0]
        sharp = abs(across) > np.sin(np.radians(CORNER_DEG)) * lengths[index] * lengths[following]
        if len(between) > 1 and sharp:
            corner = boundary[between[0]] + (gap[0] * outgoing[1] - gap[1] * outgoing[0]) / across * incoming
            if max(np.linalg.norm(corner - boundary[end]) for end in (between[0], between[-1])) < reach:
                parts.append(corner[None])
                continue
        parts.append(boundary[between])
    return np.concatenate(parts)


def _covariance(contours: MaskContours, plane: Plane, frame: bool) -> Float[np.ndarray, "3 3"]:
    """Covariance of the tilts along t_u and t_v and of the frame's height: σ² H⁻¹, or H⁻¹ (Σ_views g gᵀ) H⁻¹ if larger.

    The second takes views, not contour points, for independent, as errors of poses are (Liang and Zeger 1986).
    """
    distances = boundary_residuals(contours, plane)
    weights = robust_weights(distances, FINAL_SCALE_PX)
    gradients, matrix = normal_equations(contours, distances, FINAL_SCALE_PX, len(plane.boundary), frame)
    inverse = np.linalg.pinv(matrix, hermitian=True)[[0, 1, 3]]
    variance = (weights * distances.pixels**2).sum() / max(weights.sum(), 1.0)
    by_point = variance * inverse[:, [0, 1, 3]]
    views = len(np.unique(contours.view))
    moves = gradients @ inverse.T * np.sqrt(views / (views - 1))
    by_view = moves.T @ moves
    return by_view if np.trace(by_view[:2, :2]) > np.trace(by_point[:2, :2]) else by_point


def _score(views: Views, contours: MaskContours, plane: Plane, sigma_deg: float) -> PlaneFit:
    distances = boundary_residuals(contours, plane)
    size = np.where(distances.valid, np.abs(distances.pixels), np.inf)
    count = len(views.train)
    median_px, rms_px, iou = np.full(count, np.inf), np.full(count, np.inf), np.zeros(count)
    for index, view in enumerate(views.train):
        own = size[contours.view == index]
        if len(own):
            median_px[index], rms_px[index] = np.median(own), np.sqrt((own**2).mean())
        alpha = plane_buffers(plane, view.camera).alpha
        both, either = alpha.minimum(view.mask).sum(), alpha.maximum(view.mask).sum()
        iou[index] = float(both / either) if either > 0 else 0.0
    return PlaneFit(
        plane=plane,
        normal_sigma_deg=sigma_deg,
        median_px=median_px,
        rms_px=rms_px,
        iou=iou,
        share_inside=float((distances.pixels[distances.valid] < -CLEAR_PX).sum() / len(size)),
        share_outside=float((distances.pixels[distances.valid] > CLEAR_PX).sum() / len(size)),
    )
