"""A bent mirror from photographs: edge and frame by outlines, then all heights by what is mirrored."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.cubemap import solve_environment
from panoless.plane import Plane
from panoless.plane_contours import Contours, moved_plane, view_contours
from panoless.sheet import Sheet, flat_sheet
from panoless.sheet_contours import edge_equations
from panoless.sheet_photometric import observations, photometric_equations
from panoless.views import Views
from shinypartial.progress import Progress

CELLS = 16
"""Of the spline along the longer side of the outline."""
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


def fit_sheet(views: Views, plane: Plane) -> Sheet:
    """The heights over a plane, and the plane itself, that explain outlines and photographs best.

    The outlines alone give the plane of a frame that stands out, and the heights along the mirror's edge. From there
    on a step asks outlines and photographs together; the map is solved anew before each, and eliminated in it.
    """
    contours = view_contours(views)
    contours = contours.every(max(1, len(contours.view) // MOST_POINTS))
    sheet = flat_sheet(plane, CELLS)
    for scale in EDGE_SCALES_PX:
        sheet = moved(sheet, *edge_equations(contours, sheet, scale), EDGE_BENDING)
    progress = Progress("fitting a bent mirror", sum(each.steps for each in ROUNDS))
    with torch.no_grad():
        for each in ROUNDS:
            for _ in range(each.steps):
                sheet = _step(views, contours, sheet, each)
                progress.advance()
    return sheet


def _step(views: Views, contours: Contours, sheet: Sheet, each: Round) -> Sheet:
    """One Gauss–Newton step on outlines and photographs."""
    seen = observations(views, sheet, each.rays)
    environment = solve_environment([seen.rays], each.resolution)
    gradient, matrix = (part / CONTOUR_SIGMA_PX**2 for part in edge_equations(contours, sheet, CONTOUR_SCALE_PX))
    by_photographs, of_photographs = photometric_equations(seen, sheet, environment, each.robust)
    first = len(gradient) - sheet.coefficients.size
    gradient[first:] += by_photographs
    matrix[first:, first:] += of_photographs
    return moved(sheet, gradient, matrix, BENDING)


def moved(sheet: Sheet, gradient: Float[np.ndarray, "D"], matrix: Float[np.ndarray, "D D"], bending: float) -> Sheet:
    """The sheet after the step that minimizes a quadratic of plane, outline and coefficients, plus its own bending,
    with that weight against the mean diagonal of the coefficients.
    """
    size = sheet.coefficients.size
    first = len(gradient) - size
    energy = bending * np.trace(matrix[first:, first:]) / size * sheet.bending()
    damped = matrix + DAMPING * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
    damped[first:, first:] += energy
    step = -np.linalg.solve(damped, gradient + np.append(np.zeros(first), energy @ sheet.coefficients.ravel()))
    coefficients = sheet.coefficients + step[first:].reshape(sheet.coefficients.shape)
    return replace(sheet, plane=moved_plane(sheet.plane, step[:first]), coefficients=coefficients)
