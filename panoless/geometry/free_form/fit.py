"""A free-form surface from silhouettes and photographs: accepted Gauss–Newton steps, from coarse to fine."""

from collections.abc import Collection, Iterable, Iterator, MutableMapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from panoless.capture.poses import StatedCameras
from panoless.capture.views import Views, split_held_out
from panoless.deadline import check_time, improving
from panoless.environment.rays import Rays
from panoless.environment.resolution import ERROR_SCALE
from panoless.environment.solve import solve_environment
from panoless.geometry.free_form.concave import concave_start
from panoless.geometry.free_form.map import Mirrored
from panoless.geometry.free_form.material import Material
from panoless.geometry.free_form.photometric import INNER_PX, LEAST_COSINE, Linearization, ReflectedRays
from panoless.geometry.free_form.schedule import SILHOUETTE_GAIN, Round, Schedule
from panoless.geometry.free_form.steps import DAMPING, solved_equations, take_steps, with_noise
from panoless.geometry.free_form.surface import LevelSet
from panoless.geometry.free_form.task import make_task
from panoless.geometry.free_form.trust import Trust, full_trust
from panoless.journal import remembered
from panoless.kernels.cubemap import sample_cubemap
from panoless.numeric.factorize import regularize
from panoless.numeric.gauss_newton import keep_if_better
from panoless.numeric.robust import bounded_error
from panoless.problem.blocks import CameraPoses, Distortion, Walls
from panoless.problem.evidence import Decision, needed
from panoless.problem.nuisance import NO_NUISANCE, Nuisance, nuisance_of
from panoless.problem.observations import silhouette_rays, solid_pixels
from shinypartial.io.progress import Progress

LAST_RAYS = 2.5
"""Factor of the pixels of the last round, which all views take: those before lead to where it starts…"""
MOST_RAYS = 300_000
"""…and the most of them."""
JUDGED_RAYS = 40_000
"""Pixels by which blocks are judged."""
VARIANCE_STEPS = 60
"""Conjugate-gradient steps of a variance, which fewer understate."""
SETTLING_STEPS = 3
"""In which distortion is found beside what is known."""
POSE_STEPS = 6
"""Most steps to the blocks of views that took no part in a fit."""
FIRST_MAP_ROUNDS = 3
"""Robust rounds of the map at the start of a round of steps."""
HELD_OUT_RAYS = 200_000
"""Most pixels of held-out views, and of the others, by which the held-out error is measured."""
HELD_OUT_RESOLUTION = 128
"""Texels along a face side of the map that predicts them."""
LEAST_FINER_GAIN = 0.002
"""Share of the held-out error by which a finer round has to lower it."""
LEAST_GAIN = 0.02
"""Share of the held-out error by which concavities, a refit and details have to lower it."""
DETAILED_ERROR = 0.11
"""Held-out error from which details are looked for."""
MOST_REFITS = 3
"""Refits that are tried at most."""
DISTRUSTED = 0.2
"""Trust below which a pixel distrusts what it sees."""
LEAST_DISTRUSTED = 0.01
"""Share of such pixels among those that see the surroundings, from which a refit is tried."""


@dataclass(frozen=True)
class FitStage:
    """A surface between two rounds, and what the next one starts from."""

    surface: LevelSet
    trust: Trust
    environment: Float[Tensor, "6 3 L L"] | None = None
    damping: float = DAMPING
    settings: Round | None = None
    """Of the round that led here."""
    nuisance: Nuisance = NO_NUISANCE
    """Cameras, exposures and masks, where these are unknown."""
    material: Material | None = None
    """What places mirror and scatter; None: they are perfect mirrors."""

    @classmethod
    def begun(cls, surface: LevelSet, nuisance: Nuisance = NO_NUISANCE, material: Material | None = None) -> "FitStage":
        """A surface that is trusted everywhere, before its first round."""
        return cls(surface, full_trust(surface), nuisance=nuisance, material=material)

    @property
    def last(self) -> Round:
        """The round that led here."""
        assert self.settings is not None, "a round was taken"
        return self.settings


