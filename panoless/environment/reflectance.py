"""What share of the light a metal mirrors, by what it shows of the same directions at different angles."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.encoding import SATURATED
from panoless.environment.cubemap import texels_of
from panoless.environment.options import MaterialOptions
from panoless.environment.rays import Rays
from panoless.numeric.robust import robust_weight

LEAST = 0.02
"""Of a reflectance at normal incidence, about that of water; no metal has less."""


@dataclass(frozen=True)
class Reflectance:
    """F(θ) = F₀ + (1 − F₀)(1 − cos θ)⁵ at the angle of incidence θ (Schlick 1994)."""

    at_normal: Float[np.ndarray, "3"]
    """F₀ in (0, 1] of red, green and blue (linear)."""

    @property
    def tint(self) -> tuple[float, float, float]:
        """F₀ as numbers."""
        red, green, blue = self.at_normal.tolist()
        return red, green, blue

    def share(self, cosines: Float[Tensor, "*P"]) -> Float[Tensor, "3 *P"]:
        """F of cos θ in [0, 1]; grazing rays see all of the light."""
        at_normal = torch.from_numpy(self.at_normal).to(cosines).reshape(3, *[1] * cosines.ndim)
        return at_normal + (1 - at_normal) * grazing(cosines)


def grazing(cosines: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
    """(1 − cos θ)⁵."""
    return (1 - cosines.clamp(0, 1)) ** 5


def cosines_of_incidence(rays: Rays) -> Float[Tensor, "P"]:
    """cos θ of rays that were mirrored once: half the length of ω − v, as v and ω differ by 2 cos θ n."""
    assert rays.incoming is not None
    return (rays.directions - rays.incoming).norm(dim=1) / 2


def unsaturated(rays: Rays, saturation: Float[Tensor, "3"]) -> Rays:
    """The rays whose radiance is known in all channels, all trusted alike: those that graze see wide parts of a map and
    are trusted less for that, but tell most about the mirror.
    """
    known = rays.kept((rays.radiance < SATURATED * saturation.to(rays.radiance)).all(1))
    return replace(known, trust=None)


def find_reflectance(rays: Rays, options: MaterialOptions) -> Reflectance:
    """F₀ by min Σ w ‖c − F(θ) E‖² over it and the texels E of a map together.

    w are the rays' trust and Geman–McClure weights. Each round is a Gauss–Newton step of each channel's F₀, from which
    the texels are eliminated: all that counts is how a direction looks at different angles. A plane in a far world
    shows each direction at one angle and tells nothing; F₀ stays 1 there.
    """
    return Reflectance(_Texels.of(rays, options).found(options))


def left_unexplained(rays: Rays, reflectance: Reflectance, options: MaterialOptions) -> Float[np.ndarray, "P 3"]:
    """c − F(θ) E with each texel of E the robust mean of the rays that are trusted; others are only predicted."""
    texels, weight = _Texels.of(rays, options), rays.initial_weight().double().cpu().numpy()
    residual = texels.radiance
    for _ in range(options.rounds):
        share, light, _ = texels.solved(reflectance.at_normal, weight)
        residual = texels.radiance - share * light
        weight = texels.trust * robust_weight(residual, options.robust_scale)
    return residual


@dataclass(frozen=True)
class _Texels:
    """Rays by the texel that they fall into."""

    texel: Int[np.ndarray, "P"]
    radiance: Float[np.ndarray, "P 3"]
    trust: Float[np.ndarray, "P"]
    grazing: Float[np.ndarray, "P 1"]

    @classmethod
    def of(cls, rays: Rays, options: MaterialOptions) -> "_Texels":
        return cls(
            texels_of(rays.directions.double().cpu().numpy(), options.resolution),
            rays.radiance.double().cpu().numpy(),
            rays.initial_weight().double().cpu().numpy(),
            grazing(cosines_of_incidence(rays)).double().cpu().numpy()[:, None],
        )

    def summed(self, values: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Over each ray's texel."""
        return np.stack([np.bincount(self.texel, each) for each in values.T], 1)[self.texel]

    def solved(
        self, at_normal: Float[np.ndarray, "3"], weight: Float[np.ndarray, "P"]
    ) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
        """F, E and Σ w F² of each ray's texel."""
        share = at_normal + (1 - at_normal) * self.grazing
        squares = np.maximum(self.summed(weight[:, None] * share**2), 1e-12)
        return share, self.summed(weight[:, None] * share * self.radiance) / squares, squares

    def found(self, options: MaterialOptions) -> Float[np.ndarray, "3"]:
        """F₀."""
        at_normal, weight = np.ones(3), self.trust
        for _ in range(options.rounds):
            share, light, squares = self.solved(at_normal, weight)
            residual = self.radiance - share * light
            weight = self.trust * robust_weight(residual, options.robust_scale)
            slope = (1 - self.grazing) * light
            slope = slope - share * self.summed(weight[:, None] * share * slope) / squares
            gain, curvature = ((weight[:, None] * slope * each).sum(0) for each in (residual, slope))
            at_normal = np.clip(at_normal + gain / np.maximum(curvature, 1e-12), LEAST, 1)
        return at_normal
