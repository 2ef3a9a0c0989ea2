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
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.revolution.options import DEFAULTS, MapOptions, RevolutionOptions
from panoless.geometry.revolution.pixels import PixelBundles
from panoless.geometry.revolution.render import smooth_pixels
from panoless.kernels.cubemap import cubemap_directions, sample_cubemap, scatter_cubemap
from panoless.numeric.conjugate_gradients import conjugate_gradients
from panoless.numeric.robust import robust_weight

OFFSETS = (-0.25, 0.25)
"""Of a footprint's directions from the pixel's center, in pixels."""
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

    def weights(
        self, seen: Float[Tensor, "P 3"], saturation: Float[Tensor, "3"], scale: float, saturated: float
    ) -> Float[Tensor, "P 3"]:
        """Robust weights of the errors of what is seen of a map; zero where it and the pixel are saturated."""
        weight = robust_weight(seen.minimum(saturation) - self.radiance, scale)[:, None]
        return weight * ~(seen.minimum(self.radiance) >= saturated * saturation)


def deblur_map(
    views: Views,
    surface: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    saturation: Float[Tensor, "3"],
    *,
    max_bounces: int = 1,
    occlusion_test: bool = True,
    options: RevolutionOptions = DEFAULTS,
) -> Float[Tensor, "6 3 L L"]:
    """The map E₀ of pixel centers, sharpened; texels that no area touches stay. Views are clipped at `saturation`, and
    pixels taken that are mirrored up to `max_bounces` times (see `model.trace_reflections`).

    It lies between 0 and that, or `ceiling` times that in channels in which pixels are saturated. Before each round,
    pixels that bend the light much, or mirror it often, and so see wide parts of it, tell how bright the inside of
    saturated regions is, coarsely.
    """
    own = options.map
    pixels = _divided(views, surface, options, max_bounces=max_bounces, occlusion_test=occlusion_test)
    if not pixels.smooth:
        return environment
    saturation = saturation.to(environment)
    lit = torch.stack([(each.radiance >= own.saturated * saturation).any(0) for each in pixels.smooth]).any(0)
    highest = (saturation * torch.where(lit, own.ceiling, 1.0))[:, None, None]
    inner = _eroded(environment >= own.lit * saturation[:, None, None])
    others = pixels.traced(surface, options) if inner.any() else None
    for _ in range(own.rounds):
        if others is not None:
            environment = _brightened(environment, others, inner, saturation, own).minimum(highest)
        change = _change(environment, pixels.smooth, saturation, own, own.robust_scale, own.steps)
        environment = (environment + change).clamp(min=0).minimum(highest)
    return environment


def _brightened(
    environment: Float[Tensor, "6 3 L L"],
    areas: PixelFootprints,
    inner: Float[Tensor, "6 3 L L"],
    saturation: Float[Tensor, "3"],
    options: MapOptions,
) -> Float[Tensor, "6 3 L L"]:
    """The map plus what a coarse one adds within saturated regions; nothing there falls below saturation for it."""
    resolution = environment.shape[-1]
    texels = cubemap_directions(resolution, device=environment.device).reshape(-1, 3)

    def finer(coarse: Float[Tensor, "6 C M M"]) -> Float[Tensor, "6 C L L"]:
        return inner * resample(coarse, resolution)

    def coarser(image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C M M"]:
        return scatter_cubemap(
            (inner * image).permute(0, 2, 3, 1).reshape(len(texels), -1), texels, options.coarse_resolution
        )

    lowest = environment.minimum(saturation[:, None, None])
    for _ in range(options.coarse_rounds):
        scale, steps = options.coarse_scale, options.coarse_steps
        change = _change(environment, [areas], saturation, options, scale, steps, finer, coarser)
        environment = (environment + change).maximum(lowest)
    return environment


def _same(image: Tensor) -> Tensor:
    return image


def _change(
    environment: Float[Tensor, "6 3 L L"],
    areas: Sequence[PixelFootprints],
    saturation: Float[Tensor, "3"],
    options: MapOptions,
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
        weights.append(each.weights(seen, saturation, scale, options.saturated))
        residual += each.spread((each.radiance - seen) * weights[-1], resolution)
        total += each.spread(weights[-1], resolution)

    def normal(change: Tensor) -> Tensor:
        image = finer(change)
        found = torch.zeros_like(image)
        for each, weight in zip(areas, weights, strict=True):
            found += each.spread(each.seen(image) * weight, resolution)
        return options.pull * change + coarser(found)

    right_side = coarser(residual)
    precondition = 1 / (options.pull + coarser(total))
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

    def traced(self, surface: SurfaceOfRevolution, options: RevolutionOptions) -> PixelFootprints:
        """About `options.map.traced` of the others, as far as all of their rays leave."""
        stride = max(1, -(-sum(map(len, self.others)) // options.map.traced))
        chosen = [pixels[index % stride :: stride] for index, pixels in enumerate(self.others)]
        bundles = PixelBundles.of(zip(self.views, chosen, strict=True))
        paths, device = bundles.trace(surface, options.max_bounces), self.views[0].radiance.device
        whole = (paths.bounces > 0).reshape(-1, bundles.rays_per_pixel).all(1)
        directions = paths.directions.reshape(-1, bundles.rays_per_pixel, 3)[whole]
        radiance = torch.from_numpy(bundles.radiance[whole])
        return PixelFootprints(torch.from_numpy(directions).float().to(device), radiance.float().to(device))


def _divided(
    views: Views,
    surface: SurfaceOfRevolution,
    options: RevolutionOptions = DEFAULTS,
    *,
    max_bounces: int = 1,
    occlusion_test: bool = True,
) -> PixelsBySmoothness:
    """All pixels of evenly chosen views."""
    stride = -(-sum(len(view.solid) for view in views.train) // options.map.pixels)
    chosen, batch = views.train[:: max(stride, 1)], options.map.batch_views
    found, others = [], []
    for view in chosen:
        places = view.solid.cpu().numpy()
        bend = options.rendering.largest_bend
        at, smooth = smooth_pixels(
            surface, view.camera, places, bend, max_bounces=max_bounces, occlusion_test=occlusion_test
        )
        pixels = view.solid[torch.from_numpy(smooth).to(view.solid.device)]
        directions = torch.stack(list(at.within(OFFSETS)), 1).to(view.radiance.device)
        found.append(PixelFootprints(directions, view.radiance.flatten(1)[:, pixels].T.contiguous()))
        others.append(places[~smooth])
    joined = [_joined(found[first : first + batch]) for first in range(0, len(found), batch)]
    return PixelsBySmoothness(chosen, [each for each in joined if len(each.radiance)], others)


def _joined(areas: Sequence[PixelFootprints]) -> PixelFootprints:
    return PixelFootprints(torch.cat([each.directions for each in areas]), torch.cat([each.radiance for each in areas]))