def fit_free_form(
    views: Views,
    start: LevelSet,
    schedule: Schedule,
    *,
    hull: LevelSet | None = None,
    caps: Sequence[LevelSet] = (),
    nuisance: Nuisance = NO_NUISANCE,
    required: Collection[str] = (),
    materials: Sequence[Material | None] = (None,),
) -> tuple[FitStage, list[Decision]]:
    """The surface that explains photographs and silhouettes best, no finer than held-out views want it, with the
    nuisance blocks that the scene needs; and what was decided of each.

    Rounds are taken with four fifths of the views as long as the others gain by them, and the last of those once more
    with all, in which silhouettes count more where photographs agree with them. After the rounds that are always taken,
    concavities are searched, blocks that are not `required` are removed unless they are needed, and parts that pixels
    distrust are refitted. Where much is left, details are searched from the `hull`, with all blocks free again, under
    each of the `materials`. Concavities are searched under the start, and if it has none, under the `caps`, other first
    surfaces.
    """
    kept, others = split_held_out(range(len(views.train)))
    if not kept or not others:
        kept, others = list(range(len(views.train))), []
    solved, tested = (replace(views, train=tuple(views.train[number] for number in part)) for part in (kept, others))
    rounds = *schedule.coarse, *schedule.finer
    again = max(
        settings.steps for settings in (schedule.coarse[-1], *schedule.finer, *schedule.detailed, *schedule.finest)
    )
    progress = Progress("fitting a free-form surface", sum(settings.steps for settings in rounds) + again)

    known: MutableMapping[FitStage, float] = WeakIdKeyDictionary()

    def error(stage: FitStage) -> float:
        if stage not in known:
            known[stage] = held_out_error(solved, tested, stage)
        return known[stage]

    def best(stages: Iterable[FitStage], least_gain: float = LEAST_GAIN) -> FitStage:
        return keep_if_better(stages, error, least_gain) if others else next(iter(stages))

    with torch.no_grad():
        usual = nuisance.freed([name for name in nuisance.free if name != Distortion.name]).of_views(kept)
        stage = coarse_stage(solved, start, schedule.coarse, progress, usual)
        decisions = dict[str, Decision]()
        with improving():
            check_time()
            begun = start
            concave = _concave_start(solved, (start, *caps) if schedule.concave and others else (), stage.surface)
            if concave is not None:
                plain, deeper = stage, coarse_stage(solved, concave, schedule.concave, nuisance=stage.nuisance)
                stage = best((plain, deeper))
                begun, hull = (start, hull) if stage is plain else (concave, None)
            stage, decisions = _needed(solved, stage, required)
            if not all(each.kept for each in decisions.values()):
                # A surface that gave way to blocks does not come back from them by further steps.
                check_time()
                rounds = schedule.coarse if begun is start else schedule.concave
                begun = replace(begun, surroundings=stage.surface.surroundings)
                stage = coarse_stage(solved, begun, rounds, nuisance=stage.nuisance)
            stage = best(refitted_stages(solved, stage, schedule.refit))
            finest = list[Round]()
            unclear = bool(others and schedule.detailed) and error(stage) > DETAILED_ERROR
            for mixed in [each for each in materials if unclear and each is not None]:
                # Paint on a smooth body needs no details, but many pixels.
                rounds = schedule.concave or schedule.coarse
                stage = best((stage, coarse_stage(solved, begun, rounds, nuisance=usual, material=mixed)))
            if unclear and error(stage) > DETAILED_ERROR:
                details = Progress(
                    "looking for details", len(materials) * sum(each.steps for each in schedule.detailed)
                )
                outer = replace(hull or begun, surroundings=start.surroundings)
                for material in materials:
                    stage = best((stage, coarse_stage(solved, outer, schedule.detailed, details, usual, material)))
                if stage.settings is schedule.detailed[-1]:
                    rays = silhouette_rays(views)
                    pixel = float(np.median(rays.size * np.linalg.norm(rays.origins, axis=1)))
                    finest = [each for each in schedule.finest if stage.surface.extent.max() / each.cells >= pixel]
            stage = best(_stages(solved, stage, schedule.finer, progress), LEAST_FINER_GAIN)
            stage, later = _needed(solved, _with_distortion(solved, stage), required)
            decisions |= later
            if finest:
                sharper = Progress("sharpening details", sum(each.steps for each in finest))
                stage = best(_stages(solved, stage, finest, sharper), LEAST_FINER_GAIN)
        if stage.settings is None:
            return FitStage.begun(start, nuisance), []
        skipped = progress.total - progress.done - stage.last.steps
        if skipped > 0:
            progress.advance(steps=skipped)
        if others:
            unseen = predicted(solved, tested, stage)
            stage = replace(stage, nuisance=joined(stage.nuisance, unseen, len(views.train)))
        settings = _with_more_rays(stage.last)
        with improving():
            stage = take_round(views, stage, settings, progress, last=True)
        return stage, list(decisions.values())


