"""MaterialRefGS (Zhang et al. 2025): Ref-Gaussian by pixels, with normals weighed by the picture and materials that
agree between neighboring views.

Left out: normals that a network predicts, its perceptual term, and surroundings of traced Gaussians.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

from panoless.capture.views import TrainView
from panoless.kernels.camera import RasterCamera
from panoless.splats.model import ShadedSurfels
from panoless.splats.rendering import ALPHA_FLOOR
from panoless.splats.shading.base import Blended, Seen, consistency_with_depth
from panoless.splats.shading.ref_gaussian import RefGaussian

COLOR, METAL, ROUGH = slice(3, 6), slice(6, 7), slice(7, 8)


@dataclass(frozen=True)
class MaterialRefGS(RefGaussian):
    """The published constants; shares are of its 50,000 steps."""

    learned: ClassVar[frozenset[str]] = RefGaussian.learned - {"indirect_harmonics"}
    traces: bool = False
    """Surroundings of Gaussians would determine it."""
    restarts_at: float = 0.0
    """Pixels are shaded from the first step on."""
    harmonics_from: float = 3_000 / 50_000
    metalness: float = 0.1
    normal_weights: tuple[tuple[float, float], ...] = (
        (0.0, 0.015),
        (10_000 / 50_000, 0.05),
        (15_000 / 50_000, 0.1),
        (25_000 / 50_000, 0.05),
    )
    """Shares of the steps, and the weight of consistent normals from there on."""
    materials_from: float = 25_000 / 50_000
    """Share of the steps after which materials of two views are compared."""
    color_weight: float = 0.015
    """Weight of the difference of base colors…"""
    material_weight: float = 0.025
    """…and of metalness and roughness."""
    depth_tolerance: float = 0.02
    """Points whose depth in the other view differs by more than this share are hidden there."""

    def penalty(
        self, seen: Seen, surfels: ShadedSurfels, view: TrainView, neighbor: RasterCamera, share: float
    ) -> Tensor | None:
        """λ · consistency, less where the picture has edges, and the difference of materials."""
        weight = next(weight for since, weight in reversed(self.normal_weights) if share >= since)
        total = weight * consistency_with_depth(seen.surface, view.camera, flatness(view.radiance))
        if share < self.materials_from:
            return total
        other = self.blended(surfels, neighbor, share, None)
        return total + self.disagreement(seen.surface, view, other, neighbor)

    def disagreement(self, surface: Blended, view: TrainView, other: Blended, neighbor: RasterCamera) -> Tensor:
        """Mean absolute difference of materials at solid pixels and where their points lie in the other view.

        Gradients flow to the materials of both, and to none of the shapes through where points lie.
        """
        places, depth = seen_at(surface.depth.detach(), view, neighbor)
        there = _sampled(torch.cat([other.attributes, other.alpha[None], other.depth.detach()[None]]), places, neighbor)
        materials, alpha, depth_there = there.split((len(other.attributes), 1, 1))
        known = (alpha[0] > 0.5) & ((depth_there[0] / depth - 1).abs() < self.depth_tolerance)
        here = surface.attributes.flatten(1)[:, view.solid]
        here = here / surface.alpha.flatten()[view.solid].clamp(min=ALPHA_FLOOR)
        difference = (here - materials / alpha.clamp(min=ALPHA_FLOOR)).abs() * known
        count = known.sum().clamp(min=1)
        color, metal, rough = (difference[part].mean(0).sum() / count for part in (COLOR, METAL, ROUGH))
        return self.color_weight * color + self.material_weight * (metal + rough)


def flatness(picture: Float[Tensor, "3 H W"]) -> Float[Tensor, "H W"]:
    """(1 − g/max g)², g the length of the gradient of the mean of the channels; 1 where a picture is of one color."""
    mean = torch.nn.functional.pad(picture.mean(0)[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    across, down = mean[1:-1, 2:] - mean[1:-1, :-2], mean[2:, 1:-1] - mean[:-2, 1:-1]
    slope = (across.square() + down.square()).sqrt()
    return (1 - slope / slope.max().clamp(min=1e-6)).square()


def seen_at(
    depth: Float[Tensor, "H W"], view: TrainView, neighbor: RasterCamera
) -> tuple[Float[Tensor, "P 2"], Float[Tensor, "P"]]:
    """Where another camera sees the surface points of the solid pixels of a view, in pixels, and at what depth."""
    rays = view.rays_camera.to(depth).flatten(1)[:, view.solid]
    points = rays / rays[2] * depth.flatten()[view.solid]
    between = neighbor.world_to_camera @ torch.linalg.inv(view.camera.world_to_camera)
    moved = between[:3, :3].to(depth) @ points + between[:3, 3:].to(depth)
    z = moved[2].clamp(min=1e-6)
    x, y = neighbor.fx * moved[0] / z + neighbor.cx, neighbor.fy * moved[1] / z + neighbor.cy
    return torch.stack([x, y], 1), z


def _sampled(image: Float[Tensor, "C H W"], places: Float[Tensor, "P 2"], camera: RasterCamera) -> Float[Tensor, "C P"]:
    """Bilinear values at places in pixels; zero beyond the picture."""
    grid = places / places.new_tensor([camera.width, camera.height]) * 2 - 1
    return grid_sample(image[None], grid[None, None], align_corners=False)[0, :, 0]
