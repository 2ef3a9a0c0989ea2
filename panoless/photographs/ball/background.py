"""What lies past a ball in its pictures, as data for the map: light in directions from the ball's center.

The surroundings are taken to be a sphere of radius W about the ball, the one at which direct and mirrored views agree
best. In the direction ω lies X = W ω, and a camera sees it at R X + c. What a mirror takes from all light is left to
the fit: it scales this map to what is mirrored.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from panoless.photographs.ball.beside import PosedBall, beside
from panoless.photographs.lens import opencv
from shinypartial.core.sphere import latlong_directions
from shinypartial.io.images import write_exr

ROWS = 512
"""Of the lat-long map: 0.35°."""
FARTHEST = 1e6
"""Radii, of surroundings that are infinitely far."""


def write_background(
    path: Path, balls: Sequence[PosedBall], lights: Sequence[Float[np.ndarray, "H W 3"]], distance: float
) -> None:
    """Write an RGBA EXR in lat-long: mean linear light of the views, and alpha 1 where any sees past the ball."""
    light, seen = past_balls(balls, lights, distance)
    planes = {name: light[..., k].astype(np.float32) for k, name in enumerate("RGB")}
    write_exr(path, {**planes, "A": seen.astype(np.float32)})


def past_balls(
    balls: Sequence[PosedBall], lights: Sequence[Float[np.ndarray, "H W 3"]], distance: float
) -> tuple[Float[np.ndarray, "R C 3"], Bool[np.ndarray, "R C"]]:
    """Mean linear light by direction from the ball's center, of the views that see it; 0 where none does.

    `lights` are the views' linear light, NaN where they show none; `distance` is W in radii.
    """
    cv2, points = opencv(), min(distance, FARTHEST) * latlong_directions(ROWS)
    total, count = np.zeros(points.shape), np.zeros(points.shape[:2])
    for ball, light in zip(balls, lights, strict=True):
        placed = points @ ball.rotation.T + ball.cone.center
        rays = placed / np.linalg.norm(placed, axis=-1, keepdims=True)
        scale = min(ROWS / np.pi / ball.lens.fx, 1.0)
        small = cv2.resize(light, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        pixels = (ball.lens.project(rays) * scale - 0.5).astype(np.float32)
        values = cv2.remap(
            small, pixels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=[np.nan] * 3
        )
        good = np.isfinite(values).all(-1) & (rays[..., 2] > 0) & beside(ball, rays)
        total[good] += values[good]
        count += good
    return total / np.maximum(count, 1)[..., None], count > 0
