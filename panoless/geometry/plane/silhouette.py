"""How far the masks' contours are from the boundary of a plane, in pixels, and their derivatives by the plane's numbers
and the boundary's vertices.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.capture.silhouettes import MaskContours
from panoless.geometry.plane.model import Plane
from panoless.numeric.gauss_newton import jacobian_of_rows
from panoless.numeric.polygon import nearest_side
from panoless.numeric.robust import bounded_error, robust_scale, robust_weight

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

CORNER_DEG = 20.0
"""Sides that turn by more than this meet in a corner."""
CORNER_PX = 1.5
"""Contour points nearer to a corner (px) do not count: the level set of pixel averages is round there."""
NOISE_SCALE = 3.0
"""The robust scale is at least this times the median distance, so that wrong poses leave all views a say."""
VERTEX_PULL = 1e-3
"""Weight of a vertex's place against the contour points of its side: along a straight side nothing else keeps it."""


@dataclass(frozen=True)
class BoundaryResiduals:
    """Signed distances (pixels, outward) of contour points from the projected boundary, and what they depend on."""

    pixels: Float[np.ndarray, "P"]
    by_plane: Float[np.ndarray, "P 4"]
    """Derivatives by the normal along t_u and t_v, by the offset, and by the frame's height."""
    by_side: Float[np.ndarray, "P 2"]
    """Derivatives by a shift of the nearest side."""
    end_share: Float[np.ndarray, "P"]
    """Share of the side's second vertex in these; the first has the rest."""
    by_height: Float[np.ndarray, "P"]
    """Derivatives by the height of the mirror's edge over the plane; zero where the frame hides that edge."""
    side: Int[np.ndarray, "P"]
    along: Float[np.ndarray, "P"]
    """The nearest point is so far along this side of the boundary, 0 at its first vertex, 1 at its second."""
    pixels_per_unit: Float[np.ndarray, "P"]
    outward: Float[np.ndarray, "P 2"]
    """Direction outward from the side in plane coordinates, of that length."""
    beyond: Float[np.ndarray, "P"]
    """ν·v, in pixels."""
    parallax: Float[np.ndarray, "P"]
    """z/(H − z)."""
    rise: Float[np.ndarray, "P"]
    """z/(H − z)²."""
    valid: Bool[np.ndarray, "P"]
    """In front of a camera that faces the mirror."""
    counted: Bool[np.ndarray, "P"]
    """Valid, and not at a corner."""

    def framed(self, frame: bool) -> "BoundaryResiduals":
        """With derivatives by the height of the frame, or without where there is none."""
        return replace(self, by_plane=self.by_plane * [1, 1, 1, frame])

    def ends(self, vertices: int) -> Int[np.ndarray, "P 2"]:
        """The first and the second vertex of each side, of so many."""
        return np.stack([self.side, (self.side + 1) % vertices], 1)

    def scale(self, scale_px: float) -> float:
        """The robust scale: `scale_px`, or a multiple of the median distance if that is larger."""
        return robust_scale(self.pixels[self.valid], scale_px, NOISE_SCALE)

    def weights(self, scale: float) -> Float[np.ndarray, "P"]:
        """Geman–McClure weights, zero for points that do not count."""
        return self.counted * robust_weight(self.pixels, scale)

    def cost(self, scale: float, counted: Bool[np.ndarray, "P"]) -> float:
        """Sum of e²/(e² + s²) over some of the points; 1 for those that no camera sees in front of the mirror."""
        return float(np.where(self.valid, bounded_error(self.pixels, scale), 1.0)[counted].sum())


def back_project(contours: MaskContours, plane: Plane) -> tuple[Float[np.ndarray, "P 2"], Bool[np.ndarray, "P"]]:
    """Plane coordinates of the contour points, and whether their rays meet the mirror's front (zero where not)."""
    slope, height = contours.rays @ plane.normal, contours.centers @ plane.normal - plane.offset
    valid = (slope < -1e-6) & (height > 0)
    points = contours.centers + np.where(valid, -height / np.where(valid, slope, -1.0), 0.0)[:, None] * contours.rays
    coordinates = np.stack([points @ plane.tangent_u, points @ plane.tangent_v], 1)
    return np.where(valid[:, None], coordinates, 0.0), valid


