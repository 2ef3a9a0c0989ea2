"""A free-form surface from silhouettes and photographs: accepted Gauss–Newton steps, from coarse to fine."""

import math
from collections.abc import Iterator, MutableMapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from panoless.capture.lens import LensChange
from panoless.capture.poses import Poses, StatedCameras, with_pose_covariances
from panoless.capture.views import Views, split_held_out
from panoless.environment.rays import Rays
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.base import ToldPoses
from panoless.geometry.free_form.concave import concave_start
from panoless.geometry.free_form.observations import outline_rays, solid_pixels
from panoless.geometry.free_form.options import DEFAULTS, FreeFormOptions, FreeFormRound
from panoless.geometry.free_form.photometric import Sights, Solution, Task
from panoless.geometry.free_form.surface import LevelSet
from panoless.geometry.free_form.trust import Trust, full_trust
from panoless.journal import remembered
from panoless.numeric.conjugate_gradients import solve_by_products
from panoless.numeric.factorize import regularize
from panoless.numeric.gauss_newton import keep_if_better
from shinypartial.io.progress import Progress

THIRD_DIFFERENCE_DIAGONAL = 3 * 20 + 6 * 3 * 12 + 6 * 8
"""Of DᵀD: Σ over the kinds of how often one counts in |D³c|² times its squared factors."""
KNOWN = 1e9
"""Rays a texel that ask for nothing, under which the map stays."""
LEAST_BRIGHTNESS = 1e-6
"""Photographs that are black count as this bright (linear radiance)."""


@dataclass(frozen=True)
class FitStage:
    """A surface between two rounds, and what the next one starts from."""

    surface: LevelSet
    trust: Trust
    environment: Float[Tensor, "6 3 L L"] | None
    damping: float
    settings: FreeFormRound | None = None
    """Of the round that led here."""
    poses: Poses | None = None
    """Of the views, where they are unknowns."""
    lens: LensChange | None = None
    """Of all views, where it is unknown."""
    cost: float = math.inf
    """After that round."""

    @property
    def last(self) -> FreeFormRound:
        """The round that led here."""
        assert self.settings is not None, "a round was taken"
        return self.settings


@dataclass(frozen=True)
class Change:
    """A step of everything that is unknown: coefficients in cells, and what is unknown beside them."""

    coefficients: Float[np.ndarray, "A B C"]
    beside: list[Float[np.ndarray, "_ _"]]


def fit_free_form(
    views: Views,
    start: LevelSet,
    options: FreeFormOptions = DEFAULTS,
    *,
    lids: Sequence[LevelSet] = (),
    free_poses: bool = False,
) -> tuple[LevelSet, Trust, Poses | None]:
    """The surface that explains photographs and outlines best, no finer than held-out views want it, its trust, and the
    poses of the views where these are unknowns.

    Rounds are taken with four fifths of the views as long as the others gain by them, and the last of those once more
    with all, in which outlines count more where photographs agree with them. After the rounds that are always taken,
    hollows are searched, parts that pixels distrust are mended, details are looked for where much is left, and poses
    are set `free`, under the prior that views state of them. Hollows are searched under the start, and if there is
    none, under the `lids`, other first surfaces.
    """
    kept, held_out = split_held_out(views.train)
    solved = replace(views, train=tuple(kept)) if kept and held_out else views
    tested = replace(views, train=tuple(held_out))
    rounds = *options.rounds, *options.finer
    again = max(settings.steps for settings in (options.rounds[-1], *options.finer, *options.detailing[-1:]))
    progress = Progress("fitting a free-form surface", sum(settings.steps for settings in rounds) + again)

    known: MutableMapping[FitStage, float] = WeakIdKeyDictionary()

    def error(stage: FitStage) -> float:
        if stage not in known:
            known[stage] = held_out_error(solved, tested, stage, options)
        return known[stage]

    def better(stage: FitStage, other: FitStage, least_gain: float) -> FitStage:
        return keep_if_better((stage, other), error, least_gain)

    with torch.no_grad():
        stage = coarse_stage(solved, start, options.rounds, options, progress)
        begun, hollowed = start, None
        for lid in (start, *lids) if options.concave.search else ():
            hollowed = concave_start(solved, lid, stage.surface, options.concave)
            if hollowed is not None:
                break
        if hollowed is not None:
            deeper = coarse_stage(solved, hollowed, options.concave.rounds, options)
            stage = better(stage, deeper, options.concave.least_held_out_gain) if held_out else deeper
            begun = hollowed if stage is deeper else start
        if held_out:
            stage = keep_if_better(mended_stages(solved, stage, options), error, options.least_mending_gain)
            if options.detailing and not free_poses and error(stage) > options.detailed_error:
                stage = better(stage, _detailed_stage(solved, begun, options), options.least_detailing_gain)
        if free_poses:
            stage = take_round(solved, replace(stage, poses=Poses.none(len(solved.train))), stage.last, options)
        if held_out:
            stage = keep_if_better(_stages(solved, stage, options, progress), error, options.least_held_out_gain)
        skipped = progress.total - progress.done - stage.last.steps
        if skipped > 0:
            progress.advance(steps=skipped)
        if stage.poses is not None and held_out:
            stage = replace(stage, poses=_joined(stage.poses, found_poses(solved, tested, stage, options)))
        stage = take_round(views, stage, stage.last, options, progress, last=True)
    return stage.surface, stage.trust, stage.poses


