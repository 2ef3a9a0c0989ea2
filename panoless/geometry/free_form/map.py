"""The map that a fit works with: weighted least squares of pixels as means of a few rays, from the one before."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from panoless.capture.views import Views
from panoless.environment.cubemap import by_face, by_texel, resample
from panoless.environment.direct import direct_rays
from panoless.environment.fill import fill_unobserved, texel_neighbors
from panoless.environment.footprints import PixelFootprints, splat
from panoless.environment.rays import Rays
from panoless.environment.surroundings import Surroundings
from panoless.geometry.free_form.material import LEAST_SHARE, Material
from panoless.numeric.conjugate_gradients import conjugate_gradients
from panoless.numeric.robust import robust_weight
from panoless.problem.observations import is_saturated
from shinypartial.core.sphere import flat_texels

SMOOTHNESS = 0.05
"""Weight λ of squared differences of neighboring texels, in rays."""
STEPS = 6
"""Conjugate-gradient steps of a robust round."""
PHOTON_SHARE = 0.75
"""Share of a pixel's variance that grows with its light."""
FLAT_SHARE, STEEP_SHARE = 0.5, 0.2
"""Of all pixels: those where the map changes least show their noise, those where it does most how far rays err."""
LEAST_NOISE = 1e-4
"""Median length of a residual at least (linear radiance)."""


def splatted_map(pixels: PixelFootprints, weights: Float[Tensor, "P"], resolution: int) -> Float[Tensor, "6 3 L L"]:
    """Each texel the mean of what fell on it, gaps filled."""
    light, total = splat(pixels, weights, resolution).split((3, 1), 1)
    return fill_unobserved(light / total.clamp(min=1e-9), total[:, 0])


def smoothed_map(
    environment: Float[Tensor, "6 3 L L"],
    pixels: PixelFootprints,
    weights: Float[Tensor, "P"],
) -> Float[Tensor, "6 3 L L"]:
    """min_E Σ w ‖mean_k E(ω_k) − c‖² + λ Σ ‖E_i − E_j‖² over neighboring texels: a few steps from a map on."""
    resolution = environment.shape[-1]
    of_pixels = pixels.normal_product(weights[:, None], resolution)
    around = texel_neighbors(resolution).to(environment.device)

    def differences(image: Tensor) -> Tensor:
        texels = by_texel(image)
        return by_face(4 * texels - texels[around].sum(0), resolution)

    def product(image: Tensor) -> Tensor:
        return of_pixels(image) + SMOOTHNESS * differences(image)

    light, total = splat(pixels, weights, resolution).split((3, 1), 1)
    diagonal = total + 4 * SMOOTHNESS
    found = conjugate_gradients(product, environment, light - product(environment), 1 / diagonal, STEPS)
    return found.clamp(min=0)


def photon_gain(seen: Float[np.ndarray, "P 3"], brightness: float) -> Float[np.ndarray, "P"]:
    """By how much a residual counts more than at the mean brightness m: 1/√(1 − s + s E/m), with E what is seen.

    The share s of the variance grows with the light, as that of photons does and that of what a map gets wrong: so a
    dark ground under a bright sky counts, too. E is the prediction, not the pixel, whose own error would weigh it.
    """
    light = np.maximum(seen.mean(1), 0.0)
    gain: Float[np.ndarray, "P"] = 1 / np.sqrt(1 - PHOTON_SHARE + PHOTON_SHARE * light / brightness)
    return gain


def direction_gain(
    residual: Float[np.ndarray, "P 3"],
    slopes: Float[np.ndarray, "P 3 3"],
    clear: Bool[np.ndarray, "P"],
    least_noise: float = LEAST_NOISE,
) -> Float[np.ndarray, "P"]:
    """By how much residuals count less because mirrored rays err: 1/√(1 + (θ ‖∇E‖/σ)²).

    A ray that is wrong by θ (rad) shows light that is wrong by θ ‖∇E‖ (effective variance, Orear 1982). σ is the median
    ‖e‖ of flat pixels, or the `least_noise` if it is larger; θ is the median of √(‖e‖² − σ²)/‖∇E‖ of steep ones.
    Without it few lamps decide where a surface ends: each keeps the pixels that show it already.
    """
    size, steepness = np.linalg.norm(residual, axis=1), np.linalg.norm(slopes, axis=(1, 2))
    if not clear.any():
        return np.ones(len(size))
    of_flat, of_steep = np.quantile(steepness[clear], (FLAT_SHARE, 1 - STEEP_SHARE))
    flat, steep = clear & (steepness <= of_flat), clear & (steepness >= max(of_steep, 1e-9))
    noise = max(float(np.median(size[flat])), least_noise)
    off = np.sqrt(np.maximum(size[steep] ** 2 - noise**2, 0)) / steepness[steep]
    turned = float(np.median(off)) if len(off) else 0.0
    gain: Float[np.ndarray, "P"] = 1 / np.sqrt(1 + (turned * steepness / noise) ** 2)
    return gain


