"""One plane from silhouettes alone: the boundary, carried from view to view through it, has to stay the boundary.

Tilting a planar mirror and turning the environment the other way leaves every picture as it was, so no color can
determine the tilt of a mirror (see docs/explanation/planar-mirrors.md); its boundary can. The plane's three numbers,
the boundary's vertices and the height of a frame that hides part of the mirror are found together, by robust
Gauss–Newton on the distances, in pixels, of each view's contour from the boundary that it should see.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from panoless.capture.rays import pose_of, project
from panoless.capture.silhouettes import MaskContours, mask_contours
from panoless.capture.views import TrainView, Views
from panoless.geometry.base import overlap
from panoless.geometry.plane.model import Plane, plane_buffers
from panoless.geometry.plane.silhouette import (
    CORNER_DEG,
    BoundaryResiduals,
    apply_plane_step,
    back_project,
    boundary_jacobian,
    boundary_residuals,
    vertex_pull,
)
from panoless.numeric.gauss_newton import accept_step, damped_step, normal_equations
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import fibonacci_directions


@dataclass(frozen=True)
class BoundaryRound:
    """A boundary by vote of the masks on a grid, then one Gauss–Newton step on plane and boundary for each scale."""

    grid: int
    """Points along a side of the grid."""
    level: float
    """The boundary runs where this share of the largest vote is; later rounds see sharper edges."""
    tolerance_cells: float
    """The voted boundary is simplified by at most this many cells."""
    scales_px: tuple[float, ...]
    """Robust scales of the steps (px)."""


MIN_VIEWS = 3
"""Fewest distinct views that determine a plane."""
MIN_BASELINE = 0.02
"""Distance between two cameras, as a share of their distance from the object, that makes them distinct."""
START_DIRECTIONS = 200
"""Normals that are tried, evenly over the sphere."""
START_OFFSETS = (-0.2, 0.0, 0.2)
"""Offsets that are tried with each, in radii of the object."""
START_COSINE = 0.15
"""A plane faces a camera if the cosine between its normal and the direction to it is above this."""
START_GRID = 32
"""Points along a side of the grid on which masks are compared at the start."""
START_VIEWS = 16
"""Views that are compared at the start."""
START_HALF_SIDE = 1.2
"""Half a side of that grid, in radii of the object."""
STARTS = 3
"""So many of the best starts go through the first round."""
MAX_VERTICES = 128
"""Most vertices of the boundary."""
MAX_POINTS = 40_000
"""Most contour points of all views."""
VOTING_VIEWS = 32
"""Views whose masks vote for the boundary."""
FIRST_ROUND = BoundaryRound(96, 0.5, 1.0, (16.0, 8.0, 8.0))
"""From each start."""
LATER_ROUNDS = (
    BoundaryRound(128, 0.5, 1.0, (4.0, 4.0, 2.0, 2.0)),
    BoundaryRound(256, 0.4, 0.7, (1.0, 1.0, 0.5, 0.5, 0.5)),
)
"""From the best of them."""
HOPELESS_PX = 2.0
"""A start whose median contour point is further from the boundary than this (px), and than a cell of its grid, is no
plane."""
LARGEST_STEP = 0.2
"""Most by which a step may move any parameter, in radii of the object or radians."""
FINAL_SCALE_PX = 0.5
"""Robust scale of the last steps (px)."""
FINAL_STEPS = 3
"""Steps after each simplification."""
SIMPLIFICATIONS = 2
"""How often the boundary is simplified."""
SIMPLE_PX = 0.25
"""A vertex goes if the boundary without it is nowhere further away than this (px)."""
CHAMFER_PX = 6.0
"""Shorter sides (px) that cut the corner of longer ones are removed: votes round corners."""
FRAME_SIGMAS = 3.0
"""A frame is kept if its height is this many standard deviations above zero."""


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
    iou: Float[np.ndarray, "V"]
    """Σ min(alpha, mask) / Σ max(alpha, mask), with the frame."""


def fit_plane(views: Views, *, thorough: bool = True) -> PlaneFit:
    """The plane and boundary that explain the masks best, from several starts; never a failure because none is good.

    Unless `thorough`, a plane that the first round leaves hopelessly far from the contours is returned as it is then,
    with no idea of its normal's error.

    Raises InputError when masks have a boundary in fewer than three views taken from distinct places.
    """
    contours = mask_contours(views)
    _require_distinct_views(contours)
    sparse = contours.every(max(1, len(contours.view) // MAX_POINTS))
    starts = [_refine(views, sparse, start, FIRST_ROUND) for start in _starts(views)]
    plane = min(starts, key=lambda start: _cost(sparse, start))
    if not thorough and _hopeless(sparse, plane):
        return _score(views, contours, plane, math.inf)
    for settings in LATER_ROUNDS:
        plane = _refine(views, sparse, plane, settings)
    final_scales = (FINAL_SCALE_PX,) * FINAL_STEPS
    for _ in range(SIMPLIFICATIONS):
        plane = _descend(sparse, _simplify_boundary(plane, sparse), final_scales)
    sigma = float(np.sqrt(max(_covariance(sparse, plane, frame=True)[2, 2], 0.0)))
    frame = plane.frame_height > FRAME_SIGMAS * sigma
    if not frame:
        plane = _descend(sparse, replace(plane, frame_height=0.0), final_scales, frame=False)
    tilt = np.linalg.eigvalsh(_covariance(sparse, plane, frame)[:2, :2])[-1]
    return _score(views, contours, plane, float(np.degrees(np.sqrt(max(tilt, 0.0)))))


def _require_distinct_views(contours: MaskContours) -> None:
    distinct: list[np.ndarray] = []
    for center in contours.centers[np.unique(contours.view, return_index=True)[1]]:
        if all(np.linalg.norm(center - other) > MIN_BASELINE * np.linalg.norm(center) for other in distinct):
            distinct.append(center)
    if len(distinct) < MIN_VIEWS:
        raise InputError(
            expected=f"masks with a boundary, seen from at least {MIN_VIEWS} distinct places",
            found=f"{len(distinct)} such views",
            remedy="Add views from other directions, and check that masks end within the images.",
        )


def _starts(views: Views) -> list[Plane]:
    """The best few of many planes through the object that face as many cameras as a plane can."""
    centers = np.stack([view.position for view in views.train])
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    # The mean view direction joins the lattice: with few cameras it can be the only one that all of them face.
    directions = np.concatenate([centers.mean(0, keepdims=True), fibonacci_directions(START_DIRECTIONS)])
    facing = (directions @ centers.T > START_COSINE).sum(1)
    voters = spread(views.train, START_VIEWS)
    planes = [_plane(n, offset) for n in directions[facing == facing.max()] for offset in START_OFFSETS]
    planes.sort(key=lambda plane: -_agreement(plane, voters))
    return planes[:STARTS]


def _plane(direction: Float[np.ndarray, "3"], offset: float) -> Plane:
    normal = direction / np.linalg.norm(direction)
    tangent_u = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    tangent_u /= np.linalg.norm(tangent_u)
    return Plane(normal, offset, tangent_u, np.cross(normal, tangent_u), np.zeros((0, 2)))


def spread(views: Sequence[TrainView], count: int) -> Sequence[TrainView]:
    """About so many of the views, evenly."""
    return views[:: max(1, len(views) // count)]


def _agreement(plane: Plane, voters: Sequence[TrainView]) -> float:
    """Mean intersection over union, on the plane, of each mask with the majority of all."""
    line = np.linspace(-START_HALF_SIDE, START_HALF_SIDE, START_GRID)
    votes = votes_on(plane, line, line, voters).reshape(len(voters), -1) > 0.5
    majority = votes.mean(0) > 0.5
    return float(((votes & majority).sum(1) / np.maximum((votes | majority).sum(1), 1)).mean())


def votes_on(
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


def _refine(views: Views, contours: MaskContours, plane: Plane, settings: BoundaryRound) -> Plane:
    plane = replace(plane, boundary=_vote_boundary(views, contours, plane, settings))
    return _descend(contours, plane, settings.scales_px)


def _vote_boundary(
    views: Views, contours: MaskContours, plane: Plane, settings: BoundaryRound
) -> Float[np.ndarray, "N 2"]:
    """The level set of the mean of all masks on the plane, simplified; a box where they have no point in common."""
    from skimage.measure import find_contours

    coordinates, valid = back_project(contours, plane)
    low, high = np.percentile(coordinates[valid], (2, 98), axis=0) if valid.any() else (-np.ones(2), np.ones(2))
    low, high = (low - 0.1 * (high - low), high + 0.1 * (high - low)) if (high > low).all() else (low - 1, high + 1)
    u, v = (np.linspace(low[axis], high[axis], settings.grid) for axis in (0, 1))
    votes = votes_on(plane, u, v, spread(views.train, VOTING_VIEWS)).mean(0)
    votes[[0, -1]], votes[:, [0, -1]] = 0, 0
    curves = find_contours(votes, settings.level * votes.max()) if votes.max() > 0 else []
    if not curves:
        return np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    cells = _simplify(max(curves, key=len)[:-1], settings.tolerance_cells)
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
    """The robust cost of all contour points at the scale of the last step of the first round."""
    residuals = boundary_residuals(contours, plane)
    return residuals.cost(FIRST_ROUND.scales_px[-1], np.ones(len(contours.view), dtype=bool))


def _hopeless(contours: MaskContours, plane: Plane) -> bool:
    """Whether half of the contour points are more than a cell of the first round's grid, and 2 px, from the boundary.

    That boundary follows the vote to a cell before it is moved.
    """
    residuals = boundary_residuals(contours, plane)
    size = np.where(residuals.valid, np.abs(residuals.pixels), np.inf)
    pixels_per_unit = float(np.median(residuals.pixels_per_unit))
    cell = float(np.ptp(plane.boundary, axis=0).max()) * pixels_per_unit / FIRST_ROUND.grid
    return float(np.median(size)) > max(cell, HOPELESS_PX)


def _descend(contours: MaskContours, plane: Plane, scales_px: Sequence[float], frame: bool = True) -> Plane:
    """A robust Gauss–Newton step of plane and boundary together for each scale; none raises the cost at its scale."""

    def residuals_of(plane: Plane) -> tuple[Plane, BoundaryResiduals]:
        return plane, boundary_residuals(contours, plane)

    state = residuals_of(plane)
    for scale_px in scales_px:
        plane, residuals = state
        scale, counted = residuals.scale(scale_px), residuals.counted
        gradients, matrix = _equations(contours, plane, residuals, scale, frame)
        state = accept_step(
            state,
            damped_step(gradients.sum(0), matrix, largest=LARGEST_STEP),
            lambda state, step: residuals_of(apply_plane_step(state[0], step)),
            partial(_cost_of_state, scale=scale, counted=counted),
        )
    return state[0]


def _cost_of_state(state: tuple[Plane, BoundaryResiduals], scale: float, counted: Bool[np.ndarray, "P"]) -> float:
    return state[1].cost(scale, counted)


def _equations(
    contours: MaskContours,
    plane: Plane,
    residuals: BoundaryResiduals,
    scale: float,
    frame: bool,
) -> tuple[Float[np.ndarray, "V D"], Float[np.ndarray, "D D"]]:
    """The gradient Σ J w e of each view and the matrix Jᵀ W J, over four numbers of the plane and two of each vertex.

    Without `frame`, the frame's height has no influence and no gradient.
    """
    from scipy import sparse

    vertices, weights = len(plane.boundary), residuals.weights(scale)
    residuals = residuals.framed(frame)
    jacobian = boundary_jacobian(residuals, vertices)
    _, matrix = normal_equations(jacobian, residuals.pixels, weights)
    matrix[4:, 4:] += vertex_pull(residuals, weights, vertices) * np.eye(2 * vertices)
    points = np.arange(len(weights))
    by_view = sparse.csr_matrix((weights * residuals.pixels, (contours.view, points)))
    return (by_view @ jacobian).toarray(), matrix


def _simplify_boundary(plane: Plane, contours: MaskContours) -> Plane:
    """The plane with sharp corners and as few vertices as a quarter of a pixel allows."""
    pixel = 1 / max(float(np.median(boundary_residuals(contours, plane).pixels_per_unit)), 1e-9)
    simple = _simplify(plane.boundary, SIMPLE_PX * pixel)
    return replace(plane, boundary=_sharpen(simple, CHAMFER_PX * pixel, CORNER_DEG))


def _sharpen(boundary: Float[np.ndarray, "N 2"], reach: float, corner_deg: float) -> Float[np.ndarray, "M 2"]:
    """Where short sides lead from one long side to the next, their common corner instead, if it is within `reach`."""
    sides = np.roll(boundary, -1, 0) - boundary
    lengths = np.linalg.norm(sides, axis=1)
    long = np.nonzero(lengths >= reach)[0]
    parts = [] if len(long) >= 3 else [boundary]
    for index, following in zip(long, np.roll(long, -1), strict=True) if len(long) >= 3 else ():
        between = np.arange(index + 1, following + 1 + (len(boundary) if following <= index else 0)) % len(boundary)
        incoming, outgoing, gap = sides[index], sides[following], boundary[between[-1]] - boundary[between[0]]
        across = incoming[0] * outgoing[1] - incoming[1] * outgoing[0]
        sharp = abs(across) > np.sin(np.radians(corner_deg)) * lengths[index] * lengths[following]
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
    residuals = boundary_residuals(contours, plane)
    scale = residuals.scale(FINAL_SCALE_PX)
    weights = residuals.weights(scale)
    gradients, matrix = _equations(contours, plane, residuals, scale, frame)
    inverse = np.linalg.pinv(matrix, hermitian=True)[[0, 1, 3]]
    variance = (weights * residuals.pixels**2).sum() / max(weights.sum(), 1.0)
    by_point = variance * inverse[:, [0, 1, 3]]
    views = len(np.unique(contours.view))
    moves = gradients @ inverse.T * np.sqrt(views / (views - 1))
    by_view = moves.T @ moves
    return by_view if np.trace(by_view[:2, :2]) > np.trace(by_point[:2, :2]) else by_point


def _score(views: Views, contours: MaskContours, plane: Plane, sigma_deg: float) -> PlaneFit:
    residuals = boundary_residuals(contours, plane)
    size = np.where(residuals.valid, np.abs(residuals.pixels), np.inf)
    count = len(views.train)
    median_px, iou = np.full(count, np.inf), np.zeros(count)
    for index, view in enumerate(views.train):
        own = size[contours.view == index]
        if len(own):
            median_px[index] = np.median(own)
        alpha = plane_buffers(plane, view.camera).alpha
        iou[index] = overlap(alpha, view.mask)
    return PlaneFit(plane, sigma_deg, median_px, iou)
