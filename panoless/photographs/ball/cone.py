"""A ball of radius 1 before a camera: the circular cone of the rays that touch it, and what it mirrors.

The camera's frame has OpenCV axes. The ball's center lies at d a, a being a unit vector, and sin α = 1/d is the sine of
half the angle of its cone. A ray v meets the ball with the unit normal n where d a + n is parallel to v, and leaves it
along ω = v − 2 (v·n) n.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.sphere import tangents

NEWTON_STEPS = 8
"""For the angle φ of n from −a where ω is: 2 φ + atan(sin φ/(d − cos φ)) = π − ∠(a, ω), whose left side is concave."""


@dataclass(frozen=True)
class Sighting:
    """Rays of a camera that meet a ball; of those that miss it, where they come nearest."""

    rays: Float[np.ndarray, "*P 3"]
    """Unit, in the camera's frame."""
    normals: Float[np.ndarray, "*P 3"]
    """Unit, outward: also where on the ball they are, in radii from its center."""
    directions: Float[np.ndarray, "*P 3"]
    """ω, unit, in the camera's frame."""
    met: Bool[np.ndarray, "*P"]

    @property
    def cosines(self) -> Float[np.ndarray, "*P"]:
        """−v·n: 1 in the middle of the ball, 0 at its rim."""
        return -(self.rays * self.normals).sum(-1)


@dataclass(frozen=True)
class BallCone:
    """Where a ball is in a camera's frame."""

    axis: Float[np.ndarray, "3"]
    """a, unit."""
    distance: float
    """d, in radii of the ball, above 1."""

    @property
    def half_angle(self) -> float:
        """α in rad."""
        return float(np.arcsin(1 / self.distance))

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Of the ball."""
        return self.distance * self.axis

    @cached_property
    def across(self) -> Float[np.ndarray, "2 3"]:
        """Unit vectors across the axis and one another."""
        return np.stack(tangents(self.axis))

    @cached_property
    def facing(self) -> Float[np.ndarray, "3 3"]:
        """Rows of a rotation from the camera's frame: +Z back toward the camera, +Y near the camera's."""
        back = -self.axis
        right = np.cross([0.0, 1.0, 0.0], back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back])

    def moved(self, step: Float[np.ndarray, "3"]) -> "BallCone":
        """With the axis turned by so many rad along both vectors across it, and α wider by so many."""
        axis = self.axis + step[:2] @ self.across
        return BallCone(axis / np.linalg.norm(axis), float(1 / np.sin(np.clip(self.half_angle + step[2], 1e-3, 1.5))))

    def turned(self, rotation: Float[np.ndarray, "3 3"]) -> "BallCone":
        """In another frame of the same camera."""
        return replace(self, axis=rotation @ self.axis)

    def along(self, rays: Float[np.ndarray, "*P 3"]) -> Sighting:
        """What unit rays meet."""
        middle = rays @ self.center
        room = 1 - self.distance**2 + middle**2
        normals = (middle - np.sqrt(np.maximum(room, 0)))[..., None] * rays - self.center
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        mirrored = rays - 2 * (rays * normals).sum(-1, keepdims=True) * normals
        return Sighting(rays, normals, mirrored, (room > 0) & (middle > 0))

    def toward(self, directions: Float[np.ndarray, "*P 3"]) -> Sighting:
        """The rays that leave the ball along unit directions: none leaves within α of a, what the ball itself hides."""
        middle = directions @ self.axis
        aside = directions - middle[..., None] * self.axis
        sine = np.linalg.norm(aside, axis=-1)
        target, d = np.pi - np.arctan2(sine, middle), self.distance
        place = target / (2 + 1 / (d - 1))
        for _ in range(NEWTON_STEPS):
            turned = 2 * place + np.arctan2(np.sin(place), d - np.cos(place))
            slope = 2 + (d * np.cos(place) - 1) / (d**2 - 2 * d * np.cos(place) + 1)
            place = np.minimum(place + (target - turned) / slope, np.pi / 2 - self.half_angle)
        aside /= np.maximum(sine, 1e-12)[..., None]
        normals = np.sin(place)[..., None] * aside - np.cos(place)[..., None] * self.axis
        rays = self.center + normals
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return Sighting(rays, normals, directions, directions @ self.axis < np.cos(self.half_angle))
