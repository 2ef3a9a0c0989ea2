"""A sphere as a surface of few numbers: center and radius."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from panoless.geometry.sphere.model import Sphere
from panoless.numeric.gauss_newton import jacobian_of_rows
from panoless.problem.parametric import LEAST_COSINE, MirrorHits, ParametricSurface, Regularization, Silhouette
from panoless.problem.rays import PixelRays
from shinypartial.core.camera import Similarity


@dataclass(frozen=True)
class SphereUnknowns(ParametricSurface):
    """c and ρ, the radius where it is not known."""

    sphere: Sphere
    radius_known: bool = False

    @property
    def shape(self) -> Sphere:
        """The sphere."""
        return self.sphere

    @property
    def count(self) -> int:
        """Four."""
        return 4

    def hits(self, rays: PixelRays) -> MirrorHits:
        """n = (x − c)/ρ with S = 1/ρ; at a fixed ray x moves by d (n·δc + δρ)/(n·d)."""
        found, directions = self.sphere.hits(rays.origins, rays.directions), rays.directions
        facing = (found.normals * directions).sum(1)
        clear = found.met & (facing < -LEAST_COSINE)
        by_numbers = np.concatenate([found.normals, np.ones((len(facing), 1))], 1)
        rows = directions[:, :, None] * (by_numbers / np.where(clear, facing, -1.0)[:, None])[:, None]
        rows[:, :, :3] -= np.eye(3)
        rows[:, :, 3] -= found.normals
        rows /= self.sphere.radius
        if self.radius_known:
            rows[:, :, 3] = 0.0
        distance = np.linalg.norm(found.points - rays.origins, axis=1)
        shape = np.tile(np.eye(3) / self.sphere.radius, (len(facing), 1, 1))
        columns = np.tile(np.arange(4), (len(facing), 1))
        return MirrorHits(clear, distance, found.points, found.normals, shape, rows, columns)

    def silhouette(self, rays: PixelRays) -> Silhouette:
        """β − α in pixels, and its derivatives. With p = c − o, β is the angle between a ray r and p, and that of a ray
        that touches is α = arcsin(ρ/‖p‖):

        ∂β/∂c = ((p·r) p⊥/‖p⊥‖ − ‖p⊥‖ r)/‖p‖², ∂α/∂(c, ρ) = (−ρ p/‖p‖², 1)/√(‖p‖² − ρ²).

        The angle stays where all is scaled about a camera, so one view moves nothing along what it leaves open.
        """
        directions, radius, toward = rays.directions, self.sphere.radius, self.sphere.center - rays.origins
        square, along = ((toward * each).sum(1, keepdims=True) for each in (toward, directions))
        passing = toward - along * directions
        across = np.maximum(np.linalg.norm(passing, axis=1, keepdims=True), 1e-12)
        room = np.sqrt(np.maximum(square - radius**2, 1e-12))
        angle = np.arctan2(across, along) - np.arcsin(np.clip(radius / np.sqrt(square), -1, 1))
        by_center = (along * passing / across - across * directions) / square + radius * toward / square / room
        by_radius = -(not self.radius_known) / room
        by_turn = -np.cross(directions, passing / across)
        rows = np.concatenate([angle, by_center, by_radius, by_turn, -by_center], 1) / rays.size[:, None]
        columns, seen = np.tile(np.arange(4), (len(rays.size), 1)), np.ones(len(rays.size), dtype=bool)
        return Silhouette(rows[:, 0], seen.astype(float), seen, jacobian_of_rows(rows[:, 1:5], columns, 4), rows[:, 5:])

    def regularization(self, matrix: Float[np.ndarray, "4 4"]) -> Regularization:
        """A radius that is known stays."""
        known = np.zeros((4, 4))
        known[3, 3] = self.radius_known * max(float(np.trace(matrix)), 1.0)
        return Regularization(known)

    def stepped(self, step: Float[np.ndarray, "4"]) -> "SphereUnknowns":
        """Moved."""
        return SphereUnknowns(self.sphere.moved(step), self.radius_known)

    def taken_back(self, common: Similarity) -> "SphereUnknowns":
        """Moved and scaled; a radius that is known stays."""
        center, scale = common.undone(self.sphere.center[None])[0], 1.0 if self.radius_known else common.scale
        return SphereUnknowns(replace(self.sphere, center=center, radius=self.sphere.radius / scale), self.radius_known)
