"""A bent mirror from photographs: edge and frame by silhouettes, then all heights by what is mirrored."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.silhouettes import MaskContours, mask_contours
from panoless.capture.views import Views
from panoless.environment.solve import solve_environment
from panoless.geometry.height_field.model import HeightField, flat_height_field
from panoless.geometry.height_field.options import HeightFieldOptions
from panoless.geometry.height_field.photometric import Photographs, observe
from panoless.geometry.height_field.silhouette import edge_equations, edge_residuals
from panoless.geometry.plane.model import Plane
from panoless.geometry.plane.silhouette import apply_plane_step
from panoless.numeric.gauss_newton import accept_step, damped_step
from shinypartial.io.progress import Progress


def fit_height_field(
    views: Views,
    plane: Plane,
    options: HeightFieldOptions = HeightFieldOptions(),
    fitted: HeightField | None = None,
) -> HeightField:
    """The heights over a plane, and the plane itself, that explain silhouettes and photographs best.

    The silhouettes alone give the plane of a frame that stands out, and the heights along the mirror's edge. From there
    on a step asks silhouettes and photographs together; the map is solved anew before each, and eliminated in it.
    One that was `fitted` to almost the same views goes on in the last round.
    """
    contours = mask_contours(views)
    contours = contours.every(max(1, len(contours.view) // options.max_points))
    height_field, rounds = fitted, options.rounds[-1:]
    if height_field is None:
        height_field, rounds = flat_height_field(plane, options.cells), options.rounds
        for scale_px in options.edge_scales_px:
            height_field = step_height_field(contours, height_field, scale_px, options.edge_bending, options)
    progress = Progress("fitting a bent mirror", sum(settings.steps for settings in rounds))
    with torch.no_grad():
        for settings in rounds:
            for _ in range(settings.steps):
                observed = observe(views, height_field, settings.rays, options)
                environment = solve_environment([observed.rays], settings.resolution)
                photographs = Photographs.at(height_field, observed, environment, settings.robust_scale, options)
                height_field = step_height_field(
                    contours, height_field, options.contour_scale_px, options.bending, options, photographs
                )
                progress.advance()
    return height_field


def step_height_field(
    contours: MaskContours,
    height_field: HeightField,
    scale_px: float,
    bending: float,
    options: HeightFieldOptions,
    photographs: Photographs | None = None,
) -> HeightField:
    """One Gauss–Newton step of plane, boundary and heights that does not raise the cost

    s²/2σ² Σ e²/(e² + s²) + ½ λ cᵀ B c, plus that of the photographs, with e the distances of contours in pixels, s
    their robust scale, c the coefficients, B the bending energy and λ a share of their mean diagonal.
    """
    residuals = edge_residuals(contours, height_field, options)
    scale, precision = residuals.scale(scale_px, options.contours), options.contour_sigma_px**-2
    gradient, matrix = (precision * part for part in edge_equations(residuals, height_field, scale, options))
    first = len(gradient) - height_field.coefficients.size
    if photographs is not None:
        by_photographs, of_photographs = photographs.equations()
        gradient[first:] += by_photographs
        matrix[first:, first:] += of_photographs
    energy = bending * np.trace(matrix[first:, first:]) / height_field.coefficients.size * height_field.bending()
    gradient[first:] += energy @ height_field.coefficients.ravel()
    matrix[first:, first:] += energy

    def cost(candidate: HeightField) -> float:
        coefficients = candidate.coefficients.ravel()
        contour_cost = edge_residuals(contours, candidate, options).cost(scale, residuals.counted)
        total = precision * scale**2 * contour_cost / 2 + coefficients @ energy @ coefficients / 2
        return float(total if photographs is None else total + photographs.cost(candidate))

    return accept_step(height_field, damped_step(gradient, matrix), apply_height_field_step, cost)


def apply_height_field_step(height_field: HeightField, step: Float[np.ndarray, "D"]) -> HeightField:
    """The height field after a step of its plane and boundary, and of its coefficients, the last of the numbers."""
    shape, size = height_field.coefficients.shape, height_field.coefficients.size
    return replace(
        height_field,
        plane=apply_plane_step(height_field.plane, step[:-size]),
        coefficients=height_field.coefficients + step[-size:].reshape(shape),
    )
