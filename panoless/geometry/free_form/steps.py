"""Damped Gauss–Newton steps of a level set with its nuisance blocks, each of which lowers the cost."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from panoless.geometry.free_form.material import measured_material
from panoless.geometry.free_form.photometric import Linearization
from panoless.geometry.free_form.schedule import SILHOUETTE_GAIN
from panoless.geometry.free_form.task import RADIANCE_SIGMA
from panoless.geometry.free_form.trust import Trust
from panoless.numeric.conjugate_gradients import solve_by_products
from panoless.numeric.factorize import regularize
from panoless.problem.rows import CHI_MEDIAN, CORRELATED
from shinypartial.io.progress import Progress

THIRD_DIFFERENCE_DIAGONAL = 3 * 20 + 6 * 3 * 12 + 6 * 8
"""Of DᵀD: Σ over the kinds of how often one counts in |D³c|² times its squared factors."""
DAMPING = 1e-3
"""First μ of Marquardt's damping μ diag(H)."""
DAMPING_LESS, DAMPING_MORE = 0.3, 4.0
"""Factors of μ after a whole step, and for each time that one was shortened."""
DAMPING_RANGE = (1e-5, 1.0)
"""Bounds of μ."""
SHORTENING = 0.35
"""Factor of a step that raises the cost."""
TRIALS = 4
"""Lengths that are tried."""
SOLVER_TOLERANCE = 1e-5
"""Conjugate-gradient steps end when the preconditioned residual's energy has fallen to this share."""
MATERIAL_ROUNDS = 3
"""In which material and map are determined in turn before the first step of a round; before others in one."""
LONGEST_STEP_CELLS = 1.0
"""No coefficient moves by more in one step."""


@dataclass(frozen=True)
class Change:
    """A step of everything that is unknown: coefficients in cells, and what is unknown beside them."""

    coefficients: Float[np.ndarray, "A B C"]
    beside: list[Float[np.ndarray, "_ _"]]


def with_noise(linearization: Linearization) -> Linearization:
    """With priors and silhouettes in the units of the noise that residuals show, in place of the nominal one.

    A pixel of variance σ² where e has σₑ² counts (σₑ/σ)² too much; errors of a map and of a surface are alike in about
    `CORRELATED` pixels.
    """
    task, clear = linearization.task, linearization.free > 0
    size = np.linalg.norm(linearization.residual[clear], axis=1)
    sigma = float(np.median(size)) / CHI_MEDIAN if len(size) else 0.0
    factor = max(sigma / RADIANCE_SIGMA, 1.0) ** 2
    weight = task.silhouette_weight / task.settings.silhouette_gain * SILHOUETTE_GAIN * factor
    return replace(linearization, task=replace(task, prior_factor=CORRELATED * factor, silhouette_weight=weight))


def take_steps(
    linearization: Linearization, damping: float, progress: Progress | None = None, *, still: bool = False
) -> tuple[Linearization, float]:
    """The steps of a round, each of which lowers the cost with hits, visibility and map computed again; the last
    damping.
    """
    settings = linearization.task.settings
    for index in range(settings.steps):
        if not still:
            for _ in range(MATERIAL_ROUNDS if index == 0 else 1):
                linearization = with_material(linearization)
            linearization = replace(linearization, trust=measured_trust(linearization))
        before = linearization
        linearization, shortened = _accepted(linearization, gauss_newton_step(linearization, damping, still=still))
        stiffest = damping >= DAMPING_RANGE[1]
        factor = DAMPING_MORE**shortened if shortened else DAMPING_LESS
        damping = float(np.clip(damping * factor, *DAMPING_RANGE))
        gain = 1 - linearization.cost(before) / before.cost(before)
        last = gain < settings.least_gain and (shortened < TRIALS or stiffest)
        if progress is not None:
            progress.advance(steps=settings.steps - index if last else 1)
        if last:
            break
    return linearization, damping


def _accepted(linearization: Linearization, step: Change) -> tuple[Linearization, int]:
    """The linearization after the longest of the tried lengths of a step that lowers the cost, and how many times it
    was shortened; the same one after none, and the number of trials.
    """
    before = linearization.cost(linearization)
    for shortened in range(TRIALS):
        length = SHORTENING**shortened
        moved = linearization.after(length * step.coefficients, [length * each for each in step.beside])
        if moved.cost(linearization) < before:
            return moved, shortened
    return linearization, TRIALS


def gauss_newton_step(linearization: Linearization, damping: float, *, still: bool = False) -> Change:
    """−(H + μ diag H)⁻¹ g, nowhere longer than the longest step; in a `still` scene only blocks of views move."""
    gradient, beside = linearization.gradient()
    change = solved_equations(linearization, (-gradient, [-each for each in beside]), damping, still=still)
    coefficients = np.clip(change.coefficients, -LONGEST_STEP_CELLS, LONGEST_STEP_CELLS)
    return replace(change, coefficients=coefficients)


def solved_equations(
    linearization: Linearization,
    right_side: tuple[Float[np.ndarray, "A B C"], list[Float[np.ndarray, "_ _"]]],
    damping: float,
    *,
    still: bool = False,
) -> Change:
    """(H + μ diag H)⁻¹ b by conjugate gradients.

    That is preconditioned by its blocks: with H = L Lᵀ of a block its unknowns are y = Lᵀ x.
    """
    shape, size = linearization.surface.shape, linearization.surface.coefficients.size
    diagonal = linearization.diagonal(THIRD_DIFFERENCE_DIAGONAL)
    damped = [each.matrix * (1 + damping * np.eye(each.matrix.shape[1])) for each in linearization.beside]
    back = [
        np.linalg.inv(np.linalg.cholesky(regularize(blocks, "cameras and exposures"))).transpose(0, 2, 1)
        for blocks in damped
    ]
    ends = np.cumsum([size, *(each.value.size for each in linearization.beside)])

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
        by_change, by_others = linearization.product(change.coefficients, change.beside)
        for each, moved, by_moved in zip(linearization.beside, change.beside, by_others, strict=True):
            by_moved += damping * np.einsum("bmm->bm", each.matrix) * moved
        return packed(by_change + damping * diagonal * change.coefficients, by_others)

    moving = [np.full(each.value.size, not still or index == 0) for index, each in enumerate(linearization.beside)]
    free = np.zeros(shape) if still else linearization.active / (diagonal * (1 + damping))
    return unpacked(
        solve_by_products(
            product,
            packed(*right_side),
            np.concatenate([free.ravel(), *moving]),
            linearization.task.settings.solver_steps,
            SOLVER_TOLERANCE,
        )
    )


def with_material(linearization: Linearization) -> Linearization:
    """With the material measured, where places differ, and the map computed again."""
    if linearization.task.material is None:
        return linearization
    return linearization.under(replace(linearization.task, material=measured_material(linearization)))


def measured_trust(linearization: Linearization) -> Trust:
    """Trust by the residuals of a linearization."""
    clear = linearization.free > 0
    return linearization.trust.measured(linearization.points, linearization.residual, linearization.free, clear)
