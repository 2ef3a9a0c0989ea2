"""The frame in which the object lies in the unit ball."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import Similarity


@dataclass(frozen=True)
class ObjectFrame:
    """x_normalized = (x_world − center)/radius."""

    center: Float[np.ndarray, "3"]
    radius: float
    reach: float = 1.0
    """How far from the origin, in normalized units, the object extends in some views: 1 or less is within the ball."""
    depth_is_open: bool = False
    """Whether all views look along one line, so that how far away the center is was only assumed."""

    @property
    def from_world(self) -> Similarity:
        """World points to this frame."""
        return Similarity(1 / self.radius, np.eye(3), -self.center / self.radius)

    def pose_covariance(self, in_world: Float[np.ndarray, "6 6"] | None) -> Float[np.ndarray, "6 6"] | None:
        """That of a camera's turn and shift in this frame, whose axes are the world's; None for None."""
        return None if in_world is None else self.from_world.pose_covariance(in_world)

    def to_world(self, points: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P 3"]:
        """Points of the object frame in the world."""
        return points * self.radius + self.center
