"""Which kind of geometry a scene needs: the simplest that explains silhouettes and held-out views.

A kind that is not needed costs accuracy, too: tilting a flat mirror and turning the environment the other way leaves
every picture as it was.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from panoless.alignment.align import pose_prior
from panoless.alignment.search import PosedProposal, align_proposal, fit_at, fit_with_poses, proposed
from panoless.capture.silhouettes import silhouette_distance_px
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.surroundings import FAR, Surroundings
from panoless.first_surface.visual_hull import contradiction_px
from panoless.geometry.base import Family, Geometry, Proposal, usable_views
from panoless.geometry.registry import FAMILIES
from panoless.journal import remembered
from panoless.selection.candidates import Candidate, Selection, Verdict, describe
from panoless.selection.corrections import with_corrections
from panoless.selection.fitted import Fitted, is_refined, missed_share
from panoless.selection.held_out import held_out_errors, held_out_parts
from panoless.selection.joint import fit_jointly
from panoless.selection.surroundings import explains_clearly_more, on_floor, proposed_surroundings
from shinypartial.core.errors import InputError

ANY = "auto"
LEAST = "leaves much unexplained, and nothing explains more"
BENT = "a bend explains clearly more"
EXPLAINS = "explains held-out views"
OTHER = "another kind is preferred"
TOO_MUCH = "leaves too much unexplained"
NONE_HELD_OUT = "too few views to hold one out"


def choose_geometry(views: Views, config: FitConfig) -> tuple[Geometry, Selection]:
    """The geometry of the scene and the evidence for it.

    Candidates are examined from the simplest on. One is refused when it misses the silhouettes, or when a kind that
    refines it explains held-out views clearly better. One that leaves more than right ones do is taken unless one after
    it leaves much less, or at once where outlines tell its whole shape. One that leaves too much waits until all others
    are refused; of those the one that leaves least is taken. `config.model` overrides.
    Raises InputError when a kind is asked for and can't be proposed, and when the silhouettes refuse all kinds.
    """
    if config.model != ANY:
        return _fit_asked(views, config)
    families = list(FAMILIES.values())
    if views.object_frame.depth_is_open:
        families = [family for family in families if not family.needs_depth]
    table, refused = list[Candidate](), dict[str, list[PosedProposal]]()
    fitted = list[tuple[Candidate, Geometry]]()
    for family in families:
        source = _source(family)
        proposals = refused.get(source.kind, []) if family.refines else _proposals(source, views, config, asked=False)
        candidate, geometry = _examine(family, proposals, views, config)
        table.append(candidate)
        refused[family.kind] = [each for each in proposals if _is_near(each, views, config, bent=True)]
        if geometry is None:
            continue
        explains = candidate.verdict == Verdict.CHOSEN
        corrected = candidate.corrections.applied(views, config)
        if explains and _bends_rather(family, geometry, proposals, corrected, config):
            table[-1] = candidate = replace(candidate, verdict=Verdict.REFUSED_BY_HELD_OUT_VIEWS, reason=BENT)
            explains = False
        fitted.append((candidate, geometry))
        if explains and (family.told_by_outlines or error_of(fitted[-1]) <= config.selection.doubted_error):
            break
    chosen = [each for each in fitted if each[0].verdict == Verdict.CHOSEN]
    if chosen:
        return _chosen(*much_less_unexplained(chosen, views, config), table)
    if fitted:
        candidate, geometry = least_unexplained(fitted, config)
        return _chosen(replace(candidate, verdict=Verdict.CHOSEN, reason=LEAST), geometry, table)
    raise along_one_line() if views.object_frame.depth_is_open else _refused_by_silhouettes(table)


def _chosen(candidate: Candidate, geometry: Geometry, table: Sequence[Candidate]) -> tuple[Geometry, Selection]:
    """The geometry, and the evidence with what was chosen last; what else might have been is refused."""
    others = (
        replace(each, verdict=Verdict.REFUSED_BY_HELD_OUT_VIEWS, reason=OTHER)
        if each.verdict == Verdict.CHOSEN
        else each
        for each in table
        if each.kind != candidate.kind
    )
    return geometry, Selection(candidate.kind, (*others, candidate))


def error_of(each: tuple[Candidate, Geometry]) -> float:
    """The held-out error; zero where it was not measured."""
    return each[0].held_out_error or 0.0


def much_less_unexplained(
    fitted: Sequence[tuple[Candidate, Geometry]], views: Views, config: FitConfig
) -> tuple[Candidate, Geometry]:
    """The simplest, unless one after it leaves a share of its error only, what it misses of the object included."""
    chosen = fitted[0]
    for each in fitted[1:]:
        enough = config.selection.doubted_share * error_of(chosen)
        if error_of(each) < enough and _with_missed(each, views, config) < enough:
            chosen = each
    return chosen


def _with_missed(each: tuple[Candidate, Geometry], views: Views, config: FitConfig) -> float:
    """The held-out error with pixels unexplained that lie well inside the masks and off the geometry: a surface with a
    hole in it explains the rest.
    """
    candidate, geometry = each
    missed = missed_share(candidate.corrections.applied(views, config), geometry, config.corrections.largest_px)
    return missed + (1 - missed) * error_of(each)


def least_unexplained(fitted: Sequence[tuple[Candidate, Geometry]], config: FitConfig) -> tuple[Candidate, Geometry]:
    """Of what leaves too much unexplained, the simplest than which nothing else explains clearly more. A kind that
    another takes on counts only where no other was fitted.
    """
    waiting = [each for each in fitted if not is_refined(each[0].kind)] or fitted
    enough = min(map(error_of, waiting)) / (1 - config.selection.least_gain)
    return next(each for each in waiting if error_of(each) <= enough)


def _source(family: Family) -> Family:
    """The kind that makes the proposals."""
    return family if family.refines is None else FAMILIES[family.refines]


@remembered()
def _proposals(source: Family, views: Views, config: FitConfig, *, asked: bool) -> list[PosedProposal]:
    """With the cameras turned so that outlines agree, where that helps, and with the cameras as they are said to be."""
    proposal = proposed(source, views, config, asked=asked)
    if proposal is None:
        return []
    if source.joint:
        return [PosedProposal(proposal)]
    worthwhile = asked or _few_come_near(source, views, proposal, config)
    aligned = align_proposal(source, views, proposal, config) if worthwhile else None
    return [PosedProposal(proposal)] if aligned is None else [aligned, PosedProposal(proposal)]


def _few_come_near(source: Family, views: Views, proposal: Proposal, config: FitConfig) -> bool:
    """Whether turns of a few of many cameras bring a proposal so near to the masks that it is fitted. Turns of all take
    as much longer as there are more, and a wrong kind stays far from the masks.
    """
    stride = len(views.train) // config.poses.trial_views
    if stride < 2 or config.poses.mode != "auto":
        return True
    asked = replace(views, train=views.train[::stride])
    few = align_proposal(source, asked, proposal, config)
    return few is not None and _is_near(few, asked, config, bent=True)


def _is_near(start: PosedProposal, views: Views, config: FitConfig, *, bent: bool) -> bool:
    """Whether a proposal explains the silhouettes, or would where a kind that refines it bends its edge.

    Outlines that contradict each other miss any shape. By d pixels, they leave the share d · length / area of the
    object to one side alone.
    """
    options, proposal = config.selection, start.proposal
    farther = options.bent_edge if bent else 1.0
    outside, missed = farther * options.largest_silhouette_px, farther * (1 - options.least_overlap)
    away, apart = proposal.silhouette_px, 1 - proposal.overlap
    if away <= outside and apart <= missed:
        return True
    if away > options.farthest * outside or apart > options.farthest * missed:
        return False
    error_px = contradiction_px(views if start.poses is None else start.poses.moved(views))
    return away <= outside + error_px and apart <= missed + error_px * _outline_share(views)


def _outline_share(views: Views) -> float:
    """Length of the outline over the area of the object, in pixels: median over views."""
    shares = [
        float(((distance := silhouette_distance_px(view.mask)) < 0).logical_and(distance > -1).sum())
        / float((distance < 0).sum().clamp(min=1))
        for view in views.train
    ]
    return float(np.median(shares))


def _best_fit(
    family: Family, proposals: Sequence[PosedProposal], views: Views, config: FitConfig, *, asked: bool
) -> Fitted | None:
    """The fit of a kind, to photographs that are corrected where held-out views ask for it."""
    source = _source(family)
    if family.joint:
        return fit_jointly(family, views, proposals[0], config) if proposals else None

    def near(proposals: Sequence[PosedProposal]) -> list[PosedProposal]:
        bent = family.refines is not None
        return list(proposals) if asked else [each for each in proposals if _is_near(each, views, config, bent=bent)]

    def refit(views: Views, before: Fitted, *, anew: bool) -> Fitted | None:
        poses = before.geometry.poses
        if poses is None:
            again = _proposals(source, views, config, asked=False)
        else:
            proposal = proposed(source, poses.moved(views), config)
            start = None if proposal is None else PosedProposal(proposal, poses)
            again = [] if start is None else [start if anew else start.after(before.geometry)]
        return _first_fit(family, near(again), views, config, before.geometry.surroundings)

    first = _first_fit(family, near(proposals), views, config)
    return None if first is None else with_corrections(source, views, first, config, refit)


def _first_fit(
    family: Family,
    proposals: Sequence[PosedProposal],
    views: Views,
    config: FitConfig,
    known: Surroundings = FAR,
) -> Fitted | None:
    """The geometry from the first of the proposals whose poses held-out views ask for, or that believes them."""
    for start in proposals:
        geometry = _fit_around(family, views, start, config, known)
        if geometry is not None:
            return Fitted(geometry, start)
    return None


def _fit_around(
    family: Family, views: Views, start: PosedProposal, config: FitConfig, known: Surroundings
) -> Geometry | None:
    """A fit in the surroundings that the proposal asks for, if it explains clearly more than one in a far world; or in
    near ones that are `known` already.

    The far world is tried on from the fit in a near one, and only where it does as well, from the beginning.
    """
    source, posed = _source(family), views if start.poses is None else start.poses.moved(views)

    def follow(fitted: Geometry, surroundings: Surroundings) -> Geometry | None:
        return fit_at(family, views, start.after(fitted).in_surroundings(surroundings), config)

    around = proposed_surroundings(family, posed, start.proposal, config)
    if around.is_far:
        start = start if known.is_far else start.in_surroundings(FAR)
        return fit_with_poses(family, source, views, start, config)
    around = around if known.is_far else known
    near = fit_with_poses(family, source, views, start.in_surroundings(around), config)
    if near is None or not known.is_far:
        return near
    near = on_floor(views, near, follow, config)
    if config.surroundings.mode == "on":
        return near
    start = replace(start, poses=near.poses)
    far = fit_at(family, views, start.after(near).in_surroundings(FAR), config)
    return (
        near
        if explains_clearly_more(views, near, far, config)
        else fit_with_poses(family, source, views, start, config)
    )


def _bends_rather(
    family: Family, geometry: Geometry, proposals: Sequence[PosedProposal], views: Views, config: FitConfig
) -> bool:
    """Whether a kind that refines this one explains held-out views clearly better in a far world.

    In few steps where this one is in a far world, too. In near surroundings wholly fitted: a slight bend of a flat
    mirror shows much of what a near room shows.
    """
    others = [other for other in FAMILIES.values() if other.refines == family.kind]
    if held_out_parts(views) is None:
        return False
    if geometry.surroundings.is_far:
        return any(_bends_in_few_steps(other, geometry, views, config) for other in others)
    far = replace(config, surroundings=replace(config.surroundings, mode="off"))
    near = [each for each in proposals if _is_near(each, views, config, bent=True)]
    fitted = (_first_fit(other, near, views, far) for other in others)
    return any(each is not None and explains_clearly_more(views, each.geometry, geometry, config) for each in fitted)


@remembered()
def _bends_in_few_steps(other: Family, geometry: Geometry, views: Views, config: FitConfig) -> bool:
    """With the cameras where the geometry has them, from the shape before the first step on."""
    posed = geometry.corrected(views)
    proposal = proposed(_source(other), posed, config)
    if proposal is None:
        return False
    start = other.before_steps(posed, proposal, config)
    bent = other.fit(posed, replace(proposal, fitted=start), config)
    return explains_clearly_more(posed, bent, geometry.with_poses(None), config)


@remembered(lambda _, config: f"Stage 1 of 1: {FAMILIES[config.model].label}")
def _fit_asked(views: Views, config: FitConfig) -> tuple[Geometry, Selection]:
    family = FAMILIES[config.model]
    if views.object_frame.depth_is_open and family.needs_depth:
        raise along_one_line()
    fitted = _best_fit(family, _proposals(_source(family), views, config, asked=True), views, config, asked=True)
    assert fitted is not None, "a kind that is asked for is proposed"
    asked_for = Candidate(
        family.kind,
        Verdict.CHOSEN,
        "asked for",
        **_found(fitted, views, config),
    )
    return fitted.geometry, Selection(family.kind, (asked_for,))


def along_one_line() -> InputError:
    """What is said where views don't tell how far away the object is."""
    labels = " or ".join(family.label for family in FAMILIES.values() if not family.needs_depth)
    return InputError(
        expected=f"cameras that see the object from different directions, or {labels}",
        found="views along a single line",
        remedy="Add views from the sides; an arc of at least 30° is best.",
    )


