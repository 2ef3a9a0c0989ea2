"""Ref-Gaussian (Yao et al. 2024): surfels with a base color, a metalness and a roughness, under the split sum.

Primitives are shaded one by one at first, then the pixels that they blend to; between the two, materials and map begin
again. Where a mirrored ray meets the object again, as a grid of distances to its surface determines, light that
primitives hold by direction takes the place of the map's.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.rays import reflect
from panoless.kernels.camera import RasterCamera
from panoless.splats.model import ShadedSurfels, Surfels
from panoless.splats.shading.base import (
    Blended,
    Seen,
    SurfacePixels,
    Unchanging,
    ambient_light,
    at_least,
    blend_surfels,
    facing,
    harmonic_color,
    incidence_cosines,
    points_at,
    propagated,
    seen_from,
    shaded,
    split_sum_light,
)
from panoless.splats.shading.occlusion import Occluder
from panoless.splats.split_sum import look_up_rough, prefiltered, specular_share

DIELECTRIC = 0.04
"""Reflectance at normal incidence of what is no metal."""


@dataclass(frozen=True)
class RefGaussian(Unchanging):
    """The published constants; shares are of its 50,000 steps."""

    learned: ClassVar[frozenset[str]] = frozenset(
        {"harmonics", "strength_logits", "roughness_logits", "base_color_logits", "indirect_harmonics"}
    )
    restarts_at: float = 18_000 / 50_000
    """Share of the steps that shade primitives, not pixels."""
    harmonics_from: float = 5_000 / 50_000
    """Share of the steps after which diffuse light depends on direction."""
    metalness: float = 0.01
    roughness: float = 0.1
    base_color: float = 0.5
    propagated_metalness: float = 0.02
    """Surfels of at least this metalness…"""
    propagated_roughness: float = 0.01
    """…and at most this roughness are enlarged to spread their normals."""
    disturbance: float = 0.4
    """Diffuse color of the others changes at random by up to so much, once pixels are shaded."""
    traces: bool = True

    def begun(self, surfels: Surfels, *, random: bool) -> ShadedSurfels:
        """Gray, hardly metallic, rather smooth."""
        materials = self.metalness, self.roughness, self.base_color
        return shaded(surfels, surfels.log_scales, *materials, indirect=self.traces)

    def seen(
        self,
        surfels: ShadedSurfels,
        camera: RasterCamera,
        environment: Float[Tensor, "6 3 L L"],
        share: float,
        offsets: Float[Tensor, "K 2"] | None = None,
        occluder: Occluder | None = None,
    ) -> Seen:
        """By primitives first, then by pixels."""
        levels = prefiltered(environment)
        if share < self.restarts_at:
            return self._by_primitives(surfels, camera, levels, offsets)
        return self._by_pixels(surfels, camera, levels, share, offsets, occluder)

    def propagated(self, surfels: ShadedSurfels, share: float, generator: torch.Generator) -> ShadedSurfels:
        """All more opaque, smooth metals larger, and later the diffuse color of the others disturbed."""
        reflects = torch.sigmoid(surfels.strength_logits) >= self.propagated_metalness
        reflects &= torch.sigmoid(surfels.roughness_logits) <= self.propagated_roughness
        return propagated(surfels, reflects, generator, self.disturbance * (share >= self.restarts_at))

    def revived(self, surfels: ShadedSurfels) -> ShadedSurfels:
        """A metalness of at least that of the start."""
        return at_least(surfels, self.metalness)

    def _by_primitives(self, surfels, camera, levels, offsets) -> Seen:
        views = seen_from(camera, surfels.means)
        normals = facing(surfels.normals, views)
        metal, rough = torch.sigmoid(surfels.strength_logits), torch.sigmoid(surfels.roughness_logits)
        color = torch.sigmoid(surfels.base_color_logits)
        diffuse = ambient_light(levels, normals) * color * (1 - metal)[:, None]
        at_normal = DIELECTRIC * (1 - metal)[:, None] + color * metal[:, None]
        specular = split_sum_light(levels, views, normals, at_normal, rough)
        surface = blend_surfels(surfels, camera, torch.cat([diffuse, specular], 1), offsets)
        return Seen(surface, surface.attributes[:3], surface.attributes[3:])

    def blended(
        self,
        surfels: ShadedSurfels,
        camera: RasterCamera,
        share: float,
        offsets: Float[Tensor, "K 2"] | None,
        *,
        indirect: bool = False,
    ) -> Blended:
        """Diffuse and base color, metalness and roughness, eight channels in that order; if requested, three more of
        the light that comes to each primitive from the object itself, out of the direction that it mirrors.
        """
        views = seen_from(camera, surfels.means)
        metal, rough = torch.sigmoid(surfels.strength_logits), torch.sigmoid(surfels.roughness_logits)
        color = torch.sigmoid(surfels.base_color_logits)
        diffuse = harmonic_color(surfels.harmonics, views, 3 if share >= self.harmonics_from else 0)
        diffuse = diffuse * (1 - metal)[:, None]
        attributes = [diffuse, color, metal[:, None], rough[:, None]]
        if indirect:
            mirrored = reflect(views, facing(surfels.normals, views))
            attributes.append(harmonic_color(surfels.indirect_harmonics, mirrored, 3, middle=0.0))
        return blend_surfels(surfels, camera, torch.cat(attributes, 1), offsets)

    def _by_pixels(self, surfels, camera, levels, share, offsets, occluder) -> Seen:
        surface = self.blended(surfels, camera, share, offsets, indirect=occluder is not None)
        at = SurfacePixels.of(surface, camera)
        color, metal, rough = at.of_image(surface.attributes[3:8]).split((3, 1, 1), 1)
        rough = rough[:, 0].clamp(0, 1)
        at_normal = DIELECTRIC * (1 - metal) + color * metal
        mirrored = reflect(at.views, at.normals)
        light = look_up_rough(levels, mirrored, rough)
        if occluder is not None:
            hidden = occluder.hides(points_at(camera, surface.depth, at.pixels, at.views), mirrored)
            light = torch.where(hidden[:, None], at.of_image(surface.attributes[8:]), light)
        specular = light * specular_share(at_normal, incidence_cosines(at.views, at.normals), rough)
        return Seen(surface, surface.attributes[:3], at.image(specular, surface.attributes))
