"""What a camera sees in a surface of revolution: radiance averaged over pixels, many reflections deep.

A camera averages light over the area of a pixel, and so does this: over 4×4 rays. On a smooth mirror the directions in
which neighboring pixels see the environment tell those in between,

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
from panoless.capture.views import TrainView
from panoless.geometry.revolution.model import SUBPIXELS, SurfaceOfRevolution, trace_reflections
from panoless.kernels.cubemap import sample_cubemap
from panoless.kernels.rasterize import RasterCamera

MAX_RENDER_BOUNCES = 16
"""Reflections that a render follows."""
LARGEST_BEND = 0.05
"""Second differences of directions (rad per pixel²) up to which they are interpolated."""
SUBRAYS = ((0.125, 0.625), (0.375, 0.125), (0.625, 0.875), (0.875, 0.375))
"""Column and row within a pixel: four distinct ones of either."""
ERROR_SCALE = 0.1
OFFSETS = tuple((i + 0.5) / SUBPIXELS for i in range(SUBPIXELS))


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


@dataclass(frozen=True)
class MultiBouncePixels:
    """Pixels as bundles of 2×2 rays in distinct columns and rows, pixel after pixel, and the radiance they saw."""

    origins: Float[np.ndarray, "R 3"]
    directions: Float[np.ndarray, "R 3"]
    radiance: Float[np.ndarray, "P 3"]

    @classmethod
    def of(cls, view: TrainView, pixels: Int[np.ndarray, "P"]) -> "MultiBouncePixels":
        """The given pixels (flat indices) of a view."""
        rays = [pixel_rays(view.camera, pixels, shift) for shift in SUBRAYS]
        origins, directions = (np.stack([each[part] for each in rays], 1).reshape(-1, 3) for part in (0, 1))
        seen = view.radiance.flatten(1)[:, torch.from_numpy(pixels).to(view.radiance.device)]
        return cls(origins, directions, seen.T.cpu().numpy().astype(np.float64))

    def every(self, stride: int) -> "MultiBouncePixels":
        """Every stride-th pixel."""
        rays = (each.reshape(-1, len(SUBRAYS), 3)[::stride].reshape(-1, 3) for each in (self.origins, self.directions))
        return MultiBouncePixels(next(rays), next(rays), self.radiance[::stride])

    def shown(self, surface: SurfaceOfRevolution, environment: Float[Tensor, "6 3 L L"]) -> Float[np.ndarray, "P 3"]:
        """The mean of what the rays of each pixel see; black where they miss or have not left after sixteen
        reflections.
        """
        escapes = trace_reflections(surface, self.origins, self.directions, MAX_RENDER_BOUNCES)
        left = escapes.bounces > 0
        light = np.zeros((len(left), 3))
        directions = torch.from_numpy(escapes.directions[left]).float().to(environment.device)
        light[left] = sample_cubemap(environment, directions).cpu().numpy()
        return light.reshape(-1, len(SUBRAYS), 3).mean(1)

    def error(self, surface: SurfaceOfRevolution, environment: Float[Tensor, "6 3 L L"]) -> float:
        """Mean of ‖e‖²/(‖e‖² + s²), s = 0.1, over pixels."""
        return bounded_error(self.shown(surface, environment) - self.radiance)


def bounded_error(error: Float[np.ndarray, "P 3"]) -> float:
    """Mean of ‖e‖²/(‖e‖² + s²), s = 0.1, over pixels; 1 if there are none."""
    squared = (error**2).sum(1)
    return float((squared / (squared + ERROR_SCALE**2)).mean()) if len(squared) else 1.0


def mean_light(
    surface: SurfaceOfRevolution, environment: Float[Tensor, "6 3 L L"], camera: RasterCamera, pixels: Int[Tensor, "P"]
) -> Float[Tensor, "P 3"]:
    """Radiance of pixels (flat indices): the mean over those of their 4×4 rays that meet the surface; zero if none
    does.

    A ray that has not left after sixteen reflections is black.
    """
    places = pixels.cpu().numpy()
    at, smooth = smooth_pixels(surface, camera, places, MAX_RENDER_BOUNCES)
    light = torch.zeros(len(places), 3, device=environment.device)
    light[torch.from_numpy(smooth)] = _interpolated(environment, at)
    light[torch.from_numpy(~smooth)] = _traced(surface, environment, camera, places[~smooth])
    return light


def smooth_pixels(
    surface: SurfaceOfRevolution, camera: RasterCamera, pixels: Int[np.ndarray, "P"], most: int
) -> tuple[RayDifferentials, Bool[np.ndarray, "P"]]:
    """Those of the pixels whose directions continue smoothly to their neighbors, by up to `most` reflections."""
    count = camera.height * camera.width
    directions, bounces = np.zeros((count, 3)), np.zeros(count, np.int64)
    escapes = trace_reflections(surface, *pixel_rays(camera, pixels), most)
    directions[pixels], bounces[pixels] = escapes.directions, escapes.bounces
    return _continued(directions, bounces.reshape(camera.height, camera.width), pixels)


def _interpolated(environment: Float[Tensor, "6 3 L L"], at: RayDifferentials) -> Float[Tensor, "P 3"]:
    directions = torch.cat(list(at.within([offset - 0.5 for offset in OFFSETS])))
    return sample_cubemap(environment, directions.to(environment.device)).view(SUBPIXELS**2, -1, 3).mean(0)


def _traced(
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    camera: RasterCamera,
    pixels: Int[np.ndarray, "P"],
) -> Float[Tensor, "P 3"]:
    total, count = torch.zeros(len(pixels), 3, device=environment.device), np.zeros(len(pixels))
    for row in OFFSETS:
        rays = [pixel_rays(camera, pixels, (column, row)) for column in OFFSETS]
        origins, directions = (np.concatenate([each[part] for each in rays]) for part in (0, 1))
        escapes = trace_reflections(surface, origins, directions, MAX_RENDER_BOUNCES)
        left = torch.from_numpy(escapes.bounces > 0)
        light = torch.zeros(len(left), 3, device=environment.device)
        light[left] = sample_cubemap(environment, torch.from_numpy(escapes.directions).to(light)[left])
        total += light.view(SUBPIXELS, -1, 3).sum(0)
        count += escapes.first.met.reshape(SUBPIXELS, -1).sum(0)
    return total / torch.from_numpy(np.maximum(count, 1)).to(total)[:, None]


def _continued(
    directions: Float[np.ndarray, "N 3"], bounces: Int[np.ndarray, "H W"], pixels: Int[np.ndarray, "P"]
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
        straight &= (second**2).sum(1) < LARGEST_BEND**2
    smooth = np.zeros(len(pixels), bool)
    smooth[chosen[straight]] = True
    return RayDifferentials(*(each[straight] for each in vars(found).values())), smooth
