"""Where the edge of a bent mirror is seen: the boundary of its plane, lifted to the mirror's height there.

A boundary alone can't determine whether a mirror bends, but its edge is a curve in space: a height shifts it against
views from either side. A frame in front of it is flat and says how the plane of the frame lies.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from panoless.capture.silhouettes import MaskContours
from panoless.geometry.height_field.model import HeightField
from panoless.geometry.plane.silhouette import BoundaryResiduals, boundary_jacobian, boundary_residuals
from panoless.numeric.gauss_newton import jacobian_of_rows

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


def edge_residuals(contours: MaskContours, height_field: HeightField) -> BoundaryResiduals:
    """Distances of the contours from the mirror's edge or its frame, whichever hides the other."""

    def heights(side: Int[np.ndarray, "P"], along: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
        index, weights = height_field.edge_basis(side, along)
        found: np.ndarray = (weights * height_field.coefficients.ravel()[index]).sum(1)
        return found

    return boundary_residuals(contours, height_field.plane, heights)


def edge_jacobian(residuals: BoundaryResiduals, height_field: HeightField) -> "csr_matrix":
    """Derivatives of the distances by four numbers of the plane, two of each vertex of the boundary, the coefficients.

    The plane's offset is left to the coefficients. So is its tilt, unless a frame distinguishes them.
    """
    from scipy import sparse

    boundary, framed = height_field.plane.boundary, height_field.plane.frame_height > 0
    index, weights = height_field.edge_basis(residuals.side, residuals.along)
    by_height = jacobian_of_rows(residuals.by_height[:, None] * weights, index, height_field.coefficients.size)
    known = sparse.diags(np.append([framed, framed, 0.0, framed], np.ones(boundary.size)))
    return sparse.hstack([boundary_jacobian(residuals, len(boundary)) @ known, by_height]).tocsr()
