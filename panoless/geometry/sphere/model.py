"""A sphere, and which directions it mirrors."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.capture.rays import pixel_rays
from panoless.environment.surroundings import FAR, Surroundings
from panoless.geometry.base import RayHits
from panoless.geometry.exact import reflected
from panoless.kernels.camera import RasterCamera
from shinypartial.core.conventions import PIXEL_CENTER
from shinypartial.io.threads import in_threads

CENTER = (PIXEL_CENTER, PIXEL_CENTER)


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

    def hits(self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]) -> RayHits:
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
        return RayHits((room > 0) & (distance > 0), points, normals)


def mirrored(
    sphere: Sphere, camera: RasterCamera, pixels: Int[np.ndarray, "P"], places: list[tuple[float, float]]
) -> tuple[Float[np.ndarray, "P K 3"], Bool[np.ndarray, "P K"]]:
    """Where in the map rays through those places of pixels (flat indices) look, and which of them meet the sphere."""
    found = list(in_threads(lambda place: reflected(sphere, *pixel_rays(camera, pixels, place)), places))
    return np.stack([each[0] for each in found], 1), np.stack([each[1] for each in found], 1)
