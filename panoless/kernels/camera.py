"""A pinhole camera, the rays through its pixels, and where a mirror sends them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.kernels.constants import SHORTEST_NORMAL


@dataclass(frozen=True)
class RasterCamera:
    """A pinhole camera with OpenCV axes (+x right, +y down, +z forward); pixel (0, 0) has its center at (0.5, 0.5).

    No gradient flows to the camera: to refine a pose, transform the surfels in torch and rasterize the result.
    """

    world_to_camera: Float[Tensor, "4 4"]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float = 0.2
    """Surfels whose center is nearer than this, in scene units, are culled; also the near end of the distortion's
    scale.
    """
    far: float = 100.0
    """Far end of the distortion's scale, in scene units; nothing is culled by it."""


def unit_rays(
    size: tuple[int, int],
    focal: tuple[float, float],
    center: tuple[float, float],
    dtype: torch.dtype = torch.float32,
    device: torch.device | None = None,
) -> Float[Tensor, "3 H W"]:
    """Unit ray directions in the camera frame through the pixel centers (i + ½, j + ½) of H×W pixels."""
    y, x = (
        (torch.arange(count, dtype=dtype, device=device) + 0.5 - middle) / length
        for count, middle, length in zip(size, reversed(center), reversed(focal), strict=True)
    )
    # A norm over three planes by torch takes fifteen times as long.
    length = (x.square() + y.square()[:, None] + 1).sqrt()
    return torch.stack([x / length, y[:, None] / length, 1 / length])


def reflection_directions_world(
    raster_normals_camera: Float[Tensor, "3 P"],
    rays_camera: Float[Tensor, "3 P"],
    camera_to_world_rotation: Float[Tensor, "3 3"],
) -> Float[Tensor, "P 3"]:
    """ω_r = v − 2 (v·n) n (Eq. 5) for unit camera rays v and blended normals, which are renormalized here.

    Computed in the camera frame and rotated once: reflection commutes with rotation.
    """
    # As `normalize` does, which takes ten times as long along the first of two dimensions.
    squared = raster_normals_camera.square().sum(0, keepdim=True)
    normals = raster_normals_camera * squared.clamp(min=SHORTEST_NORMAL**2).rsqrt()
    along = (rays_camera * normals).sum(0, keepdim=True)
    return (camera_to_world_rotation @ (rays_camera - 2 * along * normals)).T