def follow_views(
    views: Views, fitted: FitStage, options: FreeFormOptions = DEFAULTS, *, longer: bool = False
) -> FitStage:
    """What an earlier fit led to after its last round was taken again, with views that changed a little, or with the
    lens among the unknowns. A few steps by fewer pixels tell whether that asks for more of them, or for as many
    without where `longer`.
    """
    rounds = [*options.detailing, *options.rounds, *options.finer]
    last = next((each for each in reversed(rounds) if each.cells == fitted.surface.cells), rounds[-1])
    stage, settings = replace(fitted, settings=last), last
    with torch.no_grad():
        if stage.lens is not None:
            glance = replace(
                settings, steps=options.lens_glance_steps, rays=min(options.lens_glance_rays, settings.rays)
            )
            seen = take_round(views, stage, glance, options, last=True)
            assert seen.lens is not None, "the lens was unknown"
            least = seen.lens.of_unknowns(options.least_focal_change, options.least_k1_change)
            if (np.abs(seen.lens.values) < least).all():
                return seen
        if longer or stage.lens is not None or not stage.surface.surroundings.is_far:
            settings = replace(settings, steps=options.shared_steps)
            options = replace(options, least_gain=options.least_shared_gain)
        return take_round(views, stage, settings, options, Progress("fitting on", settings.steps), last=True)


def coarse_stage(
    views: Views,
    start: LevelSet,
    rounds: Sequence[FreeFormRound],
    options: FreeFormOptions,
    progress: Progress | None = None,
    poses: Poses | None = None,
) -> FitStage:
    """What rounds lead to from a first surface, and from poses where these are unknowns."""
    stage = FitStage(start, full_trust(start, options.trust_cells), None, options.damping, poses=poses)
    for settings in rounds:
        stage = take_round(views, stage, settings, options, progress)
    return stage


def _detailed_stage(views: Views, start: LevelSet, options: FreeFormOptions) -> FitStage:
    """What fine grids under coarse maps lead to from a first surface."""
    progress = Progress("looking for details", sum(each.steps for each in options.detailing))
    return coarse_stage(views, start, options.detailing, options, progress)


