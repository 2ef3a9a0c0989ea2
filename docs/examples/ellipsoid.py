"""The ellipsoid as a kind of geometry: nine numbers, of its center and its shape."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from scipy.linalg import expm

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.surroundings import FAR, Surroundings
from panoless.geometry.base import Geometry, Mesh, Proposal, RayHits
from panoless.geometry.exact import ExactFamily, SeenByCenters
from panoless.numeric.gauss_newton import jacobian_of_rows
from panoless.problem.observations import silhouette_rays
from panoless.problem.parametric import LEAST_COSINE, MirrorHits, ParametricSurface, Silhouette, motion_rows
from panoless.problem.rays import PixelRays
from panoless.problem.solve import by_silhouettes_alone
from shinypartial.core.camera import Similarity
from shinypartial.core.errors import InputError

Vectors = Float[np.ndarray, "P 3"]
STRAINS = np.array([np.outer(a, b) + np.outer(b, a) for i, a in enumerate(np.eye(3)) for b in np.eye(3)[i:]]) / 2
"""A basis E of symmetric matrices, (6, 3, 3)."""


@dataclass(frozen=True)
class Ellipsoid:
    """(x − c)ᵀ Q (x − c) = 1 in the normalized frame, with a symmetric positive Q."""

    center: Float[np.ndarray, "3"]
    matrix: Float[np.ndarray, "3 3"]
    surroundings: Surroundings = FAR
    num_parameters: ClassVar[int] = 9

    def chords(self, origins: Vectors, directions: Vectors) -> Float[np.ndarray, "2 P"]:
        """Along rays o + t d: t where (x − c)ᵀ Q (x − c) is least, and the squared half chord, negative for a miss."""
        away, image = origins - self.center, directions @ self.matrix
        square, along = (image * directions).sum(1), (image * away).sum(1)
        return np.stack([-along / square, (along / square) ** 2 - ((away @ self.matrix * away).sum(1) - 1) / square])

    def hits(self, origins: Vectors, directions: Vectors) -> RayHits:
        """Where chords begin."""
        middle, square = self.chords(origins, directions)
        distance = middle - np.sqrt(np.maximum(square, 0.0))
        points = origins + distance[:, None] * directions
        return RayHits((square > 0) & (distance > 0), points, self.normals(points))

    def normals(self, points: Vectors) -> Vectors:
        """g/‖g‖ with g = Q (x − c), outward."""
        gradient = (points - self.center) @ self.matrix
        return gradient / np.linalg.norm(gradient, axis=1, keepdims=True)


@dataclass(frozen=True)
class EllipsoidUnknowns(ParametricSurface):
    """A shift δ of the center and a symmetric strain S, by which points p = x − c of the surface move by δ + S p."""

    surface: Ellipsoid
    count: ClassVar[int] = 9

    def hits(self, rays: PixelRays) -> MirrorHits:
        """Where p moves by V, a fixed ray has δx = d (n·V)/(n·d), δg = Q (δx − V) − S g and δn = (1 − n nᵀ) δg/‖g‖."""
        surface, first = self.surface, self.surface.hits(rays.origins, rays.directions)
        normals, points = first.normals, first.points - surface.center
        facing = (normals * rays.directions).sum(1)
        clear = first.met & (facing < -LEAST_COSINE)
        gradient, moves = points @ surface.matrix, _moves(points)
        along = np.einsum("pi,pik->pk", normals, moves) / np.where(clear, facing, -1.0)[:, None]
        change = surface.matrix @ (rays.directions[:, :, None] * along[:, None] - moves)
        change[:, :, 3:] -= _moves(gradient)[:, :, 3:]
        across = (np.eye(3) - normals[:, :, None] * normals[:, None]) / np.linalg.norm(gradient, axis=1)[:, None, None]
        distance = np.linalg.norm(first.points - rays.origins, axis=1)
        shape, columns = across @ surface.matrix, np.tile(np.arange(9), (len(facing), 1))
        return MirrorHits(clear, distance, first.points, normals, shape, across @ change, columns)

    def silhouette(self, rays: PixelRays) -> Silhouette:
        """(q − 1) q/‖g‖ in the middle of chords, with q² = pᵀ Q p, over the width of a pixel: zero on the cone of
        tangent rays, with the derivatives −n·V by the numbers and n by a shift of the ray.
        """
        surface, directions = self.surface, rays.directions
        middle = surface.chords(rays.origins, directions)[0]
        valid, middle = middle > 0, np.where(middle > 0, middle, 1.0)
        points = rays.origins + middle[:, None] * directions - surface.center
        gradient = points @ surface.matrix
        pixel = np.maximum(np.linalg.norm(gradient, axis=1), 1e-12) * middle * rays.size
        level, outward = np.sqrt((gradient * points).sum(1)), gradient / pixel[:, None]
        rows = -np.einsum("pi,pik->pk", outward, _moves(points))
        jacobian = jacobian_of_rows(rows, np.tile(np.arange(9), (len(rows), 1)), 9)
        pixels, motions = (level - 1) * level / pixel, motion_rows(outward, directions, middle)
        return Silhouette(pixels, valid.astype(float), valid, jacobian, motions)

    def stepped(self, step: Float[np.ndarray, "9"]) -> "EllipsoidUnknowns":
        """c + δ and e⁻ˢ Q e⁻ˢ, which stays positive."""
        center, back = self.surface.center + step[:3], expm(-np.tensordot(step[3:], STRAINS, 1))
        return replace(self, surface=replace(self.surface, center=center, matrix=back @ self.surface.matrix @ back))

    def taken_back(self, common: Similarity) -> "EllipsoidUnknowns":
        """As p = s R p′ has it."""
        center, turn = common.undone(self.surface.center[None])[0], common.scale * common.rotation
        return replace(self, surface=replace(self.surface, center=center, matrix=turn.T @ self.surface.matrix @ turn))

    @property
    def shape(self) -> Ellipsoid:
        """The ellipsoid."""
        return self.surface


def _moves(points: Vectors) -> Float[np.ndarray, "P 3 9"]:
    """V: unit vectors for the numbers of δ, and E p for those of S."""
    shifts = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([shifts, np.einsum("kij,pj->pik", STRAINS, points)], 2)


@dataclass(frozen=True)
class EllipsoidMirror(SeenByCenters):
    """It is convex: its pixels show the surroundings."""

    kind: ClassVar[str] = "ellipsoid"
    surface: Ellipsoid

    def mesh(self, frame: ObjectFrame) -> Mesh:
        """c + L⁻ᵀ u of the unit sphere, with Q = L Lᵀ."""
        sphere, faces = Mesh.unit_sphere()
        points = self.surface.center + sphere @ np.linalg.inv(np.linalg.cholesky(self.surface.matrix))
        return Mesh.smooth(frame.to_world(points), faces, self.surface.normals(points))


class EllipsoidFamily(ExactFamily):
    """Ellipsoids by silhouettes, then by photographs."""

    kind: ClassVar[str] = "ellipsoid"
    geometry: ClassVar[type[Geometry]] = EllipsoidMirror
    label: ClassVar[str] = "an ellipsoid"

    def propose(self, views: Views, config: FitConfig, *, requested: bool) -> Proposal | None:
        """By silhouettes alone, from a sphere of the radius 0.7 about the origin, where the object has the radius 1."""
        if len(silhouette_rays(views, longest_only=True).size):
            start = EllipsoidUnknowns(Ellipsoid(np.zeros(3), np.eye(3) / 0.7**2))
            nearest = by_silhouettes_alone(views, start)
            return Proposal.of(views, nearest.surface, nearest)
        if requested:
            raise InputError(expected="masks with a silhouette", found="none", remedy="Show the whole object.")
        return None

    def unknowns(self, views: Views, proposal: Proposal, config: FitConfig) -> EllipsoidUnknowns:
        """Of the proposed ellipsoid."""
        return EllipsoidUnknowns(proposal.shape)
