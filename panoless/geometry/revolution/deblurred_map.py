"""The footprints of pixels on a surface of revolution: from neighboring pixels, or traced where these disagree."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Int

from panoless.capture.views import TrainView, Views
from panoless.environment.footprints import Footprints, PixelFootprints
from panoless.geometry.revolution.footprints import SUBRAYS, trace_footprints
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.revolution.render import smooth_pixels

OFFSETS = (-0.25, 0.25)
MOST_PIXELS = 3_500_000
BATCH_VIEWS = 4
MOST_TRACED = 60_000


def pixel_footprints(views: Views, surface: SurfaceOfRevolution, most: int = 1) -> Footprints:
    """Footprints of all pixels of evenly chosen views that are mirrored up to `most` times."""
    stride = -(-sum(len(view.solid) for view in views.train) // MOST_PIXELS)
    chosen = views.train[:: max(stride, 1)]
    found, others = [], []
    for view in chosen:
        places = view.solid.cpu().numpy()
        at, smooth = smooth_pixels(surface, view.camera, places, most)
        pixels = view.solid[torch.from_numpy(smooth).to(view.solid.device)]
        directions = torch.stack(list(at.within(OFFSETS)), 1).to(view.radiance.device)
        found.append(PixelFootprints(directions, view.radiance.flatten(1)[:, pixels].T.contiguous()))
        others.append(places[~smooth])
    joined = [_joined(found[first : first + BATCH_VIEWS]) for first in range(0, len(found), BATCH_VIEWS)]
    return Footprints([batch for batch in joined if len(batch.radiance)], lambda: _traced(chosen, surface, others))


def _traced(
    views: Sequence[TrainView], surface: SurfaceOfRevolution, pixels: Sequence[Int[np.ndarray, "_"]]
) -> PixelFootprints:
    """About `MOST_TRACED` of the pixels, as far as all of their rays leave, however often they are reflected."""
    stride = max(1, -(-sum(map(len, pixels)) // MOST_TRACED))
    chosen = [each[index % stride :: stride] for index, each in enumerate(pixels)]
    found, device = trace_footprints(views, surface, chosen), views[0].radiance.device
    directions = torch.from_numpy(found.outgoing.reshape(-1, len(SUBRAYS), 3)).float().to(device)
    return PixelFootprints(directions, torch.from_numpy(found.radiance).float().to(device))


def _joined(areas: Sequence[PixelFootprints]) -> PixelFootprints:
    return PixelFootprints(torch.cat([each.directions for each in areas]), torch.cat([each.radiance for each in areas]))