def poses_by_outlines(
    views: Views,
    starts: Sequence[LevelSet],
    options: FreeFormOptions = DEFAULTS,
    *,
    views_agree: bool = True,
    always: bool = False,
) -> ToldPoses | None:
    """Poses that outlines alone tell, beside a shape that starts from the best of some first surfaces, under the prior
    that views state of them; but `always` None where a shape under believed poses costs little more. The first start
    that tells so is believed where `views_agree` on a hull.

    How far a face bulges is nothing to outlines, so a wrong shape can't draw cameras along, as it does by photographs.
    From one view, a turn looks much like a shift. How large either is in all views is known better: what cameras are
    turned about their lines of sight, or shifted along these, looks like nothing else. So poses are found again under a
    prior of the sizes that turns and shifts were found to have.
    """
    wide, settings = replace(options, outline_scale_px=options.pose_outline_scale_px), options.outline_round
    glance = replace(wide, outline_points=min(options.pose_glance_points, options.outline_points))
    with torch.no_grad():
        cost, least, start = math.inf, math.inf, starts[0]
        for each in starts:
            free = coarse_stage(views, each, [settings], glance, poses=Poses.none(len(views.train))).cost
            if free < least:
                least, start = free, each
            if not always:
                cost = min(cost, coarse_stage(views, each, [settings], glance).cost)
            if views_agree and least > options.largest_cost_left * cost:
                return None
        if least > options.largest_cost_left * cost:
            return None
        told = coarse_stage(views, start, [settings], wide, poses=Poses.none(len(views.train)))
        task, cameras = make_task(views, settings, wide), StatedCameras.of(views)
        stated = task.pose_prior
        for _ in range(options.pose_prior_rounds):
            assert told.poses is not None, "poses were free"
            prior = told.poses.likely_prior(cameras, stated, options.least_pose_share)
            views = with_pose_covariances(views, np.linalg.inv(regularize(prior, "the poses")))
            told = coarse_stage(views, start, [settings], wide, poses=Poses.none(len(views.train)))
            task = make_task(views, settings, wide)
        assert told.poses is not None, "poses were free"
        known = Solution.at(task, told.surface, told.trust, None, 0, told.poses).beside[0].blocks - task.pose_prior
    precision = regularize(options.outline_trust * known + task.pose_prior, "the poses")
    return ToldPoses(told.poses, np.linalg.inv(precision), task.pose_prior)


def _joined(solved: Poses, tested: Poses) -> Poses:
    """Poses of all views from those of the two parts."""
    order = np.argsort(np.concatenate(split_held_out(range(len(solved.turns) + len(tested.turns)))))
    both = np.concatenate([solved.stacked, tested.stacked])[order]
    return Poses(both[:, :3], both[:, 3:])


def found_poses(solved: Views, views: Views, stage: FitStage, options: FreeFormOptions) -> Poses:
    """Poses of views that took no part, under the surface and the map of those that did, which stay as they are."""
    known = make_task(solved, stage.last, options)
    under = Solution.at(known, stage.surface, stage.trust, None, options.first_map_rounds, stage.poses)
    environment = under.environment
    settings = replace(stage.last, steps=options.pose_steps, under_known_map=True)
    task = make_task(views, settings, options)
    poses = Poses.none(len(views.train))
    solution = Solution.at(task, stage.surface, stage.trust, environment, 0, poses)
    moved = take_steps(solution, stage.damping, still=True)[0].poses
    assert moved is not None, "poses were free"
    return moved


def _stages(views: Views, stage: FitStage, options: FreeFormOptions, progress: Progress) -> Iterator[FitStage]:
    """A stage, and those after each of the rounds that are finer."""
    yield stage
    for settings in [each for each in options.finer if each.cells >= stage.last.cells]:
        stage = take_round(views, stage, settings, options, progress)
        yield stage


def mended_stages(views: Views, stage: FitStage, options: FreeFormOptions) -> Iterator[FitStage]:
    """A stage, and those after each mending of its distrusted parts.

    A part that the first surface has wrong lost its say, and few pixels are left to mend it by. But the others tell
    the map, so under that all pixels pull such a part to where it belongs: coarsely at first, from far off.
    """
    yield stage
    for _ in range(options.most_mendings if options.mending else 0):
        if distrusted_share(views, stage, options) < options.least_distrusted:
            return
        settings, progress = stage.last, Progress("mending", sum(each.steps for each in options.mending))
        for each in options.mending:
            stage = take_round(views, stage, each, options, progress)
        stage = replace(stage, settings=settings)
        yield stage


def distrusted_share(views: Views, stage: FitStage, options: FreeFormOptions) -> float:
    """Of the pixels that see the surroundings: how many lie where trust is low."""
    surface, rays = stage.surface, solid_pixels(views, options.held_out_rays).rays
    sights = Sights.of(surface, rays, 1, options.least_cosine)
    trust = stage.trust.at(surface.points(sights.hits.places[sights.clear]))
    return float((trust < options.distrusted).mean()) if len(trust) else 0.0