def boundary_residuals(
    contours: MaskContours,
    plane: Plane,
    heights: Callable[[Int[np.ndarray, "P"], Float[np.ndarray, "P"]], Float[np.ndarray, "P"]] | None = None,
) -> BoundaryResiduals:
    """First-order pixel distances: the plane distance from a side times |det J|/‖J τ‖, J = ∂pixel/∂coordinates.

    A turn of the normal by a t_u + b t_v and a shift of the offset by c move the hit point by r (c − a p₁ − b p₂)/(n·r)
    along its ray r. What stands at height z over a side is seen (ν·v) z/(H − z) inside of it, ν the outward normal,
    v = camera − side and H = n·v. The same turn and shift change ν·v by −H ν·(a, b) and H by
    a (v₁ + p₁) + b (v₂ + p₂) − c. What stands there is the frame where the camera stands beyond the side, and elsewhere
    the edge of the mirror itself, at the `heights` over sides and places on them, or at zero.
    """
    coordinates, valid = back_project(contours, plane)
    corners, tangent_u, tangent_v = plane.boundary, plane.tangent_u, plane.tangent_v
    side, along, _ = nearest_side(coordinates, corners)
    sides = np.roll(corners, -1, 0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    tangents = sides / np.maximum(lengths, 1e-12)[:, None]
    tangent = tangents[side]
    slope = np.where(valid, contours.rays @ plane.normal, -1.0)
    depth = np.where(valid, (plane.offset - contours.centers @ plane.normal) / slope, 1.0)
    column_u, column_v = contours.columns @ tangent_u / depth, contours.columns @ tangent_v / depth
    row_u, row_v = contours.rows @ tangent_u / depth, contours.rows @ tangent_v / depth
    stretch = np.hypot(
        column_u * tangent[:, 0] + column_v * tangent[:, 1], row_u * tangent[:, 0] + row_v * tangent[:, 1]
    )
    pixels_per_unit = np.abs(column_u * row_v - column_v * row_u) / np.maximum(stretch, 1e-12)
    outward = pixels_per_unit[:, None] * np.stack([tangent[:, 1], -tangent[:, 0]], 1)
    foot = corners[side] + along[:, None] * sides[side]
    camera = np.stack([contours.centers @ tangent_u, contours.centers @ tangent_v], 1)
    beyond = (outward * (camera - foot)).sum(1)
    own_height = np.zeros(len(side)) if heights is None else heights(side, along)
    framed = plane.frame_height > 0 or heights is None
    by_frame = (beyond > 0) & (own_height <= plane.frame_height) & framed
    level = np.where(by_frame, plane.frame_height, own_height)
    camera_height = np.where(valid, contours.centers @ plane.normal - plane.offset, np.inf)
    above = np.where(camera_height > 2 * np.abs(level), camera_height - level, np.inf)
    parallax = level / above
    hit_shift = (outward[:, 0] * (contours.rays @ tangent_u) + outward[:, 1] * (contours.rays @ tangent_v)) / slope
    turn_of_camera = np.where(np.isfinite(above), camera_height, 0.0)[:, None] * outward
    by_turn = -hit_shift[:, None] * coordinates - parallax[:, None] * (
        turn_of_camera + (beyond / above)[:, None] * camera
    )
    by_level = beyond / above * (1 + parallax)
    turns = np.einsum("ni,ni->n", tangents, np.roll(tangents, 1, 0)) < np.cos(np.radians(CORNER_DEG))
    reach = stretch * lengths[side]
    at_corner = (turns[side] & (along * reach < CORNER_PX)) | (
        np.roll(turns, -1)[side] & ((1 - along) * reach < CORNER_PX)
    )
    return BoundaryResiduals(
        pixels=(outward * (coordinates - foot)).sum(1) + beyond * parallax,
        by_plane=np.stack([*by_turn.T, hit_shift + beyond / above * parallax, by_level * by_frame], 1),
        by_side=-(1 + parallax)[:, None] * outward,
        end_share=along
        + ((camera - foot) * tangent).sum(1) * parallax / (1 + parallax) / np.maximum(lengths[side], 1e-12),
        by_height=by_level * ~by_frame,
        side=side,
        along=along,
        pixels_per_unit=pixels_per_unit,
        outward=outward,
        beyond=beyond,
        parallax=parallax,
        rise=parallax / above,
        valid=valid,
        counted=valid & ~at_corner,
    )


def boundary_jacobian(residuals: BoundaryResiduals, vertices: int) -> "csr_matrix":
    """Derivatives of the distances by the four numbers of the plane and by two of each vertex, P rows."""
    count = len(residuals.side)
    ends = residuals.ends(vertices)
    shares = np.stack([1 - residuals.end_share, residuals.end_share], 1)
    values = shares[:, :, None] * residuals.by_side[:, None, :]
    columns = 4 + 2 * ends[:, :, None] + np.arange(2)
    return jacobian_of_rows(
        np.concatenate([residuals.by_plane, values.reshape(count, 4)], 1),
        np.concatenate([np.tile(np.arange(4), (count, 1)), columns.reshape(count, 4)], 1),
        4 + 2 * vertices,
    )


def vertex_pull(residuals: BoundaryResiduals, weights: Float[np.ndarray, "P"], vertices: int) -> float:
    """What holds each number of a vertex where it is, against the sum of the contour points' weights."""
    return float(VERTEX_PULL * weights.sum() / vertices * np.median(residuals.pixels_per_unit**2))


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
    offset = float((plane.offset + step[2]) / length)
    return replace(
        plane,
        normal=normal,
        offset=offset,
        tangent_u=tangent_u,
        tangent_v=tangent_v,
        boundary=boundary,
        frame_height=frame_height,
    )
