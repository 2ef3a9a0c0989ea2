"""Where the edge of a bent mirror is seen: the outline of its plane, lifted to the mirror's height there.

An outline alone can't tell whether a mirror bends, but its edge is a curve in space: a height shifts it against views
from either side. A rim in front of it is flat and says how the plane of the frame lies.
"""

import numpy as np
from jaxtyping import Float

from panoless.plane_contours import Contours, outline_distances, outline_jacobian, outline_pull, robust_weights
from panoless.sheet import Sheet


def edge_equations(
    contours: Contours, sheet: Sheet, scale_px: float
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """Gradient Jᵀ W e and matrix Jᵀ W J of the distances in pixels: four numbers of the plane, two of each vertex of
    the outline, then the coefficients.

    The plane's offset is left to the coefficients. So is its tilt, unless a rim tells them apart.
    """
    from scipy import sparse

    plane = sheet.plane
    distances = outline_distances(contours, plane, lambda places: sheet.heights(places)[0])
    weights, vertices = robust_weights(distances, scale_px), len(plane.outline)
    corners, count = plane.outline, len(distances.edge)
    foot = corners[distances.edge] + distances.along[:, None] * (np.roll(corners, -1, 0) - corners)[distances.edge]
    index, basis = sheet.basis(foot)
    by_height = sparse.csr_matrix(
        ((distances.by_height[:, None] * basis[0]).ravel(), index.ravel(), np.arange(count + 1) * 16),
        shape=(count, sheet.coefficients.size),
    )
    framed = plane.rim_height > 0
    known = sparse.diags(np.append(np.array([framed, framed, 0.0, framed]), np.ones(2 * vertices)))
    jacobian = sparse.hstack([outline_jacobian(distances, vertices) @ known, by_height]).tocsr()
    weighted = jacobian.multiply(weights[:, None]).tocsr()
    matrix = (weighted.T @ jacobian).toarray()
    held = np.arange(4, 4 + 2 * vertices)
    matrix[held, held] += outline_pull(distances, weights, vertices)
    return weighted.T @ distances.pixels, matrix
