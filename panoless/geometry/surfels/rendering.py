"""Surfels → screen-space buffers → deferred mirror shading (paper Eqs. 1–8)."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from panoless.geometry.surfels.model import Surfels
from panoless.kernels.constants import ALPHA_FLOOR
from panoless.kernels.rasterize import ALL_CHANNELS, Channels, RasterBuffers, RasterCamera, rasterize, tiles_of
from panoless.kernels.reference.objective import compose, reflection_directions_world, surface_depth

__all__ = [
    "ALPHA_FLOOR",
    "SurfaceBuffers",
    "compose",
    "rasterize_surfels",
    "reflection_directions_world",
    "surface_buffers",
    "tiles_of",
]


@dataclass(frozen=True)
class SurfaceBuffers:
    """What one camera sees of the surfels: Eq. 1 for albedo, Eq. 2 for the seven auxiliary channels, Eq. 3.

    `raster_normals_camera` is alpha-blended and not unit; `expected_depth` is the accumulated depth over alpha.
    `roughness` is blended like the albedo, zero unless it was asked for.
    """

    albedo: Float[Tensor, "3 H W"]
    alpha: Float[Tensor, "H W"]
    raster_normals_camera: Float[Tensor, "3 H W"]
    expected_depth: Float[Tensor, "H W"]
    median_depth: Float[Tensor, "H W"]
    surface_depth: Float[Tensor, "H W"]
    distortion: Float[Tensor, "H W"]
    in_frustum: Tensor


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
    surfels: Surfels,
    camera: RasterCamera,
    *,
    curved: bool,
    depth_blend: float,
    screen_offsets: Float[Tensor, "K 2"] | None = None,
    attribute: Float[Tensor, "K 3"] | None = None,
) -> SurfaceBuffers:
    """Rasterize, and blend the depths to D_surf (Eq. 3). `attribute` replaces the albedo as ψ of Eq. 1."""
    raster = rasterize_surfels(surfels, camera, curved=curved, screen_offsets=screen_offsets, attribute=attribute)
    return SurfaceBuffers(
        albedo=raster.colors,
        alpha=raster.alpha,
        raster_normals_camera=raster.normals_camera,
        expected_depth=surface_depth(raster.accumulated_depth, raster.median_depth, raster.alpha, 0.0),
        median_depth=raster.median_depth,
        surface_depth=surface_depth(raster.accumulated_depth, raster.median_depth, raster.alpha, depth_blend),
        distortion=raster.distortion,
        in_frustum=raster.in_frustum,
    )
