"""What a camera sees in a surface of revolution: radiance averaged over pixels, many reflections deep.

A camera averages light over the area of a pixel, and so does this: over a grid of rays. On a smooth mirror the
directions in which neighboring pixels see the environment determine those in between,

ω(a, b) = ω + a ω_x + b ω_y + ½ a² ω_xx + ½ b² ω_yy + a b ω_xy,

with central differences and |a|, |b| < ½; rays are traced only where neighbors disagree.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.rays import pixel_rays
from panoless.geometry.revolution.model import MAX_BOUNCES, SurfaceOfRevolution, trace_reflections
from panoless.kernels.camera import RasterCamera
from panoless.kernels.cubemap import sample_cubemap

SAMPLES = 4
"""Rays along either side of a pixel: a box filter, as in the data sets."""
LARGEST_BEND = 0.05
"""Second differences of directions (rad per pixel²) up to which they are interpolated between pixels."""


@dataclass(frozen=True)
class RayDifferentials:
    """Directions of pixels and their differences along columns (x) and rows (y)."""

    center: Float[np.ndarray, "P 3"]
    x: Float[np.ndarray, "P 3"]
    y: Float[np.ndarray, "P 3"]
    xx: Float[np.ndarray, "P 3"]
    yy: Float[np.ndarray, "P 3"]
    xy: Float[np.ndarray, "P 3"]

    def within(self, offsets: Sequence[float]) -> Iterator[Float[Tensor, "P 3"]]:
        """Directions, about unit, at all pairs of offsets from the pixels' centers."""
        center, x, y, xx, yy, xy = (torch.from_numpy(each).float() for each in vars(self).values())
        for b in offsets:
            in_row, slope = center + b * y + b * b / 2 * yy, x + b * xy
            for a in offsets:
                yield in_row + a * slope + a * a / 2 * xx


def mean_light(
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    camera: RasterCamera,
    pixels: Int[Tensor, "P"],
    *,
    largest_bend: float = LARGEST_BEND,
) -> Float[Tensor, "P 3"]:
    """Radiance of pixels (flat indices): the mean over those of their rays that meet the surface; zero if none does.

    A ray that has not left after the last reflection is black.
    """
    places = pixels.cpu().numpy()
    at, smooth = smooth_pixels(surface, camera, places, largest_bend, max_bounces=MAX_BOUNCES)
    light = torch.zeros(len(places), 3, device=environment.device)
    light[torch.from_numpy(smooth)] = _interpolated(environment, at)
    light[torch.from_numpy(~smooth)] = _traced(surface, environment, camera, places[~smooth])
    return light


def smooth_pixels(
    surface: SurfaceOfRevolution,
    camera: RasterCamera,
    pixels: Int[np.ndarray, "P"],
    largest_bend: float,
    *,
    max_bounces: int = 1,
    occlusion_test: bool = True,
) -> tuple[RayDifferentials, Bool[np.ndarray, "P"]]:
    """Those of the pixels whose directions continue smoothly to their neighbors (see `trace_reflections`)."""
    count = camera.height * camera.width
    directions, bounces = np.zeros((count, 3)), np.zeros(count, np.int64)
    rays = pixel_rays(camera, pixels)
    paths = trace_reflections(surface, *rays, max_bounces=max_bounces, occlusion_test=occlusion_test)
    directions[pixels], bounces[pixels] = paths.directions, paths.bounces
    return _continued(directions, bounces.reshape(camera.height, camera.width), pixels, largest_bend)


def _offsets(samples: int) -> list[float]:
    return [(i + 0.5) / samples for i in range(samples)]


def _interpolated(environment: Float[Tensor, "6 3 L L"], at: RayDifferentials) -> Float[Tensor, "P 3"]:
    directions = torch.cat(list(at.within([offset - 0.5 for offset in _offsets(SAMPLES)])))
    light = sample_cubemap(environment, directions.to(environment.device))
    return light.view(SAMPLES**2, -1, 3).mean(0)


def _traced(
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    camera: RasterCamera,
    pixels: Int[np.ndarray, "P"],
) -> Float[Tensor, "P 3"]:
    total, count = torch.zeros(len(pixels), 3, device=environment.device), np.zeros(len(pixels))
    offsets = _offsets(SAMPLES)
    for row in offsets:
        rays = [pixel_rays(camera, pixels, (column, row)) for column in offsets]
        origins, directions = (np.concatenate([each[part] for each in rays]) for part in (0, 1))
        paths = trace_reflections(surface, origins, directions, max_bounces=MAX_BOUNCES)
        left = torch.from_numpy(paths.bounces > 0)
        light = torch.zeros(len(left), 3, device=environment.device)
        light[left] = sample_cubemap(environment, torch.from_numpy(paths.directions).to(light)[left])
        total += light.view(len(offsets), -1, 3).sum(0)
        count += paths.first.met.reshape(len(offsets), -1).sum(0)
    return total / torch.from_numpy(np.maximum(count, 1)).to(total)[:, None]


def _continued(
    directions: Float[np.ndarray, "N 3"],
    bounces: Int[np.ndarray, "H W"],
    pixels: Int[np.ndarray, "P"],
    largest_bend: float,
) -> tuple[RayDifferentials, Bool[np.ndarray, "P"]]:
    """Differences at those of the pixels that continue smoothly to all eight neighbors, and which these are."""
    height, width = bounces.shape
    row, column = np.divmod(pixels, width)
    inside = np.flatnonzero((row > 0) & (row < height - 1) & (column > 0) & (column < width - 1))
    own = bounces.ravel()[pixels[inside]]
    alike = own > 0
    for shift in (-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1):
        alike &= bounces.ravel()[pixels[inside] + shift] == own
    chosen = inside[alike]
    at = pixels[chosen]
    center, left, right, above, below = (directions[at + shift] for shift in (0, -1, 1, -width, width))
    corners = [directions[at + shift] for shift in (width + 1, width - 1, -width + 1, -width - 1)]
    found = RayDifferentials(
        center,
        (right - left) / 2,
        (below - above) / 2,
        right - 2 * center + left,
        below - 2 * center + above,
        (corners[0] - corners[1] - corners[2] + corners[3]) / 4,
    )
    straight = np.ones(len(chosen), bool)
    for second in (found.xx, found.yy, found.xy):
        straight &= (second**2).sum(1) < largest_bend**2
    smooth = np.zeros(len(pixels), bool)
    smooth[chosen[straight]] = True
    return RayDifferentials(*(each[straight] for each in vars(found).values())), smooth
