"""Heights of a bent mirror by what it mirrors: Gauss–Newton against the photographs, with the map eliminated.

At a fixed ray d, in the axes of the plane, a height δ moves the hit by δ/(d_z − ∇h·d) along the ray, so the slope that
is seen there changes by ∇δ + (D²h d) δ/(d_z − ∇h·d). Tilting a mirror and turning the map after it changes little, so
a step at a fixed map would get nowhere: each texel takes the mean of what its rays ask for, and only the rest moves
the mirror (variable projection, Golub and Pereyra 1973).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.rays import reflect
from panoless.capture.views import Views, concatenated, every_kth_pixel
from panoless.environment.cubemap import gather_texels, texels_of
from panoless.environment.rays import Rays
from panoless.geometry.height_field.model import HeightField, HeightFieldHits, visible_reflections
from panoless.geometry.height_field.options import HeightFieldOptions
from panoless.kernels.cubemap import sample_cubemap
from panoless.numeric.gauss_newton import jacobian_of_rows, normal_equations
from panoless.numeric.robust import robust_weight

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


@dataclass(frozen=True)
class Observations:
    """Pixels of all views that see the environment by way of a height field: rays of camera depth 1 in the normalized
    frame, where they meet it, and what they saw.
    """

    origins: Float[np.ndarray, "P 3"]
    directions: Float[np.ndarray, "P 3"]
    hits: HeightFieldHits
    rays: Rays


def observe(
    views: Views, height_field: HeightField, max_pixels: int, options: HeightFieldOptions = HeightFieldOptions()
) -> Observations:
    """About `max_pixels` pixels of all views, evenly."""
    visible = [visible_reflections(height_field, *chosen, options) for chosen in every_kth_pixel(views, max_pixels)]
    radiance = [view.radiance_at(part.pixels) for view, part in zip(views.train, visible, strict=True)]
    outgoing = torch.from_numpy(np.concatenate([part.outgoing for part in visible])).float()
    return Observations(
        np.concatenate([part.origins for part in visible]),
        np.concatenate([part.directions for part in visible]),
        concatenated([part.hits for part in visible]),
        Rays(outgoing.to(radiance[0]), torch.cat(radiance)),
    )


@dataclass(frozen=True)
class Photographs:
    """Least squares of what a height field shows under a map that follows it, linearized at `height_field`.

    The cost is ½ Σ w ‖r − r̄‖², r = E(ω) − c, with robust weights w and the texel of each ray as they are at
    `height_field`, and r̄ the weighted mean over a texel: what the map takes over.
    """

    height_field: HeightField
    observed: Observations
    environment: Float[Tensor, "6 3 L L"]
    residual: Float[np.ndarray, "P 3"]
    weights: Float[np.ndarray, "P"]
    texel: Int[np.ndarray, "P"]

    @classmethod
    def at(
        cls,
        height_field: HeightField,
        observed: Observations,
        environment: Float[Tensor, "6 3 L L"],
        robust_scale: float,
        radiance_sigma: float,
    ) -> "Photographs":
        """Weights (1 + ‖r‖²/s²)⁻²/σ² and texels of observations at the height field that they were made with."""
        radiance = observed.rays.radiance.cpu().numpy()
        residual = _look_up(environment, height_field, observed, observed.hits) - radiance
        weights = robust_weight(residual, robust_scale) / radiance_sigma**2
        texel = texels_of(observed.rays.directions.cpu().numpy().astype(np.float64), environment.shape[-1])
        return cls(height_field, observed, environment, residual, weights, texel)

    def equations(self) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
        """Gradient and Gauss–Newton matrix of the cost over the coefficients.

        Zero when there are no rays, as where a high frame is mirrored everywhere.
        """
        height_field, hits, count = self.height_field, self.observed.hits, self.height_field.coefficients.size
        gradient, matrix = np.zeros(count), np.zeros((count, count))
        if not len(self.weights):
            return gradient, matrix
        directions = self.observed.directions @ height_field.frame.T
        index, basis = height_field.basis(hits.places)
        _, _, _, h_uu, h_uv, h_vv = (basis * height_field.coefficients.ravel()[index]).sum(2)
        rate = directions[:, 2] - (hits.slopes * directions[:, :2]).sum(1)
        slide = np.stack([h_uu, h_uv, h_uv, h_vv]).reshape(2, 2, -1)
        slide = np.einsum("abp,pb->ap", slide, directions[:, :2]) / rate
        slopes = basis[1:3] + slide[:, :, None] * basis[0]
        by_slope, gather = self._radiance_by_slope(), self.gather
        for channel, residual in enumerate(self.residual.T):
            values = by_slope[0, :, channel, None] * slopes[0] + by_slope[1, :, channel, None] * slopes[1]
            jacobian = jacobian_of_rows(values, index, count)
            by_rays, of_rays = normal_equations(jacobian, residual, self.weights)
            mean = (gather @ jacobian).toarray()
            gradient += by_rays - mean.T @ (gather @ residual)
            matrix += of_rays - mean.T @ mean
        return gradient, matrix

    def cost(self, candidate: HeightField) -> float:
        """The cost of another height field near to this one; a ray that misses it has a residual of 1."""
        residual = self.residual
        if candidate is not self.height_field:
            hits = candidate.hits(self.observed.origins, self.observed.directions)
            shown = _look_up(self.environment, candidate, self.observed, hits)
            residual = np.where(hits.met[:, None], shown - self.observed.rays.radiance.cpu().numpy(), 1.0)
        explained = self.gather @ residual
        return float((self.weights @ residual**2).sum() - (explained**2).sum()) / 2

    @cached_property
    def gather(self) -> "csr_matrix":
        """What the map takes over (see `gather_texels`)."""
        return gather_texels(self.weights, self.texel)

    def _radiance_by_slope(self) -> Float[np.ndarray, "2 P 3"]:
        """Derivatives of what is seen by the slopes along u and v: differences over a texel."""
        step, hits = np.pi / 2 / self.environment.shape[-1] / 2, self.observed.hits

        def shifted(shift: Float[np.ndarray, "2"]) -> Float[np.ndarray, "P 3"]:
            turned = HeightFieldHits(hits.distance, hits.places, hits.slopes + shift)
            return _look_up(self.environment, self.height_field, self.observed, turned)

        return np.stack([(shifted(step * axis) - shifted(-step * axis)) / (2 * step) for axis in np.eye(2)])


def _look_up(
    environment: Float[Tensor, "6 3 L L"],
    height_field: HeightField,
    observed: Observations,
    hits: HeightFieldHits,
) -> Float[np.ndarray, "P 3"]:
    mirrored = reflect(observed.directions, hits.normals @ height_field.frame)
    surroundings = height_field.plane.surroundings
    if not surroundings.is_far:
        mirrored /= np.linalg.norm(mirrored, axis=1, keepdims=True)
        distance = np.where(hits.met, hits.distance, 0.0)[:, None]
        mirrored = surroundings.looked_up(observed.origins + distance * observed.directions, mirrored)
    return sample_cubemap(environment, torch.from_numpy(mirrored).to(environment)).cpu().numpy().astype(np.float64)
