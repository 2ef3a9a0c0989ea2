"""Pixels as areas: what each saw is the mean over its footprint, not the light of one direction."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from panoless.environment.rays import Rays, Weighted
from panoless.kernels.cubemap import apply_gram, lookup_gram, sample_cubemap, scatter_cubemap, weigh_cubemap
from panoless.numeric.robust import robust_weight
from shinypartial.core.sphere import flat_texels

BATCH_PIXELS = 500_000
"""Views make a batch until it has so many, which bounds memory. Each batch costs time for every texel of the map: with
batches of four views of 160 px, that of Vase takes 1.3 times as long."""


@dataclass(frozen=True)
class PixelFootprints(Weighted):
    """K directions over the area of each pixel, and the mean radiance seen there."""

    directions: Float[Tensor, "P K 3"]
    radiance: Float[Tensor, "P 3"]
    trust: Float[Tensor, "P"] | None = None
    """How far each is weighted beforehand; None: all alike."""

    @classmethod
    def centers(cls, rays: Rays) -> "PixelFootprints":
        """Rays as pixels without an area."""
        return cls(rays.directions[:, None], rays.radiance, rays.trust)

    def rays(self) -> Rays:
        """As rays in their mean directions."""
        return Rays(normalize(self.directions.mean(1), dim=1), self.radiance, self.trust)

    def every(self, stride: int, first: int) -> "PixelFootprints":
        """Every stride-th pixel from the first."""
        return self.kept(slice(first, None, stride))

    def kept(self, part: slice | Bool[Tensor, "P"]) -> "PixelFootprints":
        """Those of the pixels."""
        trust = None if self.trust is None else self.trust[part]
        return PixelFootprints(self.directions[part].contiguous(), self.radiance[part].contiguous(), trust)

    def without(self, stride: int, first: int) -> "PixelFootprints":
        """All of them, but those of `every` are not weighted at all."""
        trust = self.initial_weight()
        trust[first::stride] = 0
        return replace(self, trust=trust)

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
        """All pixels of at least one part, which all say how far they are weighted, or none."""
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

    def normal_product(
        self, weights: Float[Tensor, "P W"], resolution: int
    ) -> Callable[[Float[Tensor, "6 C L L"]], Float[Tensor, "6 C L L"]]:
        """What is `seen` of a map, times weights of all channels or of each, `spread`: as a function of the map, for a
        face of so many texels. No pixel is seen again where each has one direction and one weight.
        """
        if self.directions.shape[1] == weights.shape[1] == 1:
            gram = lookup_gram(self.directions[:, 0], weights[:, 0], resolution)
            return lambda environment: apply_gram(gram, environment)
        return lambda environment: weigh_cubemap(environment, self.directions, weights)

    def weights(
        self, seen: Float[Tensor, "P 3"], saturation: Float[Tensor, "3"], scale: float, saturated: float
    ) -> Float[Tensor, "P 3"]:
        """Robust weights of the errors of what is seen of a map; zero where it and the pixel are saturated."""
        weight = robust_weight(seen.minimum(saturation) - self.radiance, scale)[:, None]
        if self.trust is not None:
            weight = weight * self.trust[:, None]
        return weight * ~(seen.minimum(self.radiance) >= saturated * saturation)


Batch = TypeVar("Batch", Rays, PixelFootprints)


def grouped(batches: Iterable[Batch], size: int) -> Iterator[list[Batch]]:
    """Batches in a row together until they have so many rays or pixels; the last group may have fewer."""
    group: list[Batch] = []
    for batch in batches:
        group.append(batch)
        if sum(len(each.radiance) for each in group) >= size:
            yield group
            group = []
    if group:
        yield group


def thinned(batches: Sequence[Batch], most: float) -> list[Batch]:
    """About `most` of the rays or pixels at most: every k-th, beginning elsewhere in each batch."""
    stride = max(1, math.ceil(sum(len(batch.radiance) for batch in batches) / most))
    return [batch.every(stride, index % stride) for index, batch in enumerate(batches)]


def in_patches(batches: Sequence[PixelFootprints], most: int, side: int) -> list[PixelFootprints]:
    """About so many of the pixels at most: all those that look at patches of the sky, side² a face of a cubemap, which
    are chosen at random. As many fall on a texel there as of all pixels.
    """
    share = most / max(sum(len(batch.radiance) for batch in batches), 1)
    if share >= 1:
        return list(batches)
    number = 6 * side**2
    order = torch.randperm(number, generator=torch.Generator().manual_seed(0))
    parts = []
    for batch in batches:
        patch = torch.from_numpy(flat_texels(batch.rays().directions.cpu().numpy(), side))
        parts.append(batch.kept((order[patch] < share * number).to(batch.radiance.device)))
    return parts


def splat(batch: Rays | PixelFootprints, weights: Float[Tensor, "P"], resolution: int) -> Float[Tensor, "6 4 L L"]:
    """Sums of what fell on each texel: weighted light, and weights."""
    values = torch.cat([batch.radiance, torch.ones_like(batch.radiance[:, :1])], 1) * weights[:, None]
    return scatter_cubemap(values, batch.directions, resolution)


def counting_saturated(
    batch: Batch, weight: float, level: Float[Tensor, "3"], share: Float[Tensor, "P"] | float = 1.0
) -> Batch:
    """The same, but of those that reach a radiance in some channel, a share is weighted by so much of what it was."""
    return replace(batch, trust=batch.initial_weight() * (1 - batch.reaches(level) * share * (1 - weight)))


def batched(parts: Iterable[PixelFootprints]) -> list[PixelFootprints]:
    """The pixels in batches; parts that come one by one need memory once."""
    groups = grouped((part for part in parts if len(part.radiance)), BATCH_PIXELS)
    return [PixelFootprints.joined(group) for group in groups]


@dataclass(frozen=True)
class Footprints:
    """The footprints of the pixels of some views."""

    smooth: list[PixelFootprints]
    """Of pixels that see the environment smoothly, in batches."""
    trace_others: Callable[[], list[PixelFootprints]] | None = None
    """Traces those of a sample of the other pixels, which bend the light much or reflect it often; None: none."""

    def widened(self, blur_px: float) -> "Footprints":
        """Those of a picture that was blurred."""
        others = self.trace_others
        traced = None if others is None else lambda: [each.widened(blur_px) for each in others()]
        return Footprints([each.widened(blur_px) for each in self.smooth], traced)

    @classmethod
    def of(cls, parts: Iterable[PixelFootprints]) -> "Footprints | None":
        """All of them, which stand for other pixels as well; None where there are none."""
        batches = batched(parts)
        return cls(batches, lambda: batches) if batches else None
