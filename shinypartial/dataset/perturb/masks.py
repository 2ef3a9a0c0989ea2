"""Wrong masks: silhouettes moved, holes, blobs. An alpha is the share of each pixel that the mask covers."""

import math

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.conventions import PIXEL_CENTER

#: Steps along and between the rings on which an erosion looks for the smallest alpha.
RING_STEP_PX = 0.5
#: Radius of holes and blobs as a share of that of a disk with the object's area; the last ones are smaller.
BLOB_RADIUS = 0.15
#: Standard deviation of the Gaussian that smooths what a silhouette wanders by: it changes sign every 20 pixels or so.
WOBBLE_LENGTH_PX = 6.0


def eroded(alpha: Float[np.ndarray, "H W"], radius_px: float) -> Float[np.ndarray, "H W"]:
    """Smallest alpha within a disk about each pixel, bilinear between pixels; the picture's border is no silhouette.

    The silhouette moves inward by the radius, which may be fractional.
    """
    reach = math.ceil(radius_px) + 1
    padded, smallest = np.pad(alpha, reach, mode="edge"), alpha
    for radius in np.arange(radius_px, 0, -1.0):
        count = max(8, math.ceil(2 * math.pi * radius / RING_STEP_PX))
        for angle in 2 * math.pi * np.arange(count) / count:
            smallest = np.minimum(smallest, _shifted(padded, radius * math.sin(angle), radius * math.cos(angle), reach))
    return smallest


def _shifted(padded: Float[np.ndarray, "_H _W"], down: float, right: float, margin: int) -> Float[np.ndarray, "H W"]:
    """What lies that far from each pixel of the picture inside the margin."""
    row, column = math.floor(down), math.floor(right)
    height, width = (side - 2 * margin for side in padded.shape)
    top, left = margin + row, margin + column
    corner = padded[top : top + height + 1, left : left + width + 1]
    below, beside = padded.dtype.type(down - row), padded.dtype.type(right - column)
    rows = corner[:-1] * (1 - below) + corner[1:] * below
    return rows[:, :-1] * (1 - beside) + rows[:, 1:] * beside


def dilated(alpha: Float[np.ndarray, "H W"], radius_px: float) -> Float[np.ndarray, "H W"]:
    """Largest alpha within a disk about each pixel: the erosion of what the mask leaves out."""
    return 1 - eroded(1 - alpha, radius_px)


def wobbling(alpha: Float[np.ndarray, "H W"], sigma_px: float, random: np.random.Generator) -> Float[np.ndarray, "H W"]:
    """The mask by a smooth random shift of each pixel, whose parts have this standard deviation: so has that along the
    normal of a silhouette.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates

    noise = np.stack([gaussian_filter(random.standard_normal(alpha.shape), WOBBLE_LENGTH_PX) for _ in range(2)])
    # Of white noise under that filter.
    places = np.indices(alpha.shape) + sigma_px * noise * (2 * math.sqrt(math.pi) * WOBBLE_LENGTH_PX)
    wandered: np.ndarray = map_coordinates(alpha, places, order=1, mode="nearest")
    return wandered.astype(alpha.dtype)


def with_holes(alpha: Float[np.ndarray, "H W"], share: float, random: np.random.Generator) -> Float[np.ndarray, "H W"]:
    """The mask less round holes about random points of the object, which take this share of its area together."""
    area = float(alpha.sum())
    return alpha * (1 - _blobs(alpha, share * area, area, random))


def with_stray_blobs(
    alpha: Float[np.ndarray, "H W"], share: float, random: np.random.Generator
) -> Float[np.ndarray, "H W"]:
    """The mask with round blobs about random points outside, which add this share of its area together."""
    area = float(alpha.sum())
    return alpha + (1 - alpha) * _blobs(1 - alpha, share * area, area, random)


def _blobs(
    room: Float[np.ndarray, "H W"], target: float, area: float, random: np.random.Generator
) -> Float[np.ndarray, "H W"]:
    """A mask of disks about random pixels of what is left of `room`, until they cover `target` pixels of it."""
    covered = np.zeros_like(room)
    largest = BLOB_RADIUS * math.sqrt(area / math.pi)
    while True:
        missing = target - float((room * covered).sum())
        free: Bool[np.ndarray, "H W"] = room * (1 - covered) > 0.5
        if missing < 0.5 or not free.any():
            return covered
        center = np.argwhere(free)[random.integers(free.sum())] + PIXEL_CENTER
        disk = _disk(room.shape, center, min(largest, math.sqrt(missing / math.pi)))
        covered = np.maximum(covered, disk.astype(room.dtype))


def _disk(shape: tuple[int, ...], center: Float[np.ndarray, "2"], radius: float) -> Float[np.ndarray, "H W"]:
    """A disk with a silhouette one pixel wide, at least its middle pixel."""
    row, column = np.indices(shape) + PIXEL_CENTER
    return np.clip(radius + 0.5 - np.hypot(row - center[0], column - center[1]), 0, 1)