def _refused_by_silhouettes(table: Sequence[Candidate]) -> InputError:
    labels = ", ".join(family.label for family in FAMILIES.values())
    return InputError(
        expected=f"silhouettes of {labels}",
        found="; ".join(f"{each.kind}: {describe(each)}" for each in table),
        remedy="Look whether masks and cameras are right, and take more views of more sides: a free-form surface needs "
        "5. --model surfels takes any silhouettes.",
    )


def _stage(family: Family, *_: object) -> str:
    """Which of the kinds is examined."""
    return f"Stage {list(FAMILIES).index(family.kind) + 1} of at most {len(FAMILIES)}: {family.label}"


@remembered(_stage)
def _examine(
    family: Family, proposals: Sequence[PosedProposal], views: Views, config: FitConfig
) -> tuple[Candidate, Geometry | None]:
    """The evidence for one kind, and its geometry where the silhouettes do not refuse it."""
    if not proposals:
        reason = "silhouettes determine none" if family.refines is None else f"no {family.refines} to start from"
        return Candidate(family.kind, Verdict.NOT_PROPOSED, reason), None
    fitted = _best_fit(family, proposals, views, config, asked=False)
    if fitted is None:
        said = proposals[-1].proposal
        evidence = said.silhouette_px, said.overlap
        return Candidate(family.kind, Verdict.REFUSED_BY_SILHOUETTES, "misses the silhouettes", *evidence), None
    geometry, start = fitted.geometry, fitted.start
    evidence = start.proposal.silhouette_px, start.proposal.overlap
    views = fitted.corrections.applied(views, config)
    errors = held_out_errors(usable_views(views, geometry), config, geometry)
    found = _found(fitted, views, config)
    if errors is None:
        return Candidate(family.kind, Verdict.CHOSEN, NONE_HELD_OUT, *evidence, **found), geometry
    error = float(errors.mean())
    unexplained = error > config.selection.largest_error
    verdict, reason = (Verdict.LEFT_TOO_MUCH, TOO_MUCH) if unexplained else (Verdict.CHOSEN, EXPLAINS)
    return Candidate(family.kind, verdict, reason, *evidence, error, **found), geometry


def _found(fitted: Fitted, views: Views, config: FitConfig) -> dict[str, Any]:
    """What a candidate states of photographs, and of cameras whose poses were unknowns."""
    poses, blocks = fitted.geometry.poses, tuple(asdict(each) for each in fitted.decisions)
    found = {"corrections": fitted.corrections, "blocks": blocks}
    if poses is None:
        return found
    principal = poses.principal_point_px(views, pose_prior(views, config.poses))
    return {**found, "camera_turn_deg": poses.turn_deg, "principal_point_px": principal}
