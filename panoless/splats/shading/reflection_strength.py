"""3DGS-DR (Ye et al. 2024): 3D Gaussians that blend a color, a normal and how strongly they reflect."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.rays import reflect
from panoless.kernels.camera import RasterCamera
from panoless.kernels.cubemap import sample_cubemap
from panoless.splats.model import ShadedSurfels, Surfels
from panoless.splats.shading.base import (
    Seen,
    SurfacePixels,
    Unchanging,
    at_least,
    blend_gaussians,
    facing,
    harmonic_color,
    propagated,
    seen_from,
    shaded,
    shortest_axes,
    solid_scales,
)
from panoless.splats.shading.occlusion import Occluder


@dataclass(frozen=True)
class ReflectionStrength(Unchanging):
    """The published constants; shares are of its 61,000 steps."""

    learned: ClassVar[frozenset[str]] = frozenset({"harmonics", "strength_logits"})
    restarts_at: float = 0.0
    """Never."""
    traces: bool = False
    reflects_from: float = 3_000 / 61_000
    """Share of the steps before which nothing is reflected."""
    harmonics_from: tuple[float, ...] = (10_000 / 61_000, 11_000 / 61_000, 12_000 / 61_000)
    """Shares of the steps after which color depends on direction, by one degree more each."""
    strength: float = 0.001
    propagated_strength: float = 0.02
    """Gaussians that reflect at least so strongly are enlarged to spread their normals."""
    disturbance: float = 0.4
    """The color of the others changes at random by up to so much."""

    def begun(self, surfels: Surfels, *, random: bool) -> ShadedSurfels:
        """Gray, hardly reflecting."""
        return shaded(surfels, solid_scales(surfels, random=random), self.strength, 0.5)

    def seen(
        self,
        surfels: ShadedSurfels,
        camera: RasterCamera,
        environment: Float[Tensor, "6 3 L L"],
        share: float,
        offsets: Float[Tensor, "K 2"] | None = None,
        occluder: Occluder | None = None,
    ) -> Seen:
        """(1 − R) B + R E(ω) of blended B, R and normals."""
        views = seen_from(camera, surfels.means)
        degree = sum(share >= each for each in self.harmonics_from)
        color = harmonic_color(surfels.harmonics, views, degree)
        strength = torch.sigmoid(surfels.strength_logits)[:, None]
        normals = facing(shortest_axes(surfels), views)
        surface = blend_gaussians(surfels, camera, torch.cat([color, strength], 1), offsets, normals)
        base, reflected = surface.attributes[:3], surface.attributes[3:]
        if share < self.reflects_from:
            return Seen(surface, base, torch.zeros_like(base))
        at = SurfacePixels.of(surface, camera)
        specular = at.of_image(reflected) * sample_cubemap(environment, reflect(at.views, at.normals))
        return Seen(surface, (1 - reflected) * base, at.image(specular, base))

    def propagated(self, surfels: ShadedSurfels, share: float, generator: torch.Generator) -> ShadedSurfels:
        """All more opaque, those that reflect larger, the color of the others disturbed."""
        reflects = torch.sigmoid(surfels.strength_logits) >= self.propagated_strength
        return propagated(surfels, reflects, generator, self.disturbance)

    def revived(self, surfels: ShadedSurfels) -> ShadedSurfels:
        """A strength of at least that of the start."""
        return at_least(surfels, self.strength)
