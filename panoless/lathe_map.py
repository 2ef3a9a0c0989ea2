"""The map of a surface of revolution, sharpened: a pixel saw the mean over its area, not the light of one direction.

For pixels whose directions are known over their whole area, min_E Σ w ‖mean_k E(ω_k) − c‖² + λ ‖E − E₀‖², over 2×2
directions ω_k of each and with E₀ the map of pixel centers, by conjugate gradients.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.cubemap import conjugate_gradients, robust_weight
from panoless.kernels.cubemap import sample_cubemap, scatter_cubemap
from panoless.lathe import Lathe
from panoless.lathe_render import smooth_pixels
from panoless.views import Views

OFFSETS = (-0.25, 0.25)
MOST_PIXELS = 3_500_000
ROBUST_SCALE = 0.08
PULL = 0.2
"""λ, in rays."""
BATCH_VIEWS = 4


@dataclass(frozen=True)
class Areas:
    """Directions over the area of each pixel, and the mean radiance seen there."""

    directions: Float[Tensor, "P 4 3"]
    radiance: Float[Tensor, "P 3"]

    def seen(self, environment: Float[Tensor, "6 C L L"]) -> Float[Tensor, "P C"]:
        """Means of the map over the areas."""
        return sample_cubemap(environment, self.directions.flatten(0, 1)).unflatten(0, (-1, 4)).mean(1)

    def spread(self, values: Float[Tensor, "P C"], resolution: int) -> Float[Tensor, "6 C L L"]:
        """The adjoint of `seen`."""
        each = (values[:, None] / 4).expand(-1, 4, -1).flatten(0, 1).contiguous()
        return scatter_cubemap(each, self.directions.flatten(0, 1), resolution)


def sharpened_map(views: Views, lathe: Lathe, environment: Float[Tensor, "6 3 L L"]) -> Float[Tensor, "6 3 L L"]:
    """The map E₀ of pixel centers, sharpened; texels that no area touches stay. It lies between 0 and the brightest
    pixel, or 1 where that is more.
    """
    areas = _areas(views, lathe)
    if not areas:
        return environment
    resolution = environment.shape[-1]
    weights = [robust_weight(each.seen(environment) - each.radiance, ROBUST_SCALE)[:, None] for each in areas]

    def normal(image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C L L"]:
        found = PULL * image
        for each, weight in zip(areas, weights, strict=True):
            found += each.spread(each.seen(image) * weight, resolution)
        return found

    diagonal, residual = torch.full_like(environment[:, :1], PULL), torch.zeros_like(environment)
    for each, weight in zip(areas, weights, strict=True):
        diagonal += each.spread(weight, resolution)
        residual += each.spread((each.radiance - each.seen(environment)) * weight, resolution)
    result = conjugate_gradients(normal, environment, residual, 1 / diagonal)
    return result.clamp(0, max([1.0, *(float(each.radiance.max()) for each in areas)]))


def _areas(views: Views, lathe: Lathe) -> list[Areas]:
    """All smooth pixels of evenly chosen views that see the environment at once, a few views to a batch."""
    stride = -(-sum(len(view.solid) for view in views.train) // MOST_PIXELS)
    found = []
    for view in views.train[:: max(stride, 1)]:
        at, smooth = smooth_pixels(lathe, view.camera, view.solid.cpu().numpy(), 1)
        pixels = view.solid[torch.from_numpy(smooth).to(view.solid.device)]
        directions = torch.stack(list(at.within(OFFSETS)), 1).to(view.radiance.device)
        found.append(Areas(directions, view.radiance.flatten(1)[:, pixels].T.contiguous()))
    joined = [_joined(found[first : first + BATCH_VIEWS]) for first in range(0, len(found), BATCH_VIEWS)]
    return [each for each in joined if len(each.radiance)]


def _joined(areas: Sequence[Areas]) -> Areas:
    return Areas(torch.cat([each.directions for each in areas]), torch.cat([each.radiance for each in areas]))
