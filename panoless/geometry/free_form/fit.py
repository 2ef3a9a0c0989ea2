"""A free-form surface from silhouettes and photographs: accepted Gauss–Newton steps, from coarse to fine."""

from collections.abc import Collection, Iterator, MutableMapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from panoless.capture.poses import StatedCameras
from panoless.capture.views import Views, split_held_out
from panoless.environment.rays import Rays
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.free_form.concave import concave_start
from panoless.geometry.free_form.options import DEFAULTS, FreeFormOptions, FreeFormRound
from panoless.geometry.free_form.photometric import Sights, Solution, Task
from panoless.geometry.free_form.steps import solved_equations, take_steps, with_noise
from panoless.geometry.free_form.surface import LevelSet
from panoless.geometry.free_form.trust import Trust, full_trust
from panoless.journal import remembered
from panoless.numeric.factorize import regularize
from panoless.numeric.gauss_newton import keep_if_better
from panoless.problem.evidence import Decision, decided
from panoless.problem.nuisance import (
    NO_NUISANCE,
    CameraPoses,
    Distortion,
    Exposures,
    Nuisance,
    WhiteBalances,
    nuisance_of,
)
from panoless.problem.observations import is_saturated, outline_rays, solid_pixels
from shinypartial.io.progress import Progress

KNOWN = 1e9
"""Rays a texel that ask for nothing, under which the map stays."""
SHARED_SCALE = 0.2
"""Robust scale above which what all views share stays: its derivative under a coarse map has the wrong sign."""
LAST_RAYS = 2.5
"""Factor of the pixels of the last round, which all views take: those before lead to where it starts."""
JUDGED_RAYS = 40_000
"""Pixels by which blocks are judged."""
VARIANCE_STEPS = 60
"""Conjugate-gradient steps of a variance, which fewer understate."""
SETTLING_STEPS = 3
"""In which distortion is found beside what is known."""
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
    nuisance: Nuisance = NO_NUISANCE
    """Cameras, exposures and masks, where these are unknown."""

    @classmethod
    def begun(cls, surface: LevelSet, options: FreeFormOptions, nuisance: Nuisance = NO_NUISANCE) -> "FitStage":
        """A surface that is trusted everywhere, before its first round."""
        return cls(surface, full_trust(surface, options.trust_cells), None, options.damping, nuisance=nuisance)

    @property
    def last(self) -> FreeFormRound:
        """The round that led here."""
        assert self.settings is not None, "a round was taken"
        return self.settings


