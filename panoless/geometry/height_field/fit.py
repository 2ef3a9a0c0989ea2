"""A bent mirror from photographs: edge and frame by silhouettes, then all heights by what is mirrored, on a grid as
fine as held-out views ask for.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.silhouettes import MaskContours, mask_contours
from panoless.capture.views import Views, split_held_out
from panoless.environment.solve import solve_environment
from panoless.geometry.height_field.model import HeightField, flat_height_field
from panoless.geometry.height_field.photometric import Photographs, observe
from panoless.geometry.height_field.silhouette import edge_equations, edge_residuals
from panoless.geometry.plane.model import Plane
from panoless.geometry.plane.silhouette import apply_plane_step
from panoless.journal import remembered
from panoless.numeric.gauss_newton import accept_step, damped_step, keep_if_better
from panoless.numeric.robust import bounded_error
from shinypartial.io.progress import Progress


@dataclass(frozen=True)
class HeightFieldRound:
    """Gauss–Newton steps, the map solved anew before each."""

    resolution: int
    """Texels along a face side of the map."""
    robust_scale: float
    """Residual (linear radiance) beyond which a pixel loses its vote."""
    rays: int
    """About so many pixels of all views take part."""
    steps: int
    """Most steps."""


CELLS = 16
"""Cells of the spline along the longer side of the boundary, to begin with."""
HALVINGS = 1
"""How often they may be halved, where held-out views gain by it."""
JUDGED_STEPS = 2
"""Steps on a finer grid after which it is judged."""
MAX_POINTS = 20_000
"""Most contour points of all views."""
EDGE_SCALES_PX = (2.0, 1.0, 1.0, 0.5, 0.5, 0.5)
"""Robust scales of the first steps (px), which ask contours only."""
START_SLOPES = (0.0, 0.2, 0.4, 0.6, -0.2, -0.4, -0.6)
"""Domes and bowls, by their slope at the edge, of which the one that photographs agree on best is the start."""
SLOPE_STEPS = (0.1, 0.05, 0.025)
"""By these the best of them is made steeper or flatter, unless it is flat."""
EDGE_BENDING = 1e-2
"""Weight of the bending energy in the first steps, against the mean diagonal of the data."""
CONTOUR_SCALE_PX = 0.5
"""Robust scale of the contours beside photographs (px)."""
CONTOUR_SIGMA_PX = 0.05
"""Standard deviation of a contour point (px): less than its error, because errors of the map are common to all rays of
a texel."""
BENDING = 1e-4
"""Weight of the bending energy beside photographs."""
ROUNDS = (
    HeightFieldRound(16, 0.5, 60_000, 12),
    HeightFieldRound(32, 0.3, 60_000, 8),
    HeightFieldRound(64, 0.3, 60_000, 6),
    HeightFieldRound(128, 0.1, 200_000, 4),
)
"""From coarse to fine. Only in the last do photographs tell the tilt of the whole."""
LEAST_FALL = 1e-3
"""A round ends with a step that lowers its cost by a smaller share."""
CLEARANCES = (0.03, 0.06, 0.12)
"""Heights over the plane, in radii of the object, that mirrored rays may have to pass at the rim, tried in turn."""
LEAST_CLEARED = 0.1
"""Share of the held-out error by which one has to lower it."""


def fit_height_field(
    views: Views,
    plane: Plane,
    fitted: HeightField | None = None,
    *,
    cells: int = CELLS,
    halvings: int = HALVINGS,
    rounds: Sequence[HeightFieldRound] = ROUNDS,
) -> HeightField:
    """The heights over a plane, and the plane itself, that explain silhouettes and photographs best.

    The silhouettes alone give the plane of a frame that stands out, and the heights along the mirror's edge. From there
    on a step asks silhouettes and photographs together; the map is solved anew before each, and eliminated in it.
    One that was `fitted` to almost the same views goes on in the last round, on its grid.
    """
    with torch.no_grad():
        contours = _contours(views)
        if fitted is not None:
            return _refine(views, contours, fitted, rounds[-1], rounds[-1])
        height_field = flat_height_field(plane, cells)
        for scale_px in EDGE_SCALES_PX:
            height_field = step_height_field(contours, height_field, scale_px, EDGE_BENDING)[0]
        progress = Progress("fitting a bent mirror", len(rounds) + 3)
        height_field = best_dome(views, height_field)
        progress.advance()
        for each in rounds:
            height_field = _refine(views, contours, height_field, each, rounds[-1])
            progress.advance()
        kept, held_out = (replace(views, train=tuple(part)) for part in split_held_out(views.train))

        def error(each: HeightField) -> float:
            return _unexplained(kept, held_out, each, rounds[-1])

        if held_out.train:
            height_field = _refine_grid(views, kept, contours, height_field, error, halvings, rounds[-1])
        progress.advance()
        if held_out.train:
            cleared = _cleared(height_field, error)
            if cleared is not height_field:
                height_field = _refine(views, contours, cleared, rounds[-1], rounds[-1])
        progress.advance()
    return height_field


@remembered()
def best_dome(views: Views, height_field: HeightField) -> HeightField:
    """The heights with the dome or bowl more under which photographs agree best: of those to begin with, and then of
    others that are a little steeper or flatter.
    """
    errors: dict[float, float] = {}

    def best_of(slopes: Iterable[float]) -> float:
        for slope in slopes:
            if slope not in errors:
                errors[slope] = _unexplained(views, views, height_field.domed(slope), ROUNDS[0])
        return min(errors, key=errors.__getitem__)

    slope = best_of(START_SLOPES)
    for step in SLOPE_STEPS if slope else ():
        slope = best_of((slope - step, slope + step))
    return height_field.domed(slope)


def _cleared(height_field: HeightField, error: Callable[[HeightField], float]) -> HeightField:
    """With the height that mirrored rays have to pass, as long as what is left out was clearly worse explained."""
    least = error(height_field)
    for height in CLEARANCES:
        higher = replace(height_field, clearance=height)
        left = error(higher)
        if left > (1 - LEAST_CLEARED) * least:
            break
        height_field, least = higher, left
    return height_field


def _refine_grid(
    views: Views,
    kept: Views,
    contours: MaskContours,
    height_field: HeightField,
    error: Callable[[HeightField], float],
    halvings: int,
    last: HeightFieldRound,
) -> HeightField:
    """The height field on finer grids, as long as held-out views gain by them.

    What is there already was fitted to all views, so a finer grid has to gain a little more than that.
    """
    judged, of_kept = replace(last, steps=JUDGED_STEPS), _contours(kept)
    for _ in range(halvings):
        candidate = _refine(kept, of_kept, height_field.with_halved_cells(), judged, last)
        if keep_if_better((height_field, candidate), error) is height_field:
            return height_field
        height_field = _refine(views, contours, candidate, last, last)
    return height_field


def _unexplained(solved: Views, tested: Views, height_field: HeightField, each: HeightFieldRound) -> float:
    """The mean bounded error of some views under the map of others; 1 where nothing is seen."""
    known = observe(solved, height_field, each.rays)
    environment = solve_environment([known.rays], each.resolution)
    observed = known if tested is solved else observe(tested, height_field, each.rays)
    shown = observed.mirrored_by(height_field, observed.hits).light(environment)
    return float(bounded_error(shown - observed.radiance, each.robust_scale).mean()) if len(shown) else 1.0


@remembered()
def _refine(
    views: Views,
    contours: MaskContours,
    height_field: HeightField,
    each: HeightFieldRound,
    last: HeightFieldRound,
) -> HeightField:
    """The height field after the steps of one round, as long as they lower the cost; under the maps of the last round
    photographs tell the tilt.
    """
    for _ in range(each.steps):
        observed = observe(views, height_field, each.rays)
        environment = solve_environment([observed.rays], each.resolution)
        tell_tilt = each.resolution >= last.resolution
        photographs = Photographs.at(height_field, observed, environment, each.robust_scale, tell_tilt=tell_tilt)
        height_field, fall = step_height_field(contours, height_field, CONTOUR_SCALE_PX, BENDING, photographs)
        if fall < LEAST_FALL:
            break
    return height_field


def _contours(views: Views) -> MaskContours:
    contours = mask_contours(views)
    return contours.every(max(1, len(contours.view) // MAX_POINTS))


def step_height_field(
    contours: MaskContours,
    height_field: HeightField,
    scale_px: float,
    bending: float,
    photographs: Photographs | None = None,
    *,
    contour_sigma_px: float = CONTOUR_SIGMA_PX,
) -> tuple[HeightField, float]:
    """One Gauss–Newton step of plane, boundary and heights that does not raise the cost

    s²/2σ² Σ e²/(e² + s²) + ½ λ cᵀ B c, plus that of the photographs, with e the distances of contours in pixels, s
    their robust scale, c the coefficients, B the bending energy and λ a share of their mean diagonal. And the share of
    the cost by which it fell.
    """
    residuals = edge_residuals(contours, height_field)
    scale, precision = residuals.scale(scale_px), contour_sigma_px**-2
    gradient, matrix = (precision * part for part in edge_equations(residuals, height_field, scale))
    first = len(gradient) - height_field.coefficients.size
    if photographs is not None:
        by_photographs, of_photographs = photographs.equations()
        gradient[first:] += by_photographs
        matrix[first:, first:] += of_photographs
    energy = bending * np.trace(matrix[first:, first:]) / height_field.coefficients.size * height_field.bending()
    gradient[first:] += energy @ height_field.coefficients.ravel()
    matrix[first:, first:] += energy

    costs = list[float]()

    def cost(candidate: HeightField) -> float:
        coefficients = candidate.coefficients.ravel()
        contour_cost = edge_residuals(contours, candidate).cost(scale, residuals.counted)
        total = precision * scale**2 * contour_cost / 2 + coefficients @ energy @ coefficients / 2
        costs.append(float(total if photographs is None else total + photographs.cost(candidate)))
        return costs[-1]

    moved = accept_step(height_field, damped_step(gradient, matrix), apply_height_field_step, cost)
    return moved, 0.0 if moved is height_field else 1 - costs[-1] / costs[0]


def apply_height_field_step(height_field: HeightField, step: Float[np.ndarray, "D"]) -> HeightField:
    """The height field after a step of its plane and boundary, and of its coefficients, the last of the numbers."""
    shape, size = height_field.coefficients.shape, height_field.coefficients.size
    return replace(
        height_field,
        plane=apply_plane_step(height_field.plane, step[:-size]),
        coefficients=height_field.coefficients + step[-size:].reshape(shape),
    )
