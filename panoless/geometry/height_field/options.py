"""What a user may sweep in the fit of a height field."""

from dataclasses import dataclass

from shinypartial.io.records import Count, Natural


@dataclass(frozen=True)
class HeightFieldOptions:
    """How fine the heights over a plane are, and how many rounds find them."""

    cells: Count = 16
    """Cells of the spline along the longer side of the boundary, to begin with."""
    halvings: Natural = 1
    """How often they may be halved, where held-out views gain by it."""
    rounds: Count = 4
    """Most rounds of steps, which go from coarse to fine."""


DEFAULTS = HeightFieldOptions()
