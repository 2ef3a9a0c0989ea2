"""Which kind of geometry a scene needs: the simplest that explains silhouettes and held-out views.

A kind that is not needed costs accuracy, too: tilting a flat mirror and turning the environment the other way leaves
every picture as it was.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from panoless.capture.poses import Poses, StatedCameras
from panoless.capture.silhouettes import silhouette_distance_px
from panoless.capture.views import Views, held_out_parts
from panoless.config import FitConfig
from panoless.deadline import improving, is_past_limit
from panoless.first_surface.visual_hull import contradiction_px
from panoless.geometry.base import Family, Geometry, Proposal
from panoless.geometry.exact import LARGEST_SHARE_LEFT
from panoless.geometry.registry import FAMILIES
from panoless.journal import remembered
from panoless.problem.blocks import SHIFT, STATED_FLOOR, TURN_DEG
from panoless.selection.candidates import MATTE, Candidate, Selection, Verdict, describe
from panoless.selection.fitted import Fitted, is_refined, missed_share
from panoless.selection.held_out import LEAST_GAIN, held_out_errors, is_matte
from panoless.selection.joint import fit_jointly, nuisance_kinds, proposed, refitted
from panoless.selection.material import usable_as_perfect_mirror
from panoless.selection.surroundings import explains_clearly_more
from shinypartial.core.errors import InputError

ANY = "auto"
LEAST = "leaves much unexplained, and nothing explains more"
BENT = "a bend explains clearly more"
EXPLAINS = "explains held-out views"
OTHER = "another kind is preferred"
TOO_MUCH = "leaves too much unexplained"
NONE_HELD_OUT = "too few views to hold one out"
LARGEST_SILHOUETTE_PX = 0.5
"""A candidate's silhouette lies at most this far from the masks' contours: median over views of the median."""
LEAST_NEAR_OVERLAP = 0.98
"""Its silhouette and the masks share at least this part of their union: median over views. Both are for silhouettes
that agree with each other. Where they contradict each other a candidate may be farther from them by as much."""
FARTHEST = 4.0
"""What is farther off than so many times either is not near, however much silhouettes contradict each other: wrong
cameras make them do so, too, and are turned."""
BENT_EDGE = 2.0
"""What a kind refines may be farther from the masks by this factor: its edge bends, too."""
LARGEST_ERROR = 0.3
"""A candidate that leaves more of the held-out views unexplained is refused, unless no later kind explains more."""
DOUBTED_ERROR = 0.15
"""Where a candidate leaves more, later ones are examined, too, unless silhouettes determine its whole shape."""
DOUBTED_SHARE = 0.5
"""One of those is preferred where it leaves less than this share of that."""
LEAST_OVERLAP = 0.75
"""No turns are looked for where a shape overlaps less with the masks: mirror and vase do by 0.86 and 0.83 with turns of
2°, and a plane by 0.70 with sculpture."""
TRIAL_VIEWS = 16
"""So many views determine first, where there are at least twice as many, whether turns bring a shape near."""


def choose_geometry(views: Views, config: FitConfig) -> tuple[Geometry, Selection]:
    """The geometry of the scene and the evidence for it.

    Candidates are examined from the simplest on. One is refused when it misses the silhouettes, or when a kind that
    refines it explains held-out views clearly better. One that leaves more than right ones do is taken unless one after
    it leaves much less, or at once where silhouettes determine its whole shape. One that leaves too much waits until
    all others are refused; of those the one that leaves least is taken. `config.model` overrides.
    Raises InputError when a kind is requested and can't be proposed, and when the silhouettes refuse all kinds.
    """
    if config.model != ANY:
        return _fit_requested(views, config)
    families = list(FAMILIES.values())
    if views.object_frame.depth_is_open:
        families = [family for family in families if not family.needs_depth]
    table, refused = list[Candidate](), dict[str, Start | None]()
    fitted = list[tuple[Candidate, Geometry]]()
    for family in families:
        if fitted and is_past_limit():
            break
        source = _source(family)
        if family.refines is None:
            before = start = begun(family, views, config, requested=False)
        else:
            before = refused.get(source.kind)
            start = begun_over(family, before, views, config)
        candidate, geometry = _examine(family, start, views, config)
        table.append(candidate)
        refused[family.kind] = start if start is not None and is_near(start, views, config, bent=True) else None
        if geometry is None:
            continue
        if candidate.is_matte:
            return _chosen(candidate, geometry, table)
        explains = candidate.verdict == Verdict.CHOSEN
        corrected = candidate.corrections.applied(views, config)
        if explains and _bends_rather(family, geometry, before, corrected, config):
            table[-1] = candidate = replace(candidate, verdict=Verdict.REFUSED_BY_HELD_OUT_VIEWS, reason=BENT)
            explains = False
        fitted.append((candidate, geometry))
        if explains and (family.silhouettes_suffice or error_of(fitted[-1]) <= DOUBTED_ERROR):
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
        enough = DOUBTED_SHARE * error_of(chosen)
        if error_of(each) < enough and _with_missed(each, views, config) < enough:
            chosen = each
    return chosen


def _with_missed(each: tuple[Candidate, Geometry], views: Views, config: FitConfig) -> float:
    """The held-out error with pixels unexplained that lie well inside the masks and off the geometry: a surface with a
    hole in it explains the rest.
    """
    candidate, geometry = each
    missed = missed_share(candidate.corrections.applied(views, config), geometry)
    return missed + (1 - missed) * error_of(each)


def least_unexplained(fitted: Sequence[tuple[Candidate, Geometry]], config: FitConfig) -> tuple[Candidate, Geometry]:
    """Of what leaves too much unexplained, the simplest than which nothing else explains clearly more. A kind that
    another kind starts from counts only where no other was fitted.
    """
    waiting = [each for each in fitted if not is_refined(each[0].kind)] or fitted
    enough = min(map(error_of, waiting)) / (1 - LEAST_GAIN)
    return next(each for each in waiting if error_of(each) <= enough)


def _source(family: Family) -> Family:
    """The kind that makes the proposals."""
    return family if family.refines is None else FAMILIES[family.refines]


@dataclass(frozen=True)
class Start:
    """A proposal, and the poses under which it was made; None: as they are stated."""

    proposal: Proposal
    poses: Poses | None = None


@remembered()
def begun(source: Family, views: Views, config: FitConfig, *, requested: bool) -> Start | None:
    """A proposal, with the cameras as they are stated, or where silhouettes turn them if that brings it clearly nearer
    to the masks. A few of many views determine first whether it does.
    """
    first = proposed(source, views, config, requested=requested)
    if first is None:
        return None
    start = Start(first)
    is_off = np.isfinite(first.silhouette_px) and first.overlap >= LEAST_OVERLAP
    if config.corrections.poses == "off" or not is_off or is_near(start, views, config, bent=False):
        return start
    stride = len(views.train) // TRIAL_VIEWS
    if stride >= 2 and not requested:
        few = replace(views, train=views.train[::stride])
        turned = _turned(source, few, first, config)
        if turned is None or not is_near(turned, few, config, bent=True):
            return start
    return _turned(source, views, first, config) or start


@remembered()
def begun_over(
    family: Family, start: Start | None, views: Views, config: FitConfig, *, requested: bool = False
) -> Start | None:
    """What a kind that refines another starts from, by the start of that one."""
    if start is None:
        return None
    posed = views if start.poses is None else start.poses.moved(views)
    found = family.proposed_over(posed, start.proposal, config, requested=requested)
    return None if found is None else replace(start, proposal=found)


def _turned(source: Family, views: Views, first: Proposal, config: FitConfig) -> Start | None:
    """A proposal under cameras that are turned by silhouettes; None where it is hardly nearer to the masks."""
    poses = source.poses_by_silhouettes(views, first, nuisance_kinds(config)[0], config)
    again = proposed(source, poses.moved(views), config)
    if again is None or again.silhouette_px > LARGEST_SHARE_LEFT * first.silhouette_px:
        return None
    return Start(again, poses)


def is_near(start: Start, views: Views, config: FitConfig, *, bent: bool) -> bool:
    """Whether a proposal explains the silhouettes, or would where a kind that refines it bends its edge.

    Silhouettes that contradict each other miss any shape. By d pixels, they leave the share d · length / area of the
    object to one side alone.
    """
    proposal, farther = start.proposal, BENT_EDGE if bent else 1.0
    outside, missed = farther * LARGEST_SILHOUETTE_PX, farther * (1 - LEAST_NEAR_OVERLAP)
    away, apart = proposal.silhouette_px, 1 - proposal.overlap
    if away <= outside and apart <= missed:
        return True
    if away > FARTHEST * outside or apart > FARTHEST * missed:
        return False
    error_px = contradiction_px(views if start.poses is None else start.poses.moved(views))
    return away <= outside + error_px and apart <= missed + error_px * _silhouette_share(views)


def _silhouette_share(views: Views) -> float:
    """Length of the silhouette over the area of the object, in pixels: median over views."""
    shares = [
        float(((distance := silhouette_distance_px(view.mask)) < 0).logical_and(distance > -1).sum())
        / float((distance < 0).sum().clamp(min=1))
        for view in views.train
    ]
    return float(np.median(shares))


def _bends_rather(family: Family, geometry: Geometry, start: Start | None, views: Views, config: FitConfig) -> bool:
    """Whether a kind that refines this one, or the same, explains held-out views clearly better in a far world.

    In few steps where this one is in a far world, too. In near surroundings wholly fitted: a slight bend of a flat
    mirror shows much of what a near room shows.
    """
    over = {family.kind, family.refines} - {None}
    rivals = [other for other in FAMILIES.values() if other.refines in over and other is not family]
    others = [other for other in rivals if other.in_few_steps]
    if held_out_parts(views) is None:
        return False
    with improving():
        bent = (_bent(other, geometry, start, views, config) for other in others)
        return any(each is not None and explains_clearly_more(views, each, geometry) for each in bent)
    return False


@remembered()
def _bent(other: Family, geometry: Geometry, start: Start | None, views: Views, config: FitConfig) -> Geometry | None:
    """A kind that refines a geometry; in few steps with its cameras, from the shape before the first step on."""
    if geometry.surroundings.is_far:
        posed = geometry.corrected(views)
        proposal = proposed(_source(other), posed, config)
        if proposal is None:
            return None
        begin = other.before_steps(posed, proposal, config)
        return refitted(other, posed, begin, begin.surroundings, config).with_poses(geometry.poses)
    if start is None or not is_near(start, views, config, bent=True):
        return None
    far = replace(config, surroundings=replace(config.surroundings, mode="off"))
    return fit_jointly(other, _source(other), views, start.proposal, far).geometry


@remembered(lambda _, config: f"Stage 1 of 1: {FAMILIES[config.model].label}")
def _fit_requested(views: Views, config: FitConfig) -> tuple[Geometry, Selection]:
    family = FAMILIES[config.model]
    if views.object_frame.depth_is_open and family.needs_depth:
        raise along_one_line()
    start = begun(_source(family), views, config, requested=True)
    if family.refines is not None:
        start = begun_over(family, start, views, config, requested=True)
    assert start is not None, "a kind that is requested is proposed"
    fitted = fit_jointly(family, _source(family), views, start.proposal, config)
    requested = Candidate(
        family.kind,
        Verdict.CHOSEN,
        "requested",
        **_found(fitted, views),
    )
    return fitted.geometry, Selection(family.kind, (requested,))


def along_one_line() -> InputError:
    """What is said where views don't determine how far away the object is."""
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
def _examine(family: Family, start: Start | None, views: Views, config: FitConfig) -> tuple[Candidate, Geometry | None]:
    """The evidence for one kind, and its geometry where the silhouettes do not refuse it."""
    if start is None:
        reason = "silhouettes determine none" if family.refines is None else f"no {family.refines} to start from"
        return Candidate(family.kind, Verdict.NOT_PROPOSED, reason), None
    evidence = start.proposal.silhouette_px, start.proposal.overlap
    if not is_near(start, views, config, bent=family.refines is not None):
        return Candidate(family.kind, Verdict.REFUSED_BY_SILHOUETTES, "misses the silhouettes", *evidence), None
    surface = family.as_proposed(start.proposal, config)
    if is_matte(views, surface, config):
        return Candidate(family.kind, Verdict.CHOSEN, MATTE, *evidence), surface
    fitted = fit_jointly(family, _source(family), views, start.proposal, config)
    geometry, found = fitted.geometry, _found(fitted, views)
    views = fitted.corrections.applied(views, config)
    errors = held_out_errors(usable_as_perfect_mirror(views, geometry, config), config, geometry)
    if errors is None:
        return Candidate(family.kind, Verdict.CHOSEN, NONE_HELD_OUT, *evidence, **found), geometry
    error = float(errors.mean())
    unexplained = error > LARGEST_ERROR
    verdict, reason = (Verdict.LEFT_TOO_MUCH, TOO_MUCH) if unexplained else (Verdict.CHOSEN, EXPLAINS)
    return Candidate(family.kind, verdict, reason, *evidence, error, **found), geometry


def _found(fitted: Fitted, views: Views) -> dict[str, Any]:
    """What a candidate states of photographs, and of cameras whose poses were unknowns."""
    poses, blocks = fitted.geometry.poses, tuple(asdict(each) for each in fitted.decisions)
    found = {"corrections": fitted.corrections, "blocks": blocks}
    if poses is None:
        return found
    prior = StatedCameras.of(views).prior(math.radians(TURN_DEG), SHIFT, STATED_FLOOR)
    principal = poses.principal_point_px(views, prior)
    return {**found, "camera_turn_deg": poses.turn_deg, "principal_point_px": principal}
