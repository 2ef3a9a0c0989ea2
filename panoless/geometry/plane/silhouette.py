"""How far the masks' contours are from the boundary of a plane, in pixels, and what moves them: the plane's numbers and
the boundary's vertices.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.capture.silhouettes import MaskContours
from panoless.geometry.plane.model import Plane

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

HeightOf = Callable[[Float[np.ndarray, "P 2"]], Float[np.ndarray, "P"]]
CORNER_DEG = 20.0
CORNER_PX = 1.5
"""The level set of pixel averages is round at corners: points this near to one say nothing about it."""
NOISE_SCALE = 3.0
"""The robust scale is at least this times the median distance, so that wrong poses leave all views a say."""
PULL = 1e-3
"""Weight of a vertex's place against the contour points of its side: along a straight side nothing else holds it."""


@dataclass(frozen=True)
class BoundaryResiduals:
    """Signed distances (pixels, outward) of contour points from the projected boundary, and what they depend on."""

    coordinates: Float[np.ndarray, "P 2"]
    pixels: Float[np.ndarray, "P"]
    by_plane: Float[np.ndarray, "P 4"]
    """Derivatives by the normal along t_u and t_v, by the offset, and by the frame's height."""
    edge: Int[np.ndarray, "P"]
    along: Float[np.ndarray, "P"]
    outward: Float[np.ndarray, "P 2"]
    """Outward unit normals of the boundary, times pixels per unit."""
    valid: Bool[np.ndarray, "P"]
    """In front of a camera that faces the mirror."""
    corner: Bool[np.ndarray, "P"]
    by_height: Float[np.ndarray, "P"]
    """Derivatives by the height of the mirror's edge over the plane; zero where the frame hides that edge."""


def back_project(contours: MaskContours, plane: Plane) -> tuple[Float[np.ndarray, "P 2"], Bool[np.ndarray, "P"]]:
    """Plane coordinates of the contour points, and whether their rays meet the mirror's front (zero where not)."""
    slope, height = contours.rays @ plane.normal, contours.centers @ plane.normal - plane.offset
    valid = (slope < -1e-6) & (height > 0)
    points = contours.centers + np.where(valid, -height / np.where(valid, slope, -1.0), 0.0)[:, None] * contours.rays
    coordinates = np.stack([points @ plane.tangent_u, points @ plane.tangent_v], 1)
    return np.where(valid[:, None], coordinates, 0.0), valid