def _with_more_rays(settings: Round) -> Round:
    """A round as all views take it at the end."""
    return replace(settings, rays=min(round(LAST_RAYS * settings.rays), MOST_RAYS))


def _concave_start(views: Views, caps: Sequence[LevelSet], surface: LevelSet) -> LevelSet | None:
    """A start with concavities under the first of the caps that has any."""
    found = (concave_start(views, cap, surface) for cap in caps)
    return next((each for each in found if each is not None), None)


def _needed(views: Views, stage: FitStage, required: Collection[str]) -> tuple[FitStage, dict[str, Decision]]:
    """A stage without the free blocks that the scene does not need, and what was decided of each."""
    left, decisions = needed(stage.nuisance, variances(views, stage), {}, required)
    by_name, found = {each.name: each for each in decisions}, replace(stage, nuisance=left)
    if Walls.name not in by_name or by_name[Walls.name].kept:
        return found, by_name
    surface = replace(stage.surface, surroundings=stage.surface.surroundings.without_walls)
    return replace(found, surface=surface, environment=None), by_name


def _with_distortion(views: Views, stage: FitStage) -> FitStage:
    """A stage after a few steps with the distortion beside what is free, where it is an unknown."""
    if stage.nuisance.get(Distortion) is None:
        return stage
    free = stage.nuisance.freed([*stage.nuisance.free, Distortion.name])
    settings = replace(stage.last, steps=SETTLING_STEPS, rays=min(stage.last.rays, JUDGED_RAYS))
    return replace(take_round(views, replace(stage, nuisance=free), settings), settings=stage.last)


def continued_fit(views: Views, fitted: FitStage, schedule: Schedule) -> FitStage:
    """What an earlier fit led to after its last round was taken again, with views that changed a little."""
    rounds = [*schedule.detailed, *schedule.coarse, *schedule.finer, *schedule.finest]
    last = next((each for each in reversed(rounds) if each.cells == fitted.surface.cells), rounds[-1])
    stage, settings = replace(fitted, settings=last), _with_more_rays(last)
    with torch.no_grad():
        return take_round(views, stage, settings, Progress("fitting on", settings.steps), last=True)


def coarse_stage(
    views: Views,
    start: LevelSet,
    rounds: Sequence[Round],
    progress: Progress | None = None,
    nuisance: Nuisance = NO_NUISANCE,
    material: Material | None = None,
) -> FitStage:
    """What rounds lead to from a first surface, from nuisance blocks and from a material."""
    stage = FitStage.begun(start, nuisance, material)
    with improving():
        for settings in rounds:
            stage = take_round(views, stage, settings, progress)
    return stage


def joined(solved: Nuisance, tested: Nuisance, count: int) -> Nuisance:
    """Blocks of so many views from those of the two parts."""
    order = np.argsort(np.concatenate(split_held_out(range(count))))
    pairs = zip(solved.blocks, tested.blocks, strict=True)
    return solved.replaced([one.joined(other, order) for one, other in pairs if one.by_view])


