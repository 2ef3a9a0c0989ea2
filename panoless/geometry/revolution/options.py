"""What a user may sweep in the fit of a surface of revolution."""

from dataclasses import dataclass

from shinypartial.io.records import Count


@dataclass(frozen=True)
class RevolutionOptions:
    """How thorough a fit is, and what it takes into account."""

    rounds: Count = 4
    """Most rounds of steps of each series, which go from coarse to fine."""
    pixels: Count = 120_000
    """Pixels of a step on single rays. Half as many are taken as areas, a quarter under the coarsest maps."""
    map_rays: Count = 600_000
    """Rays that a round's map is solved from; a quarter of them under the coarsest."""
    thin_walls: bool = True
    """Whether a wall without thickness, which mirrors on both faces, is among the candidates for a mouth."""
    max_bounces: Count = 6
    """Reflections that a fit follows."""


DEFAULTS = RevolutionOptions()
