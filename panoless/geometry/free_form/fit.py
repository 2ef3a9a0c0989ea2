"""A free-form surface from silhouettes and photographs: accepted Gauss–Newton steps, from coarse to fine."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.views import Views, split_held_out
from panoless.environment.rays import Rays
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
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


@dataclass(frozen=True)
class FitStage:
    """A surface between two rounds, and what the next one starts from."""

    surface: LevelSet
    trust: Trust
    environment: Float[Tensor, "6 3 L L"] | None
    damping: float
    settings: FreeFormRound | None = None
    """Of the round that led here."""


def fit_free_form(views: Views, start: LevelSet, options: FreeFormOptions = DEFAULTS) -> tuple[LevelSet, Trust]:
    """The surface that explains photographs and outlines best, no finer than held-out views want it, and its trust.

    Rounds are taken with four fifths of the views as long as the others gain by them, and the last of those once more
    with all.
    """
    kept, held_out = split_held_out(views.train)
    solved = replace(views, train=tuple(kept)) if kept and held_out else views
    tested = replace(views, train=tuple(held_out))
    every = [*options.rounds, *options.finer, (*options.rounds, *options.finer)[-1]]
    progress = Progress("fitting a free-form surface", sum(settings.steps for settings in every))
    with torch.no_grad():
        stage = FitStage(start, full_trust(start, options.trust_cells), None, options.damping)
        for settings in options.rounds:
            stage = take_round(solved, stage, settings, options, progress)
        if held_out and options.finer:
            stage = keep_if_better(
                _stages(solved, stage, options, progress),
                lambda each: held_out_error(solved, tested, each, options),
                options.least_held_out_gain,
            )
        assert stage.settings is not None, "a fit has rounds"
        skipped = progress.total - progress.done - stage.settings.steps
        if skipped > 0:
            progress.advance(steps=skipped)
        stage = take_round(views, stage, stage.settings, options, progress)
    return stage.surface, stage.trust


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
    solution = Solution.at(task, surface, stage.trust, stage.environment, options.first_map_rounds)
    solution, damping = take_steps(solution, stage.damping, progress)
    return FitStage(solution.surface, solution.trust, solution.environment, damping, settings)


def make_task(views: Views, settings: FreeFormRound, options: FreeFormOptions) -> Task:
    """The pixels and outlines of a round, weighted as if `counted_rays` pixels took part."""
    pixels, outlines = solid_pixels(views, settings.rays), outline_rays(views)
    total = max(sum(len(view.solid) for view in views.train), 1)
    chosen = outlines.chosen(slice(None, None, max(1, -(-len(outlines.size) // options.outline_points))))
    share = options.counted_rays / options.radiance_sigma**2 / max(len(pixels.inner_px), 1)
    density = options.counted_rays / total * len(outlines.size) / max(len(chosen.size), 1)
    return Task(pixels, chosen, share, density / options.outline_sigma_px**2, settings, options)


def take_steps(solution: Solution, damping: float, progress: Progress | None = None) -> tuple[Solution, float]:
    """The steps of a round, each of which lowers the cost with hits, visibility and map made anew; the last damping."""
    options, settings = solution.task.options, solution.task.settings
    for index in range(settings.steps):
        solution = replace(solution, trust=measured_trust(solution))
        before = solution
        solution, length = _accepted(solution, gauss_newton_step(solution, damping))
        factor = options.damping_less if length == 1 else options.damping_more
        damping = float(np.clip(damping * factor, *options.damping_range))
        gain = 1 - solution.cost(before) / before.cost(before)
        last = gain < options.least_gain
        if progress is not None:
            progress.advance(steps=settings.steps - index if last else 1)
        if last:
            break
    return solution, damping


def _accepted(solution: Solution, step: Float[np.ndarray, "A B C"]) -> tuple[Solution, float]:
    """The solution after the longest of the tried lengths of a step that lowers the cost, and that length; the same
    solution after none.
    """
    options, length, before = solution.task.options, 1.0, solution.cost(solution)
    for _ in range(options.trials):
        coefficients = solution.surface.coefficients + length * step
        surface = replace(solution.surface, coefficients=coefficients)
        moved = Solution.at(solution.task, surface, solution.trust, solution.environment, options.map_rounds)
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


def measured_trust(solution: Solution) -> Trust:
    """Trust by the residuals of a solution."""
    points, clear = solution.surface.points(solution.sights.hits.places), solution.free > 0
    return solution.trust.measured(points, solution.residual, solution.free, clear, solution.task.options)


def held_out_error(solved: Views, tested: Views, stage: FitStage, options: FreeFormOptions) -> float:
    """Mean of ‖e‖²/(‖e‖² + s²) over rays of views that neither surface nor map have seen."""
    rays = [_rays(views, stage, options) for views in (solved, tested)]
    return prediction_error(rays[1:], solve_environment(rays[:1], options.held_out_resolution))


def _rays(views: Views, stage: FitStage, options: FreeFormOptions) -> Rays:
    pixels = solid_pixels(views, options.held_out_rays)
    sights = Sights.of(stage.surface, pixels.rays, 1, options.least_cosine)
    clear = sights.clear & (pixels.inner_px > options.inner_px)
    outgoing, radiance = (
        torch.from_numpy(values[clear]).float() for values in (sights.outgoing[:, 0], pixels.radiance)
    )
    return Rays(outgoing, radiance)
