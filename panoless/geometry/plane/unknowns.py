"""A plane within a boundary as a surface of few numbers.

Photographs do not determine it: what a tilt changes, a map that is turned the other way changes back.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from panoless.geometry.plane.model import Plane, passes_frame
from panoless.geometry.plane.silhouette import (
    VERTEX_PULL,
    BoundaryResiduals,
    apply_plane_step,
    boundary_jacobian,
    boundary_residuals,
)
from panoless.problem.observations import contours_of
from panoless.problem.parametric import (
    LEAST_COSINE,
    MirrorHits,
    ParametricSurface,
    Regularization,
    Silhouette,
    StepLimit,
)
from panoless.problem.rays import PixelRays
from shinypartial.core.camera import Similarity

PLANE_NUMBERS = 4
LIMIT = StepLimit(0.2, slice(PLANE_NUMBERS))
"""In radii of the object or radians."""


@dataclass(frozen=True)
class PlaneUnknowns(ParametricSurface):
    """Normal, offset and frame, and the boundary's vertices."""

    plane: Plane

    @property
    def shape(self) -> Plane:
        """The plane."""
        return self.plane

    @property
    def count(self) -> int:
        """Four, and two a vertex."""
        return PLANE_NUMBERS + self.plane.boundary.size

    @property
    def limit(self) -> StepLimit:
        """Of the plane."""
        return LIMIT

    def hits(self, rays: PixelRays) -> MirrorHits:
        """Where rays meet the plane and their reflections pass the frame; the normal is the same everywhere."""
        plane, count = self.plane, len(rays.size)
        facing = rays.directions @ plane.normal
        above = rays.origins @ plane.normal - plane.offset
        met = (facing < -LEAST_COSINE) & (above > 0)
        distance = np.where(met, above / -np.where(met, facing, -1.0), 0.0)
        points = rays.origins + distance[:, None] * rays.directions
        outgoing = rays.directions - 2 * facing[:, None] * plane.normal
        met &= passes_frame(plane, points, outgoing, plane.frame_height, distance * rays.size)
        normals = np.tile(plane.normal, (count, 1))
        shape, rows = np.zeros((count, 3, 3)), np.zeros((count, 3, 0))
        return MirrorHits(met, distance, points, normals, shape, rows, np.zeros((count, 0), dtype=np.int64))

    def silhouette(self, rays: PixelRays) -> Silhouette:
        """How far rays pass outside of the boundary or of the frame."""
        found = boundary_residuals(contours_of(rays), self.plane)
        jacobian = boundary_jacobian(found.framed(self.plane.frame_height > 0), len(self.plane.boundary))
        motions = boundary_motion_rows(found, self.plane, rays)
        return Silhouette(found.pixels, found.counted.astype(float), found.valid, jacobian, motions)

    def regularization(self, matrix: Float[np.ndarray, "D D"]) -> Regularization:
        """Along a straight side nothing else keeps a vertex where it is."""
        return Regularization(vertices_kept(matrix, self.plane))

    def stepped(self, step: Float[np.ndarray, "D"]) -> "PlaneUnknowns":
        """Turned and shifted, with another boundary."""
        return PlaneUnknowns(apply_plane_step(self.plane, step))

    def taken_back(self, common: Similarity) -> "PlaneUnknowns":
        """Moved and scaled."""
        return PlaneUnknowns(self.plane.taken_back(common))


def vertices_kept(matrix: Float[np.ndarray, "D D"], plane: Plane) -> Float[np.ndarray, "D D"]:
    """A share of the mean diagonal for the numbers of vertices, and a little for a plane that data leave open."""
    first, last = PLANE_NUMBERS, PLANE_NUMBERS + plane.boundary.size
    diagonal = np.zeros(len(matrix))
    diagonal[first:last] = VERTEX_PULL * np.trace(matrix[first:last, first:last]) / plane.boundary.size
    return np.diag(diagonal)


def boundary_motion_rows(found: BoundaryResiduals, plane: Plane, rays: PixelRays) -> Float[np.ndarray, "S 6"]:
    """Derivatives of the distances by (ω, τ) of rays.

    With M the outward direction in the plane, in pixels, a ray d from the height H meets the plane at s d, and what
    stands at height z over the boundary shifts it by π = z/(H − z) of (M·v). With w = M − (M·d)/(n·d) n the rows are
    w + π M − (M·v) π/(H − z) n by τ, and d × s w by ω.
    """
    outward = found.outward @ np.stack([plane.tangent_u, plane.tangent_v])
    slope = np.where(found.valid, rays.directions @ plane.normal, -1.0)
    height = rays.origins @ plane.normal - plane.offset
    along = (outward * rays.directions).sum(1) / slope
    by_hit = outward - along[:, None] * plane.normal
    by_turn = np.cross(rays.directions, (-height / slope)[:, None] * by_hit)
    by_shift = by_hit + found.parallax[:, None] * outward - (found.beyond * found.rise)[:, None] * plane.normal
    return np.concatenate([by_turn, by_shift], 1) * found.valid[:, None]
