"""Heights of a bent mirror by what it mirrors: Gauss–Newton against the photographs, with the map eliminated.

At a fixed ray d, in the axes of the plane, a height δ moves the hit by δ/(d_z − ∇h·d) along the ray, so the slope that
is seen there changes by ∇δ + (D²h d) δ/(d_z − ∇h·d). Tilting a mirror and turning the map after it changes little, so
a step at a fixed map would get nowhere: each texel takes the mean of what its rays ask for, and only the rest moves
the mirror (variable projection, Golub and Pereyra 1973).
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.rays import reflect
from panoless.capture.views import Views, concatenated, every_kth_pixel
from panoless.environment.rays import Rays
from panoless.geometry.height_field.model import HeightField, HeightFieldHits, visible_reflections
from panoless.geometry.revolution.photometric import RADIANCE_SIGMA
from panoless.kernels.cubemap import sample_cubemap
from shinypartial.core.sphere import directions_to_cube


@dataclass(frozen=True)
class Observations:
    """Pixels of all views that see the environment by way of a height field."""

    directions_local: Float[np.ndarray, "P 3"]
    """Rays of camera depth 1, in the axes of the plane."""
    hits: HeightFieldHits
    rays: Rays


def select_observations(views: Views, height_field: HeightField, most: int) -> Observations:
    """About `most` pixels of all views, evenly."""
    seen = [visible_reflections(height_field, *chosen) for chosen in every_kth_pixel(views, most)]
    radiance = [view.radiance.flatten(1)[:, each.pixels].T for view, each in zip(views.train, seen, strict=True)]
    outgoing = torch.from_numpy(np.concatenate([each.outgoing for each in seen])).float()
    return Observations(
        np.concatenate([each.directions_local for each in seen]),
        concatenated([each.hits for each in seen]),
        Rays(outgoing.to(radiance[0]), torch.cat(radiance)),
    )


def photometric_equations(
    seen: Observations, height_field: HeightField, environment: Float[Tensor, "6 3 L L"], robust: float
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """Gradient and matrix over the coefficients, the map eliminated, in units of the radiance's deviation.

    Zero when there are no rays, as where a high frame is mirrored everywhere.
    """
    from scipy import sparse

    if not len(seen.rays.radiance):
        return np.zeros(height_field.coefficients.size), np.zeros((height_field.coefficients.size,) * 2)
    residual, by_slope = _residuals(seen, height_field, environment)
    index, basis = height_field.basis(seen.hits.places)
    _, _, _, h_uu, h_uv, h_vv = (basis * height_field.coefficients.ravel()[index]).sum(2)
    rate = seen.directions_local[:, 2] - (seen.hits.slopes * seen.directions_local[:, :2]).sum(1)
    slide = np.stack([h_uu, h_uv, h_uv, h_vv]).reshape(2, 2, -1)
    slide = np.einsum("abp,pb->ap", slide, seen.directions_local[:, :2]) / rate
    slopes = basis[1:3] + slide[:, :, None] * basis[0]
    weights = (1 + (residual**2).sum(1) / robust**2) ** -2 / RADIANCE_SIGMA**2
    count, num_parameters = len(weights), height_field.coefficients.size
    texel = _texels(seen.rays.directions, environment.shape[-1])
    gather = sparse.csr_matrix((weights, (texel, np.arange(count))), shape=(texel.max() + 1, count))
    total = np.maximum(np.asarray(gather.sum(1)).ravel(), 1e-12)
    gradient, matrix = np.zeros(num_parameters), np.zeros((num_parameters, num_parameters))
    for channel in range(3):
        values = by_slope[0, :, channel, None] * slopes[0] + by_slope[1, :, channel, None] * slopes[1]
        rows = np.arange(count + 1) * 16
        jacobian = sparse.csr_matrix((values.ravel(), index.ravel(), rows), shape=(count, num_parameters))
        mean = (gather @ jacobian).toarray() / np.sqrt(total)[:, None]
        mean_residual = (gather @ residual[:, channel]) / np.sqrt(total)
        weighted = jacobian.multiply(weights[:, None]).tocsr()
        gradient += weighted.T @ residual[:, channel] - mean.T @ mean_residual
        matrix += (weighted.T @ jacobian).toarray() - mean.T @ mean
    return gradient, matrix


def _texels(directions: Float[Tensor, "P 3"], resolution: int) -> np.ndarray:
    """Which of the texels that are seen each direction falls into, numbered from zero."""
    face, st = directions_to_cube(directions.cpu().numpy().astype(np.float64))
    column, row = np.clip((st + 1) * resolution / 2, 0, resolution - 1).astype(np.int64).T
    return np.unique((face * resolution + row) * resolution + column, return_inverse=True)[1].reshape(-1)


def _residuals(
    seen: Observations, height_field: HeightField, environment: Float[Tensor, "6 3 L L"]
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "2 P 3"]]:
    """E(ω) − c, and its derivatives by the slopes along u and v: differences over a texel."""
    step = np.pi / 2 / environment.shape[-1] / 2

    def look(slopes: np.ndarray) -> np.ndarray:
        turned = HeightFieldHits(seen.hits.distance, seen.hits.places, slopes)
        directions = torch.from_numpy(reflect(seen.directions_local, turned.normals) @ height_field.frame)
        return sample_cubemap(environment, directions.to(environment)).cpu().numpy().astype(np.float64)

    residual = look(seen.hits.slopes) - seen.rays.radiance.cpu().numpy()
    derivatives = [
        (look(seen.hits.slopes + step * axis) - look(seen.hits.slopes - step * axis)) / (2 * step) for axis in np.eye(2)
    ]
    return residual, np.stack(derivatives)
