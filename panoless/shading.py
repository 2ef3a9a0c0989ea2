"""Surfels → screen-space buffers → deferred mirror shading (paper Eqs. 1–8)."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from panoless.kernels.rasterize import RasterCamera, rasterize
from panoless.surfels import Surfels

ALPHA_FLOOR = 1e-3


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


def surface_buffers(
    surfels: Surfels,
    camera: RasterCamera,
    *,
    curved: bool,
    depth_blend: float,
    screen_offsets: Float[Tensor, "K 2"] | None = None,
    attribute: Float[Tensor, "K 3"] | None = None,
) -> SurfaceBuffers:
    """Rasterize; D_surf = (1 − λ_d) D_exp + λ_d D_med (Eq. 3). `attribute` replaces the albedo as ψ of Eq. 1."""
    raster = rasterize(
        surfels.means,
        surfels.quats,
        surfels.scales,
        surfels.opacities,
        surfels.albedo if attribute is None else attribute,
        surfels.curvatures if curved else None,
        camera,
        screen_offsets=screen_offsets,
    )
    expected = raster.accumulated_depth / raster.alpha.clamp(min=ALPHA_FLOOR)
    if depth_blend == 0.0:
        surface = expected
    else:
        surface = (1 - depth_blend) * expected + depth_blend * raster.median_depth
    return SurfaceBuffers(
        albedo=raster.colors,
        alpha=raster.alpha,
        raster_normals_camera=raster.normals_camera,
        expected_depth=expected,
        median_depth=raster.median_depth,
        surface_depth=surface,
        distortion=raster.distortion,
        in_frustum=raster.in_frustum,
    )


def reflection_directions_world(
    raster_normals_camera: Float[Tensor, "3 P"],
    rays_camera: Float[Tensor, "3 P"],
    camera_to_world_rotation: Float[Tensor, "3 3"],
) -> Float[Tensor, "P 3"]:
    """ω_r = v − 2 (v·n) n (Eq. 5) for unit camera rays v and blended normals, which are renormalized here.

    Computed in the camera frame and rotated once: reflection commutes with rotation.
    """
    normals = normalize(raster_normals_camera, dim=0, eps=1e-8)
    along = (rays_camera * normals).sum(0, keepdim=True)
    return (camera_to_world_rotation @ (rays_camera - 2 * along * normals)).T


def compose(
    albedo: Float[Tensor, "3 *S"], specular: Float[Tensor, "3 *S"], alpha: Float[Tensor, "*S"], alpha_applied: str
) -> Float[Tensor, "3 *S"]:
    """C = A + L_env (Eq. 8) under the matte α, without the background term (1 − α) b.

    `paper`: (A + L)·α as Eq. 10 is written, although the blended A holds α already; `once`: A + L·α.
    """
    if alpha_applied == "paper":
        return (albedo + specular) * alpha
    return albedo + specular * alpha
