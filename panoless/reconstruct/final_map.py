"""The map of a finished geometry, and how well each of its directions was observed."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.contrast import exposed
from panoless.capture.encoding import encoding_of
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.deadline import improving
from panoless.environment.lobe import Lobe
from panoless.environment.resolution import count_rays
from panoless.environment.roughness import sharpened_map, with_smaller_lamps
from panoless.environment.solve import solve_environment
from panoless.environment.visibility import agreement, visibility_from_agreement, visibility_from_evidence
from panoless.geometry.base import Geometry, observe_views, pixel_areas, usable_views
from panoless.journal import remembered
from panoless.reconstruct.state import FitState
from panoless.selection.blur import Blur, needed_blur
from panoless.selection.material import as_perfect_mirror, earned_reflectance
from panoless.splats.training import Training
from shinypartial.io.events import note

GRAY = 0.5


def complete(state: FitState, views: Views, config: FitConfig) -> tuple[Views, FitConfig]:
    """Set reflectance, roughness, blur, environment and visibility of a state from its geometry and corrected
    photographs. These are returned as a mirror of all light would have shown them, with the configuration that says at
    which radiance they are saturated.

    The map is solved in closed form, unless the configuration keeps that of an iterative fit, which knows no material.
    It is that of photographs as they were taken: exposed more, their robust scales would leave out what is beside a
    lamp, which counts most in a map.
    Only kinds in closed form have a roughness: wrong normals blur a map as well, and so does a material that was solved
    with the shape.
    """
    usable, exposure = usable_views(views, state.geometry), encoding_of(config).exposure
    if config.environment.solve or state.training is None:
        state.reflectance = earned_reflectance(usable, state.geometry, config)
    if state.reflectance is not None:
        if state.reflectance.uneven_share is not None:
            note(f"Material: differs on {state.reflectance.uneven_share:.0%} of the seen surface.")
        views = as_perfect_mirror(views, usable, state.geometry, state.reflectance, encoding_of(config))
        usable = usable_views(views, state.geometry)
        config = replace(config, tint=state.reflectance.tint)
        state.reflectance = state.reflectance.exposed(1 / exposure)
    blur = Blur()
    if state.training is None and state.geometry.reflectance is None:
        with improving():
            blur = needed_blur(usable, state.geometry, config)
    state.roughness, state.blur_px = blur.roughness, blur.blur_px
    taken = exposed(usable if state.blur_px is None else replace(usable, blur_px=state.blur_px), 1 / exposure)
    state.environment, state.visibility = _solved(
        taken, state.geometry, state.training, state.roughness, replace(config, exposure=1.0)
    )
    return views if state.blur_px is None else replace(views, blur_px=state.blur_px), config


@remembered()
def _solved(
    views: Views, geometry: Geometry, training: Training | None, roughness: float | None, config: FitConfig
) -> tuple[Float[Tensor, "6 3 L L"], Float[Tensor, "6 L L"]]:
    """Environment and visibility from usable pixels."""
    encoding = encoding_of(config)
    with torch.no_grad():
        if config.environment.solve or training is None:
            environment, rays = geometry.solve_map(views, config)
            shown = environment
            if roughness is not None:
                environment = _of_rough_mirror(roughness, geometry, views, config, environment.shape[-1])
                shown = Lobe.of(roughness, environment.shape[-1]).blurred(environment)
            if not config.environment.fill:
                environment = torch.where(count_rays(rays, environment.shape[-1]) > 0, environment, GRAY)
        else:
            rays = list(observe_views(views, geometry, config.environment.rays))
            sigmoid = config.environment.activation == "sigmoid"
            environment = torch.sigmoid(training.environment) if sigmoid else training.environment
            shown = environment
        if config.splats.visibility == "online" and training is not None:
            visibility = visibility_from_evidence(training.evidence)
        else:
            agreed = agreement(rays, shown, encoding.saturation)
            visibility = visibility_from_agreement(agreed)
        return encoding.decoded(environment), visibility


def _of_rough_mirror(
    roughness: float, geometry: Geometry, views: Views, config: FitConfig, resolution: int
) -> Float[Tensor, "6 3 L L"]:
    """The sharpened map. It starts from one of pixel centers: footprints, which sharpen as well, would do so twice."""
    areas = pixel_areas(views, geometry, config.environment.rays)
    saturation = encoding_of(config).saturation
    start = with_smaller_lamps(solve_environment([each.rays() for each in areas], resolution), saturation)
    lobe = Lobe.of(roughness, resolution)
    return sharpened_map(start, areas, lobe, saturation)
