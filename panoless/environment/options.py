"""What a user may sweep in the search for the surroundings and for what the mirror is made of."""

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

COARSEST = 4
"""Texels along a face side on which the widest blur of a lobe works."""


def halves_whole(resolution: int) -> bool:
    """Whether a map of so many texels along a face side is halved without a rest until it is as coarse as blurs
    require."""
    while resolution > COARSEST and resolution % 2 == 0:
        resolution //= 2
    return resolution <= COARSEST


@dataclass(frozen=True)
class SurroundingsOptions:
    """When the surroundings are taken to be near."""

    mode: Literal["auto", "off", "on"] = "auto"
    """Whether their distance is an unknown: where held-out views gain by it, never, or always."""
    degree: Literal[0, 1, 2] = 0
    """Of the harmonics that 1/D is made of where it is near: 0 is a sphere, 1 one about another point, 2 walls that
    differ."""
    floor: Literal["auto", "off"] = "auto"
    """Whether what the object stands on is taken for a level disk before the walls, where held-out views gain by it."""


@dataclass(frozen=True)
class MaterialOptions:
    """What the mirror may be made of, where held-out views gain by it."""

    reflectance: Literal["auto", "off"] = "auto"
    """Whether the share of the light that is mirrored may depend on color and angle, as that of a metal does; not where
    a tint is given, and never in a high dynamic range."""
    scattering: Literal["auto", "off"] = "auto"
    """Whether the shape is looked for again without scattered light, where there is some."""
    roughness: Literal["auto", "off"] = "auto"
    """Whether the mirror may be slightly rough; not of surfels, whose normals are too coarse to determine, and never in
    a high dynamic range."""
    blur: Literal["auto", "off"] = "auto"
    """Whether pictures may be blurred, as out of focus or by compression. Where roughness explains held-out views
    better, too, the one that does so more is taken."""
    known_roughness: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.0
    """Where it is known, in units of Blender's principled shader; 0: held-out views determine it."""
