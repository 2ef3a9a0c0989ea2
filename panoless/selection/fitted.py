"""A fit of one kind, and which part of the object it misses."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor, nonzero

from panoless.capture.corrections import NO_CORRECTIONS, Corrections
from panoless.capture.silhouettes import silhouette_distance_px
from panoless.capture.views import Views
from panoless.geometry.base import Geometry, Proposal
from panoless.geometry.registry import FAMILIES
from panoless.problem.evidence import Decision

FEW_VIEWS = 8
"""By so many views at most what a geometry misses is measured."""
DEEP_PX = 6.0
"""Pixels that are missed count where they lie deeper inside of a mask."""


@dataclass(frozen=True)
class Fitted:
    """A geometry, what it was fitted from, and the corrections of the photographs that it was fitted to."""

    geometry: Geometry
    start: Proposal
    corrections: Corrections = NO_CORRECTIONS
    decisions: tuple[Decision, ...] = ()
    """Which nuisance blocks the scene needs."""


def is_refined(kind: str) -> bool:
    """Whether another kind starts from this one's proposal where it is refused."""
    return kind in {family.refines for family in FAMILIES.values()}


def pixels_inside(mask: Float[Tensor, "H W"], depth_px: float) -> Int[Tensor, "P"]:
    """Flat indices of the pixels that lie deeper inside a mask."""
    return nonzero(silhouette_distance_px(mask).flatten() < -depth_px)[:, 0]


def missed_share(views: Views, geometry: Geometry) -> float:
    """Share of the pixels deep inside the masks of a few views where a geometry is not; 0 where there are none."""
    missed, number = 0, 0
    for view in geometry.corrected(views).train[:: -(-len(views.train) // FEW_VIEWS)]:
        inside = pixels_inside(view.mask, DEEP_PX)
        missed += int((geometry.buffers(view.camera).alpha.flatten()[inside.cpu()] < 0.5).sum())
        number += len(inside)
    return missed / max(number, 1)
