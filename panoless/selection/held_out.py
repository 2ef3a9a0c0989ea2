"""Held-out views: how much of them a geometry explains, and whether another explains more."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.views import Views, split_held_out
from panoless.config import FitConfig
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.base import Geometry, Training, observe_views
from panoless.geometry.registry import FAMILIES
from panoless.journal import remembered
from panoless.selection.options import SelectionOptions

Trial = Callable[[Views, FitConfig, Geometry], Geometry]
"""Fits the kind that explains anything to views for a while, from a geometry on."""


class Unobserved:
    """Nobody is told of the steps of a trial."""

    title = "comparing models"

    def after_step(self, iteration: int, seconds: float, current: Callable[[], tuple[Geometry, Training]]) -> None:
        """Nothing."""

    def record(self, point: dict[str, float]) -> None:
        """Nothing."""


@remembered()
def train_briefly(views: Views, config: FitConfig, start: Geometry) -> Geometry:
    """A geometry after a share of the configured steps, in memory only; itself where its kind takes none."""
    steps = max(round(config.iterations * config.selection.trial_share), 1)
    config, family = replace(config, iterations=steps), FAMILIES[start.kind]
    training = family.begin(views, start, config)
    return start if training is None else family.train(views, start, training, config, Unobserved())[0]


def held_out_errors(
    views: Views, config: FitConfig, candidate: Geometry, trial: Trial, least: float = 0.0
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"] | None] | None:
    """Mean ‖e‖²/(‖e‖² + s²) of each held-out view, for a candidate and for surfels that started on it; None of these
    where the candidate leaves less than `least`, and nothing at all where there are too few views.

    Every fifth view is held out from the map and from the surfels.
    """
    parts = held_out_parts(views)
    if parts is None:
        return None
    options = config.selection

    def errors(geometry: Geometry) -> Float[np.ndarray, "V"]:
        return unexplained(*parts, geometry, options.compared_rays, options.trial_resolution)

    own = errors(candidate)
    if own.mean() < least:
        return own, None
    return own, errors(trial(parts[0], config, candidate.to_surfels(config).to(views.train[0].mask.device)))


def held_out_parts(views: Views) -> tuple[Views, Views] | None:
    """Four fifths of the views, and the others; None where there are too few."""
    kept, held_out = split_held_out(views.train)
    if not kept or not held_out:
        return None
    return replace(views, train=tuple(kept)), replace(views, train=tuple(held_out))


def unexplained(solved: Views, tested: Views, geometry: Geometry, rays: int, resolution: int) -> Float[np.ndarray, "V"]:
    """Mean ‖e‖²/(‖e‖² + s²) of each tested view under the map of the solved ones, at most `rays` of either."""
    with torch.no_grad():
        environment = solve_environment(list(observe_views(solved, geometry, rays)), resolution)
        return np.array([prediction_error([batch], environment) for batch in observe_views(tested, geometry, rays)])


def is_clearly_lower(errors: Float[np.ndarray, "V"], of: Float[np.ndarray, "V"], options: SelectionOptions) -> bool:
    """Whether `errors` lie below those `of` another by the least gain and the standard errors of the options."""
    gain = of - errors
    noise = options.standard_errors * float(gain.std(ddof=1)) / len(gain) ** 0.5 if len(gain) > 1 else np.inf
    return bool(gain.mean() > max(noise, options.least_gain * of.mean()))
