"""What is chosen about the fit of a free-form surface."""

from dataclasses import dataclass

from shinypartial.io.records import Count


@dataclass(frozen=True)
class FreeFormOptions:
    """How much a level set's fit tries; its schedule and its numbers are constants beside their formulas."""

    concavities: bool = True
    """Whether concavities that no silhouette shows are looked for."""
    starts: bool = True
    """Whether several first surfaces descend under coarse maps, and details are searched from the hull where much stays
    unexplained. Else the usual rounds begin at the surface whose pixels disagree least."""
    finest_cells: Count = 60
    """Cells along the longest side of the finest grid of the usual rounds. Rounds with more are left out, but for the
    first. Below 60, no grid has more than 60."""
