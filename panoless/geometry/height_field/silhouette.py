"""Where the edge of a bent mirror is seen: the boundary of its plane, lifted to the mirror's height there.

An boundary alone can't tell whether a mirror bends, but its edge is a curve in space: a height shifts it against views
from either side. A frame in front of it is flat and says how the plane of the frame lies.
"""

import numpy as np
from jaxtyping import Float

from panoless.capture.silhouettes import MaskContours
from panoless.geometry.height_field.model import HeightField
from panoless.geometry.plane.silhouette import boundary_jacobian, boundary_pull, boundary_residuals, robust_weights


def edge_equations(
    contours: MaskContours, height_field: HeightField, scale_px: float
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """Gradient Jᵀ W e and matrix Jᵀ W J of the distances in pixels: four numbers of the plane, two of each vertex of
    the boundary, then the coefficients.

    The plane's offset is left to the coefficients. So is its tilt, unless a frame tells them apart.
    """
    from scipy import sparse

    plane = height_field.plane
    distances = boundary_residuals(contours, plane, lambda places: height_field.heights(places)[0])
    weights, vertices = robust_weights(distances, scale_px), len(plane.boundary)
    corners, count = plane.boundary, len(distances.edge)
    foot = corners[distances.edge] + distances.along[:, None] * (np.roll(corners, -1, 0) - corners)[distances.edge]
    index, basis = height_field.basis(foot)
    by_height = sparse.csr_matrix(
        ((distances.by_height[:, None] * basis[0]).ravel(), index.ravel(), np.arange(count + 1) * 16),
        shape=(count, height_field.coefficients.size),
    )
    framed = plane.frame_height > 0
    known = sparse.diags(np.append(np.array([framed, framed, 0.0, framed]), np.ones(2 * vertices)))
    jacobian = sparse.hstack([boundary_jacobian(distances, vertices) @ known, by_height]).tocsr()
    weighted = jacobian.multiply(weights[:, None]).tocsr()
    matrix = (weighted.T @ jacobian).toarray()
    held = np.arange(4, 4 + 2 * vertices)
    matrix[held, held] += boundary_pull(distances, weights, vertices)
    return weighted.T @ distances.pixels, matrix
