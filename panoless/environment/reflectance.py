"""What share of the light a mirror mirrors, by what it shows of the same directions at different angles, and what it
scatters beside.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from panoless.capture.encoding import SATURATED
from panoless.environment.material_field import MaterialField
from panoless.environment.rays import Rays
from panoless.numeric.robust import robust_weight
from shinypartial.core.harmonics import project, real_harmonics
from shinypartial.core.sphere import cube_directions, cube_solid_angles, flat_texels

ROBUST_SCALE = 0.1
"""Residual (linear radiance) beyond which a ray loses its vote; narrower scales lose the rays of a strong color."""
ROUNDS = 12
"""Gauss–Newton steps."""

LEAST = 0.02
"""Of a reflectance at normal incidence, about that of water; no metal has less."""
LAMBERT = np.repeat([1, 2 / 3, 1 / 4], [1, 3, 5])
"""Of each harmonic of the light, what a matte surface shows of it (Ramamoorthi and Hanrahan 2001), albedo 1."""


@dataclass(frozen=True)
class Reflectance:
    """F(θ) = F₀ + (1 − F₀)(1 − cos θ)⁵ at the angle of incidence θ (Schlick 1994), and what is scattered evenly."""

    at_normal: Float[np.ndarray, "3"]
    """F₀ in (0, 1] of red, green and blue (linear)."""
    albedo: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Share of the light that is scattered."""
    scattered: Float[np.ndarray, "9 3"] = field(default_factory=lambda: np.zeros((9, 3)))
    """That light: coefficients of the harmonics up to degree 2 of the normal."""
    field: MaterialField | None = None
    """By which places differ from both."""

    @property
    def tint(self) -> tuple[float, float, float]:
        """F₀ as numbers."""
        red, green, blue = self.at_normal.tolist()
        return red, green, blue

    @property
    def scattered_share(self) -> tuple[float, float, float] | None:
        """The albedo as numbers; None where it is zero."""
        red, green, blue = self.albedo.clip(0, 1).tolist()
        return (red, green, blue) if self.albedo.any() else None

    @property
    def uneven_share(self) -> float | None:
        """Share of the surface that differs; None where none does."""
        return None if self.field is None else self.field.extent

    @property
    def is_scattering(self) -> bool:
        """Whether any light is scattered."""
        return bool(self.albedo.any()) or self.field is not None

    def exposed(self, factor: float) -> "Reflectance":
        """The same in light that many times as bright."""
        field = None if self.field is None else self.field.exposed(factor)
        return replace(self, scattered=factor * self.scattered, field=field)

    def shown(
        self,
        cosines: Float[Tensor, "P"],
        normals_world: Float[Tensor, "P 3"],
        points: Float[Tensor, "P 3"] | None,
    ) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
        """F of cos θ in [0, 1], with F₀ and what is scattered as they are at points of the normalized frame; grazing
        rays see all of the light. Where normals are zero, nothing is scattered. Points matter where places differ only.
        """
        normals = normals_world.double().cpu().numpy()
        light = np.where(normals.any(1, keepdims=True), real_harmonics(normals, 2) @ self.scattered, 0.0)
        at_normal = np.broadcast_to(self.at_normal, light.shape)
        if self.field is not None:
            assert points is not None, "places differ"
            share, scattered = self.field.at(points.double().cpu().numpy())
            at_normal, light = (at_normal + share).clip(0, 1), light + scattered
        mirrored, matte = (torch.from_numpy(each.copy()).to(cosines) for each in (at_normal, light.clip(0)))
        return mirrored + (1 - mirrored) * grazing(cosines)[:, None], matte


