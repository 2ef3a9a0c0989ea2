"""The footprints of pixels on a surface of revolution: from neighboring pixels, or traced where these disagree."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Int

from panoless.capture.views import TrainView, Views
from panoless.environment.footprints import Footprints, PixelFootprints, batched
from panoless.geometry.revolution.model import FITTED_BOUNCES, SurfaceOfRevolution
from panoless.geometry.revolution.pixels import PixelBundles
from panoless.geometry.revolution.render import LARGEST_BEND, smooth_pixels

PIXELS = 3_500_000
"""Most pixels with a footprint."""
TRACED = 60_000
"""Pixels without a smooth footprint that determine how bright saturated regions are."""

OFFSETS = (-0.25, 0.25)
"""Of a footprint's directions from the pixel's center, in pixels."""


def pixel_footprints(
    views: Views,
    surface: SurfaceOfRevolution,
    *,
    max_bounces: int = 1,
    occlusion_test: bool = True,
) -> Footprints:
    """Footprints of all pixels of evenly chosen views that are reflected up to `max_bounces` times."""
    stride = -(-views.num_solid // PIXELS)
    chosen = views.train[:: max(stride, 1)]
    others = list[Int[np.ndarray, "_"]]()

    def seen() -> Iterator[PixelFootprints]:
        for view in chosen:
            places = view.solid.cpu().numpy()
            at, smooth = smooth_pixels(
                surface, view.camera, places, LARGEST_BEND, max_bounces=max_bounces, occlusion_test=occlusion_test
            )
            others.append(places[~smooth])
            pixels = view.solid[torch.from_numpy(smooth).to(view.solid.device)]
            directions = torch.stack(list(at.within(OFFSETS)), 1).to(view.radiance.device)
            yield PixelFootprints(directions, view.radiance_at(pixels))

    return Footprints(batched(seen()), lambda: [_trace(chosen, surface, others)])


def _trace(
    views: Sequence[TrainView],
    surface: SurfaceOfRevolution,
    pixels: Sequence[Int[np.ndarray, "_"]],
) -> PixelFootprints:
    """About `TRACED` of the pixels, as far as all of their rays leave."""
    stride = max(1, -(-sum(map(len, pixels)) // TRACED))
    chosen = [each[index % stride :: stride] for index, each in enumerate(pixels)]
    bundles = PixelBundles.of(zip(views, chosen, strict=True))
    paths, device = bundles.trace(surface, FITTED_BOUNCES), views[0].radiance.device
    whole = (paths.bounces > 0).reshape(-1, bundles.rays_per_pixel).all(1)
    directions = paths.directions.reshape(-1, bundles.rays_per_pixel, 3)[whole]
    radiance = torch.from_numpy(bundles.radiance[whole])
    return PixelFootprints(torch.from_numpy(directions).float().to(device), radiance.float().to(device))