def predicted(solved: Views, views: Views, stage: FitStage) -> Nuisance:
    """The blocks of views that took no part, which alone are free, under surface, map and lens of those that did."""
    of_views = [each for each in nuisance_of(views).blocks if each.by_view]
    nuisance = stage.nuisance.replaced(of_views).freed([each.name for each in stage.nuisance.free_blocks(by_view=True)])
    if not nuisance.free:
        return nuisance
    settings = replace(stage.last, rays=min(stage.last.rays, JUDGED_RAYS))
    known = make_task(solved, settings, stage.nuisance, stage.material)
    under = Linearization.at(known, stage.surface, stage.trust, None, FIRST_MAP_ROUNDS, stage.nuisance)
    settings = replace(settings, rays=JUDGED_RAYS // 4, steps=POSE_STEPS, under_known_map=True)
    task = make_task(views, settings, nuisance, stage.material)
    linearization = Linearization.at(task, stage.surface, stage.trust, under.environment, 0, nuisance)
    return take_steps(with_noise(linearization), stage.damping, still=True)[0].nuisance


def _stages(views: Views, stage: FitStage, finer: Sequence[Round], progress: Progress) -> Iterator[FitStage]:
    """A stage, and those after each of the rounds that are finer."""
    yield stage
    for settings in [each for each in finer if each.cells >= stage.last.cells]:
        stage = take_round(views, stage, settings, progress)
        yield stage


def refitted_stages(views: Views, stage: FitStage, rounds: Sequence[Round]) -> Iterator[FitStage]:
    """A stage, and those after each refit of its distrusted parts; no rounds: the stage alone.

    A part that the first surface has wrong lost its weight, and few pixels are left to correct it. But the others
    determine the map, so under that all pixels pull such a part to where it belongs: coarsely at first, from far off.
    """
    yield stage
    for _ in range(MOST_REFITS if rounds else 0):
        if distrusted_share(views, stage) < LEAST_DISTRUSTED:
            return
        settings, progress = stage.last, Progress("refitting", sum(each.steps for each in rounds))
        for each in rounds:
            stage = take_round(views, stage, each, progress)
        stage = replace(stage, settings=settings)
        yield stage


def distrusted_share(views: Views, stage: FitStage) -> float:
    """Of the pixels that see the surroundings: how many lie where trust is low."""
    surface, rays = stage.surface, solid_pixels(views, HELD_OUT_RAYS).rays
    reflected = ReflectedRays.of(surface, rays, 1, LEAST_COSINE)
    trust = stage.trust.at(surface.points(reflected.hits.places[reflected.clear]))
    return float((trust < DISTRUSTED).mean()) if len(trust) else 0.0


@remembered()
def take_round(
    views: Views,
    stage: FitStage,
    settings: Round,
    progress: Progress | None = None,
    *,
    last: bool = False,
) -> FitStage:
    """A stage after the steps of a round; in the `last` one silhouettes count more if photographs agree with them."""
    surface, nuisance = stage.surface, stage.nuisance
    if settings.is_coarse:
        stage = replace(stage, nuisance=nuisance.under_coarse(settings.resolution))
    if stage.settings is None or stage.settings.cells != settings.cells:
        surface = surface.resampled(settings.cells)
    task = make_task(views, settings, stage.nuisance, stage.material)
    if settings.increment_prior:
        task = replace(task, reference=surface.coefficients)
    linearization = Linearization.at(task, surface, stage.trust, stage.environment, FIRST_MAP_ROUNDS, stage.nuisance)
    if stage.nuisance.free:
        linearization = with_noise(linearization)
    elif last and linearization.silhouettes_agree:
        linearization = replace(linearization, task=task.with_silhouette_gain(SILHOUETTE_GAIN))
    linearization, damping = take_steps(linearization, stage.damping, progress)
    found = replace(
        stage,
        surface=linearization.surface,
        trust=linearization.trust,
        environment=linearization.environment,
        damping=damping,
        settings=settings,
        nuisance=linearization.nuisance.freed(nuisance.free),
        material=linearization.task.material,
    )
    common, moved = found.nuisance.without_common(task.cameras)
    if common is None or CameraPoses.name not in linearization.nuisance.free:
        return found
    # The next round solves its map from nothing.
    return replace(found, surface=linearization.surface.taken_back(common), nuisance=moved, environment=None)


def variances(views: Views, stage: FitStage) -> dict[str, Float[np.ndarray, "B M"]]:
    """Posterior variances of the free blocks, in units of the noise that residuals show.

    Of those of all views (H⁻¹)ᵢᵢ, with the surface, the blocks of views and the map eliminated. Of those of views by
    the inverse of each view's matrix, with the surface and the map as they are.
    """
    by_view, shared = (stage.nuisance.free_blocks(by_view=each) for each in (True, False))
    found: dict[str, np.ndarray] = {}
    if not by_view and not shared:
        return found
    task = make_task(views, stage.last, stage.nuisance, stage.material)
    linearization = Linearization.at(task, stage.surface, stage.trust, None, FIRST_MAP_ROUNDS, stage.nuisance)
    linearization = with_noise(linearization)
    converged = replace(linearization.task, settings=replace(stage.last, solver_steps=VARIANCE_STEPS))
    linearization = replace(linearization, task=converged)
    factor, start = linearization.task.prior_factor, 0
    if by_view:
        of_views = np.einsum("bmm->bm", np.linalg.inv(regularize(linearization.beside[0].matrix, "cameras")))
    for block in by_view:
        found[block.name], start = factor * of_views[:, start : start + block.size], start + block.size
    start, size = 0, sum(each.size for each in shared)
    of_all = np.zeros(size)
    for index in range(size):
        unit = [np.zeros_like(each.value) for each in linearization.beside]
        unit[-1][0, index] = 1.0
        column = solved_equations(linearization, (np.zeros(stage.surface.shape), unit), stage.damping)
        of_all[index] = factor * max(float(column.beside[-1][0, index]), 1e-30)
    for block in shared:
        found[block.name], start = of_all[None, start : start + block.size], start + block.size
    return found


def held_out_error(solved: Views, tested: Views, stage: FitStage) -> float:
    """Mean ‖e‖²/(‖e‖² + s²) over rays of views that neither surface nor map have seen, under a map as fine as any, and
    1 for those that miss the surface. What is saturated may be any brighter.
    """
    known, unknown = _Seen.of(solved, stage, stage.nuisance), _Seen.of(tested, stage, predicted(solved, tested, stage))
    environment = solve_environment([known.rays], HELD_OUT_RESOLUTION)
    error = unknown.share * (sample_cubemap(environment, unknown.rays.directions) - unknown.rays.radiance)
    error = torch.where(unknown.brighter, error.clamp(max=0), error)
    summed = float(bounded_error(error, ERROR_SCALE).sum()) + unknown.missed
    return summed / max(len(error) + unknown.missed, 1)


@dataclass(frozen=True)
class _Seen:
    """Pixels well inside the masks that see the surroundings as a perfect mirror would, the share that they mirror,
    which are saturated, and how many others miss the surface.
    """

    rays: Rays
    share: Float[Tensor, "P 3"]
    brighter: Bool[Tensor, "P 3"]
    missed: int

    @classmethod
    def of(cls, views: Views, stage: FitStage, nuisance: Nuisance) -> "_Seen":
        surface, pixels = stage.surface, solid_pixels(views, HELD_OUT_RAYS)
        rays = nuisance.moved(pixels.rays, StatedCameras.of(views))
        reflected, inner = ReflectedRays.of(surface, rays, 1, LEAST_COSINE), pixels.inner_px > INNER_PX
        clear = reflected.clear & inner
        facing, points = reflected.hits.facing(rays.directions), surface.points(reflected.hits.places)
        mirrored = Mirrored.by(
            stage.material, pixels.radiance, nuisance.equalized(pixels.radiance, rays.view), points, facing
        )
        outgoing, seen, share = (
            torch.from_numpy(values[clear]).float()
            for values in (reflected.outgoing[:, 0], mirrored.radiance, mirrored.share)
        )
        bright = torch.from_numpy(mirrored.brighter[clear])
        if stage.environment is not None:
            seen = torch.where(bright, seen.maximum(sample_cubemap(stage.environment, outgoing)), seen)
        missed = int((inner & ~reflected.hits.met).sum())
        return cls(Rays(outgoing, seen, share.amax(1) ** 2), share, bright, missed)
