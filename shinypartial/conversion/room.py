"""A proxy of near surroundings, as engines want it to project a light probe onto: a box, or a sphere."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.core.conventions import Y_UP_TO_WORLD
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions, latlong_solid_angles
from shinypartial.prediction.format import INVERSE_DISTANCE, read_inverse_distance

#: Directions within this angle of an axis determine where the wall across it is; not tuned.
WALL_DEG = 30.0
#: 1/D below which a direction is open, in inverse scene units; not tuned.
LEAST_INVERSE = 1e-6


def room_of(prediction: Path) -> dict[str, Any]:
    """The content of room.json, about Y-up axes; InputError when the prediction takes its surroundings to be far."""
    inverse = read_inverse_distance(prediction)
    if inverse is None or not (inverse > LEAST_INVERSE).any():
        raise InputError(
            expected=f"near surroundings, {INVERSE_DISTANCE} in {prediction}, for --to room",
            found="surroundings that are infinitely far",
            remedy="Leave room out: a probe at infinity needs no proxy.",
        )
    low, high = box_of(inverse)
    weights = latlong_solid_angles(len(inverse))
    return {
        "probe": [0.0, 0.0, 0.0],
        "box_min": low.tolist(),
        "box_max": high.tolist(),
        "sphere_radius": float(1 / max((inverse * weights).sum() / weights.sum(), LEAST_INVERSE)),
        "axes": "right-handed, +Y up, as in glTF; (x, y, z) is (x, -z, y) in the world of the dataset; scene units",
        "use": "box projection: from the point p in the direction d, look up the cube map in p + t d - probe, "
        "where p + t d leaves the box",
    }


def box_of(inverse_distance: Float[np.ndarray, "H W"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Lowest and highest corner, about Y-up axes: a wall at the median of (ω·a)/κ(ω) of directions ω near its axis a.

    Exact for the walls of a box about the origin. An axis without a wall in sight is open as far as the farthest wall.
    Raises InputError where no axis has one.
    """
    directions, distances = latlong_directions(len(inverse_distance)) @ Y_UP_TO_WORLD, []
    for axis in np.concatenate([-np.eye(3), np.eye(3)]):
        cosine = directions @ axis
        seen = (cosine > np.cos(np.radians(WALL_DEG))) & (inverse_distance > LEAST_INVERSE)
        distances.append(float(np.median(cosine[seen] / inverse_distance[seen])) if seen.any() else np.nan)
    if np.isnan(distances).all():
        raise InputError(
            expected=f"near surroundings within {WALL_DEG:.0f}° of an axis, for --to room",
            found="only some that no wall of a box stands for",
            remedy="Leave room out.",
        )
    walls = np.where(np.isnan(distances), np.nanmax(distances), distances)
    return -walls[:3], walls[3:]
