"""The map of a surface of revolution, sharpened: a pixel saw the mean over its area, not the light of one direction.

For pixels whose directions are known over their whole area, min_E Σ w ‖mean_k E(ω_k) − c‖² + λ ‖E − E₀‖², over 2×2
directions ω_k of each, by conjugate gradients from the map E₀ of pixel centers. Views are clipped at some largest
radiance s, c = min(s, mean_k E(ω_k)): a saturated pixel has no error while its prediction is saturated too, and light
above s is told by pixels that see a lamp in part.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d

from panoless.capture.views import TrainView, Views
from panoless.environment.cubemap import resample
from panoless.geometry.revolution.footprints import SUBRAYS, trace_footprints
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.revolution.render import smooth_pixels
from panoless.kernels.cubemap import cubemap_directions, sample_cubemap, scatter_cubemap
from panoless.numeric.conjugate_gradients import conjugate_gradients
from panoless.numeric.robust import robust_weight

OFFSETS = (-0.25, 0.25)
MOST_PIXELS = 3_500_000
ROBUST_SCALE = 0.16
PULL = 0.2
"""λ, in rays."""
BATCH_VIEWS = 4
ROUNDS, STEPS = 4, 2
"""Weights are found anew in every round of so many steps."""
SATURATED, LIT = 0.998, 0.95
"""Shares of the largest value from which a pixel, and a texel of E₀, count as saturated."""
CEILING = 4.0
"""Largest radiance of a map, over that of views."""
MOST_TRACED = 60_000
COARSE_RESOLUTION, COARSE_ROUNDS, COARSE_STEPS = 8, 2, 6
COARSE_SCALE = 1.0
"""Of robust weights: while a lamp is far too dark, pixels that see it in part must keep their votes."""

Linear = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class PixelFootprints:
    """K directions over the area of each pixel, and the mean radiance seen there."""

    directions: Float[Tensor, "P K 3"]
    radiance: Float[Tensor, "P 3"]

    def seen(self, environment: Float[Tensor, "6 C L L"]) -> Float[Tensor, "P C"]:
        """Means of the map over the areas."""
        count = self.directions.shape[1]
        return sample_cubemap(environment, self.directions.flatten(0, 1)).unflatten(0, (-1, count)).mean(1)

    def spread(self, values: Float[Tensor, "P C"], resolution: int) -> Float[Tensor, "6 C L L"]:
        """The adjoint of `seen`."""
        count = self.directions.shape[1]
        each = (values[:, None] / count).expand(-1, count, -1).flatten(0, 1).contiguous()
        return scatter_cubemap(each, self.directions.flatten(0, 1), resolution)

    def weights(self, seen: Float[Tensor, "P 3"], saturation: Float[Tensor, "3"], scale: float) -> Float[Tensor, "P 3"]:
        """Robust weights of the errors of what is seen of a map; zero where it and the pixel are saturated."""
        weight = robust_weight(seen.minimum(saturation) - self.radiance, scale)[:, None]
        return weight * ~(seen.minimum(self.radiance) >= SATURATED * saturation)


def deblur_map(
    views: Views,
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    saturation: Float[Tensor, "3"],
    most: int = 1,
) -> Float[Tensor, "6 3 L L"]:
    """The map E₀ of pixel centers, sharpened; texels that no area touches stay. Views are clipped at `saturation`, and
    pixels taken that are mirrored up to `most` times (see `surface.trace_reflections`).

    It lies between 0 and that, or `CEILING` times that in channels in which pixels are saturated. Before each round,
    pixels that bend the light much, or mirror it often, and so see wide parts of it, tell how bright the inside of
    saturated regions is, coarsely.
    """
    pixels = _divided(views, surface, most)
    if not pixels.smooth:
        return environment
    saturation = saturation.to(environment)
    lit = torch.stack([(each.radiance >= SATURATED * saturation).any(0) for each in pixels.smooth]).any(0)
    highest = (saturation * torch.where(lit, CEILING, 1.0))[:, None, None]
    inner = _eroded(environment >= LIT * saturation[:, None, None])
    others = pixels.traced(surface) if inner.any() else None
    for _ in range(ROUNDS):
        if others is not None:
            environment = _brightened(environment, others, inner, saturation).minimum(highest)
        change = _change(environment, pixels.smooth, saturation, ROBUST_SCALE, STEPS)
        environment = (environment + change).clamp(min=0).minimum(highest)
    return environment


def _brightened(
    environment: Float[Tensor, "6 3 L L"],
    areas: PixelFootprints,
    inner: Float[Tensor, "6 3 L L"],
    saturation: Float[Tensor, "3"],
) -> Float[Tensor, "6 3 L L"]:
    """The map plus what a coarse one adds within saturated regions; nothing there falls below saturation for it."""
    resolution = environment.shape[-1]
    texels = cubemap_directions(resolution, device=environment.device).reshape(-1, 3)

    def finer(coarse: Float[Tensor, "6 C M M"]) -> Float[Tensor, "6 C L L"]:
        return inner * resample(coarse, resolution)

    def coarser(image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C M M"]:
        return scatter_cubemap((inner * image).permute(0, 2, 3, 1).reshape(len(texels), -1), texels, COARSE_RESOLUTION)

    lowest = environment.minimum(saturation[:, None, None])
    for _ in range(COARSE_ROUNDS):
        change = _change(environment, [areas], saturation, COARSE_SCALE, COARSE_STEPS, finer, coarser)
        environment = (environment + change).maximum(lowest)
    return environment


def _same(image: Tensor) -> Tensor:
    return image


def _change(
    environment: Float[Tensor, "6 3 L L"],
    areas: Sequence[PixelFootprints],
    saturation: Float[Tensor, "3"],
    scale: float,
    steps: int,
    finer: Linear = _same,
    coarser: Linear = _same,
) -> Float[Tensor, "6 3 L L"]:
    """min_X Σ w ‖A (E + B X) − c‖² + λ ‖X‖²: steps of conjugate gradients from zero; B X.

    B is `finer` and `coarser` its adjoint. The weight that lies on each texel preconditions.
    """
    resolution = environment.shape[-1]
    weights, residual, total = [], torch.zeros_like(environment), torch.zeros_like(environment)
    for each in areas:
        seen = each.seen(environment)
        weights.append(each.weights(seen, saturation, scale))
        residual += each.spread((each.radiance - seen) * weights[-1], resolution)
        total += each.spread(weights[-1], resolution)

    def normal(change: Tensor) -> Tensor:
        image = finer(change)
        found = torch.zeros_like(image)
        for each, weight in zip(areas, weights, strict=True):
            found += each.spread(each.seen(image) * weight, resolution)
        return PULL * change + coarser(found)

    right_side = coarser(residual)
    precondition = 1 / (PULL + coarser(total))
    return finer(conjugate_gradients(normal, torch.zeros_like(right_side), right_side, precondition, steps))


def _eroded(mask: Tensor) -> Float[Tensor, "6 3 L L"]:
    """1 where a texel and its eight neighbors on the same face are in a mask, and 0 elsewhere."""
    return -max_pool2d(-mask.float(), 3, 1, 1)


@dataclass(frozen=True)
class PixelsBySmoothness:
    """Pixels of some views by whether the directions over their areas are known from those of their neighbors."""

    views: Sequence[TrainView]
    smooth: list[PixelFootprints]
    """Of those that see the environment at once, a few views to a batch."""
    others: list[Int[np.ndarray, "_"]]
    """Flat indices, a view each."""

    def traced(self, surface: SurfaceOfRevolution) -> PixelFootprints:
        """About `MOST_TRACED` of the others, as far as all of their rays leave, however often they are mirrored."""
        stride = max(1, -(-sum(map(len, self.others)) // MOST_TRACED))
        chosen = [pixels[index % stride :: stride] for index, pixels in enumerate(self.others)]
        found, device = trace_footprints(self.views, surface, chosen), self.views[0].radiance.device
        directions = torch.from_numpy(found.outgoing.reshape(-1, len(SUBRAYS), 3)).float().to(device)
        return PixelFootprints(directions, torch.from_numpy(found.radiance).float().to(device))


def _divided(views: Views, surface: SurfaceOfRevolution, most: int = 1) -> PixelsBySmoothness:
    """All pixels of evenly chosen views."""
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
    return PixelsBySmoothness(chosen, [each for each in joined if len(each.radiance)], others)


def _joined(areas: Sequence[PixelFootprints]) -> PixelFootprints:
    return PixelFootprints(torch.cat([each.directions for each in areas]), torch.cat([each.radiance for each in areas]))
