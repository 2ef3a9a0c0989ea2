"""The ground below the object, where photographs show it past the object: light that is known before any reflection."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from panoless.capture.background import Background
from panoless.capture.masks import BESIDE_PX
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import camera_rays
from shinypartial.core.camera import Camera
from shinypartial.core.sphere import flat_texels
from shinypartial.dataset.schema import GroundPlane

SAMPLED_PIXELS = 30_000
"""About so many pixels of a view are looked at."""
LEAST_FALL = 0.05
"""Sine of the angle at which a ray has to come down on the ground."""
FARTHEST = 8.0
"""From the object's center, in its radii."""
RESOLUTION = 128
"""Texels along a face side: directions from the object in which the ground has one color."""
LEAST_SEEN = 4
"""Pixels of such a direction…"""
MOST_COUNTED = 16
"""…which count as no more pixels that mirror it."""
AGREED, AGREED_SHARE = 0.03, 0.15
"""Pixels of one place differ from their median by less, in the median: radiance, and as a share of it."""


@dataclass(frozen=True)
class Ground:
    """A stated plane in the normalized frame, and what photographs show of it."""

    up: Float[np.ndarray, "3"]
    """Its unit normal, on the object's side."""
    depth: float
    """Of the plane below the origin, in radii of the object."""
    light: Background
    """As the object's center sees it."""


@dataclass(frozen=True)
class SeenGround:
    """Points of the ground in the world that a view shows past the object, and their encoded radiance."""

    points: Float[np.ndarray, "P 3"]
    radiance: Float[np.ndarray, "P 3"]


def seen_ground(
    camera: Camera,
    radiance: Float[np.ndarray, "H W 3"],
    alpha: Float[np.ndarray, "H W"],
    shown: Float[np.ndarray, "H W"],
    plane: GroundPlane,
) -> SeenGround:
    """Of pixels outside of a mask, evenly, as far as the photograph is shown."""
    from scipy.ndimage import distance_transform_edt

    stride = max(int(np.sqrt(alpha.size / SAMPLED_PIXELS)), 1)
    beside = distance_transform_edt(alpha <= 0)[::stride, ::stride] > BESIDE_PX
    beside &= shown[::stride, ::stride] >= 1
    row, column = (stride * each + 0.5 for each in np.nonzero(beside))
    directions = camera_rays(camera, column, row) @ camera.camera_to_world[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    normal, position = np.array(plane.normal), camera.position_world
    fall, height = -directions @ normal, float(normal @ position) - plane.offset
    falls = fall > LEAST_FALL if height > 0 else np.zeros(len(fall), dtype=bool)
    points = position + (height / fall[falls])[:, None] * directions[falls]
    return SeenGround(points.astype(np.float32), radiance[::stride, ::stride][beside][falls].astype(np.float32))


def ground_of(plane: GroundPlane, frame: ObjectFrame, seen: Sequence[SeenGround]) -> Ground | None:
    """What views agree on; None where the object's center is not above the plane.

    A direction from the center has the median color of its pixels, if at least half of these differ little from it:
    what stands on the ground, or lies behind its end, is seen elsewhere by each view.
    """
    known = plane.moved(frame.from_world)
    if known.offset >= 0:
        return None
    places = frame.from_world(np.concatenate([each.points for each in seen]).astype(np.float64))
    near = np.linalg.norm(places, axis=1) < FARTHEST
    directions = places[near] / np.linalg.norm(places[near], axis=1, keepdims=True)
    radiance = np.concatenate([each.radiance for each in seen])[near]
    texels = flat_texels(directions, RESOLUTION)
    _, group, counts = np.unique(texels, return_inverse=True, return_counts=True)
    color = _medians(radiance, group, counts)
    spread = _medians(np.abs(radiance - color[group]), group, counts)
    agreed = (counts >= LEAST_SEEN) & (spread < AGREED + AGREED_SHARE * color).all(1)
    sums = np.stack([np.bincount(group, part) for part in directions.T], 1)
    parts = sums / np.linalg.norm(sums, axis=1, keepdims=True), color, np.minimum(counts, MOST_COUNTED)
    light = Background(*(torch.from_numpy(each[agreed]).float() for each in parts))
    return Ground(np.array(known.normal), -known.offset, light)


def _medians(
    values: Float[np.ndarray, "P 3"], group: Int[np.ndarray, "P"], counts: Int[np.ndarray, "G"]
) -> Float[np.ndarray, "G 3"]:
    """The lower median of each channel of each group."""
    middle = np.cumsum(counts) - counts + (counts - 1) // 2
    return np.stack([part[np.lexsort((part, group))][middle] for part in values.T], 1)
