"""What a user may sweep in how photographs are read."""

from dataclasses import dataclass
from typing import Literal

from shinypartial.io.records import NonNegative, Positive


@dataclass(frozen=True)
class MaskRepairOptions:
    """When a part is added to a mask, or taken from it: where the other views contradict it."""

    mode: Literal["auto", "off"] = "auto"
    """Whether masks are repaired at all."""


@dataclass(frozen=True)
class ContrastOptions:
    """How bright photographs are in a fit, and when they are compared as logarithms: where most of what the object
    shows is dark.
    """

    dark: NonNegative = 0.2
    """Mean radiance of the object's pixels (linear) below which photographs are dark; with 0 none are."""
    brightness: Positive = 0.35
    """Mean radiance to which dark ones are exposed, all together."""
    dark_share: NonNegative = 0.5
    """Share of the mean brightness below which a median one is dark; with 0 none is."""