def fit_free_form(
    views: Views,
    start: LevelSet,
    options: FreeFormOptions = DEFAULTS,
    *,
    lids: Sequence[LevelSet] = (),
    nuisance: Nuisance = NO_NUISANCE,
    required: Collection[str] = (),
) -> tuple[FitStage, list[Decision]]:
    """The surface that explains photographs and outlines best, no finer than held-out views want it, with the nuisance
    blocks that the scene needs; and what was decided of each.

    Rounds are taken with four fifths of the views as long as the others gain by them, and the last of those once more
    with all, in which outlines count more where photographs agree with them. After the rounds that are always taken,
    hollows are searched, blocks that are not `required` are removed unless they are needed, parts that pixels distrust
    are mended, and details are looked for where much is left. Hollows are searched under the start, and if there is
    none, under the `lids`, other first surfaces.
    """
    kept, others = split_held_out(range(len(views.train)))
    if not kept or not others:
        kept, others = list(range(len(views.train))), []
    solved, tested = (replace(views, train=tuple(views.train[number] for number in part)) for part in (kept, others))
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
        usual = nuisance.freed([name for name in nuisance.free if name != Distortion.name]).of_views(kept)
        stage = coarse_stage(solved, start, options.rounds, options, progress, usual)
        begun, hollowed = start, None
        for lid in (start, *lids) if options.concave.search else ():
            hollowed = concave_start(solved, lid, stage.surface, options.concave)
            if hollowed is not None:
                break
        if hollowed is not None:
            deeper = coarse_stage(solved, hollowed, options.concave.rounds, options, nuisance=stage.nuisance)
            stage = better(stage, deeper, options.concave.least_held_out_gain) if others else deeper
            begun = hollowed if stage is deeper else start
        stage, decisions = _needed(solved, stage, required, options)
        if not all(each.kept for each in decisions.values()):
            # A surface that gave way to blocks does not come back from them by going on.
            rounds = options.rounds if begun is start else options.concave.rounds
            stage = coarse_stage(solved, begun, rounds, options, nuisance=stage.nuisance)
        if others:
            stage = keep_if_better(mended_stages(solved, stage, options), error, options.least_mending_gain)
            if options.detailing and error(stage) > options.detailed_error:
                stage = better(
                    stage, _detailed_stage(solved, begun, stage.nuisance, options), options.least_detailing_gain
                )
            stage = keep_if_better(_stages(solved, stage, options, progress), error, options.least_held_out_gain)
        stage, later = _needed(solved, _with_distortion(solved, stage, options), required, options)
        skipped = progress.total - progress.done - stage.last.steps
        if skipped > 0:
            progress.advance(steps=skipped)
        if others:
            unseen = predicted(solved, tested, stage, options)
            stage = replace(stage, nuisance=joined(stage.nuisance, unseen, len(views.train)))
        settings = replace(stage.last, rays=round(LAST_RAYS * stage.last.rays))
        return take_round(views, stage, settings, options, progress, last=True), list((decisions | later).values())


def _needed(
    views: Views, stage: FitStage, required: Collection[str], options: FreeFormOptions
) -> tuple[FitStage, dict[str, Decision]]:
    """A stage without the free blocks that the scene does not need, and what was decided of each."""
    known = variances(views, stage, options)
    blocks = [each for each in stage.nuisance.blocks if each.name in stage.nuisance.free]
    decisions = {each.name: decided(each, known[each.name], required=each.name in required) for each in blocks}
    needless = [each.name for each in decisions.values() if not each.kept]
    return replace(stage, nuisance=stage.nuisance.without(needless)), decisions


def _with_distortion(views: Views, stage: FitStage, options: FreeFormOptions) -> FitStage:
    """A stage after a few steps with the distortion beside what is free, where it is an unknown."""
    if stage.nuisance.get(Distortion) is None:
        return stage
    free = stage.nuisance.freed([*stage.nuisance.free, Distortion.name])
    settings = replace(stage.last, steps=SETTLING_STEPS, rays=min(stage.last.rays, JUDGED_RAYS))
    return replace(take_round(views, replace(stage, nuisance=free), settings, options), settings=stage.last)


def follow_views(views: Views, fitted: FitStage, options: FreeFormOptions = DEFAULTS) -> FitStage:
    """What an earlier fit led to after its last round was taken again, with views that changed a little. In near
    surroundings that takes more steps.
    """
    rounds = [*options.detailing, *options.rounds, *options.finer]
    last = next((each for each in reversed(rounds) if each.cells == fitted.surface.cells), rounds[-1])
    stage, settings = replace(fitted, settings=last), replace(last, rays=round(LAST_RAYS * last.rays))
    with torch.no_grad():
        if not stage.surface.surroundings.is_far:
            settings = replace(settings, steps=options.shared_steps)
            options = replace(options, least_gain=options.least_shared_gain)
        return take_round(views, stage, settings, options, Progress("fitting on", settings.steps), last=True)


def coarse_stage(
    views: Views,
    start: LevelSet,
    rounds: Sequence[FreeFormRound],
    options: FreeFormOptions,
    progress: Progress | None = None,
    nuisance: Nuisance = NO_NUISANCE,
) -> FitStage:
    """What rounds lead to from a first surface and from nuisance blocks."""
    stage = FitStage.begun(start, options, nuisance)
    for settings in rounds:
        stage = take_round(views, stage, settings, options, progress)
    return stage


