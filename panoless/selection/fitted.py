"""A fit of one kind, and what it leaves unexplained of held-out views and of outlines."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.alignment.equations import PoseRows, outline_rows
from panoless.alignment.search import PosedProposal
from panoless.capture.corrections import NO_CORRECTIONS, Corrections
from panoless.capture.silhouettes import silhouette_distance_px
from panoless.capture.views import TrainView, Views, at_most_pixels
from panoless.config import FitConfig
from panoless.geometry.base import Geometry, usable_views
from panoless.geometry.registry import FAMILIES
from panoless.journal import remembered
from panoless.problem.evidence import Decision
from panoless.selection.held_out import held_out_parts, unexplained


@dataclass(frozen=True)
class Fitted:
    """A geometry, what it was fitted from, and the corrections of the photographs that it was fitted to."""

    geometry: Geometry
    start: PosedProposal
    corrections: Corrections = NO_CORRECTIONS
    decisions: tuple[Decision, ...] = ()
    """Which nuisance blocks the scene needs, of a joint fit."""

    def with_geometry(self, geometry: Geometry) -> "Fitted":
        """The same with another geometry."""
        return replace(self, geometry=geometry)


@runtime_checkable
class Refit(Protocol):
    """Fits a kind to views that are corrected otherwise."""

    def __call__(self, views: Views, before: Fitted, *, anew: bool) -> Fitted | None:
        """From the poses of the fit before and in surroundings like its own. The shape goes on from it where that kind
        can, or is fitted `anew`, as where outlines are other ones.
        """
        ...


PULLED_VIEWS = 8
"""From so many views at most it is told how photographs pull outlines, and what a geometry misses."""


def is_refined(kind: str) -> bool:
    """Whether another kind takes on this one's proposal where it is refused."""
    return kind in {family.refines for family in FAMILIES.values()}


def another_takes_on(geometry: Geometry, errors: Float[np.ndarray, "V"], config: FitConfig) -> bool:
    """Whether a geometry leaves so much unexplained that another kind is to take it on; none does where one is asked
    for.
    """
    asked = config.model == geometry.kind
    return bool(not asked and is_refined(geometry.kind) and errors.mean() > config.selection.largest_error)


def _few(views: Views) -> tuple[TrainView, ...]:
    """Some of the views, evenly."""
    return views.train[:: -(-len(views.train) // PULLED_VIEWS)]


def _outlines(views: Views, geometry: Geometry) -> Iterator[PoseRows]:
    """Of a geometry against the masks of a few views that see it."""
    for view in _few(geometry.corrected(views)):
        distance = silhouette_distance_px(view.mask).cpu().numpy().astype(np.float64)
        rows = outline_rows(view, distance, geometry.buffers(view.camera))
        if len(rows.residual):
            yield rows


@remembered()
def outline_pull_px(views: Views, geometry: Geometry) -> float:
    """How far outside the masks the outlines of a geometry lie: the median over views of the median.

    A fit weighs outlines against photographs, so its outlines give way a little where masks are off.
    """
    found = [np.median(each.residual) for each in _outlines(views, geometry)]
    return float(np.median(found)) if found else 0.0


def outline_distance_px(views: Views, geometry: Geometry) -> float:
    """The same of distances without a sign."""
    found = [each.typical for each in _outlines(views, geometry)]
    return float(np.median(found)) if found else 0.0


def pixels_inside(mask: Float[Tensor, "H W"], depth_px: float) -> Int[Tensor, "P"]:
    """Flat indices of the pixels that lie deeper inside a mask."""
    return torch.nonzero(silhouette_distance_px(mask).flatten() < -depth_px)[:, 0]


def missed_share(views: Views, geometry: Geometry, depth_px: float) -> float:
    """Share of the pixels so deep inside the masks of a few views where a geometry is not; 0 where there are none."""
    missed, number = 0, 0
    for view in _few(geometry.corrected(views)):
        inside = pixels_inside(view.mask, depth_px)
        missed += int((geometry.buffers(view.camera).alpha.flatten()[inside.cpu()] < 0.5).sum())
        number += len(inside)
    return missed / max(number, 1)


def with_solid(views: Views, pixels: Sequence[Int[Tensor, "_"]]) -> Views:
    """Views of which those pixels count."""
    chosen = zip(views.train, pixels, strict=True)
    return replace(views, train=tuple(replace(view, solid=solid) for view, solid in chosen))


def fewer_pixels(views: Views, most: int) -> Views:
    """The views with no more than so many solid pixels. Every other of them is observed, so that none is weighed by the
    area beside it."""
    return with_solid(views, [pixels for _, pixels in at_most_pixels(views, most)])


def held_out_errors(views: Views, geometry: Geometry, config: FitConfig) -> Float[np.ndarray, "V"]:
    """What a geometry leaves unexplained of each held-out view."""
    parts = held_out_parts(usable_views(fewer_pixels(views, 2 * config.corrections.rays), geometry))
    assert parts is not None
    return unexplained(*parts, geometry, config.corrections.rays, config.corrections.resolution)


def errors_in_common(
    views: Views, before: Fitted, after: Fitted, config: FitConfig
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """What two fits leave unexplained of the pixels that are solid for both."""
    said, moved = (each.corrections.applied(views, config) for each in (before, after))
    solid = [one.solid[torch.isin(one.solid, other.solid)] for one, other in zip(said.train, moved.train, strict=True)]
    errors = [
        held_out_errors(with_solid(seen, solid), each.geometry, config)
        for seen, each in ((said, before), (moved, after))
    ]
    return errors[0], errors[1]
