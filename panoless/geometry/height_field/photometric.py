"""Heights of a bent mirror by what it mirrors: Gauss–Newton against the photographs, with the map eliminated.

At a fixed ray d, in the axes of the plane, a height δ moves the hit by δ/(d_z − ∇h·d) along the ray, so the slope that
is seen there changes by ∇δ + (D²h d) δ/(d_z − ∇h·d). The map follows in each step (see `environment.following`).

How far the map can follow a tilt of the whole mirror depends on its texels: coarse ones hold against it, and where they
do tells nothing. So under coarse maps photographs have no say on that.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.views import Views, concatenated, every_kth_pixel
from panoless.environment.following import FollowingMap
from panoless.environment.mirrored import MirroredRays
from panoless.environment.rays import Rays
from panoless.geometry.height_field.model import HeightField, HeightFieldHits, visible_reflections
from panoless.numeric.robust import robust_weight

RADIANCE_SIGMA = 0.05
"""Standard deviation of a pixel (linear radiance)."""


@dataclass(frozen=True)
class Observations:
    """Pixels of all views that see the environment by way of a height field: rays of camera depth 1 in the normalized
    frame, where they meet it, and what they saw.
    """

    origins: Float[np.ndarray, "P 3"]
    directions: Float[np.ndarray, "P 3"]
    hits: HeightFieldHits
    rays: Rays

    @cached_property
    def radiance(self) -> Float[np.ndarray, "P 3"]:
        """What was seen along the rays."""
        return self.rays.radiance.cpu().numpy()

    def mirrored_by(self, height_field: HeightField, hits: HeightFieldHits) -> MirroredRays:
        """The rays where they meet a height field."""
        points = self.origins + np.where(hits.met, hits.distance, 0.0)[:, None] * self.directions
        directions = self.directions / np.linalg.norm(self.directions, axis=1, keepdims=True)
        return MirroredRays(directions, hits.normals @ height_field.frame, points, height_field.plane.surroundings)


def observe(views: Views, height_field: HeightField, max_pixels: int) -> Observations:
    """About `max_pixels` pixels of all views, evenly."""
    visible = [visible_reflections(height_field, *chosen) for chosen in every_kth_pixel(views, max_pixels)]
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
    following: FollowingMap
    tell_tilt: bool = True
    """Whether they have a say on the tilt of the whole."""

    @classmethod
    def at(
        cls,
        height_field: HeightField,
        observed: Observations,
        environment: Float[Tensor, "6 3 L L"],
        robust_scale: float,
        *,
        tell_tilt: bool = True,
    ) -> "Photographs":
        """Weights (1 + ‖r‖²/s²)⁻²/σ² and texels of observations at the height field that they were made with."""
        residual = observed.mirrored_by(height_field, observed.hits).light(environment) - observed.radiance
        weights = robust_weight(residual, robust_scale) / RADIANCE_SIGMA**2
        directions = observed.rays.directions.cpu().numpy().astype(np.float64)
        following = FollowingMap.of(directions, weights, environment.shape[-1])
        return cls(height_field, observed, environment, residual, following, tell_tilt)

    def equations(self) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
        """Gradient and Gauss–Newton matrix of the cost over the coefficients, or over what they are beside tilts.

        Zero when there are no rays, as where a high frame is mirrored everywhere.
        """
        height_field, hits, count = self.height_field, self.observed.hits, self.height_field.coefficients.size
        if not len(self.residual):
            return np.zeros(count), np.zeros((count, count))
        directions = self.observed.directions @ height_field.frame.T
        index, basis = height_field.basis(hits.places)
        _, _, _, h_uu, h_uv, h_vv = (basis * height_field.coefficients.ravel()[index]).sum(2)
        rate = directions[:, 2] - (hits.slopes * directions[:, :2]).sum(1)
        slide = np.stack([h_uu, h_uv, h_uv, h_vv]).reshape(2, 2, -1)
        slide = np.einsum("abp,pb->ap", slide, directions[:, :2]) / rate
        slopes = basis[1:3] + slide[:, :, None] * basis[0]
        mirrored = self.observed.mirrored_by(height_field, hits)
        by_slope = mirrored.light_by_turns(self.environment, hits.normals_by_slopes(height_field.frame))
        rows = np.matmul(by_slope, slopes.transpose(1, 0, 2))
        gradient, matrix = self.following.sparse_equations(rows, index, count, self.residual)
        if self.tell_tilt:
            return gradient, matrix
        tilts = height_field.tilts()
        left = matrix - tilts @ (tilts.T @ matrix)
        return gradient - tilts @ (tilts.T @ gradient), left - (left @ tilts) @ tilts.T

    def cost(self, candidate: HeightField) -> float:
        """The cost of another height field near to this one; a ray that misses it has a residual of 1."""
        if candidate is self.height_field:
            return self.following.cost(self.residual)
        hits = candidate.hits(self.observed.origins, self.observed.directions)
        shown = self.observed.mirrored_by(candidate, hits).light(self.environment)
        return self.following.cost(np.where(hits.met[:, None], shown - self.observed.radiance, 1.0))
