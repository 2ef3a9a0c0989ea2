"""One step of the poses of all views together, under a map that follows them.

A map that is solved from wrong poses agrees with them in part, so poses that follow a map which follows poses get on
slowly.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from panoless.alignment.equations import PoseRows
from panoless.alignment.options import PoseOptions
from panoless.environment.following import FollowingMap
from panoless.numeric.factorize import regularize
from panoless.numeric.robust import robust_weight


def adjusting_step(
    found: Sequence[Sequence[PoseRows]],
    noise: Sequence[float],
    poses: Float[np.ndarray, "V 6"],
    prior: Float[np.ndarray, "V 6 6"],
    resolution: int,
    options: PoseOptions,
) -> Float[np.ndarray, "V 6"]:
    """−H⁻¹ g of ½ Σ w ‖e‖² of outlines, ½ Σ w ‖e − ē‖² of light and the prior, ē the mean over a texel.

    `found` are the rows of each view, of the outline and of light; weights are Geman–McClure, over the noise squared.
    """
    views, sigma = len(found), noise[-1]
    gradient, matrix = np.zeros((views, 6)), np.zeros((views, 6, views, 6))
    for index, (*outlines, _) in enumerate(found):
        parts = [each.equations(options.noise_multiple * px, px) for each, px in zip(outlines, noise[:-1], strict=True)]
        gradient[index] = sum((part[0] for part in parts), prior[index] @ poses[index])
        matrix[index, :, index] = sum((part[1] for part in parts), prior[index])
    light = [rows[-1] for rows in found]
    view = np.repeat(np.arange(views), [len(rows.residual) for rows in light])
    residual = np.concatenate([rows.residual for rows in light])
    directions = np.concatenate([rows.directions for rows in light if rows.directions is not None])
    weights = robust_weight(residual, options.noise_multiple * sigma) / sigma**2
    by_light, of_light = FollowingMap.of(directions, weights, resolution).sparse_equations(
        np.concatenate([rows.rows for rows in light]), 6 * view[:, None] + np.arange(6), 6 * views, residual
    )
    whole = regularize(matrix.reshape(6 * views, 6 * views) + of_light, "the poses")
    step: np.ndarray = -np.linalg.solve(whole, gradient.reshape(-1) + by_light)
    return step.reshape(views, 6)
