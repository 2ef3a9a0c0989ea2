"""A bent mirror from photographs: heights over the plane of its outline, by what it mirrors."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.config import FitConfig
from panoless.cubemap import resample, solve_environment
from panoless.kernels.objective import ObjectiveTerms, mirror_objective
from panoless.kernels.rasterize import Channels
from panoless.observation import observed_rays, prediction_error
from panoless.plane import Plane
from panoless.shading import rasterize_surfels
from panoless.sheet import Sheet, SheetSurfels, flat_sheet
from panoless.views import Views, split_held_out
from shinypartial.progress import Progress

CELLS = 16
"""Of the spline along the longer side of the outline."""
BENDING = 1e-5
HEIGHT_RATE, ENVIRONMENT_RATE = 5e-4, 3e-2
BETAS = (0.9, 0.99)
WARM_UP_STEPS = 30
DROP_AT, DROP_FACTOR = 0.5, 0.01
"""As in `RateConfig`: rates are constant until this share of the steps, then fall."""
BOUTS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Shares of the steps after which they pause; between two bouts the tilt is searched."""
TILTS_DEG = (0.3, 0.3, 0.2, 0.2, 0.1)
"""Steps of the searches."""
TILT_RAYS = 300_000
TILT_RESOLUTION = 128
TILT_SCALE = 0.05
NOTHING = Channels(colors=False, depth=False, distortion=False)


def fit_sheet(views: Views, config: FitConfig, plane: Plane) -> Sheet:
    """Heights that explain the views best, from a flat start, in `config.iterations` steps.

    Bouts of Adam on heights and environment together alternate with a search for the tilt, for which the environment
    is solved anew each time: tilting the mirror and turning the environment after changes little, so that no gradient
    step at a fixed environment gets far.
    """
    sheet, steps = flat_sheet(plane, CELLS), config.iterations
    mirror = SheetSurfels(sheet, config.surfels.count, config.seed)
    progress = Progress("fitting a bent mirror", len(BOUTS))
    for bout, (begin, end) in enumerate(pairwise((0.0, *BOUTS))):
        if bout > 0:
            sheet = tilted_best(views, config, mirror, sheet, np.radians(TILTS_DEG[bout - 1]))
        sheet = _bout(views, config, mirror, sheet, range(round(begin * steps), round(end * steps)))
        progress.advance()
    return sheet


def _bout(
    views: Views,
    config: FitConfig,
    mirror: SheetSurfels,
    sheet: Sheet,
    steps: range,
) -> Sheet:
    """Steps of Adam on heights and an environment that is solved first, one view each."""
    # Heights stay in main memory; what is seen of them lies where the views do.
    device = views.train[0].mask.device
    with torch.no_grad():
        rays = list(observed_rays(views, mirror.surfels(sheet.coefficients).to(device), config, TILT_RAYS))
        half = solve_environment(rays, config.environment.resolution // 2)
        light = resample(half, config.environment.resolution).requires_grad_()
    coefficients = sheet.coefficients.clone().requires_grad_()
    groups = [{"params": [coefficients], "lr": 0.0}, {"params": [light], "lr": 0.0}]
    adam = torch.optim.Adam(groups, betas=BETAS, eps=1e-12)
    terms = ObjectiveTerms(robust_scale=config.loss.robust_scale)
    order = torch.Generator().manual_seed(config.seed * 1_000_003 + steps.start)
    sequence: list[int] = []
    for step in steps:
        sequence = sequence or torch.randperm(len(views.train), generator=order).tolist()
        view = views.train[sequence.pop()]
        factor = DROP_FACTOR ** (max(step / config.iterations - DROP_AT, 0) / (1 - DROP_AT))
        adam.param_groups[0]["lr"] = HEIGHT_RATE * factor * (step >= steps.start + WARM_UP_STEPS)
        adam.param_groups[1]["lr"] = ENVIRONMENT_RATE * factor
        surfels = mirror.surfels(coefficients).to(device)
        raster = rasterize_surfels(surfels, view.camera, curved=True, channels=NOTHING, active_tiles=view.solid_tiles)
        images = raster.normals_camera, raster.alpha, raster.accumulated_depth, raster.median_depth
        objective = mirror_objective(*images, None, light, view.mirror, terms)
        adam.zero_grad()
        (objective.total + BENDING * mirror.bending(coefficients)).backward()  # type: ignore[no-untyped-call]
        adam.step()
        with torch.no_grad():
            light.clamp_(min=0)
    return replace(sheet, coefficients=coefficients.detach())


def tilted_best(views: Views, config: FitConfig, mirror: SheetSurfels, sheet: Sheet, step: float) -> Sheet:
    """The sheet with the tilt at which held-out views are predicted best, by a parabola through six tilts."""

    resolution = min(TILT_RESOLUTION, config.environment.resolution)

    def solved(
        tilt: Float[np.ndarray, "2"], start: Float[Tensor, "6 3 L L"] | None
    ) -> tuple[float, Float[Tensor, "6 3 L L"]]:
        with torch.no_grad():
            surfels = mirror.surfels(sheet.tilted(*tilt).coefficients).to(views.train[0].mask.device)
            known, held_out = split_held_out(list(observed_rays(views, surfels, config, TILT_RAYS)))
            environment = solve_environment(known, resolution, start)
            return prediction_error(held_out, environment, TILT_SCALE), environment

    _, here = solved(np.zeros(2), None)
    places = step * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1)])
    errors = np.array([solved(place, here)[0] for place in places])
    u, v = places.T / step
    design = np.stack([np.ones(6), u, v, u * u / 2, u * v, v * v / 2], 1)
    _, *slope, uu, uv, vv = np.linalg.solve(design, errors)
    curvature = np.array([[uu, uv], [uv, vv]])
    if np.linalg.eigvalsh(curvature)[0] > 0:
        best = np.linalg.solve(curvature, -np.array(slope))
        best *= min(1.0, 2.0 / max(float(np.linalg.norm(best)), 1e-9))
    else:
        best = np.array([u, v])[:, errors.argmin()]
    return sheet.tilted(*(best * step))
