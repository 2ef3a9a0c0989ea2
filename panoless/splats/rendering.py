"""Surfels → screen-space buffers → deferred mirror shading (paper Eqs. 1–8)."""

from jaxtyping import Bool, Float
from torch import Tensor

from panoless.geometry.base import SurfaceBuffers
from panoless.kernels.camera import RasterCamera, reflection_directions_world
from panoless.kernels.constants import ALPHA_FLOOR
from panoless.splats.kernels.rasterize import ALL_CHANNELS, Channels, RasterBuffers, rasterize, tiles_of
from panoless.splats.kernels.reference.objective import compose, surface_depth
from panoless.splats.model import Surfels

__all__ = [
    "ALPHA_FLOOR",
    "DEPTH_BLEND",
    "compose",
    "rasterize_surfels",
    "reflection_directions_world",
    "surface_buffers",
    "tiles_of",
]


DEPTH_BLEND = 0.5
"""λ_d of Eq. 3: 0 takes the expected depth, 1 the median depth."""


def rasterize_surfels(
    surfels: Surfels,
    camera: RasterCamera,
    *,
    curved: bool,
    screen_offsets: Float[Tensor, "K 2"] | None = None,
    attribute: Float[Tensor, "K 3"] | None = None,
    channels: Channels = ALL_CHANNELS,
    active_tiles: Bool[Tensor, "tile_rows tile_columns"] | None = None,
) -> RasterBuffers:
    """Rasterize the surfels' physical quantities. `attribute` replaces the albedo as ψ of Eq. 1."""
    return rasterize(
        surfels.means,
        surfels.quats,
        surfels.scales,
        surfels.opacities,
        surfels.albedo if attribute is None else attribute,
        surfels.curvatures if curved else None,
        camera,
        screen_offsets=screen_offsets,
        channels=channels,
        active_tiles=active_tiles,
    )


def surface_buffers(
    surfels: Surfels, camera: RasterCamera, *, curved: bool, depth_blend: float = DEPTH_BLEND
) -> SurfaceBuffers:
    """Rasterize, and blend the depths to D_surf (Eqs. 1–3)."""
    raster = rasterize_surfels(surfels, camera, curved=curved)
    depth = surface_depth(raster.accumulated_depth, raster.median_depth, raster.alpha, depth_blend)
    return SurfaceBuffers(raster.alpha, raster.normals_camera, depth, raster.colors)