def grazing(cosines: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
    """(1 − cos θ)⁵."""
    return (1 - cosines.clamp(0, 1)) ** 5


def cosines_of_incidence(rays: Rays) -> Float[Tensor, "P"]:
    """cos θ of rays that were mirrored once: half the length of ω − v, as v and ω differ by 2 cos θ n."""
    assert rays.incoming is not None
    return (rays.directions - rays.incoming).norm(dim=1) / 2


def normals_of(rays: Rays) -> Float[Tensor, "P 3"]:
    """Unit normals where rays were mirrored once: the direction of ω − v."""
    assert rays.incoming is not None
    return normalize(rays.directions - rays.incoming, dim=1)


def unsaturated(rays: Rays, saturation: Float[Tensor, "3"]) -> Rays:
    """The rays whose radiance is known in all channels, all trusted alike: those that graze see wide parts of a map and
    are trusted less for that, but determine most about the mirror.
    """
    known = rays.kept((rays.radiance < SATURATED * saturation.to(rays.radiance)).all(1))
    return replace(known, trust=None)


def lamp_light(rays: Rays, saturation: Float[Tensor, "3"], resolution: int) -> Float[np.ndarray, "9"]:
    """Harmonics of the directions in which most rays are saturated: ∫ Y dω over these texels."""
    lit = (rays.radiance >= SATURATED * saturation.to(rays.radiance)).any(1).cpu().numpy()
    texel = flat_texels(rays.directions.double().cpu().numpy(), resolution)
    count = np.bincount(texel, minlength=6 * resolution**2)
    share = np.bincount(texel, lit, minlength=len(count)) / np.maximum(count, 1)
    return _harmonics_of((share > 0.5).astype(np.float64)[:, None], resolution)[:, 0]


def _harmonics_of(values: Float[np.ndarray, "N C"], resolution: int) -> Float[np.ndarray, "9 C"]:
    """∫ v Y dω over the texels of a map."""
    return project(
        values, cube_directions(resolution).reshape(-1, 3), np.tile(cube_solid_angles(resolution).ravel(), 6), 2
    )


def find_reflectance(
    rays: Rays,
    resolution: int,
    lamps: Float[np.ndarray, "9"] | None = None,
    metal: Reflectance | None = None,
) -> Reflectance:
    """F₀ in (0, 1] by min Σ w ‖c − F(θ) E‖² over it and the texels E of a map of some resolution together.

    Where the harmonics of `lamps` are given (see `lamp_light`), min Σ w ‖c − F(θ) E − ρ I(n) − q L(n)‖² over the albedo
    ρ and q ≥ 0, too, with F₀ + ρ ≤ 1: I is the light of E that falls on a surface with the normal n, over π, and q L
    what lamps add to it that photographs do not show. That begins with what is found without, the `metal` where known.

    w are the rays' trust and Geman–McClure weights. Each round is a Gauss–Newton step of each channel's unknowns, from
    which the texels are eliminated: all that counts is how a direction looks at different angles. A plane in a far
    world shows each direction at one angle and determines nothing; F₀ stays 1 and ρ zero there.
    """
    texels = _Texels.of(rays, resolution)
    if metal is None:
        metal = texels.found(resolution, Reflectance(np.ones(3)))
    return metal if lamps is None else texels.found(resolution, metal, lamps)


def left_unexplained(rays: Rays, reflectance: Reflectance, resolution: int) -> Float[np.ndarray, "P 3"]:
    """c − F(θ) E − D(n) with each texel of E the robust mean of the trusted rays; others are only predicted."""
    texels, weight = _Texels.of(rays, resolution), rays.initial_weight().double().cpu().numpy()
    texels = texels.without(texels.basis @ reflectance.scattered)
    residual = texels.radiance
    for _ in range(ROUNDS):
        share, light, _ = texels.solved(reflectance.at_normal, weight)
        residual = texels.radiance - share * light
        weight = texels.trust * robust_weight(residual, ROBUST_SCALE)
    return residual


@dataclass(frozen=True)
class _Texels:
    """Rays by the texel that they fall into."""

    texel: Int[np.ndarray, "P"]
    """Its flat index in the map."""
    radiance: Float[np.ndarray, "P 3"]
    trust: Float[np.ndarray, "P"]
    grazing: Float[np.ndarray, "P 1"]
    basis: Float[np.ndarray, "P 9"]
    """Harmonics of the normals."""

    @classmethod
    def of(cls, rays: Rays, resolution: int) -> "_Texels":
        return cls(
            flat_texels(rays.directions.double().cpu().numpy(), resolution),
            rays.radiance.double().cpu().numpy(),
            rays.initial_weight().double().cpu().numpy(),
            grazing(cosines_of_incidence(rays)).double().cpu().numpy()[:, None],
            real_harmonics(normals_of(rays).double().cpu().numpy(), 2),
        )

    def without(self, light: Float[np.ndarray, "P 3"]) -> "_Texels":
        """The same less a part of the radiance."""
        return replace(self, radiance=self.radiance - light)

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

    def falling(self, light: Float[np.ndarray, "P 3"], resolution: int) -> Float[np.ndarray, "9 3"]:
        """Harmonics over the normal of what falls in over π, by the light of each ray's texel, if texels that no ray
        sees are as those that are seen in the mean.
        """
        values = np.full((6 * resolution**2, 3), np.nan)
        values[self.texel] = light
        values = np.where(np.isnan(values), np.nanmean(values, 0), values)
        return LAMBERT[:, None] * _harmonics_of(np.maximum(values, 0), resolution)

    def found(self, resolution: int, start: Reflectance, lamps: Float[np.ndarray, "9"] | None = None) -> Reflectance:
        """F₀ = 1 − m − ρ from a metal on, and ρ and q where lamps are given; m is the share of light that is lost."""
        weight, matte = self.trust, np.zeros((2, 9, 3))
        lost, shares = 1 - start.at_normal, np.zeros((2, 3))
        for _ in range(ROUNDS):
            at_normal = np.maximum(1 - lost - shares[0], LEAST)
            shown = self.without(self.basis @ (shares[:, None] * matte).sum(0))
            share, light, squares = shown.solved(at_normal, weight)
            residual = shown.radiance - share * light
            weight = self.trust * robust_weight(residual, ROBUST_SCALE)
            slopes = [(self.grazing - 1) * light]
            if lamps is not None:
                unseen = LAMBERT[:, None] * np.repeat(lamps[:, None], 3, 1)
                matte = np.stack([self.falling(light, resolution), unseen])
                slopes += [self.basis @ matte[0] + slopes[0], self.basis @ matte[1]]
            slopes = [each - share * self.summed(weight[:, None] * share * each) / squares for each in slopes]
            for channel in range(3):
                columns = np.stack([each[:, channel] for each in slopes], 1)
                known = np.array([lost[channel], *shares[: len(slopes) - 1, channel]])
                found = _positive_step(columns, residual[:, channel], weight, known)
                lost[channel], shares[: len(slopes) - 1, channel] = found[0], found[1:]
        return Reflectance(np.maximum(1 - lost - shares[0], LEAST), shares[0], (shares[:, None] * matte).sum(0))


def _positive_step(
    slopes: Float[np.ndarray, "P K"],
    residual: Float[np.ndarray, "P"],
    weight: Float[np.ndarray, "P"],
    known: Float[np.ndarray, "K"],
) -> Float[np.ndarray, "K"]:
    """min Σ w (r − s·(x − x₀))² over x ≥ 0."""
    from scipy.optimize import nnls

    root, count = np.sqrt(weight)[:, None], len(known)
    reduced = np.asarray(np.linalg.qr(np.concatenate([root * slopes, root * residual[:, None]], 1), mode="r"))
    columns = reduced[:count, :count]
    found: Float[np.ndarray, "K"] = nnls(columns, reduced[:count, count] + columns @ known)[0]
    return found
