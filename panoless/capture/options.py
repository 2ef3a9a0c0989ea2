"""The tuned numbers of how masks are read."""

from dataclasses import dataclass
from typing import Literal

from shinypartial.io.records import Count, NonNegative, Share


@dataclass(frozen=True)
class MaskRepairOptions:
    """When a hole in a mask is filled, and a piece beside the object removed: where the other views contradict it.

    "Not tuned" is what only has to be large or small enough.
    """

    mode: Literal["auto", "off"] = "auto"
    """Whether masks are repaired at all."""
    least_views: Count = 20
    """With fewer views a gap of the object may be seen by one of them alone: on sculpture and a torus with 12 or 16."""
    least_radius_px: NonNegative = 2.5
    """Holes in which no larger disk fits are left alone: gaps of sculpture and of a torus as narrow are seen by one
    view of 50."""
    contradicted_share: Share = 0.04
    """A point counts as the object's where no more than this share of the other views sees it beside their masks: they
    may have holes of their own. On sculpture and a torus at least 3 of 49 do at the gaps of the object, and 0 or 1 at
    holes of masks that lost 3 % of their area."""
    near_views: Count = 4
    """Of so many views nearest in direction, none may see that point of a hole beside its mask: a gap of the object
    shows in all of them. Not tuned."""
    margin_px: NonNegative = 4.0
    """A piece stays where a point of it lies no farther than this beside the masks of the others: wrong poses shift
    what a mask shows. Not tuned."""
    ray_samples: Count = 96
    """Points along a ray through the object's ball. Not tuned."""
    rays: Count = 16
    """Rays that stand for a piece. Not tuned."""
