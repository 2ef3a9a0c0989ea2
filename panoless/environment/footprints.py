"""The map from pixels as areas: a pixel saw the mean over its footprint, not the light of one direction.

For pixels whose directions are known over their whole area, min_E Σ w ‖mean_k E(ω_k) − c‖² + λ ‖E − E₀‖², over 2×2
directions ω_k of each, by conjugate gradients from the map E₀ of pixel centers. Views are clipped at some largest
radiance s, c = min(s, mean_k E(ω_k)): a saturated pixel has no error while its prediction is saturated too, and light
above s is told by pixels that see a lamp in part.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from panoless.environment.cubemap import resample
from panoless.environment.options import DEFAULTS, FootprintMapOptions
from panoless.environment.rays import Rays
from panoless.kernels.cubemap import cubemap_directions, sample_cubemap, scatter_cubemap
from panoless.numeric.conjugate_gradients import conjugate_gradients
from panoless.numeric.robust import robust_weight

Linear = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class PixelFootprints:
    """K directions over the area of each pixel, and the mean radiance seen there."""

    directions: Float[Tensor, "P K 3"]
    radiance: Float[Tensor, "P 3"]
    trust: Float[Tensor, "P"] | None = None
    """How far each is believed beforehand; None: all alike."""

    @classmethod
    def centers(cls, rays: Rays) -> "PixelFootprints":
        """Rays as pixels without an area."""
        return cls(rays.directions[:, None], rays.radiance, rays.trust)

    def rays(self) -> Rays:
        """As rays in their mean directions."""
        return Rays(normalize(self.directions.mean(1), dim=1), self.radiance, self.trust)

    def every(self, stride: int, first: int) -> "PixelFootprints":
        """Every stride-th pixel from the first."""
        part = slice(first, None, stride)
        trust = None if self.trust is None else self.trust[part]
        return PixelFootprints(self.directions[part].contiguous(), self.radiance[part].contiguous(), trust)

    def widened(self, blur_px: float) -> "PixelFootprints":
        """Areas as wide as those of pixels of a picture that was blurred by a Gaussian of that standard deviation σ.

        To first order a direction is a linear function of the place in the pixel, whose variance is 1/12 + σ² in place
        of 1/12 px².
        """
        if not blur_px:
            return self
        middle = self.directions.mean(1, keepdim=True)
        wider = middle + math.sqrt(1 + 12 * blur_px**2) * (self.directions - middle)
        return replace(self, directions=normalize(wider, dim=2).contiguous())

    @classmethod
    def joined(cls, parts: "Sequence[PixelFootprints]") -> "PixelFootprints":
        """All pixels of at least one part, which all say how far they are believed, or none."""
        trust = [part.trust for part in parts if part.trust is not None]
        directions = torch.cat([part.directions for part in parts])
        radiance = torch.cat([part.radiance for part in parts])
        return cls(directions, radiance, torch.cat(trust) if trust else None)

    def seen(self, environment: Float[Tensor, "6 C L L"]) -> Float[Tensor, "P C"]:
        """Means of the map over the areas."""
        return sample_cubemap(environment, self.directions)

    def spread(self, values: Float[Tensor, "P C"], resolution: int) -> Float[Tensor, "6 C L L"]:
        """The adjoint of `seen`."""
        return scatter_cubemap(values, self.directions, resolution)

    def weights(
        self, seen: Float[Tensor, "P 3"], saturation: Float[Tensor, "3"], scale: float, saturated: float
    ) -> Float[Tensor, "P 3"]:
        """Robust weights of the errors of what is seen of a map; zero where it and the pixel are saturated."""
        weight = robust_weight(seen.minimum(saturation) - self.radiance, scale)[:, None]
        if self.trust is not None:
            weight = weight * self.trust[:, None]
        return weight * ~(seen.minimum(self.radiance) >= saturated * saturation)


Batch = TypeVar("Batch", Rays, PixelFootprints)


def thinned(batches: Sequence[Batch], most: float) -> list[Batch]:
    """About `most` of the rays or pixels at most: every k-th, beginning elsewhere in each batch."""
    stride = max(1, math.ceil(sum(len(batch.radiance) for batch in batches) / most))
    return [batch.every(stride, index % stride) for index, batch in enumerate(batches)]


@dataclass(frozen=True)
class Footprints:
    """The footprints of the pixels of some views."""

    smooth: list[PixelFootprints]
    """Of pixels that see the environment smoothly, a few views to a batch."""
    trace_others: Callable[[], PixelFootprints]
    """Traces those of a sample of the other pixels, which bend the light much or reflect it often."""

    def widened(self, blur_px: float) -> "Footprints":
        """Those of a picture that was blurred."""
        return Footprints([each.widened(blur_px) for each in self.smooth], lambda: self.trace_others().widened(blur_px))

    @classmethod
    def of(cls, parts: Sequence[PixelFootprints]) -> "Footprints | None":
        """All of them in one batch, which stands for other pixels as well; None where there are none."""
        parts = [part for part in parts if len(part.radiance)]
        if not parts:
            return None
        areas = PixelFootprints.joined(parts)
        return cls([areas], lambda: areas)


def deblur_map(
    footprints: Footprints,
    environment: Float[Tensor, "6 3 L L"],
    saturation: Float[Tensor, "3"],
    options: FootprintMapOptions = DEFAULTS,
) -> Float[Tensor, "6 3 L L"]:
    """The map E₀ of pixel centers, sharpened; texels that no footprint touches stay. Views are clipped at `saturation`.

    It lies between 0 and that, or `ceiling` times that in channels in which pixels are saturated. Before each round,
    pixels that bend the light much, or reflect it often, and so see wide parts of it, tell how bright the inside of
    saturated regions is, coarsely.
    """
    if not footprints.smooth:
        return environment
    saturation = saturation.to(environment)
    lit = torch.stack([(each.radiance >= options.saturated * saturation).any(0) for each in footprints.smooth]).any(0)
    highest = (saturation * torch.where(lit, options.ceiling, 1.0))[:, None, None]
    inner = _eroded(environment >= options.lit * saturation[:, None, None])
    others = footprints.trace_others() if inner.any() else None
    for _ in range(options.rounds):
        if others is not None:
            environment = _brightened(environment, others, inner, saturation, options).minimum(highest)
        change = _change(environment, footprints.smooth, saturation, options, options.robust_scale, options.steps)
        environment = (environment + change).clamp(min=0).minimum(highest)
    return environment


def _brightened(
    environment: Float[Tensor, "6 3 L L"],
    areas: PixelFootprints,
    inner: Float[Tensor, "6 3 L L"],
    saturation: Float[Tensor, "3"],
    options: FootprintMapOptions,
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
    options: FootprintMapOptions,
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
