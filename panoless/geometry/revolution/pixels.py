"""Pixels as areas: a few rays each, followed to the environment, and the radiance that the pixel saw.

A pixel's prediction is the mean over its K rays, c = 1/K Σₖ E(ωₖ).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.rays import pixel_rays
from panoless.capture.views import TrainView, Views, concatenated, every_kth_pixel
from panoless.environment.mirrored import radiance_of
from panoless.geometry.revolution.model import ReflectionPaths, SurfaceOfRevolution, trace_reflections
from panoless.numeric.robust import bounded_error
from shinypartial.core.conventions import PIXEL_CENTER

JUDGED_SCALE = 0.1
"""Scale s of the errors ‖e‖²/(‖e‖² + s²) by which held-out views judge."""

CENTER = ((PIXEL_CENTER, PIXEL_CENTER),)
FOUR = ((0.125, 0.625), (0.375, 0.125), (0.625, 0.875), (0.875, 0.375))
"""Places (column, row) within a pixel: every column and every row of a 4×4 grid once."""


@dataclass(frozen=True)
class PixelBundles:
    """Pixels as bundles of K rays (pixel after pixel, camera depth 1) and the radiance that each saw."""

    origins: Float[np.ndarray, "R 3"]
    directions: Float[np.ndarray, "R 3"]
    radiance: Float[np.ndarray, "P 3"]

    @classmethod
    def of(
        cls,
        chosen: Iterable[tuple[TrainView, Int[np.ndarray, "_"]]],
        places: Sequence[tuple[float, float]] = FOUR,
    ) -> "PixelBundles":
        """The chosen pixels (flat indices) of each view."""
        parts = []
        for view, pixels in chosen:
            rays = [pixel_rays(view.camera, pixels, place) for place in places]
            origins, directions = (np.stack([each[part] for each in rays], 1).reshape(-1, 3) for part in (0, 1))
            seen = view.radiance_at(torch.from_numpy(pixels)).cpu().numpy()
            parts.append(cls(origins, directions, seen.astype(np.float64)))
        return concatenated(parts)

    @property
    def rays_per_pixel(self) -> int:
        """K."""
        return max(len(self.directions) // max(len(self.radiance), 1), 1)

    def at_most(self, count: int) -> "PixelBundles":
        """Every k-th pixel, so that about `count` remain."""
        stride, rays = max(1, len(self.radiance) // count), self.rays_per_pixel
        origins, directions = (
            each.reshape(-1, rays, 3)[::stride].reshape(-1, 3) for each in (self.origins, self.directions)
        )
        return PixelBundles(origins, directions, self.radiance[::stride])

    def trace(self, surface: SurfaceOfRevolution, max_bounces: int) -> ReflectionPaths:
        """Where all rays go."""
        return trace_reflections(surface, self.origins, self.directions, max_bounces=max_bounces)

    def mean_light(self, paths: ReflectionPaths, environment: Float[Tensor, "6 3 L L"]) -> Float[np.ndarray, "P 3"]:
        """What each pixel shows of a map; rays that miss or have not left are black."""
        left = paths.bounces > 0
        light = np.zeros((len(left), 3))
        light[left] = radiance_of(environment, paths.directions[left])
        return light.reshape(-1, self.rays_per_pixel, 3).mean(1)

    def shown(
        self, surface: SurfaceOfRevolution, environment: Float[Tensor, "6 3 L L"], max_bounces: int
    ) -> Float[np.ndarray, "P 3"]:
        """What each pixel shows of a map in a surface."""
        return self.mean_light(self.trace(surface, max_bounces), environment)

    def error(
        self, surface: SurfaceOfRevolution, environment: Float[Tensor, "6 3 L L"], max_bounces: int, scale: float
    ) -> float:
        """Mean of ‖e‖²/(‖e‖² + s²) over pixels; 1 if there are none."""
        found = bounded_error(self.shown(surface, environment, max_bounces) - self.radiance, scale)
        return float(found.mean()) if len(found) else 1.0


def evenly(views: Views, count: int) -> list[tuple[TrainView, Int[np.ndarray, "_"]]]:
    """About `count` pixels of all views that lie wholly on the object."""
    return [(view, pixels.cpu().numpy()) for view, pixels in every_kth_pixel(views, count)]
