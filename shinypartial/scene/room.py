"""The room whose walls carry the world's light, where they are at a finite distance."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

RoomShape = Literal["sphere", "box"]


@dataclass(frozen=True)
class Room:
    """A sphere or a box about the origin; `distance` is that of the nearest wall, floor or ceiling, in scene units."""

    shape: RoomShape
    distance: float
    proportions: tuple[float, float, float]
    """Of a box along X, Y and Z, in any unit; a sphere has none."""

    @property
    def half_sizes(self) -> Float[np.ndarray, "3"]:
        """How far the room reaches along each axis."""
        sizes = np.array(self.proportions if self.shape == "box" else (1.0, 1.0, 1.0))
        return self.distance * sizes / sizes.min()

    def inverse_distance(self, directions: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
        """1/D from the origin to the wall in unit directions d: in a box with half sizes h it is max |dᵢ|/hᵢ."""
        if self.shape == "sphere":
            return np.full(directions.shape[:-1], 1 / self.distance)
        return np.max(np.abs(directions) / self.half_sizes, -1)

    def holds(self, points: Float[np.ndarray, "P 3"], margin: float) -> bool:
        """Whether all points lie inside, no wall nearer than the margin."""
        if self.shape == "sphere":
            return bool(np.linalg.norm(points, axis=-1).max() + margin < self.distance)
        return bool((np.abs(points) + margin < self.half_sizes).all())
