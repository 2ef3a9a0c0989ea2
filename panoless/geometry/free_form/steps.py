"""Damped Gauss–Newton steps of a level set with its nuisance blocks, each of which lowers the cost."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from panoless.geometry.free_form.photometric import Solution
from panoless.geometry.free_form.trust import Trust
from panoless.numeric.conjugate_gradients import solve_by_products
from panoless.numeric.factorize import regularize
from panoless.problem.rows import CHI_MEDIAN, CORRELATED
from shinypartial.io.progress import Progress

THIRD_DIFFERENCE_DIAGONAL = 3 * 20 + 6 * 3 * 12 + 6 * 8
"""Of DᵀD: Σ over the kinds of how often one counts in |D³c|² times its squared factors."""
OUTLINE_GAIN = 9.0
"""Factor of the weight of silhouettes where the offsets of their masks are free: as if they were right to 0.05 px."""


@dataclass(frozen=True)
class Change:
    """A step of everything that is unknown: coefficients in cells, and what is unknown beside them."""

    coefficients: Float[np.ndarray, "A B C"]
    beside: list[Float[np.ndarray, "_ _"]]


def with_noise(solution: Solution) -> Solution:
    """With priors and silhouettes in the units of the noise that residuals show, in place of the nominal one.

    A pixel of variance σ² where e has σₑ² counts (σₑ/σ)² too much; errors of a map and of a surface are alike in about
    `CORRELATED` pixels.
    """
    task, clear = solution.task, solution.free > 0
    size = np.linalg.norm(solution.residual[clear], axis=1)
    sigma = float(np.median(size)) / CHI_MEDIAN if len(size) else 0.0
    factor = max(sigma / task.options.radiance_sigma, 1.0) ** 2
    weight = task.outline_weight / task.settings.outline_gain * OUTLINE_GAIN * factor
    return replace(solution, task=replace(task, prior_factor=CORRELATED * factor, outline_weight=weight))


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
    """−(H + μ diag H)⁻¹ g, nowhere longer than the longest step; in a `still` scene only blocks of views move."""
    gradient, beside = solution.gradient()
    change = solved_equations(solution, (-gradient, [-each for each in beside]), damping, still=still)
    longest = solution.task.options.largest_step_cells
    return replace(change, coefficients=np.clip(change.coefficients, -longest, longest))


def solved_equations(
    solution: Solution,
    right_side: tuple[Float[np.ndarray, "A B C"], list[Float[np.ndarray, "_ _"]]],
    damping: float,
    *,
    still: bool = False,
) -> Change:
    """(H + μ diag H)⁻¹ b by conjugate gradients.

    That is preconditioned by its blocks: with H = L Lᵀ of a block its unknowns are y = Lᵀ x.
    """
    options, shape = solution.task.options, solution.surface.shape
    diagonal, size = solution.diagonal(THIRD_DIFFERENCE_DIAGONAL), solution.surface.coefficients.size
    damped = [each.matrix * (1 + damping * np.eye(each.matrix.shape[1])) for each in solution.beside]
    back = [
        np.linalg.inv(np.linalg.cholesky(regularize(blocks, "cameras and exposures"))).transpose(0, 2, 1)
        for blocks in damped
    ]
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
            by_moved += damping * np.einsum("bmm->bm", each.matrix) * moved
        return packed(by_change + damping * diagonal * change.coefficients, by_others)

    moving = [np.full(each.value.size, not still or index == 0) for index, each in enumerate(solution.beside)]
    free = np.zeros(shape) if still else solution.active / (diagonal * (1 + damping))
    return unpacked(
        solve_by_products(
            product,
            packed(*right_side),
            np.concatenate([free.ravel(), *moving]),
            solution.task.settings.solver_steps,
            options.solver_tolerance,
        )
    )


def measured_trust(solution: Solution) -> Trust:
    """Trust by the residuals of a solution."""
    points, clear = solution.surface.points(solution.sights.hits.places), solution.free > 0
    return solution.trust.measured(points, solution.residual, solution.free, clear, solution.task.options)
