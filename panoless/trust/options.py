"""What a user may sweep in the evidence for a fit."""

from dataclasses import dataclass

from shinypartial.io.records import Count


@dataclass(frozen=True)
class TrustOptions:
    """How much of the views is looked at."""

    rays: Count = 300_000
    """Most rays that the map without held-out views is solved from, and most that test it."""
    resolution: Count = 128
    """Most texels along a face side of that map."""
    views: Count = 20
    """Most views of either part, kept and held out, whose silhouettes and places are looked at."""
