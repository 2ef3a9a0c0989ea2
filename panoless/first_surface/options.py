"""Options of the first surface."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from shinypartial.io.records import Share


@dataclass(frozen=True)
class FirstSurfaceOptions:
    """How the visual hull is carved."""

    hull_resolution: Annotated[int, Meta(ge=8)] = 96
    """Voxels along a side of the cube in which the hull is carved; silhouettes count below the size of a voxel."""
    hull_votes: Share = 0.96
    """Least share of the views whose mask must keep a point of the hull; all views count unless they contradict."""
