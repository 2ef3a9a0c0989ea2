"""The tuned numbers of how photographs are read."""

from dataclasses import dataclass
from typing import Literal

from shinypartial.io.records import Count, NonNegative, Positive, Share


@dataclass(frozen=True)
class MaskRepairOptions:
    """When a part is added to a mask, or taken from it: where the other views contradict it.

    "Not tuned" is what only has to be large or small enough.
    """

    mode: Literal["auto", "off"] = "auto"
    """Whether masks are repaired at all."""
    least_views: Count = 20
    """With fewer views a gap of the object may be seen by one of them alone: on sculpture and a torus with 12 or 16."""
    contradicted_share: Share = 0.04
    """A point counts as the object's where no more than this share of the other views sees it beside their masks: they
    may be wrong themselves. On sculpture and a torus at least 3 of 49 do at the gaps of the object, and 0 or 1 at holes
    of masks that lost 3 % of their area."""
    near_views: Count = 4
    """Of so many views nearest in direction, none may see a point beside its mask that a view lacks: a gap of the
    object shows in all of them. Not tuned."""
    cells: Count = 48
    """Points along a side of the grid that views vote on, which holds the object."""
    fine_cells: Count = 96
    """The same of a finer grid on which mended masks vote on the masks as they were. Of holes of 3 % of vase, 0.23 %
    are left by the coarse grid and 0.05 % by this one; of sculpture 0.31 % and 0.13 %."""
    margin: NonNegative = 0.8
    """What stands out lies farther than this beside the masks of the others, in spacings of the first grid: 2.8 px in
    pictures of 160 px. With 0.6, vase loses parts of its lip to masks that are 4 px too small."""
    least_radius: NonNegative = 1.0
    """Parts in which no larger disk fits are left alone, in spacings: gaps of sculpture as narrow are seen by one view
    of 50."""
    least_radius_px: NonNegative = 3.0
    """The same in pixels, where these are wider than a third of a spacing. Not tuned."""
    largest_length: Positive = 6.0
    """Parts longer than so many times the radius of that disk are left alone: wrong poses make crescents."""
    least_share: Share = 0.75
    """Share that parts which are not long have of all that is as wide and contradicts, at least. It is 1.0 with holes
    and stray pieces, 0.01 to 0.3 with wrong poses and masks that are too small."""
    rounds: Count = 4
    """Most rounds on each grid: masks that were mended tell more about others."""


@dataclass(frozen=True)
class ContrastOptions:
    """How bright photographs are in a fit, and when they are compared as logarithms: where most of what the object
    shows is dark.
    """

    dark: NonNegative = 0.2
    """Mean radiance of the object's pixels (linear) below which photographs are dark: that of sculpture, the darkest of
    vase, mirror, sculpture, cola and deformed mirror. On these most numbers were chosen that call an error small or
    large. With 0 none are."""
    brightness: Positive = 0.35
    """Mean radiance to which dark ones are exposed, all together: about the geometric mean of these scenes. With 0.2
    the trial shapes die and drum end at 0.75° and 0.52° in the median, with 0.35 at 0.19° and 0.17°."""
    largest_exposure: Positive = 100.0
    """More than so many times brighter nothing is made: darker photographs show noise. Not tuned."""

    dark_share: NonNegative = 0.5
    """Share of the mean brightness below which a median one is dark; with 0 none is. The median is 0.6 to 0.9 of the
    mean on development scenes, and 0.17, 0.11, 0.37 and 0.37 on the trial shapes ingot, ellipsoid, bust and twist."""
    medians: Positive = 6.0
    """Radiance counts as it is up to the median brightness over this, and as its logarithm above."""
    least_knee: Positive = 0.002
    """But up to this at least (linear radiance), below which photographs show noise. On ingot, whose median is 0.007,
    knees of 0.001, 0.002 and 0.005 take the normals after the first rounds from 7.5° to 0.6°, 0.7° and 1.7°."""
    explained: NonNegative = 0.15
    """Error of held-out views, in logarithms, below which a shape that was fitted to radiance stays. On
    ingot it is 0.27 of the surface fitted to radiance and 0.09 of the one fitted to logarithms, on bust 0.39 and 0.35,
    on twist 0.12 and on ellipsoid 0.04."""
