"""The frame in which the object lies in the unit ball."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class ObjectFrame:
    """x_normalized = (x_world − center)/radius."""

    center: Float[np.ndarray, "3"]
    radius: float
    reach: float = 1.0
    """How far from the origin, in normalized units, the object extends in some views: 1 or less is within the ball."""