@remembered()
def take_round(
    views: Views,
    stage: FitStage,
    settings: FreeFormRound,
    options: FreeFormOptions,
    progress: Progress | None = None,
    *,
    last: bool = False,
) -> FitStage:
    """A stage after the steps of a round; in the `last` one outlines count more where photographs agree with them."""
    surface = stage.surface
    if stage.settings is None or stage.settings.cells != settings.cells:
        surface = surface.resampled(settings.cells)
    task = make_task(views, settings, options)
    if settings.anchored:
        task = replace(task, anchor=surface.coefficients)
    solution = Solution.at(
        task, surface, stage.trust, stage.environment, options.first_map_rounds, stage.poses, stage.lens
    )
    if last and solution.outlines_agree:
        solution = replace(solution, task=task.outlined(options.agreed_outline_gain))
    solution, damping = take_steps(solution, stage.damping, progress)
    found = replace(
        stage,
        surface=solution.surface,
        trust=solution.trust,
        environment=solution.environment,
        damping=damping,
        settings=settings,
        poses=solution.poses,
        lens=solution.lens,
        cost=solution.cost(solution),
    )
    if solution.poses is None:
        return found
    # The map follows with the next round, which starts it anew.
    common, poses = solution.poses.without_common(task.cameras, task.pose_prior)
    return replace(found, surface=solution.surface.taken_back(common), poses=poses, environment=None)


