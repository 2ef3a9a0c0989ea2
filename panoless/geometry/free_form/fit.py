"""A free-form surface from silhouettes and photographs: accepted Gauss–Newton steps, from coarse to fine."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.poses import Poses
from panoless.capture.rays import pose_of
from panoless.capture.views import Views, split_held_out
from panoless.environment.rays import Rays
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.free_form.concave import concave_start
from panoless.geometry.free_form.observations import outline_rays, solid_pixels
from panoless.geometry.free_form.options import DEFAULTS, FreeFormOptions, FreeFormRound
from panoless.geometry.free_form.photometric import Sights, Solution, Task
from panoless.geometry.free_form.surface import LevelSet
from panoless.geometry.free_form.trust import Trust, full_trust
from panoless.numeric.conjugate_gradients import solve_by_products
from panoless.numeric.gauss_newton import keep_if_better
from shinypartial.io.progress import Progress

THIRD_DIFFERENCE_DIAGONAL = 3 * 20 + 6 * 3 * 12 + 6 * 8
"""Of DᵀD: Σ over the kinds of how often one counts in |D³c|² times its squared factors."""
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


@dataclass(frozen=True)
class Change:
    """A step of everything that is unknown: coefficients in cells, poses of views, coefficients of the surroundings."""

    coefficients: Float[np.ndarray, "A B C"]
    poses: Float[np.ndarray, "V 6"] | None = None
    surroundings: Float[np.ndarray, "K"] | None = None


def fit_free_form(
    views: Views, start: LevelSet, options: FreeFormOptions = DEFAULTS
) -> tuple[LevelSet, Trust, Poses | None]:
    """The surface that explains photographs and outlines best, no finer than held-out views want it, its trust, and the
    poses of the views where these are unknowns.

    Rounds are taken with four fifths of the views as long as the others gain by them, and the last of those once more
    with all. After the rounds that are always taken, poses are set free, if held-out views gain.
    """
    kept, held_out = split_held_out(views.train)
    solved = replace(views, train=tuple(kept)) if kept and held_out else views
    tested = replace(views, train=tuple(held_out))
    every = [*options.rounds, *options.finer, (*options.rounds, *options.finer)[-1]]
    progress = Progress("fitting a free-form surface", sum(settings.steps for settings in every))

    def error(stage: FitStage) -> float:
        return held_out_error(solved, tested, stage, options)

    def better(stage: FitStage, other: FitStage, least_gain: float) -> FitStage:
        return keep_if_better((stage, other), error, least_gain)

    with torch.no_grad():
        stage = coarse_stage(solved, start, options.rounds, options, progress)
        hollowed = concave_start(solved, start, options.concave) if options.concave.search else None
        if hollowed is not None:
            deeper = coarse_stage(solved, hollowed, options.concave.rounds, options)
            stage = better(stage, deeper, options.concave.least_held_out_gain) if held_out else deeper
        if held_out and options.poses == "auto" and pose_pull(solved, stage, options) > options.least_pose_pull:
            settled = _settled(solved, stage, options.pose_steps, options)
            stage = better(settled, _with_poses(solved, stage, options), options.least_pose_gain)
        if held_out and options.finer:
            stage = keep_if_better(_stages(solved, stage, options, progress), error, options.least_held_out_gain)
        assert stage.settings is not None, "a fit has rounds"
        last = stage.settings if stage.poses is None else _freed(stage)
        skipped = progress.total - progress.done - last.steps
        if skipped > 0:
            progress.advance(steps=skipped)
        if stage.poses is not None and held_out:
            stage = replace(stage, poses=_joined(stage.poses, found_poses(solved, tested, stage, options)))
        stage = take_round(views, stage, last, options, progress)
    return stage.surface, stage.trust, stage.poses


def _settled(views: Views, stage: FitStage, steps: int, options: FreeFormOptions) -> FitStage:
    """A stage after its round was taken again as it is: what more freedom is compared with, after as many steps."""
    return replace(take_round(views, stage, _freed(stage, steps), options), settings=stage.settings)


def _freed(stage: FitStage, steps: int | None = None) -> FreeFormRound:
    """The round that led to a stage as one in which poses are free."""
    assert stage.settings is not None, "a round was taken"
    return replace(stage.settings, photon_share=0.0, steps=stage.settings.steps if steps is None else steps)


def pose_pull(views: Views, stage: FitStage, options: FreeFormOptions) -> float:
    """The share of the cost that one step of the poses alone would take: Σ ½ gᵀH⁻¹g of the views, over the cost."""
    task, poses = make_task(views, _freed(stage), options), Poses.none(len(views.train))
    solution = Solution.at(task, stage.surface, stage.trust, stage.environment, 0, poses)
    gradient = solution.pose_gradient()
    steps = np.linalg.solve(solution.pose_blocks(), gradient[..., None])[..., 0]
    return float((gradient * steps).sum()) / 2 / solution.cost(solution)


def coarse_stage(
    views: Views,
    start: LevelSet,
    rounds: Sequence[FreeFormRound],
    options: FreeFormOptions,
    progress: Progress | None = None,
) -> FitStage:
    """What rounds lead to from a first surface."""
    poses = Poses.none(len(views.train)) if options.poses == "on" else None
    stage = FitStage(start, full_trust(start, options.trust_cells), None, options.damping, poses=poses)
    for settings in rounds:
        stage = take_round(views, stage, settings, options, progress)
    return stage


def _with_poses(views: Views, stage: FitStage, options: FreeFormOptions) -> FitStage:
    """A stage after its round was taken again with free poses."""
    free = replace(stage, poses=Poses.none(len(views.train)))
    found = take_round(views, free, _freed(stage, options.pose_steps), options)
    return replace(found, settings=stage.settings)


def _joined(solved: Poses, tested: Poses) -> Poses:
    """Poses of all views from those of the two parts."""
    order = np.argsort(np.concatenate(split_held_out(range(len(solved.turns) + len(tested.turns)))))
    both = np.concatenate([solved.stacked, tested.stacked])[order]
    return Poses(both[:, :3], both[:, 3:])


def found_poses(solved: Views, views: Views, stage: FitStage, options: FreeFormOptions) -> Poses:
    """Poses of views that took no part, under the surface and the map of those that did, which stay as they are."""
    known = make_task(solved, _freed(stage), options)
    environment = Solution.at(
        known, stage.surface, stage.trust, None, options.first_map_rounds, stage.poses
    ).environment
    still = replace(options, map_rounds=0, texel_prior=1e9)
    task = make_task(views, _freed(stage, options.pose_steps), still)
    poses = Poses.none(len(views.train))
    solution = Solution.at(task, stage.surface, stage.trust, environment, 0, poses)
    moved = take_steps(solution, stage.damping, still=True)[0].poses
    assert moved is not None, "poses were free"
    return moved


def _stages(views: Views, stage: FitStage, options: FreeFormOptions, progress: Progress) -> Iterator[FitStage]:
    """A stage, and those after each of the finer rounds."""
    yield stage
    for settings in options.finer:
        stage = take_round(views, stage, settings, options, progress)
        yield stage


def take_round(
    views: Views, stage: FitStage, settings: FreeFormRound, options: FreeFormOptions, progress: Progress | None = None
) -> FitStage:
    """A stage after the steps of a round."""
    surface = stage.surface
    if stage.settings is None or stage.settings.cells != settings.cells:
        surface = surface.resampled(settings.cells)
    task = make_task(views, settings, options)
    solution = Solution.at(task, surface, stage.trust, stage.environment, options.first_map_rounds, stage.poses)
    solution, damping = take_steps(solution, stage.damping, progress)
    found = replace(
        stage,
        surface=solution.surface,
        trust=solution.trust,
        environment=solution.environment,
        damping=damping,
        settings=settings,
        poses=solution.poses,
    )
    if solution.poses is None:
        return found
    # The map follows with the next round, which starts it anew.
    common = solution.poses.common(task.centers, solution.pose_prior)
    poses = solution.poses.without(common, task.centers)
    return replace(found, surface=solution.surface.taken_back(common), poses=poses, environment=None)


def make_task(views: Views, settings: FreeFormRound, options: FreeFormOptions) -> Task:
    """The pixels and outlines of a round, weighted as if `counted_rays` pixels took part."""
    pixels, outlines = solid_pixels(views, settings.rays), outline_rays(views)
    total = max(sum(len(view.solid) for view in views.train), 1)
    chosen = outlines.chosen(slice(None, None, max(1, -(-len(outlines.size) // options.outline_points))))
    share = options.counted_rays / options.radiance_sigma**2 / max(len(pixels.inner_px), 1)
    density = options.counted_rays / total * len(outlines.size) / max(len(chosen.size), 1)
    centers = np.array([pose_of(view.camera)[1] for view in views.train])
    outlined, brightness = density / options.outline_sigma_px**2, max(float(pixels.radiance.mean()), LEAST_BRIGHTNESS)
    return Task(pixels, chosen, share, outlined, settings, options, centers, brightness)


def _step(solution: Solution, damping: float, still: bool) -> Change:
    if solution.poses is not None:
        return gauss_newton_step_with_poses(solution, damping, still=still)
    if not solution.surface.surroundings.is_far:
        return gauss_newton_step_with_surroundings(solution, damping)
    return Change(gauss_newton_step(solution, damping))


def take_steps(
    solution: Solution, damping: float, progress: Progress | None = None, *, still: bool = False
) -> tuple[Solution, float]:
    """The steps of a round, each of which lowers the cost with hits, visibility and map made anew; the last damping."""
    options, settings = solution.task.options, solution.task.settings
    for index in range(settings.steps):
        if not still:
            solution = replace(solution, trust=measured_trust(solution))
        before = solution
        solution, length = _accepted(solution, _step(solution, damping, still))
        factor = options.damping_less if length == 1 else options.damping_more
        damping = float(np.clip(damping * factor, *options.damping_range))
        gain = 1 - solution.cost(before) / before.cost(before)
        last = gain < options.least_gain
        if progress is not None:
            progress.advance(steps=settings.steps - index if last else 1)
        if last:
            break
    return solution, damping


def _accepted(solution: Solution, step: Change) -> tuple[Solution, float]:
    """The solution after the longest of the tried lengths of a step that lowers the cost, and that length; the same
    solution after none.
    """
    options, length, before = solution.task.options, 1.0, solution.cost(solution)
    for _ in range(options.trials):
        surface = replace(solution.surface, coefficients=solution.surface.coefficients + length * step.coefficients)
        if step.surroundings is not None:
            surface = replace(surface, surroundings=surface.surroundings.after(length * step.surroundings))
        posed = solution.poses
        if step.poses is not None and posed is not None:
            posed = posed.after(length * step.poses)
        moved = Solution.at(solution.task, surface, solution.trust, solution.environment, options.map_rounds, posed)
        if moved.cost(solution) < before:
            return moved, length
        length *= options.shortening
    return solution, 0.0


def gauss_newton_step(solution: Solution, damping: float) -> Float[np.ndarray, "A B C"]:
    """−(H + μ diag H)⁻¹ g by conjugate gradients, nowhere longer than the longest step."""
    options = solution.task.options
    diagonal = solution.diagonal(THIRD_DIFFERENCE_DIAGONAL)

    def product(change: Float[np.ndarray, "A B C"]) -> Float[np.ndarray, "A B C"]:
        return solution.product(change) + damping * diagonal * change

    step = solve_by_products(
        product,
        -solution.gradient(),
        solution.active / (diagonal * (1 + damping)),
        options.solver_steps,
        options.solver_tolerance,
    )
    return np.clip(step, -options.largest_step_cells, options.largest_step_cells)


def gauss_newton_step_with_poses(solution: Solution, damping: float, *, still: bool = False) -> Change:
    """The same with the poses of the views as further unknowns; of a `still` surface, those alone.

    Poses are preconditioned by their blocks: with H = L Lᵀ of a view its unknowns are y = Lᵀ x.
    """
    options, shape = solution.task.options, solution.surface.shape
    diagonal, size = solution.diagonal(THIRD_DIFFERENCE_DIAGONAL), int(np.prod(solution.surface.shape))
    blocks = solution.pose_blocks() * (1 + damping * np.eye(6))
    back = np.linalg.inv(np.linalg.cholesky(blocks)).transpose(0, 2, 1)

    def unpacked(values: Float[np.ndarray, "N"]) -> tuple[Float[np.ndarray, "A B C"], Float[np.ndarray, "V 6"]]:
        poses = np.matmul(back, values[size:].reshape(-1, 6, 1))[..., 0]
        return values[:size].reshape(shape), poses

    def packed(change: Float[np.ndarray, "A B C"], poses: Float[np.ndarray, "V 6"]) -> Float[np.ndarray, "N"]:
        return np.concatenate([change.ravel(), np.matmul(back.transpose(0, 2, 1), poses[..., None]).ravel()])

    diagonals = np.einsum("vii->vi", blocks) * (damping / (1 + damping))

    def product(values: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
        change, poses = unpacked(values)
        by_change, by_pose = solution.product_with_poses(change, poses)
        return packed(by_change + damping * diagonal * change, by_pose + diagonals * poses)

    free = np.zeros(shape) if still else solution.active / (diagonal * (1 + damping))
    step, poses = unpacked(
        solve_by_products(
            product,
            packed(-solution.gradient(), -solution.pose_gradient()),
            np.concatenate([free.ravel(), np.ones(blocks.shape[0] * 6)]),
            options.solver_steps,
            options.solver_tolerance,
        )
    )
    return Change(np.clip(step, -options.largest_step_cells, options.largest_step_cells), poses)


def gauss_newton_step_with_surroundings(solution: Solution, damping: float) -> Change:
    """The same with the coefficients of the surroundings as further unknowns y = Lᵀ k, H = L Lᵀ their own matrix."""
    options, shape = solution.task.options, solution.surface.shape
    diagonal, size = solution.diagonal(THIRD_DIFFERENCE_DIAGONAL), int(np.prod(shape))
    matrix = solution.surroundings_matrix()
    least = options.least_surroundings_share * max(float(np.trace(matrix)), 1e-30)
    back = np.linalg.inv(np.linalg.cholesky(matrix + least * np.eye(len(matrix)))).T

    def product(values: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
        change, moved = values[:size].reshape(shape), back @ values[size:]
        by_change, by_moved = solution.product_with_surroundings(change, moved)
        by_moved = back.T @ (by_moved + least * moved)
        return np.concatenate([(by_change + damping * diagonal * change).ravel(), by_moved])

    found = solve_by_products(
        product,
        np.concatenate([-solution.gradient().ravel(), -back.T @ solution.surroundings_gradient()]),
        np.concatenate([(solution.active / (diagonal * (1 + damping))).ravel(), np.ones(len(matrix))]),
        options.solver_steps,
        options.solver_tolerance,
    )
    step = np.clip(found[:size].reshape(shape), -options.largest_step_cells, options.largest_step_cells)
    return Change(step, surroundings=back @ found[size:])


def measured_trust(solution: Solution) -> Trust:
    """Trust by the residuals of a solution."""
    points, clear = solution.surface.points(solution.sights.hits.places), solution.free > 0
    return solution.trust.measured(points, solution.residual, solution.free, clear, solution.task.options)


def held_out_error(solved: Views, tested: Views, stage: FitStage, options: FreeFormOptions) -> float:
    """Mean of ‖e‖²/(‖e‖² + s²) over rays of views that neither surface nor map have seen.

    Where poses are unknowns, those of the tested views are found first: six numbers each, against thousands of pixels.
    """
    poses = None if stage.poses is None else found_poses(solved, tested, stage, options)
    known = _rays(solved, stage.surface, stage.poses, options)
    unknown = _rays(tested, stage.surface, poses, options)
    return prediction_error([unknown], solve_environment([known], options.held_out_resolution))


def _rays(views: Views, surface: LevelSet, poses: Poses | None, options: FreeFormOptions) -> Rays:
    pixels = solid_pixels(views, options.held_out_rays)
    rays = pixels.rays if poses is None else pixels.rays.moved(poses)
    sights = Sights.of(surface, rays, 1, options.least_cosine)
    clear = sights.clear & (pixels.inner_px > options.inner_px)
    outgoing, radiance = (
        torch.from_numpy(values[clear]).float() for values in (sights.outgoing[:, 0], pixels.radiance)
    )
    return Rays(outgoing, radiance)
