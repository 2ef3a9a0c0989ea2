"""Poses beside the shape of one kind: first by silhouettes, then by what is mirrored, where held-out views gain by it.

Shape and poses are found in turn. A geometry of few numbers averages over many views, so a few rounds are enough.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Int

from panoless.alignment.align import Alignment, Scene, known_map
from panoless.capture.poses import Poses
from panoless.capture.views import Views, split_held_out
from panoless.config import FitConfig
from panoless.environment.resolution import prediction_error
from panoless.environment.surroundings import Surroundings
from panoless.geometry.base import Family, Geometry, Proposal, observe_views, usable_views
from panoless.journal import remembered


@dataclass(frozen=True)
class PosedProposal:
    """A proposal, and the poses under which it was made."""

    proposal: Proposal
    poses: Poses | None = None

    def in_surroundings(self, surroundings: Surroundings) -> "PosedProposal":
        """The same there."""
        return replace(self, proposal=self.proposal.in_surroundings(surroundings))

    def after(self, fitted: Geometry) -> "PosedProposal":
        """The same to go on from an earlier fit."""
        return replace(self, proposal=replace(self.proposal, fitted=fitted))


@remembered()
def proposed(source: Family, views: Views, config: FitConfig, *, asked: bool = False) -> Proposal | None:
    """What a kind proposes of views."""
    return source.propose(views, config, asked=asked)


@remembered()
def align_proposal(family: Family, views: Views, proposal: Proposal, config: FitConfig) -> PosedProposal | None:
    """The proposal of a kind after its outlines turned the cameras, and it followed them, in turn; None where that does
    not bring it clearly nearer to the masks.

    Outlines hardly tell a shift across the line of sight from a turn, so cameras are only turned.
    """
    options = config.poses
    if options.mode == "off" or not np.isfinite(proposal.silhouette_px):
        return None
    outline, alignment = family.as_proposed(proposal, config), Alignment(views, options)
    if options.mode == "auto" and (
        proposal.overlap < options.least_overlap or alignment.left_by_turns(outline) > options.largest_share_left
    ):
        return None
    found = poses = Poses.none(len(views.train))
    nearest = proposal
    for _ in range(options.silhouette_rounds):
        poses = alignment.without_motion_of_object(alignment.aligned(Scene(outline), poses))
        again = family.propose(poses.moved(views), config, asked=False)
        if again is None or again.silhouette_px > (1 - options.least_fall) * nearest.silhouette_px:
            break
        nearest, found, outline = again, poses, family.as_proposed(again, config)
    is_nearer = nearest.silhouette_px <= options.largest_share_left * proposal.silhouette_px
    return PosedProposal(nearest, found) if options.mode == "on" or is_nearer else None


def fit_with_poses(
    family: Family, source: Family, views: Views, start: PosedProposal, config: FitConfig
) -> Geometry | None:
    """The geometry of a kind with the poses of the views, from the proposal that `source` made of them; None where
    held-out views do not ask for poses.

    Each round finds the poses anew by outlines and colors, and then the shape by both, on from that before. In the end
    the shape is fitted from the proposal that the found poses give.
    """
    options = config.poses
    first = geometry = fit_at(family, views, start, config)
    if start.poses is None:
        return first
    judged = options.mode == "auto" and start.proposal.fitted is None
    if judged and not _is_asked_for(views, geometry, geometry.with_poses(None), options.least_pose_gain, config):
        return None
    for _ in range(options.rounds):
        before, poses = geometry, _next_poses(views, geometry, config)
        geometry = fit_at(family, views, replace(start, poses=poses).after(before), config)
        if _turned_deg(before, geometry) < options.settled_deg:
            break
    errors = [_held_out_error(views, each, config) for each in (first, geometry)]
    if errors[1] > (1 + options.largest_rise) * errors[0]:
        if start.proposal.fitted is None:
            return first
        geometry = first
    assert geometry.poses is not None
    proposal = proposed(source, geometry.poses.moved(views), config)
    if proposal is None:
        return geometry
    return fit_at(family, views, PosedProposal(proposal.in_surroundings(geometry.surroundings), geometry.poses), config)


@remembered()
def fit_at(family: Family, views: Views, start: PosedProposal, config: FitConfig) -> Geometry:
    """The geometry of a kind by views at the poses of a proposal, which it may change where it finds them itself."""
    if start.poses is None:
        return family.fit(views, start.proposal, config)
    proposal = start.proposal
    if proposal.fitted is not None and proposal.fitted.poses is not None:
        proposal = replace(proposal, fitted=proposal.fitted.with_poses(proposal.fitted.poses.beyond(start.poses)))
    fitted = family.fit(start.poses.moved(views), proposal, config)
    return fitted.with_poses(start.poses if fitted.poses is None else start.poses.after(fitted.poses.stacked))


@remembered()
def _next_poses(views: Views, geometry: Geometry, config: FitConfig) -> Poses:
    """Poses under a geometry and its map."""
    alignment, poses = Alignment(views, config.poses), geometry.poses
    assert poses is not None
    for _ in range(config.poses.maps):
        environment = known_map(views, geometry.with_poses(poses), config.poses)
        poses = alignment.adjusted(geometry, poses, environment)
    return alignment.without_common(poses)


def _turned_deg(before: Geometry, after: Geometry) -> float:
    """By how much one has the cameras turned against the other: median over views, to first order."""
    assert before.poses is not None
    assert after.poses is not None
    return float(np.degrees(np.median(np.linalg.norm(after.poses.turns - before.poses.turns, axis=1))))


def _is_asked_for(views: Views, geometry: Geometry, believed: Geometry, least_gain: float, config: FitConfig) -> bool:
    """Whether held-out views, under the map of the others, are explained better where their poses have put them than
    where they are said to be: by the share `least_gain` of the error.

    True where there are too few views to hold any out.
    """
    solved, tested = _parts(views)
    if not len(solved) or not len(tested):
        return True
    errors = []
    for each in (geometry, believed):
        environment = known_map(_chosen(views, solved), _with_part(each, solved), config.poses)
        errors.append(_error(_chosen(views, tested), _with_part(each, tested), environment, config))
    return errors[0] < (1 - least_gain) * errors[1]


def _held_out_error(views: Views, geometry: Geometry, config: FitConfig) -> float:
    """Mean of ‖e‖²/(‖e‖² + s²) over rays of views that the map has not seen, their poses found under it."""
    solved, tested = _parts(views)
    if not len(solved) or not len(tested):
        return 0.0
    assert geometry.poses is not None
    environment = known_map(_chosen(views, solved), _with_part(geometry, solved), config.poses)
    scene = Scene(geometry, environment)
    poses = Alignment(views, config.poses).aligned(scene, geometry.poses, tested.tolist())
    return _error(_chosen(views, tested), _with_part(geometry.with_poses(poses), tested), environment, config)


def _parts(views: Views) -> tuple[Int[np.ndarray, "S"], Int[np.ndarray, "T"]]:
    """Numbers of the views that are kept and held out."""
    kept, held_out = split_held_out(range(len(views.train)))
    return np.array(kept, dtype=np.int64), np.array(held_out, dtype=np.int64)


def _chosen(views: Views, numbers: Int[np.ndarray, "N"]) -> Views:
    return replace(views, train=tuple(views.train[number] for number in numbers))


def _with_part(geometry: Geometry, numbers: Int[np.ndarray, "N"]) -> Geometry:
    if geometry.poses is None:
        return geometry
    return geometry.with_poses(Poses(geometry.poses.turns[numbers], geometry.poses.shifts[numbers]))


def _error(views: Views, geometry: Geometry, environment: torch.Tensor, config: FitConfig) -> float:
    with torch.no_grad():
        seen = usable_views(views, geometry)
        return prediction_error(list(observe_views(seen, geometry, config.poses.map_rays)), environment)