@dataclass(frozen=True)
class Mirrored:
    """What a perfect mirror would have shown in place of pixels, the share of it that they mirror, and which channels
    are saturated, so that this may be any brighter.
    """

    radiance: Float[np.ndarray, "P 3"]
    share: Float[np.ndarray, "P 3"]
    brighter: Bool[np.ndarray, "P 3"]

    @classmethod
    def by(
        cls,
        material: Material | None,
        taken: Float[np.ndarray, "P 3"],
        radiance: Float[np.ndarray, "P 3"],
        points: Float[np.ndarray, "P 3"],
        facing: Float[np.ndarray, "P"],
    ) -> "Mirrored":
        """Of pixels at equal exposures that were `taken` at their own, and see points where cos θ is `facing`. Under no
        material what is saturated is as bright as it looks.
        """
        if material is None:
            return cls(radiance, np.ones_like(radiance), np.zeros(radiance.shape, dtype=bool))
        return cls(*material.mirrored(radiance, points, facing), is_saturated(taken))

    def beside(self, direct: Rays) -> "Mirrored":
        """With light that is seen directly."""
        ones = np.ones((len(direct.radiance), 3))
        return Mirrored(
            np.concatenate([self.radiance, direct.radiance.double().numpy()]),
            np.concatenate([self.share, ones]),
            np.concatenate([self.brighter, ones < 1]),
        )

    def gain(self, light: Float[np.ndarray, "P 3"], brightness: float) -> Float[np.ndarray, "P 3"]:
        """By how much the residuals of a light count."""
        counted = self.share * photon_gain(light, brightness)[:, None]
        return np.where(self.brighter & (light > self.radiance), 0.0, counted)


@dataclass(frozen=True)
class MapData:
    """What a map is solved from: pixels that mirror it, then what is seen past the object."""

    mirrored: Mirrored
    areas: PixelFootprints
    weights: Float[Tensor, "P"]
    direct: Rays

    @classmethod
    def of(
        cls,
        mirrored: Mirrored,
        outgoing: Float[np.ndarray, "P K 3"],
        weights: Float[Tensor, "P"],
        views: Views,
        surroundings: Surroundings,
    ) -> "MapData":
        """Of pixels as areas that are mirrored in those directions."""
        areas = PixelFootprints(*(torch.from_numpy(each).float() for each in (outgoing, mirrored.radiance)))
        rays = replace(areas, trust=weights).rays()
        direct = direct_rays(views, surroundings, [rays])
        beside = PixelFootprints(direct.directions[:, None].expand(-1, outgoing.shape[1], 3), direct.radiance)
        weights = torch.cat([weights, direct.initial_weight()])
        return cls(mirrored.beside(direct), PixelFootprints.joined([areas, beside]), weights, direct)

    def first_map(self, start: Float[Tensor, "6 3 M M"] | None, size: int) -> Float[Tensor, "6 3 L L"]:
        """Another map at that size, or that of all pixels."""
        if start is None:
            return splatted_map(self.areas, self.weights * self._shares.amax(1) ** 2, size)
        return start if start.shape[-1] == size else resample(start, size)

    def next_map(
        self, environment: Float[Tensor, "6 3 L L"], robust_scale: float, brightness: float
    ) -> Float[Tensor, "6 3 L L"]:
        """A robust round of a map.

        A channel that is mirrored less than another counts less: it is drawn to what the map has already.
        """
        areas = self.areas
        seen, most = areas.seen(environment), self._shares.amax(1)
        shown = torch.where(torch.from_numpy(self.mirrored.brighter), areas.radiance.maximum(seen), areas.radiance)
        gain = torch.from_numpy(photon_gain(seen.double().numpy(), brightness)).float()
        agreed = robust_weight((seen - shown) * gain[:, None] * self._shares, robust_scale)
        unknown = 1 - (self._shares / most[:, None].clamp(min=LEAST_SHARE)) ** 2
        drawn = replace(areas, radiance=shown + unknown * (seen - shown))
        return smoothed_map(environment, drawn, self.weights * (most * gain) ** 2 * agreed)

    def known(self, resolution: int) -> Float[np.ndarray, "T"]:
        """Weights of what is seen directly of each texel."""
        texels = flat_texels(self.direct.directions.double().numpy(), resolution)
        weights = self.direct.initial_weight().double().numpy()
        return np.bincount(texels, weights, 6 * resolution**2).astype(np.float64)

    @cached_property
    def _shares(self) -> Float[Tensor, "P 3"]:
        return torch.from_numpy(self.mirrored.share).float()
