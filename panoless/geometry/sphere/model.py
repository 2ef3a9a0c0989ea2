"""A sphere, what a camera sees of it, and which directions it mirrors."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.capture.rays import pixel_rays, pose_of, reflect
from panoless.environment.surroundings import FAR, Surroundings
from panoless.geometry.base import SurfaceBuffers, beside_outline, buffers_from_arrays
from panoless.kernels.camera import RasterCamera
from shinypartial.core.conventions import PIXEL_CENTER
from shinypartial.io.threads import in_threads

CENTER = (PIXEL_CENTER, PIXEL_CENTER)


@dataclass(frozen=True)
class SphereHits:
    """Where rays meet a sphere; of those that miss it, where they come nearest to it."""

    met: Bool[np.ndarray, "P"]
    points: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]
    """Unit, outward."""


@dataclass(frozen=True)
class Sphere:
    """‖x − c‖ = ρ in the normalized frame, seen from outside."""

    center: Float[np.ndarray, "3"]
    radius: float
    surroundings: Surroundings = FAR
    """What it stands in."""

    @property
    def num_parameters(self) -> int:
        """How many numbers it is made of: four."""
        return 4

    def moved(self, step: Float[np.ndarray, "4"]) -> "Sphere":
        """With its center shifted and its radius changed."""
        return replace(self, center=self.center + step[:3], radius=self.radius + float(step[3]))

    def hits(self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]) -> SphereHits:
        """The first hit of every ray; directions of any length.

        With u the unit direction and p = c − o, the ray passes at p⊥ = p − (p·u) u from the center and meets the
        sphere at the distance p·u − √(ρ² − ‖p⊥‖²).
        """
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        toward = self.center - origins
        along = (toward * unit).sum(1)
        room = self.radius**2 - (toward**2).sum(1) + along**2
        distance = along - np.sqrt(np.maximum(room, 0.0))
        points = origins + distance[:, None] * unit
        normals = points - self.center
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return SphereHits((room > 0) & (distance > 0), points, normals)


def sphere_buffers(sphere: Sphere, camera: RasterCamera, samples: int) -> SurfaceBuffers:
    """Depth and normals of rays through pixel centers; alpha the share of `samples`² rays that hit, at the outline.

    Where only the center misses, depth and normal are those of where its ray comes nearest.
    """
    shape, (rotation, center) = (camera.height, camera.width), pose_of(camera)
    everything = np.arange(camera.height * camera.width)
    hits = sphere.hits(*pixel_rays(camera, everything))
    alpha = hits.met.astype(np.float64)
    mixed = np.flatnonzero(beside_outline(hits.met.reshape(shape)))
    alpha[mixed] = met_within(sphere, camera, mixed, samples).mean(1)
    covered = alpha > 0
    depth = ((hits.points - center) @ rotation[2]) * covered
    normals = (hits.normals * covered[:, None]) @ rotation.T
    return buffers_from_arrays(alpha.reshape(shape), depth.reshape(shape), normals.T.reshape(3, *shape), camera)


def met_within(
    sphere: Sphere, camera: RasterCamera, pixels: Int[np.ndarray, "P"], samples: int
) -> Bool[np.ndarray, "P K"]:
    """Which of the rays through the middles of `samples`² parts of pixels (flat indices) meet a sphere."""
    return np.stack([sphere.hits(*pixel_rays(camera, pixels, place)).met for place in parts_of_pixel(samples)], 1)


def parts_of_pixel(samples: int) -> list[tuple[float, float]]:
    """The middles of the parts of a pixel, so many along a side."""
    return [((i + 0.5) / samples, (j + 0.5) / samples) for j, i in np.ndindex(samples, samples)]


def mirrored(
    sphere: Sphere, camera: RasterCamera, pixels: Int[np.ndarray, "P"], places: list[tuple[float, float]]
) -> tuple[Float[np.ndarray, "P K 3"], Bool[np.ndarray, "P K"]]:
    """Where in the map rays through those places of pixels (flat indices) look, and which of them meet the sphere."""
    found = list(in_threads(lambda place: _mirrored_at(sphere, *pixel_rays(camera, pixels, place)), places))
    return np.stack([each[0] for each in found], 1), np.stack([each[1] for each in found], 1)


def _mirrored_at(
    sphere: Sphere, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]
) -> tuple[Float[np.ndarray, "P 3"], Bool[np.ndarray, "P"]]:
    hits = sphere.hits(origins, directions)
    outgoing = reflect(directions / np.linalg.norm(directions, axis=1, keepdims=True), hits.normals)
    return sphere.surroundings.looked_up(hits.points, outgoing), hits.met
