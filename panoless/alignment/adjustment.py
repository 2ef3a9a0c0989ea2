"""One step of the poses of all views together, with the map eliminated.

A map that is solved from wrong poses agrees with them in part, so poses that follow a map which follows poses get on
slowly. In a joint step each texel takes the weighted mean of what its pixels ask for, and only the rest moves cameras
(variable projection, Golub and Pereyra 1973).
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from panoless.alignment.equations import PoseRows
from panoless.alignment.options import PoseOptions
from panoless.environment.cubemap import gather_texels, texels_of
from panoless.numeric.gauss_newton import jacobian_of_rows
from panoless.numeric.robust import robust_weight

TEXELS_AT_ONCE = 4096
"""For memory."""


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
    views = len(found)
    gradient, matrix = np.zeros((views, 6)), np.zeros((views, 6, views, 6))
    for index, rows in enumerate(found):
        parts = [each.equations(options.noise_multiple * sigma, sigma) for each, sigma in zip(rows, noise, strict=True)]
        gradient[index] = sum((part[0] for part in parts), prior[index] @ poses[index])
        matrix[index, :, index] = sum((part[1] for part in parts), prior[index])
    flat, full = gradient.reshape(-1), matrix.reshape(6 * views, 6 * views)
    for means, residuals in _texel_means([rows[-1] for rows in found], noise[-1], resolution, options):
        flat -= means.T @ residuals
        full -= means.T @ means
    step: np.ndarray = -np.linalg.solve(full, flat)
    return step.reshape(views, 6)


def _texel_means(
    light: Sequence[PoseRows], sigma: float, resolution: int, options: PoseOptions
) -> Iterator[tuple[Float[np.ndarray, "T D"], Float[np.ndarray, "T"]]]:
    """Σ w J/√Σw and Σ w e/√Σw of texels, some of them at a time, a channel after the other."""
    view = np.repeat(np.arange(len(light)), [len(rows.residual) for rows in light])
    residual = np.concatenate([rows.residual for rows in light])
    jacobian = np.concatenate([rows.rows for rows in light])
    weights = robust_weight(residual, options.noise_multiple * sigma) / sigma**2
    texel = texels_of(np.concatenate([rows.directions for rows in light if rows.directions is not None]), resolution)
    gather = gather_texels(weights, texel)
    columns = 6 * view[:, None] + np.arange(6)
    for channel in range(residual.shape[1]):
        rows = jacobian_of_rows(jacobian[:, channel], columns, 6 * len(light))
        means, asked = gather @ rows, gather @ residual[:, channel]
        for first in range(0, len(asked), TEXELS_AT_ONCE):
            part = slice(first, first + TEXELS_AT_ONCE)
            yield means[part].toarray(), asked[part]
