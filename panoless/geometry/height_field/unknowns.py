"""A height field as a surface of few numbers: plane, boundary and coefficients.

At a fixed ray d, in the axes of the plane, a height δ moves the hit by δ/(d_z − ∇h·d) along the ray, so the slope that
is seen there changes by ∇δ + (D²h d) δ/(d_z − ∇h·d). How far a map can follow a tilt of the whole mirror depends on its
texels: coarse ones hold against it, and where they do means nothing.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from panoless.geometry.height_field.model import HeightField
from panoless.geometry.height_field.silhouette import edge_jacobian, edge_residuals
from panoless.geometry.plane.model import passes_frame
from panoless.geometry.plane.silhouette import apply_plane_step
from panoless.geometry.plane.unknowns import LIMIT, boundary_motion_rows, vertices_kept
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

BENDING, STIFF = 1e-4, 1e-2
"""Weights of the bending energy beside photographs, and of silhouettes alone."""

WALLS_ERROR = 0.015
"""Of 1/D (inverse radii): walls at D radii bend mirrored rays as a dome does that is steeper by 1/2D at a radius."""


@dataclass(frozen=True)
class HeightFieldUnknowns(ParametricSurface):
    """Those of the plane and its boundary, and then the coefficients."""

    height_field: HeightField
    bending: float = BENDING
    """Weight of the bending energy, a share of the mean diagonal of the data."""

    @property
    def shape(self) -> HeightField:
        """The height field."""
        return self.height_field

    @property
    def first(self) -> int:
        """The number of the first coefficient."""
        return 4 + self.height_field.plane.boundary.size

    @property
    def count(self) -> int:
        """Of all numbers."""
        return self.first + self.height_field.coefficients.size

    @property
    def limit(self) -> StepLimit:
        """Of the plane."""
        return LIMIT

    @property
    def unseen(self) -> Float[np.ndarray, "D 3"]:
        """A shift and the tilts of the whole."""
        tilts = self.height_field.tilts()
        return np.concatenate([np.zeros((self.first, tilts.shape[1])), tilts])

    @property
    def walls_error(self) -> float:
        """A dome over a plane shows what near walls show."""
        return WALLS_ERROR

    def hits(self, rays: PixelRays) -> MirrorHits:
        """Where rays meet the front and their reflections pass the rim."""
        field = self.height_field
        plane, frame, directions = field.plane, field.frame, rays.directions @ field.frame.T
        found = field.hits(rays.origins, rays.directions)
        normals, met = found.normals @ frame, found.met
        facing = (normals * rays.directions).sum(1)
        distance = np.where(met, found.distance, 0.0)
        points = rays.origins + distance[:, None] * rays.directions
        outgoing = rays.directions - 2 * facing[:, None] * normals
        height = max(plane.frame_height, field.clearance)
        met = met & (facing < -LEAST_COSINE)
        met &= passes_frame(plane, points, outgoing, height, distance * rays.size)
        met &= field.joint_distance(found.places) > distance * rays.size / np.maximum(-directions[:, 2], LEAST_COSINE)
        index, basis = field.basis(found.places)
        _, _, _, h_uu, h_uv, h_vv = (basis * field.coefficients.ravel()[index]).sum(2)
        second = np.stack([h_uu, h_uv, h_uv, h_vv], 1).reshape(-1, 2, 2)
        rate = directions[:, 2] - (found.slopes * directions[:, :2]).sum(1)
        slide = np.matmul(second, directions[:, :2, None])[..., 0] / np.where(met, rate, -1.0)[:, None]
        slopes = basis[1:3].transpose(1, 0, 2) + slide[..., None] * basis[0][:, None]
        by_slope = found.normals_by_slopes(frame)
        shape = np.matmul(np.matmul(by_slope, second), frame[:2])
        return MirrorHits(met, distance, points, normals, shape, np.matmul(by_slope, slopes), self.first + index)

    def silhouette(self, rays: PixelRays) -> Silhouette:
        """How far rays pass outside of the mirror's edge or of the frame."""
        found = edge_residuals(contours_of(rays), self.height_field)
        jacobian = edge_jacobian(found, self.height_field)
        motions = boundary_motion_rows(found, self.height_field.plane, rays)
        return Silhouette(found.pixels, found.counted.astype(float), found.valid, jacobian, motions)

    def regularization(self, matrix: Float[np.ndarray, "D D"]) -> Regularization:
        """The bending energy, and what keeps vertices."""
        field, found = self.height_field, vertices_kept(matrix, self.height_field.plane)
        part = slice(self.first, None)
        found[part, part] = self.bending * np.trace(matrix[part, part]) / field.coefficients.size * field.bending()
        value = np.zeros(self.count)
        value[part] = field.coefficients.ravel()
        return Regularization(found, value)

    def stepped(self, step: Float[np.ndarray, "D"]) -> "HeightFieldUnknowns":
        """Moved."""
        field, (of_plane, of_heights) = self.height_field, np.split(step, [self.first])
        plane = apply_plane_step(field.plane, of_plane)
        coefficients = field.coefficients + of_heights.reshape(field.coefficients.shape)
        return replace(self, height_field=replace(field, plane=plane, coefficients=coefficients))

    def taken_back(self, common: Similarity) -> "HeightFieldUnknowns":
        """Moved and scaled."""
        return replace(self, height_field=self.height_field.taken_back(common))

    def refined(self) -> "HeightFieldUnknowns":
        """With half as large cells."""
        return replace(self, height_field=self.height_field.with_halved_cells())