def make_task(views: Views, settings: FreeFormRound, options: FreeFormOptions) -> Task:
    """The pixels and outlines of a round, weighted as if `counted_rays` pixels took part.

    Under coarse maps pixels are wrong by the robust scale s, not by their noise σ: where outlines hold the surface,
    they count (s/σ)² times as much.
    """
    if settings.under_known_map:
        options = replace(options, map_rounds=0, texel_prior=KNOWN)
    pixels, outlines = solid_pixels(views, settings.rays), outline_rays(views)
    total = max(views.num_solid, 1)
    chosen = outlines.chosen(slice(None, None, max(1, -(-len(outlines.size) // options.outline_points))))
    counted = 0.0 if settings.outlines_alone else options.counted_rays
    share = counted / options.radiance_sigma**2 / max(len(pixels.inner_px), 1)
    density = options.counted_rays / total * len(outlines.size) / max(len(chosen.size), 1)
    believed = (settings.robust_scale / options.radiance_sigma) ** 2 if settings.held else 1.0
    outlined = settings.outline_gain * believed * density / options.outline_sigma_px**2
    brightness = max(float(pixels.radiance.mean()), LEAST_BRIGHTNESS)
    return Task(pixels, chosen, share, outlined, settings, options, StatedCameras.of(views), brightness)


def take_steps(
    solution: Solution, damping: float, progress: Progress | None = None, *, still: bool = False
) -> tuple[Solution, float]:
    """The steps of a round, each of which lowers the cost with hits, visibility and map made anew; the last damping."""
    options, settings = solution.task.options, solution.task.settings
    for index in range(settings.steps):
        if not still:
            solution = replace(solution, trust=measured_trust(solution))
        before = solution
        solution, shortened = _accepted(solution, gauss_newton_step(solution, damping, still=still))
        stiffest = damping >= options.damping_range[1]
        factor = options.damping_more**shortened if shortened else options.damping_less
        damping = float(np.clip(damping * factor, *options.damping_range))
        gain = 1 - solution.cost(before) / before.cost(before)
        last = gain < options.least_gain and (shortened < options.trials or stiffest)
        if progress is not None:
            progress.advance(steps=settings.steps - index if last else 1)
        if last:
            break
    return solution, damping


def _accepted(solution: Solution, step: Change) -> tuple[Solution, int]:
    """The solution after the longest of the tried lengths of a step that lowers the cost, and how many times it was
    shortened; the same solution after none, and the number of trials.
    """
    options, before = solution.task.options, solution.cost(solution)
    for shortened in range(options.trials):
        length = options.shortening**shortened
        moved = solution.after(length * step.coefficients, [length * each for each in step.beside])
        if moved.cost(solution) < before:
            return moved, shortened
    return solution, options.trials


def gauss_newton_step(solution: Solution, damping: float, *, still: bool = False) -> Change:
    """−(H + μ diag H)⁻¹ g by conjugate gradients, nowhere longer than the longest step; in a `still` scene only
    poses move.

    That is preconditioned by its blocks: with H = L Lᵀ of a block its unknowns are y = Lᵀ x.
    """
    options, shape = solution.task.options, solution.surface.shape
    diagonal, size = solution.diagonal(THIRD_DIFFERENCE_DIAGONAL), solution.surface.coefficients.size
    damped = [each.blocks * (1 + damping * np.eye(each.blocks.shape[1])) for each in solution.beside]
    back = [np.linalg.inv(np.linalg.cholesky(regularize(blocks, "the poses"))).transpose(0, 2, 1) for blocks in damped]
    ends = np.cumsum([size, *(each.value.size for each in solution.beside)])

    def unpacked(values: Float[np.ndarray, "N"]) -> Change:
        parts = zip(back, ends[:-1], ends[1:], strict=True)
        beside = [np.matmul(of, values[first:last].reshape(*of.shape[:2], 1))[..., 0] for of, first, last in parts]
        return Change(values[:size].reshape(shape), beside)

    def packed(change: Float[np.ndarray, "A B C"], beside: Sequence[Float[np.ndarray, "_ _"]]) -> np.ndarray:
        parts = zip(back, beside, strict=True)
        return np.concatenate(
            [change.ravel(), *(np.matmul(of.transpose(0, 2, 1), part[..., None]).ravel() for of, part in parts)]
        )

    def product(values: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
        change = unpacked(values)
        by_change, by_others = solution.product(change.coefficients, change.beside)
        for each, moved, by_moved in zip(solution.beside, change.beside, by_others, strict=True):
            by_moved += damping * np.einsum("bmm->bm", each.blocks) * moved
        return packed(by_change + damping * diagonal * change.coefficients, by_others)

    gradient, beside = solution.gradient()
    free = np.zeros(shape) if still else solution.active / (diagonal * (1 + damping))
    moving = [np.full(each.value.size, not still or index == 0) for index, each in enumerate(solution.beside)]
    found = solve_by_products(
        product,
        -packed(gradient, beside),
        np.concatenate([free.ravel(), *moving]),
        solution.task.settings.solver_steps,
        options.solver_tolerance,
    )
    change = unpacked(found)
    longest = options.largest_step_cells
    return replace(change, coefficients=np.clip(change.coefficients, -longest, longest))


def measured_trust(solution: Solution) -> Trust:
    """Trust by the residuals of a solution."""
    points, clear = solution.surface.points(solution.sights.hits.places), solution.free > 0
    return solution.trust.measured(points, solution.residual, solution.free, clear, solution.task.options)


def held_out_error(solved: Views, tested: Views, stage: FitStage, options: FreeFormOptions) -> float:
    """Mean of ‖e‖²/(‖e‖² + s²) over rays of views that neither surface nor map have seen, and 1 for those that miss the
    surface.

    Where poses are unknowns, those of the tested views are found first: six numbers each, against thousands of pixels.
    """
    poses = None if stage.poses is None else found_poses(solved, tested, stage, options)
    known, _ = _rays(solved, stage.surface, stage.poses, options)
    unknown, missed = _rays(tested, stage.surface, poses, options)
    error = prediction_error([unknown], solve_environment([known], options.held_out_resolution))
    return (len(unknown.directions) * error + missed) / max(len(unknown.directions) + missed, 1)


def _rays(views: Views, surface: LevelSet, poses: Poses | None, options: FreeFormOptions) -> tuple[Rays, int]:
    """Of pixels well inside the masks: those that see the surroundings, and how many miss the surface."""
    pixels = solid_pixels(views, options.held_out_rays)
    rays = pixels.rays if poses is None else pixels.rays.moved(poses)
    sights, inner = Sights.of(surface, rays, 1, options.least_cosine), pixels.inner_px > options.inner_px
    clear = sights.clear & inner
    outgoing, radiance = (
        torch.from_numpy(values[clear]).float() for values in (sights.outgoing[:, 0], pixels.radiance)
    )
    return Rays(outgoing, radiance), int((inner & ~sights.hits.met).sum())
