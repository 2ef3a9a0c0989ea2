"""Which model a scene needs: the lowest rung that explains held-out views as well as the next one.

A plane has three numbers and an outline; surfels that start on it may bend. A model that is not needed costs accuracy,
too: tilting a flat mirror and turning the environment the other way leaves every picture as it was, so surfels drift.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from panoless.capture.views import TrainView, Views, split_held_out
from panoless.config import FitConfig
from panoless.environment.observation import TRIAL_RESOLUTION, Geometry, observed_rays
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.height_field.fit import fit_height_field
from panoless.geometry.height_field.model import HeightField, visible_reflections
from panoless.geometry.plane.fit import fit_plane
from panoless.geometry.plane.model import Plane, unoccluded_share
from panoless.geometry.revolution.fit import propose_revolution, refine_revolution
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.surfels.model import Surfels
from panoless.geometry.surfels.placement import surfels_on_height_field, surfels_on_plane, surfels_on_revolution
from shinypartial.core.errors import InputError

#: A plane is considered when its outline explains the masks this well: median over views of the median distance, and
#: of intersection over union.
LARGEST_MEDIAN_PX = 0.5
LEAST_IOU = 0.98
UNOCCLUDED_SHARE = 0.99
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
    """The model that was taken, and why. `plane` is that of the outline, also when a mirror bends away from it."""

    model: Literal["plane", "bent", "revolution", "surfels"]
    reason: str
    plane: Plane | None = None
    height_field: HeightField | None = None
    """The heights over the plane, also when surfels that start on them explain more."""
    surface: SurfaceOfRevolution | None = None
    """The surface of revolution, also when surfels that start on it explain more."""


def choose_rung(views: Views, config: FitConfig, trial: Trial) -> Rung:
    """The rung of a scene.

    A plane is refused when it misses the outlines, and after it a surface of revolution by the same measure. Else
    surfels that start on the plane, or on the surface of revolution, are fitted to four fifths of the views, and it
    stays unless they explain the others better: by 5 % of the mean ‖e‖²/(‖e‖² + s²) and by two standard errors of the
    paired differences. A plane with an error above 0.3 goes anyway. Where a plane goes, heights over it are fitted, and
    stay by the same rule. `config.model` overrides.
    Raises InputError when a plane is asked for and can't be fitted.
    """
    if config.model == "surfels":
        return Rung("surfels", "asked for")
    if config.model == "revolution":
        return _revolution(views, config, trial, "asked for")
    try:
        found = fit_plane(views, thorough=config.model != "auto")
    except InputError:
        if config.model != "auto":
            raise
        return _revolution(views, config, trial, "the masks don't determine a plane")
    distance, overlap = float(np.median(found.median_px)), float(np.median(found.iou))
    if config.model == "auto" and not (distance <= LARGEST_MEDIAN_PX and overlap >= LEAST_IOU):
        away = f"{distance:.2g} px" if np.isfinite(distance) else "far"
        refused = f"no plane explains the outlines: {away} away, overlap {overlap:.0%}"
        return _revolution(views, config, trial, refused)
    boundary = f"a plane explains the outlines to {distance:.2g} px"
    if config.model == "plane":
        return Rung("plane", f"asked for; {boundary}", found.plane)
    if config.model == "height_field":
        return _bent(views, config, trial, found.plane, f"asked for; {boundary}")
    start = surfels_on_plane(found.plane, config.surfels.count, config.seed)
    flat, bent = _held_out_errors(without_frame_reflections(views, found.plane), config, found.plane, start, trial)
    compared = f"{boundary}; held-out error {flat.mean():.4f} flat, {bent.mean():.4f} with surfels"
    if flat.mean() > LARGEST_ERROR or _clearly_better(flat, bent):
        return _bent(views, config, trial, found.plane, f"{compared}: not flat")
    return Rung("plane", f"{compared}: no better", found.plane)


def _bent(views: Views, config: FitConfig, trial: Trial, plane: Plane, reason: str) -> Rung:
    """Heights over a plane, after `reason` spoke against the plane itself."""
    height_field = fit_height_field(views, plane)
    if config.model == "height_field":
        return Rung("bent", reason, height_field.plane, height_field)
    start = surfels_on_height_field(height_field, config.surfels.count, config.seed)
    smooth, free = _held_out_errors(without_frame_reflections(views, height_field), config, height_field, start, trial)
    compared = f"{reason}; {smooth.mean():.4f} with heights, {free.mean():.4f} with surfels on them"
    if _clearly_better(smooth, free):
        return Rung("surfels", f"{compared}: not smooth", height_field.plane, height_field)
    return Rung("bent", f"{compared}: no better", height_field.plane, height_field)


def _revolution(views: Views, config: FitConfig, trial: Trial, reason: str) -> Rung:
    """The second rung, after `reason` spoke against the first."""
    found, asked = propose_revolution(views), config.model == "revolution"
    if found is None:
        if asked:
            raise InputError(
                expected="masks of a surface of revolution, for --model revolution",
                found="no axis around which their outlines agree",
                remedy="Take --model auto or --model surfels.",
            )
        return Rung("surfels", f"{reason}; no axis of revolution")
    distance, overlap = float(np.median(found.median_px)), float(np.median(found.iou))
    if not asked and not (distance <= LARGEST_MEDIAN_PX and overlap >= LEAST_IOU):
        refused = f"no surface of revolution: {distance:.2g} px away, overlap {overlap:.0%}"
        return Rung("surfels", f"{reason}; {refused}")
    boundary = f"{reason}; a surface of revolution explains them to {distance:.2g} px"
    surface = refine_revolution(views, found.surface)
    if asked:
        return Rung("revolution", boundary, surface=surface)
    start = surfels_on_revolution(surface, config.surfels.count)
    round_, free = _held_out_errors(views, config, surface, start, trial)
    compared = f"{boundary}; held-out error {round_.mean():.4f}, {free.mean():.4f} with surfels"
    if _clearly_better(round_, free):
        return Rung("surfels", f"{compared}: not round", surface=surface)
    return Rung("revolution", f"{compared}: no better", surface=surface)


def _clearly_better(lower: np.ndarray, higher: np.ndarray) -> bool:
    """Whether the errors of the higher rung are smaller by the margins above."""
    gain = lower - higher
    noise = STANDARD_ERRORS * float(gain.std(ddof=1)) / len(gain) ** 0.5 if len(gain) > 1 else np.inf
    return bool(gain.mean() > max(noise, LEAST_GAIN * lower.mean()))


def without_frame_reflections(views: Views, mirror: Plane | HeightField) -> Views:
    """The views without the pixels in which a frame around a flat or bent mirror mirrors itself."""

    def clear(view: TrainView) -> TrainView:
        if isinstance(mirror, HeightField):
            return replace(view, solid=visible_reflections(mirror, view, view.solid).pixels)
        seen = unoccluded_share(mirror, view.camera).flatten()[view.solid] > UNOCCLUDED_SHARE
        return replace(view, solid=view.solid[seen])

    return replace(views, train=tuple(clear(view) for view in views.train))


def _held_out_errors(
    views: Views, config: FitConfig, lower: Geometry, start: Surfels, trial: Trial
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of held-out views, one a view, for a rung and for surfels that started on it."""
    kept, held_out = split_held_out(views.train)
    if not kept or not held_out:
        return np.zeros(1), np.zeros(1)
    solved, tested = replace(views, train=tuple(kept)), replace(views, train=tuple(held_out))
    geometries: tuple[Geometry, Geometry] = (lower, trial(solved, config, start))
    errors = []
    for geometry in geometries:
        with torch.no_grad():
            environment = solve_environment(
                list(observed_rays(solved, geometry, config, COMPARED_RAYS)), TRIAL_RESOLUTION
            )
            rays = observed_rays(tested, geometry, config, COMPARED_RAYS)
            errors.append(np.array([prediction_error([batch], environment) for batch in rays]))
    return errors[0], errors[1]