def _detailed_stage(views: Views, start: LevelSet, nuisance: Nuisance, options: FreeFormOptions) -> FitStage:
    """What fine grids under coarse maps lead to from a first surface."""
    progress = Progress("looking for details", sum(each.steps for each in options.detailing))
    return coarse_stage(views, start, options.detailing, options, progress, nuisance)


def joined(solved: Nuisance, tested: Nuisance, count: int) -> Nuisance:
    """Blocks of so many views from those of the two parts."""
    order = np.argsort(np.concatenate(split_held_out(range(count))))
    pairs = zip(solved.blocks, tested.blocks, strict=True)
    return solved.replaced([one.joined(other, order) for one, other in pairs if one.by_view])


def predicted(solved: Views, views: Views, stage: FitStage, options: FreeFormOptions) -> Nuisance:
    """The blocks of views that took no part, under the surface, the map and the lens of those that did. Their own alone
    are free.
    """
    own = [each for each in nuisance_of(views).blocks if each.by_view]
    nuisance = stage.nuisance.replaced(own).freed([each.name for each in stage.nuisance.free_blocks(by_view=True)])
    if not nuisance.free:
        return nuisance
    settings = replace(stage.last, rays=min(stage.last.rays, JUDGED_RAYS))
    known = make_task(solved, settings, options, stage.nuisance)
    under = Solution.at(known, stage.surface, stage.trust, None, options.first_map_rounds, stage.nuisance)
    settings = replace(settings, rays=JUDGED_RAYS // 4, steps=options.pose_steps, under_known_map=True)
    task = make_task(views, settings, options, nuisance)
    solution = Solution.at(task, stage.surface, stage.trust, under.environment, 0, nuisance)
    return take_steps(with_noise(solution), stage.damping, still=True)[0].nuisance


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
    surface, nuisance = stage.surface, stage.nuisance
    if settings.robust_scale > SHARED_SCALE:
        stage = replace(stage, nuisance=nuisance.locked)
    if stage.settings is None or stage.settings.cells != settings.cells:
        surface = surface.resampled(settings.cells)
    task = make_task(views, settings, options, stage.nuisance)
    if settings.anchored:
        task = replace(task, anchor=surface.coefficients)
    solution = Solution.at(task, surface, stage.trust, stage.environment, options.first_map_rounds, stage.nuisance)
    if stage.nuisance.free:
        solution = with_noise(solution)
    elif last and solution.outlines_agree:
        solution = replace(solution, task=task.outlined(options.agreed_outline_gain))
    solution, damping = take_steps(solution, stage.damping, progress)
    found = replace(
        stage,
        surface=solution.surface,
        trust=solution.trust,
        environment=solution.environment,
        damping=damping,
        settings=settings,
        nuisance=solution.nuisance.freed(nuisance.free),
    )
    cameras = solution.nuisance.get(CameraPoses)
    if cameras is None or cameras.name not in solution.nuisance.free:
        return found
    # The map is that of the next round, which starts it from nothing.
    common, poses = cameras.poses.without_common(task.cameras, cameras.precision)
    moved = found.nuisance.replaced([replace(cameras, values=poses.stacked)])
    return replace(found, surface=solution.surface.taken_back(common), nuisance=moved, environment=None)


def make_task(
    views: Views, settings: FreeFormRound, options: FreeFormOptions, nuisance: Nuisance = NO_NUISANCE
) -> Task:
    """The pixels and outlines of a round, weighted as if `counted_rays` pixels took part.

    Under coarse maps pixels are wrong by the robust scale s, not by their noise σ: where outlines hold the surface,
    they count (s/σ)² times as much.
    """
    if settings.under_known_map:
        options = replace(options, map_rounds=0, texel_prior=KNOWN)
    pixels, outlines = solid_pixels(views, settings.rays), outline_rays(views)
    total = max(views.num_solid, 1)
    chosen = outlines.chosen(slice(None, None, max(1, -(-len(outlines.size) // options.outline_points))))
    if {Exposures.name, WhiteBalances.name} & set(nuisance.free):
        # A saturated pixel has no radiance to divide by a gain.
        pixels = replace(pixels, inner_px=np.where(is_saturated(pixels.radiance), 0.0, pixels.inner_px))
    share = options.counted_rays / options.radiance_sigma**2 / max(len(pixels.inner_px), 1)
    density = options.counted_rays / total * len(outlines.size) / max(len(chosen.size), 1)
    believed = (settings.robust_scale / options.radiance_sigma) ** 2 if settings.held else 1.0
    outlined = settings.outline_gain * believed * density / options.outline_sigma_px**2
    brightness = max(float(pixels.radiance.mean()), LEAST_BRIGHTNESS)
    return Task(pixels, chosen, share, outlined, settings, options, StatedCameras.of(views), brightness)


def variances(views: Views, stage: FitStage, options: FreeFormOptions) -> dict[str, Float[np.ndarray, "B M"]]:
    """Posterior variances of the free blocks, in units of the noise that residuals show.

    Of those of all views (H⁻¹)ᵢᵢ, with the surface, the blocks of views and the map that follow them; of those of views
    by the inverse of the own matrix of each view, with the surface and the map as they are.
    """
    by_view, shared = (stage.nuisance.free_blocks(by_view=each) for each in (True, False))
    found: dict[str, np.ndarray] = {}
    if not by_view and not shared:
        return found
    task = make_task(views, stage.last, options, stage.nuisance)
    solution = Solution.at(task, stage.surface, stage.trust, None, options.first_map_rounds, stage.nuisance)
    solution = with_noise(solution)
    converged = replace(solution.task, settings=replace(stage.last, solver_steps=VARIANCE_STEPS))
    solution = replace(solution, task=converged)
    factor, start = solution.task.prior_factor, 0
    if by_view:
        own = np.einsum("bmm->bm", np.linalg.inv(regularize(solution.beside[0].matrix, "cameras")))
    for block in by_view:
        found[block.name], start = factor * own[:, start : start + block.size], start + block.size
    around = len(stage.surface.surroundings.coefficients)
    for index, block in enumerate(shared):
        unit = [np.zeros_like(each.value) for each in solution.beside]
        unit[-1][0, around + index] = 1.0
        column = solved_equations(solution, (np.zeros(stage.surface.shape), unit), stage.damping)
        found[block.name] = np.full((1, 1), factor * max(float(column.beside[-1][0, around + index]), 1e-30))
    return found


def held_out_error(solved: Views, tested: Views, stage: FitStage, options: FreeFormOptions) -> float:
    """Mean ‖e‖²/(‖e‖² + s²) over rays of views that neither surface nor map have seen, under a map as fine as any, and
    1 for those that miss the surface.
    """
    own = predicted(solved, tested, stage, options)
    known, _ = _rays(solved, stage.surface, stage.nuisance, options)
    unknown, missed = _rays(tested, stage.surface, own, options)
    error = prediction_error([unknown], solve_environment([known], options.held_out_resolution))
    return (len(unknown.directions) * error + missed) / max(len(unknown.directions) + missed, 1)


def _rays(views: Views, surface: LevelSet, nuisance: Nuisance, options: FreeFormOptions) -> tuple[Rays, int]:
    """Of pixels well inside the masks: those that see the surroundings, and how many miss the surface."""
    pixels, cameras = solid_pixels(views, options.held_out_rays), StatedCameras.of(views)
    rays = nuisance.moved(pixels.rays, cameras)
    sights, inner = Sights.of(surface, rays, 1, options.least_cosine), pixels.inner_px > options.inner_px
    radiance, clear = nuisance.equalized(pixels.radiance, rays.view), sights.clear & inner
    outgoing, seen = (torch.from_numpy(values[clear]).float() for values in (sights.outgoing[:, 0], radiance))
    return Rays(outgoing, seen), int((inner & ~sights.hits.met).sum())
