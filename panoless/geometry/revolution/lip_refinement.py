"""The end of a wall without thickness, refined by photographs: by pixels that mix the lip with what lies around it.

Outlines place the lip to a twentieth of a pixel, but over the last pixels of the wall that is a degree, and rays that
leave an open vessel pass them twice or more. Here a pixel is the mean of some rays, each followed as deep as it goes,
black where it misses. How that changes with a few numbers, a shift of the last pixels along their normals and an
extension, is found by differences; and a pixel is believed the less the more it changes with them, because it changes
as much with what is not fitted:

w = (1 + ‖e‖²/9v)⁻²/v, v = σ² + τ² mean_c ‖∂c/∂θ‖².
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.rays import pixel_rays
from panoless.capture.views import TrainView, Views, concatenated, split_held_out
from panoless.geometry.revolution.lip import beside_lip
from panoless.geometry.revolution.model import SurfaceOfRevolution, trace_reflections
from panoless.geometry.revolution.render import MAX_RENDER_BOUNCES, MultiBouncePixels

LENGTH_PX, KNOT_PX = 20, 3
"""Of the wall before the lip that is refined, and of its cubic B-splines."""
LIP_REACH_PX = 5
PIXELS = 8_000
LEAST_PIXELS = 500
STEPS = 3
DIFFERENCE_PX = 0.05
LARGEST_STEP_PX = 0.5
STEP_LENGTHS = (1, 2, 4)
RADIANCE_SIGMA = 0.05
PARAMETER_SIGMA_PX = 0.05
DAMPING = 1e-3
LEAST_GAIN = 0.02


def refine_lip(
    views: Views, surface: SurfaceOfRevolution, environment: Float[Tensor, "6 3 L L"], pixel: float
) -> SurfaceOfRevolution:
    """An open surface with its last pixels and its lip where photographs put them under a map, by Gauss–Newton.

    It is returned as it is unless the pixels of every fifth view, which take no part, are explained clearly better; and
    if it is closed or too short, or hardly any pixels see the lip.
    """
    length = surface.arc_lengths[-1]
    if not surface.is_open or length < 2 * LENGTH_PX * pixel:
        return surface
    kept, held_out = split_held_out(views.train)
    seen, tested = (_pixels(part, surface, most) for part, most in ((kept, PIXELS), (held_out, PIXELS // 2)))
    if min(len(seen.radiance), len(tested.radiance)) < LEAST_PIXELS:
        return surface
    found = surface
    for _ in range(STEPS):
        found = _step(seen, found, environment, pixel)
    before, after = (tested.error(each, environment) for each in (surface, found))
    return found if after < (1 - LEAST_GAIN) * before else surface


def _step(
    seen: MultiBouncePixels, surface: SurfaceOfRevolution, environment: Float[Tensor, "6 3 L L"], pixel: float
) -> SurfaceOfRevolution:
    shifts = _shifts(surface, pixel)
    residual = seen.shown(surface, environment) - seen.radiance
    directions_local = [
        (seen.shown(_shifted(surface, shift), environment) - seen.shown(_shifted(surface, -shift), environment))
        for shift in DIFFERENCE_PX * pixel * shifts
    ]
    jacobian = np.stack(directions_local, -1) / (2 * DIFFERENCE_PX)
    variance = RADIANCE_SIGMA**2 + PARAMETER_SIGMA_PX**2 * (jacobian**2).sum(-1).mean(1)
    weights = (1 + (residual**2).sum(1) / (9 * variance)) ** -2 / variance
    weighted = jacobian * weights[:, None, None]
    matrix = np.tensordot(weighted, jacobian, ((0, 1), (0, 1)))
    gradient = np.tensordot(weighted, residual, ((0, 1), (0, 1)))
    damping = DAMPING * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
    step = np.clip(-np.linalg.solve(matrix + damping, gradient), -LARGEST_STEP_PX, LARGEST_STEP_PX)
    # Radiance that changes by leaps makes steps too short.
    ahead = [_shifted(surface, length * pixel * np.tensordot(step, shifts, 1)) for length in STEP_LENGTHS]
    return min([surface, *ahead], key=lambda each: seen.error(each, environment))


def _shifts(surface: SurfaceOfRevolution, pixel: float) -> Float[np.ndarray, "D N 2"]:
    """Unit shifts of the profile's vertices: cubic B-splines along the normals, and an extension along the wall."""
    place = (surface.arc_lengths - surface.arc_lengths[-1]) / pixel
    excluded = np.abs(place - np.arange(-LENGTH_PX, KNOT_PX + 1, KNOT_PX)[:, None]) / KNOT_PX
    splines = np.where(excluded < 1, 2 / 3 - excluded**2 + excluded**3 / 2, np.clip(2 - excluded, 0, None) ** 3 / 6)
    along = np.gradient(surface.profile, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normals = np.stack([along[:, 1], -along[:, 0]], 1)
    extension = np.clip(1 + place / LENGTH_PX, 0, 1)[:, None] ** 2 * along
    return np.concatenate([splines[..., None] * normals, extension[None]])


def _shifted(surface: SurfaceOfRevolution, shift: Float[np.ndarray, "N 2"]) -> SurfaceOfRevolution:
    return replace(surface, profile=surface.profile + shift)


def _pixels(views: Sequence[TrainView], surface: SurfaceOfRevolution, most: int) -> MultiBouncePixels:
    """About `most` pixels: half of them near the lip, half mirrored more than once."""
    generator = np.random.default_rng(0)
    near = [np.flatnonzero(beside_lip(view.camera, surface, LIP_REACH_PX)) for view in views]
    deep = [_mirrored_again(view, surface) for view in views]
    shares = [most / 2 / max(sum(map(len, group)), 1) for group in (near, deep)]
    bundles = []
    for view, *groups in zip(views, near, deep, strict=True):
        drawn = [group[generator.random(len(group)) < share] for group, share in zip(groups, shares, strict=True)]
        bundles.append(MultiBouncePixels.of(view, np.unique(np.concatenate(drawn))))
    return concatenated(bundles)


def _mirrored_again(view: TrainView, surface: SurfaceOfRevolution) -> Int[np.ndarray, "P"]:
    pixels = view.solid.cpu().numpy()
    return pixels[trace_reflections(surface, *pixel_rays(view.camera, pixels), MAX_RENDER_BOUNCES).bounces != 1]
