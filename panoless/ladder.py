"""Which model a scene needs: the lowest rung that explains held-out views as well as the next one.

A plane has three numbers and an outline; surfels that start on it may bend. A model that is not needed costs accuracy,
too: tilting a flat mirror and turning the environment the other way leaves every picture as it was, so surfels drift.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from panoless.config import FitConfig
from panoless.cubemap import solve_environment
from panoless.initialize import surfels_on_plane
from panoless.observation import (
    TRIAL_RESOLUTION,
    Geometry,
    observed_rays,
    prediction_error,
    split_held_out,
)
from panoless.plane import Plane, unobstructed
from panoless.plane_fit import fit_plane
from panoless.surfels import Surfels
from panoless.views import TrainView, Views
from shinypartial.errors import InputError

#: A plane is considered when its outline explains the masks this well: median over views of the median distance, and
#: of intersection over union.
LARGEST_MEDIAN_PX = 0.5
LEAST_IOU = 0.98
UNOBSTRUCTED_SHARE = 0.99
#: The next rung has to lower the held-out error by this share, and by two standard errors of the paired differences.
LEAST_GAIN = 0.05
STANDARD_ERRORS = 2.0
COMPARED_RAYS = 1_000_000
#: A plane that leaves more of the held-out views unexplained is no mirror of theirs, even if a short trial of surfels
#: does no better. Right planes leave a twentieth.
LARGEST_ERROR = 0.3

Trial = Callable[[Views, FitConfig, Surfels], Surfels]
"""Fits surfels to views for a while, from the given start."""


@dataclass(frozen=True)
class Rung:
    """The model that was taken, and why. `plane` is that of the outline, also when surfels bend away from it."""

    model: Literal["plane", "surfels"]
    reason: str
    plane: Plane | None = None


def choose_rung(views: Views, config: FitConfig, trial: Trial) -> Rung:
    """The rung of a scene.

    A plane is refused when it misses the outlines. Else surfels that start on it are fitted to four fifths of the
    views, and the plane stays unless they explain the others better: by 5 % of the mean ‖e‖²/(‖e‖² + s²) and by two
    standard errors of the paired differences. A plane with an error above 0.3 goes anyway. `config.model` overrides.
    Raises InputError when a plane is asked for and can't be fitted.
    """
    if config.model == "surfels":
        return Rung("surfels", "asked for")
    try:
        found = fit_plane(views, thorough=config.model == "plane")
    except InputError:
        if config.model == "plane":
            raise
        return Rung("surfels", "the masks don't determine a plane")
    distance, overlap = float(np.median(found.median_px)), float(np.median(found.iou))
    if config.model == "auto" and not (distance <= LARGEST_MEDIAN_PX and overlap >= LEAST_IOU):
        away = f"{distance:.2g} px" if np.isfinite(distance) else "far"
        return Rung("surfels", f"no plane explains the outlines: {away} away, overlap {overlap:.0%}")
    outline = f"a plane explains the outlines to {distance:.2g} px"
    if config.model == "plane":
        return Rung("plane", f"asked for; {outline}", found.plane)
    flat, bent = _held_out_errors(without_mirrored_frame(views, found.plane), config, found.plane, trial)
    gain = flat - bent
    noise = STANDARD_ERRORS * float(gain.std(ddof=1)) / len(gain) ** 0.5 if len(gain) > 1 else np.inf
    compared = f"{outline}; held-out error {flat.mean():.4f} flat, {bent.mean():.4f} with surfels"
    if flat.mean() > LARGEST_ERROR or gain.mean() > max(noise, LEAST_GAIN * flat.mean()):
        return Rung("surfels", f"{compared}: bent", found.plane)
    return Rung("plane", f"{compared}: no better", found.plane)


def without_mirrored_frame(views: Views, plane: Plane) -> Views:
    """The views without the pixels in which a frame around the plane mirrors itself."""

    def clear(view: TrainView) -> TrainView:
        seen = unobstructed(plane, view.camera).flatten()[view.solid] > UNOBSTRUCTED_SHARE
        return replace(view, solid=view.solid[seen])

    return replace(views, train=tuple(clear(view) for view in views.train))


def _held_out_errors(views: Views, config: FitConfig, plane: Plane, trial: Trial) -> tuple[np.ndarray, np.ndarray]:
    """Errors of held-out views, one a view, for the plane and for surfels that started on it."""
    kept, held_out = split_held_out(views.train)
    if not kept or not held_out:
        return np.zeros(1), np.zeros(1)
    solved, tested = replace(views, train=tuple(kept)), replace(views, train=tuple(held_out))
    start = surfels_on_plane(plane, config.surfels.count, config.seed)
    geometries: tuple[Geometry, Geometry] = (plane, trial(solved, config, start))
    errors = []
    for geometry in geometries:
        with torch.no_grad():
            environment = solve_environment(
                list(observed_rays(solved, geometry, config, COMPARED_RAYS)), TRIAL_RESOLUTION
            )
            rays = observed_rays(tested, geometry, config, COMPARED_RAYS)
            errors.append(np.array([prediction_error([batch], environment) for batch in rays]))
    return errors[0], errors[1]
