"""How rough the object is, or how blurred pictures are that look as if it were, by what a finished geometry explains.

Neither is taken for granted: held-out views decide.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.encoding import encoding_of
from panoless.capture.views import Views, held_out_parts
from panoless.config import FitConfig
from panoless.environment.footprints import PixelFootprints, thinned
from panoless.environment.lobe import Lobe
from panoless.environment.options import MaterialOptions
from panoless.environment.resolution import ERROR_SCALE
from panoless.environment.roughness import SHARPENING_ROUNDS, sharpened_map
from panoless.environment.solve import solve_environment
from panoless.geometry.base import Geometry, pixel_areas
from panoless.journal import remembered
from panoless.numeric.robust import bounded_error
from panoless.selection.held_out import is_clearly_lower

RESOLUTION = 64
"""Most texels along a face side of the maps under which roughness and blur are judged."""
FIRST_BLUR_PX = 0.5
"""Standard deviation of the blur that is tried first (px)."""
BLURS_PX = (0.25, 2.0)
"""Among these it is searched for (px)."""
FIRST_ROUGHNESS = 0.085
"""The roughness that is tried first."""
LEAST_ROUGHNESS_GAIN = 0.01
"""Share by which that has to lower the held-out error, also that of a sharp map which its lobe smooths afterwards."""
LEAST_UNEXPLAINED = 0.01
"""Held-out error of a sharp map from which roughness and blur are tried."""
ROUGHNESSES = (0.06, 0.3)
"""Among these a roughness is searched for."""
TRIALS = 6
"""So many are tried in the search, which determines it to 15 %, and in that of a blur."""
JUDGED_PIXELS = 60_000
"""About so many pixels at most make a map under which roughness is judged: two or three a texel."""
JUDGED_ROUNDS = 8
"""Steps that sharpen it for the first question; the search takes those of the exported map."""


@dataclass(frozen=True)
class Blur:
    """What blurs the mirrored light on its way to the pixels."""

    roughness: float | None = None
    """Of the object, in (0, 0.5]; None: it is smooth."""
    blur_px: float | None = None
    """Standard deviation of a Gaussian over the pictures; None: they are sharp."""


@remembered()
def needed_blur(
    views: Views,
    geometry: Geometry,
    config: FitConfig,
    *,
    first_roughness: float = FIRST_ROUGHNESS,
    roughnesses: tuple[float, float] = ROUGHNESSES,
    trials: int = TRIALS,
) -> Blur:
    """Roughness of the object and blur of the pictures, as far as held-out views are clearly better explained by them.
    Views are those of usable pixels.

    Four fifths of the views make the maps by which the others are judged: one that is shown as it is, one that a lobe
    blurs, and one under wider pixels, after the same steps from the same start, and on areas of pixels, because a map
    that knows of none is better blurred for that. A lobe blurs all directions alike, a wider pixel those that a curved
    part spreads. A known roughness is taken. In a high dynamic range there is no blur: a mean of encoded values is not
    the encoding of the mean.
    """
    options, encoding = config.material, encoding_of(config)
    if encoding.high_dynamic_range or options.roughness == options.blur == "off":
        return Blur()
    if options.roughness == "auto" and options.known_roughness > 0:
        return Blur(options.known_roughness)
    with torch.no_grad():
        trial = BlurTrial.of(views, geometry, config)
        return Blur() if trial is None else judged_blur(trial, options, first_roughness, roughnesses, trials)


def judged_blur(
    trial: "BlurTrial",
    options: MaterialOptions,
    first_roughness: float = FIRST_ROUGHNESS,
    roughnesses: tuple[float, float] = ROUGHNESSES,
    trials: int = TRIALS,
) -> Blur:
    """The blur by the held-out errors of a trial: roughness, blur of the pictures, or one beside the other.

    A lobe averages noise, too, as that of compression. So a map without one has to explain less even where the lobe
    smooths it afterwards, which averages as much. A first value of each decides whether to search on, and for which
    (Brent 1973). Where next to nothing is left unexplained, nothing is tried.
    """
    smoothing, found, rounds = Blur(roughness=first_roughness), Blur(), JUDGED_ROUNDS
    firsts = {"roughness": (first_roughness, roughnesses), "blur_px": (FIRST_BLUR_PX, BLURS_PX)}
    left = [name for name, mode in (("roughness", options.roughness), ("blur_px", options.blur)) if mode == "auto"]
    while left:
        before = trial.errors(found, rounds)
        if before.mean() < LEAST_UNEXPLAINED:
            break
        smoothed = trial.errors(found, rounds, smoothing)
        errors = [trial.errors(_with(found, name, firsts[name][0]), rounds) for name in left]
        best = int(np.argmin([each.mean() for each in errors]))
        is_more_than_smooth = errors[best].mean() < (1 - LEAST_ROUGHNESS_GAIN) * smoothed.mean()
        if not is_more_than_smooth or not is_clearly_lower(errors[best], before, LEAST_ROUGHNESS_GAIN):
            break
        name = left.pop(best)
        searched = trial.searched(partial(_with, found, name), firsts[name][1], trials)
        found = _with(found, name, searched)
    return found


def _with(blur: Blur, name: str, value: float) -> Blur:
    """With another value of one kind."""
    return replace(blur, **{name: value})


@dataclass(frozen=True)
class BlurTrial:
    """Areas of pixels of the views that make a map, those of each other view, and the start of that map."""

    known: list[PixelFootprints]
    held_out: list[list[PixelFootprints]]
    start: Float[Tensor, "6 3 L L"]
    saturation: Float[Tensor, "3"]

    @classmethod
    def of(cls, views: Views, geometry: Geometry, config: FitConfig) -> "BlurTrial | None":
        """None where there are too few views."""
        parts = held_out_parts(views)
        if parts is None:
            return None
        known, *held_out = (
            thinned(pixel_areas(each, geometry, config.environment.rays), JUDGED_PIXELS)
            for each in (parts[0], *(replace(views, train=(view,)) for view in parts[1].train))
        )
        if not known:
            return None
        start = solve_environment([each.rays() for each in known], config.environment.trial_resolution(RESOLUTION))
        return cls(known, held_out, start, encoding_of(config).saturation)

    @remembered()
    def errors(self, blur: Blur, rounds: int, smoothing: Blur = Blur()) -> Float[np.ndarray, "V"]:
        """Mean of ‖e‖²/(‖e‖² + s²) of each held-out view with that blur, after so many rounds, under the map that
        the lobe of another one then smooths.
        """
        lobe, smoother = (Lobe.of(each.roughness, self.start.shape[-1]) for each in (blur, smoothing))
        blur_px = blur.blur_px or 0.0
        known = [each.widened(blur_px) for each in self.known]
        found = sharpened_map(self.start, known, lobe, self.saturation, rounds)
        shown, found_errors = smoother.blurred(lobe.blurred(found)), []
        for view in self.held_out:
            wider = [each.widened(blur_px) for each in view]
            error = [each.seen(shown).minimum(self.saturation.to(shown)) - each.radiance for each in wider]
            found_errors.append(float(bounded_error(torch.cat(error), ERROR_SCALE).mean()) if error else 0.0)
        return np.array(found_errors)

    def searched(self, blur: Callable[[float], Blur], bounds: tuple[float, float], trials: int) -> float:
        """The value between bounds that leaves the least error after the steps of the exported map; by logarithms."""
        from scipy.optimize import minimize_scalar

        found = minimize_scalar(
            lambda logarithm: float(self.errors(blur(math.exp(logarithm)), SHARPENING_ROUNDS).mean()),
            bounds=np.log(bounds),
            method="bounded",
            options={"maxiter": trials},
        )
        return math.exp(found.x)
