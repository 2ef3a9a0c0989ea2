"""GaussianShader (Jiang et al. 2024): 3D Gaussians, each shaded by the split sum with a normal of its own."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from panoless.capture.views import TrainView
from panoless.kernels.camera import RasterCamera
from panoless.splats.model import ShadedSurfels, Surfels
from panoless.splats.shading.base import (
    Seen,
    Unchanging,
    ambient_light,
    blend_gaussians,
    consistency_with_depth,
    facing,
    seen_from,
    shaded,
    shortest_axes,
    solid_scales,
    split_sum_light,
)
from panoless.splats.shading.occlusion import Occluder
from panoless.splats.split_sum import prefiltered

LN_3 = 1.0986123


@dataclass(frozen=True)
class GaussianShader(Unchanging):
    """The published constants."""

    learned: ClassVar[frozenset[str]] = frozenset(
        {"harmonics", "roughness_logits", "base_color_logits", "normal_residuals"}
    )
    restarts_at: float = 0.0
    """Never."""
    traces: bool = False
    tint: float = 0.5
    roughness: float = 0.65
    predicted_normal: float = 0.2
    """Weight of the agreement of blended normals with those of the depth, which it holds constant."""
    binary: float = 1e-3
    """Weight of the mean of ln o + ln(1 − o), which drives opacities to 0 and 1."""
    residual: float = 1e-3
    """Weight of the length of normal residuals."""
    least_opacity: float = 1e-3
    """Opacities are taken to be this far inside (0, 1) in that."""

    def begun(self, surfels: Surfels, *, random: bool) -> ShadedSurfels:
        """Half a mirror's tint, rather rough."""
        return shaded(surfels, solid_scales(surfels, random=random), 0.5, self.roughness, self.tint)

    def seen(
        self,
        surfels: ShadedSurfels,
        camera: RasterCamera,
        environment: Float[Tensor, "6 3 L L"],
        share: float,
        offsets: Float[Tensor, "K 2"] | None = None,
        occluder: Occluder | None = None,
    ) -> Seen:
        """σ(k_d − ln 3) + (1 − k_s) P(n, 1) + P(ω, ρ)(k_s A + B) of each Gaussian, blended."""
        levels, views = prefiltered(environment), seen_from(camera, surfels.means)
        normals = self._normals(surfels, views)
        tint, rough = torch.sigmoid(surfels.base_color_logits), torch.sigmoid(surfels.roughness_logits)
        diffuse = torch.sigmoid(surfels.harmonics[:, 0] - LN_3) + ambient_light(levels, normals) * (1 - tint)
        specular = split_sum_light(levels, views, normals, tint, rough)
        surface = blend_gaussians(surfels, camera, torch.cat([diffuse, specular], 1), offsets, normals)
        return Seen(surface, surface.attributes[:3], surface.attributes[3:])

    def penalty(
        self, seen: Seen, surfels: ShadedSurfels, view: TrainView, neighbor: RasterCamera, share: float
    ) -> Tensor | None:
        """Predicted normals, opacities that are 0 or 1, and short residuals."""
        agreement = consistency_with_depth(seen.surface, view.camera, view.mask, constant_depth=True)
        opacities = surfels.opacities.clamp(self.least_opacity, 1 - self.least_opacity)
        spread = (opacities.log() + (1 - opacities).log()).mean()
        lengths = (surfels.normal_residuals.square().sum(2) + 1e-12).sqrt().mean()
        return self.predicted_normal * agreement + self.binary * spread + self.residual * lengths

    def _normals(self, surfels: ShadedSurfels, views: Float[Tensor, "K 3"]) -> Float[Tensor, "K 3"]:
        """The shortest axis that faces the camera, and the residual of that side."""
        axes = shortest_axes(surfels)
        front = (axes * views).sum(1, keepdim=True) <= 0
        outside, inside = surfels.normal_residuals.unbind(1)
        return normalize(facing(axes, views) + torch.where(front, outside, inside), dim=1, eps=1e-8)
