"""A bent mirror from photographs: edge and frame by outlines, then all heights by what is mirrored."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.silhouettes import MaskContours, mask_contours
from panoless.capture.views import Views
from panoless.environment.solve import solve_environment
from panoless.geometry.height_field.model import HeightField, flat_height_field
from panoless.geometry.height_field.photometric import photometric_equations, select_observations
from panoless.geometry.height_field.silhouette import edge_equations
from panoless.geometry.plane.model import Plane
from panoless.geometry.plane.silhouette import apply_plane_step
from shinypartial.io.progress import Progress

CELLS = 16
"""Of the spline along the longer side of the boundary."""
MOST_POINTS = 20_000
EDGE_SCALES_PX = (2.0, 1.0, 1.0, 0.5, 0.5, 0.5)
CONTOUR_SCALE_PX = 0.5
CONTOUR_SIGMA_PX = 0.05
"""Less than a contour's noise of 0.07 px in the median: photographs count pixel by pixel, but errors of a map are those
of all rays of its texels together, and photographs alone hardly tell the tilt.
"""
EDGE_BENDING, BENDING = 1e-2, 1e-4
"""Against the mean diagonal of the data. Outlines alone say nothing of the inside, so it decides more there."""
DAMPING = 1e-9


@dataclass(frozen=True)
class Round:
    """Steps, each with a map of that resolution solved from about that many rays, and that robust scale."""

    resolution: int
    robust: float
    rays: int
    steps: int


ROUNDS = (Round(16, 0.5, 60_000, 4), Round(32, 0.3, 60_000, 3), Round(64, 0.3, 60_000, 3), Round(128, 0.1, 200_000, 4))
"""From coarse to fine: the first texels are as wide as a ray turns when its normal does by 2.8°. Finer than the last
was tried on one mirror: 0.023° instead of 0.030° for twice the time.
"""


def fit_height_field(views: Views, plane: Plane) -> HeightField:
    """The heights over a plane, and the plane itself, that explain outlines and photographs best.

    The outlines alone give the plane of a frame that stands out, and the heights along the mirror's edge. From there
    on a step asks outlines and photographs together; the map is solved anew before each, and eliminated in it.
    """
    contours = mask_contours(views)
    contours = contours.every(max(1, len(contours.view) // MOST_POINTS))
    height_field = flat_height_field(plane, CELLS)
    for scale in EDGE_SCALES_PX:
        height_field = apply_step(height_field, *edge_equations(contours, height_field, scale), EDGE_BENDING)
    progress = Progress("fitting a bent mirror", sum(each.steps for each in ROUNDS))
    with torch.no_grad():
        for each in ROUNDS:
            for _ in range(each.steps):
                height_field = _step(views, contours, height_field, each)
                progress.advance()
    return height_field


def _step(views: Views, contours: MaskContours, height_field: HeightField, each: Round) -> HeightField:
    """One Gauss–Newton step on outlines and photographs."""
    seen = select_observations(views, height_field, each.rays)
    environment = solve_environment([seen.rays], each.resolution)
    gradient, matrix = (part / CONTOUR_SIGMA_PX**2 for part in edge_equations(contours, height_field, CONTOUR_SCALE_PX))
    by_photographs, of_photographs = photometric_equations(seen, height_field, environment, each.robust)
    first = len(gradient) - height_field.coefficients.size
    gradient[first:] += by_photographs
    matrix[first:, first:] += of_photographs
    return apply_step(height_field, gradient, matrix, BENDING)


def apply_step(
    height_field: HeightField, gradient: Float[np.ndarray, "D"], matrix: Float[np.ndarray, "D D"], bending: float
) -> HeightField:
    """The height field after the step that minimizes a quadratic of plane, boundary and coefficients, plus its own
    bending, with that weight against the mean diagonal of the coefficients.
    """
    size = height_field.coefficients.size
    first = len(gradient) - size
    energy = bending * np.trace(matrix[first:, first:]) / size * height_field.bending()
    damped = matrix + DAMPING * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
    damped[first:, first:] += energy
    step = -np.linalg.solve(damped, gradient + np.append(np.zeros(first), energy @ height_field.coefficients.ravel()))
    coefficients = height_field.coefficients + step[first:].reshape(height_field.coefficients.shape)
    return replace(height_field, plane=apply_plane_step(height_field.plane, step[:first]), coefficients=coefficients)
