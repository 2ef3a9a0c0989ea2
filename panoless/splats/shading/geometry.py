"""Primitives that another method shades, as a geometry."""

from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from panoless.environment.rays import Rays
from panoless.geometry.base import SOLID_SURFACE_ALPHA, Mesh, SurfaceBuffers, to_plain
from panoless.geometry.exact import mirrored_directions
from panoless.kernels.camera import RasterCamera
from panoless.splats.mirror import SH_DEGREE_0, SurfelMirror
from panoless.splats.model import ShadedSurfels, Surfels
from panoless.splats.objective import StepObjective
from panoless.splats.rendering import ALPHA_FLOOR
from panoless.splats.shading.base import Seen, points_at
from panoless.splats.shading.objective import ShadedObjective, learned_by
from panoless.splats.shading.occlusion import Occluder
from panoless.splats.shading.registry import SHADINGS


@dataclass(frozen=True)
class ShadedMirror(SurfelMirror):
    """A set of primitives, and the method that shades them. Its images are in the encoding of the fit."""

    shading: str = ""
    """The method's name."""
    share: float = 0.0
    """Of the steps that were taken, which methods go by."""
    occluder: Occluder | None = None
    """What hides the map, where the method traces it."""

    @classmethod
    def begun(cls, mirror: SurfelMirror, config: FitConfig) -> SurfelMirror:
        """Primitives of the configured method where surfels are; the surfels themselves where they mirror."""
        if config.splats.surfels.shading not in SHADINGS:
            return mirror
        random = config.splats.surfels.initial == "random"
        surfels = SHADINGS[config.splats.surfels.shading].begun(mirror.surfels, random=random)
        return cls(**{**vars(mirror), "surfels": surfels, "curved": False, "shading": config.splats.surfels.shading})

    @property
    def num_parameters(self) -> int:
        """Of all that is learned."""
        learned = learned_by(SHADINGS[self.shading])
        return sum(value.numel() for name, value in self.surfels.named().items() if name in learned)

    def objective(self, views: Views, config: FitConfig) -> StepObjective:
        """That of its method."""
        return ShadedObjective(SHADINGS[self.shading], views, config, self.occluder)

    def at(self, surfels: Surfels, share: float, objective: StepObjective) -> "ShadedMirror":
        """With its primitives as they are when that share of the steps of its objective is taken."""
        return replace(self, surfels=surfels, share=share, occluder=cast(ShadedObjective, objective).occluder)

    def to(self, device: torch.device) -> "ShadedMirror":
        """The same numbers on a device."""
        occluder = None if self.occluder is None else self.occluder.to(device)
        return replace(self, surfels=self.surfels.to(device), occluder=occluder)

    def state_dict(self) -> dict[str, Any]:
        """That of a mirror, and what hides the map."""
        occluder = None if self.occluder is None else to_plain(self.occluder)
        return {**super().state_dict(), "occluder": occluder}

    def observe_covered(self, view: TrainView, pixels: Int[Tensor, "P"]) -> tuple[Rays, Int[Tensor, "Q"]]:
        """The rays of pixels that primitives cover, less what is diffuse without surroundings."""
        buffers = self.buffers(view.camera)
        pixels = pixels[buffers.alpha.flatten()[pixels] > SOLID_SURFACE_ALPHA]
        radiance = view.radiance_at(pixels) - buffers.albedo.flatten(1)[:, pixels].T
        directions = mirrored_directions(view.camera, pixels, buffers.normals_camera.flatten(1)[:, pixels])
        if self.occluder is not None:
            points = points_at(view.camera, buffers.depth, pixels, view.directions_world(pixels))
            sees = ~self.occluder.hides(points, directions)
            pixels, radiance, directions = pixels[sees], radiance[sees], directions[sees]
        return Rays(directions, radiance, incoming=view.directions_world(pixels)), pixels

    def buffers(self, camera: RasterCamera) -> SurfaceBuffers:
        """Blended over the primitives; the albedo is what they show without surroundings."""
        seen = self._seen(camera, self.surfels.means.new_zeros(6, 3, 4, 4))
        surface = seen.surface
        return SurfaceBuffers(surface.alpha, surface.normals_camera, surface.depth, seen.diffuse)

    def shade(
        self,
        environment: Float[Tensor, "6 3 L L"],
        camera: RasterCamera,
        pixels: Int[Tensor, "P"],
        normals_camera: Float[Tensor, "3 P"],
    ) -> Float[Tensor, "P 3"]:
        """What surroundings add, by the method; it blends its normals itself."""
        dark, seen = self.buffers(camera), self._seen(camera, environment)
        added = (seen.diffuse + seen.specular - dark.albedo).flatten(1)[:, pixels]
        return (added / dark.alpha.flatten()[pixels].clamp(min=ALPHA_FLOOR)).T

    def mesh(self, frame: ObjectFrame) -> Mesh:
        """The cloud of a mirror, with diffuse color as viewers of splats know it."""
        surfels = cast(ShadedSurfels, self.surfels)
        albedo = 0.5 + SH_DEGREE_0 * surfels.harmonics[:, 0]
        return super(ShadedMirror, replace(self, surfels=replace(surfels, albedo=albedo))).mesh(frame)

    def _seen(self, camera: RasterCamera, environment: Float[Tensor, "6 3 L L"]) -> Seen:
        with torch.no_grad():
            surfels = cast(ShadedSurfels, self.surfels.detached())
            return SHADINGS[self.shading].seen(surfels, camera, environment, self.share, occluder=self.occluder)
