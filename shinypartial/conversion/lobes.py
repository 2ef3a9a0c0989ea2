"""The light as a few spherical Gaussians, for shaders: L(d) = Σ aᵢ exp(λ (d·μᵢ − 1)) with aᵢ ≥ 0."""

from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.core.conventions import Y_UP_TO_WORLD
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import fibonacci_directions, latlong_directions, latlong_solid_angles
from shinypartial.metrics.environment import to_protocol_size

ROWS = 32
"""Of the grid on which lobes are fitted; narrower ones than of some 5° are not determined."""
SHARPNESS_SHARES = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Sharpnesses that are tried, as shares of the number of lobes. With λ = N/2 a lobe falls to 1/e at its neighbors."""
MOST_LOBES = 512


def lobes_of(latlong: Float[np.ndarray, "H W 3"], count: int) -> dict[str, Any]:
    """The content of lobes.json: axes evenly over the sphere, one sharpness, and the colors of least squares ≥ 0.

    The sharpness is the best of a few. `relative_error` is √(∫‖L − E‖²/∫‖E‖²) against means of the map.
    """
    if not 1 <= count <= MOST_LOBES:
        raise InputError(expected=f"--lobes from 1 to {MOST_LOBES}", found=str(count), remedy="24 is usual.")
    light, directions, areas = _means(latlong)
    axes = fibonacci_directions(count)
    cosines, root = directions @ axes.T, np.sqrt(areas)[:, None]
    found = {share * count: _fitted(cosines, light, root, share * count) for share in SHARPNESS_SHARES}
    sharpness = min(found, key=lambda each: float(found[each][0]))
    error, colors = found[sharpness]
    return {
        "lobes": [
            {"axis": axis, "sharpness": sharpness, "color": color}
            for axis, color in zip((axes @ Y_UP_TO_WORLD).tolist(), colors.tolist(), strict=True)
        ],
        "quantity": "linear radiance: L(d) = sum of color * exp(sharpness * (dot(d, axis) - 1))",
        "axes": "right-handed, +Y up, as in glTF; (x, y, z) is (x, -z, y) in the world of the dataset",
        "relative_error": error,
    }


def _means(
    latlong: Float[np.ndarray, "H W 3"],
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"], Float[np.ndarray, "P"]]:
    """The map in at most `ROWS` rows, as means weighted by solid angle: light, directions, solid angles."""
    rows = min(len(latlong), ROWS)
    areas = latlong_solid_angles(len(latlong))[..., None]
    means = to_protocol_size(np.concatenate([latlong * areas, areas], -1), rows).reshape(-1, 4)
    light, directions = means[:, :3] / means[:, 3:], latlong_directions(rows).reshape(-1, 3)
    return light, directions, latlong_solid_angles(rows).ravel()


def _fitted(
    cosines: Float[np.ndarray, "P N"], light: Float[np.ndarray, "P 3"], root: Float[np.ndarray, "P 1"], sharpness: float
) -> tuple[float, Float[np.ndarray, "N 3"]]:
    from scipy.optimize import nnls

    lobes = np.exp(sharpness * (cosines - 1)) * root
    colors = np.stack([nnls(lobes, channel)[0] for channel in (light * root).T], 1)
    residual = lobes @ colors - light * root
    return float(np.linalg.norm(residual)) / max(float(np.linalg.norm(light * root)), 1e-12), colors