def boundary_residuals(contours: MaskContours, plane: Plane, height_of: HeightOf | None = None) -> BoundaryResiduals:
    """First-order pixel distances: the plane distance from an edge times |det J|/‖J τ‖, J = ∂pixel/∂coordinates.

    A turn of the normal by a t_u + b t_v and a shift of the offset by c move the hit point by r (c − a p₁ − b p₂)/(n·r)
    along its ray r. What stands at height z over an edge is seen (ν·(camera − edge)) z/(H − z) inside of it by a camera
    at height H, ν the outward normal. This is the frame where the camera stands beyond the edge, and elsewhere the edge
    of the mirror itself, at height zero unless `height_of` gives one.
    """
    coordinates, valid = back_project(contours, plane)
    edge, along = _nearest(coordinates, plane.boundary)
    corners = plane.boundary
    sides = np.roll(corners, -1, 0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    tangents = sides / np.maximum(lengths, 1e-12)[:, None]
    tangent, tangent_u, tangent_v = tangents[edge], plane.tangent_u, plane.tangent_v
    slope = np.where(valid, contours.rays @ plane.normal, -1.0)
    depth = np.where(valid, (plane.offset - contours.centers @ plane.normal) / slope, 1.0)
    column_u, column_v = contours.columns @ tangent_u / depth, contours.columns @ tangent_v / depth
    row_u, row_v = contours.rows @ tangent_u / depth, contours.rows @ tangent_v / depth
    stretch = np.hypot(
        column_u * tangent[:, 0] + column_v * tangent[:, 1], row_u * tangent[:, 0] + row_v * tangent[:, 1]
    )
    scale = np.abs(column_u * row_v - column_v * row_u) / np.maximum(stretch, 1e-12)
    outward = scale[:, None] * np.stack([tangent[:, 1], -tangent[:, 0]], 1)
    hit_moves = outward[:, 0] * (contours.rays @ tangent_u) + outward[:, 1] * (contours.rays @ tangent_v)
    foot = corners[edge] + along[:, None] * sides[edge]
    camera = np.stack([contours.centers @ tangent_u, contours.centers @ tangent_v], 1)
    toward_camera = (outward * (camera - foot)).sum(1)
    own = np.zeros(len(edge)) if height_of is None else height_of(foot)
    framed = plane.frame_height > 0 or height_of is None
    by_frame = (toward_camera > 0) & (own <= plane.frame_height) & framed
    level = np.where(by_frame, plane.frame_height, own)
    height = np.where(valid, contours.centers @ plane.normal - plane.offset, np.inf)
    lean = toward_camera / np.where(height > 2 * np.abs(level), height - level, np.inf)
    by_plane = (hit_moves / slope)[:, None] * np.concatenate([-coordinates, np.ones((len(edge), 1))], 1)
    turns = np.einsum("ni,ni->n", tangents, np.roll(tangents, 1, 0)) < np.cos(np.radians(CORNER_DEG))
    reach = stretch * lengths[edge]
    return BoundaryResiduals(
        coordinates=coordinates,
        pixels=(outward * (coordinates - foot)).sum(1) + lean * level,
        by_plane=np.concatenate([by_plane, (lean * by_frame)[:, None]], 1),
        edge=edge,
        along=along,
        outward=outward,
        valid=valid,
        corner=(turns[edge] & (along * reach < CORNER_PX))
        | (np.roll(turns, -1)[edge] & ((1 - along) * reach < CORNER_PX)),
        by_height=lean * ~by_frame,
    )


def _nearest(
    points: Float[np.ndarray, "P 2"], boundary: Float[np.ndarray, "N 2"]
) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """The side nearest to each point, and where on it: 0 at its first vertex, 1 at its second."""
    best = np.full(len(points), np.inf)
    edge, along = np.zeros(len(points), dtype=np.int64), np.zeros(len(points))
    for index, (start, side) in enumerate(zip(boundary, np.roll(boundary, -1, 0) - boundary, strict=True)):
        offset_x, offset_y = points[:, 0] - start[0], points[:, 1] - start[1]
        share = ((offset_x * side[0] + offset_y * side[1]) / max(side @ side, 1e-18)).clip(0, 1)
        squared = (offset_x - share * side[0]) ** 2 + (offset_y - share * side[1]) ** 2
        nearer = squared < best
        best[nearer], along[nearer], edge[nearer] = squared[nearer], share[nearer], index
    return edge, along


def robust_weights(distances: BoundaryResiduals, scale_px: float) -> Float[np.ndarray, "P"]:
    """Geman–McClure weights (1 + e²/s²)⁻², where s is `scale_px` or, if larger, a multiple of the median |e|."""
    typical = np.median(np.abs(distances.pixels[distances.valid])) if distances.valid.any() else 0.0
    scale = max(scale_px, NOISE_SCALE * float(typical))
    return (distances.valid & ~distances.corner) / (1 + (distances.pixels / scale) ** 2) ** 2


def boundary_jacobian(distances: BoundaryResiduals, vertices: int) -> "csr_matrix":
    """Derivatives of the distances by the four numbers of the plane and by two of each vertex, P rows."""
    from scipy.sparse import csr_matrix

    count = len(distances.edge)
    ends = np.stack([distances.edge, (distances.edge + 1) % vertices], 1)
    shares = np.stack([1 - distances.along, distances.along], 1)
    values = -shares[:, :, None] * distances.outward[:, None, :]
    columns = 4 + 2 * ends[:, :, None] + np.arange(2)
    return csr_matrix(
        (
            np.concatenate([distances.by_plane, values.reshape(count, 4)], 1).ravel(),
            np.concatenate([np.tile(np.arange(4), (count, 1)), columns.reshape(count, 4)], 1).ravel(),
            np.arange(count + 1) * 8,
        ),
        shape=(count, 4 + 2 * vertices),
    )


def boundary_pull(distances: BoundaryResiduals, weights: Float[np.ndarray, "P"], vertices: int) -> float:
    """What holds each number of a vertex against the sum of the contour points' weights."""
    return float(PULL * weights.sum() / vertices * np.median((distances.outward**2).sum(1)))


def normal_equations(
    contours: MaskContours, distances: BoundaryResiduals, scale_px: float, vertices: int, frame: bool
) -> tuple[Float[np.ndarray, "V D"], Float[np.ndarray, "D D"]]:
    """The gradient Σ J w e of each view and the matrix Jᵀ W J, over four numbers of the plane and two of each vertex.

    Without `frame`, the frame's height has no influence and no gradient.
    """
    from scipy import sparse

    count, weights = len(distances.edge), robust_weights(distances, scale_px)
    jacobian = boundary_jacobian(replace(distances, by_plane=distances.by_plane * [1, 1, 1, frame]), vertices)
    matrix = (jacobian.T @ jacobian.multiply(weights[:, None]).tocsr()).toarray()
    pull = boundary_pull(distances, weights, vertices)
    matrix += np.diag(np.append(np.full(4, 1e-9 * np.trace(matrix[:4, :4])), np.full(2 * vertices, pull)))
    by_view = sparse.csr_matrix((weights * distances.pixels, (contours.view, np.arange(count))))
    return (by_view @ jacobian).toarray(), matrix


def apply_plane_step(plane: Plane, step: Float[np.ndarray, "D"]) -> Plane:
    """The plane after a turn of its normal by step₀ t_u + step₁ t_v, shifts of offset and frame, and of each vertex."""
    tilted = plane.normal + step[0] * plane.tangent_u + step[1] * plane.tangent_v
    length = np.linalg.norm(tilted)
    # The boundary moves along the old normal onto the new plane, as the derivatives have it.
    flat = (plane.boundary + step[4:].reshape(-1, 2)) @ np.stack([plane.tangent_u, plane.tangent_v])
    points = flat + (plane.offset + step[2] - flat @ tilted)[:, None] * plane.normal
    normal = tilted / length
    tangent_u = plane.tangent_u - (plane.tangent_u @ normal) * normal
    tangent_u /= np.linalg.norm(tangent_u)
    tangent_v = np.cross(normal, tangent_u)
    boundary = np.stack([points @ tangent_u, points @ tangent_v], 1)
    frame_height = max(plane.frame_height + float(step[3]), 0.0)
    return Plane(normal, float((plane.offset + step[2]) / length), tangent_u, tangent_v, boundary, frame_height)
