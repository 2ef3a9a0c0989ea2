"""A surface of few numbers solved with nuisance blocks: dense Gauss–Newton steps, the map eliminated.

With x all free unknowns, e the residuals of photographs under the map that follows them (variable projection, see
`panoless.environment.variable_projection`), δ those of silhouettes and P the precisions of the priors, a round lowers

½ Σ ρ(e)/σ² + ½ Σ ρ(δ)/σ_δ² + ½ C xᵀ P x,

with σ the noise that residuals show and C pixels that err alike. Rounds go from coarse maps to fine ones; before the
first, silhouettes alone turn cameras. What all views share is free under finer maps only, distortion in the last round.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, cast

import numpy as np
from jaxtyping import Float

from panoless.capture.poses import StatedCameras
from panoless.capture.views import Views
from panoless.deadline import improving, is_past_limit
from panoless.environment.surroundings import FAR, Surroundings
from panoless.journal import remembered
from panoless.problem.blocks import Block, CameraPoses, Distortion, Walls
from panoless.problem.equations import Data, Equations, Round, State
from panoless.problem.evidence import Decision, needed
from panoless.problem.nuisance import NO_NUISANCE, Nuisance, nuisance_of
from panoless.problem.parametric import ParametricSurface
from shinypartial.io.progress import Progress

AnySurface = TypeVar("AnySurface", bound=ParametricSurface)
LEAST_FALL = 1e-3
"""A round ends with a step that lowers its cost by a smaller share."""
SHARED_RESOLUTION = 64
"""Texels along a face side from which what all views share is free."""
LEAST_VIEWS, MOST_VIEWS = 5, 400
"""With fewer, or with more, whose dense equations would need gigabytes, nothing beside the surface is an unknown."""
SILHOUETTES = tuple(Round(0, scale, 0, 2) for scale in (4.0, 2.0, 1.0, 0.5))
"""By silhouettes alone."""
ROUNDS = (
    Round(16, 0.5, 30_000, 6),
    Round(32, 0.3, 60_000, 4),
    Round(64, 0.15, 120_000, 6),
)
"""With several rays a texel: a texel that one ray sees follows it wherever it goes."""
FINISH = Round(128, 0.1, 250_000, 3)
"""With a finer surface, for which poses make up."""
DISTORTED = replace(FINISH, steps=8)
"""With distortion, which others hide and which comes slowly."""


@dataclass(frozen=True)
class Solved:
    """A state, what was decided of each block, and the variances of those that are left."""

    state: State
    decisions: tuple[Decision, ...]
    variances: dict[str, Float[np.ndarray, "B M"]]


@remembered()
def take_round(views: Views, state: State, settings: Round, last: int) -> State:
    """A state after the steps of one round."""
    names = state.nuisance.free
    data = Data.of(views, settings, last, names)
    nuisance = state.nuisance
    if settings.resolution < SHARED_RESOLUTION:
        coarse = [] if settings.resolution == 0 else [CameraPoses.name]
        known = nuisance.under_coarse(settings.resolution)
        nuisance = nuisance.freed([name for name in known.free if name not in coarse])
    state = State(state.surface.settled(), nuisance)
    traced = None
    for _ in range(settings.steps):
        state, fall, traced = Equations.at(data, state, traced).after_step()
        if fall < LEAST_FALL:
            break
    return replace(state, nuisance=state.nuisance.freed(names))


def after_round(views: Views, surface: AnySurface, settings: Round, last: int) -> AnySurface:
    """A surface after one round in which nothing beside it is unknown."""
    return cast(AnySurface, take_round(views, State(surface, NO_NUISANCE), settings, last).surface)


def by_silhouettes_alone(views: Views, surface: AnySurface) -> AnySurface:
    """A surface by silhouettes alone, from cameras as stated."""
    return cast(AnySurface, by_silhouettes(views, surface, NO_NUISANCE).surface)


def by_silhouettes(views: Views, surface: ParametricSurface, nuisance: Nuisance) -> State:
    """A surface and cameras by silhouettes alone."""
    state = State(surface, nuisance)
    with improving():
        for settings in SILHOUETTES:
            state = take_round(views, state, settings, FINISH.resolution)
    return state


def solve(
    views: Views,
    surface: ParametricSurface,
    kinds: Collection[type[Block]],
    required: Collection[str],
    begin: Callable[[State], ParametricSurface] | None = None,
    rounds: Sequence[Round] = ROUNDS,
    around: Surroundings = FAR,
) -> Solved:
    """The surface with those of the nuisance blocks that the scene needs, and those that are `required`.

    All are free from the first round on. Those that are not needed are fixed before the others go on under a finer map.
    After silhouettes alone, `begin` may choose another surface for photographs to start from. Walls start as they are
    `around` it; the surface itself knows of none. Where such walls are not needed, all is solved once more without
    them: what they bent comes back slowly.
    """
    last = rounds[-1]

    progress = Progress("solving for cameras, exposures and masks", len(rounds) + 2)
    usual = [kind for kind in kinds if kind is not Distortion]
    state = by_silhouettes(views, surface, nuisance_of(views, usual, around))
    if begin is not None:
        state = replace(state, surface=begin(state))
    progress.advance()
    with improving():
        for each in rounds:
            state = take_round(views, state, each, FINISH.resolution)
            progress.advance()
    gone, settings, cameras = list[Decision](), last, StatedCameras.of(views)
    while True:
        state = state.without_common(cameras)
        data = Data.of(views, settings, FINISH.resolution, state.nuisance.free)
        covariances = Equations.at(data, state).covariances()
        if Walls.name in covariances:
            covariances[Walls.name] += state.surface.walls_error**2 * np.eye(len(covariances[Walls.name]))
        known = {
            each.name: np.diag(covariances[each.name]).reshape(each.values.shape) for each in state.nuisance.blocks
        }
        left, decisions = needed(state.nuisance, known, covariances, required)
        needless = [each for each in decisions if not each.kept]
        walls = [each for each in needless if each.name == Walls.name]
        if walls and around.coefficients.any() and not is_past_limit():
            fewer = [kind for kind in kinds if kind is not Walls]
            found = solve(views, surface, fewer, required, begin, rounds, around.without_walls)
            return replace(found, decisions=(*walls, *found.decisions))
        gone += needless
        if (not needless and settings is not last) or is_past_limit():
            progress.advance(steps=progress.total - progress.done)
            return Solved(replace(state, nuisance=left), (*gone, *(each for each in decisions if each.kept)), known)
        if settings is last:
            more = [Distortion] if Distortion in kinds else []
            left = nuisance_of(views, [*more, *(type(each) for each in left.blocks)], around).replaced(left.blocks)
            state = replace(state, surface=state.surface.refined())
        settings = DISTORTED if left.blocks else FINISH
        state = take_round(views, replace(state, nuisance=left), settings, settings.resolution)
