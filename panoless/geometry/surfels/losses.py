"""Terms of the training objective (paper Eqs. 9–14)."""

from jaxtyping import Float
from torch import Tensor

from panoless.geometry.surfels.rendering import SurfaceBuffers
from panoless.kernels.image import depth_normals, ssim
from panoless.kernels.rasterize import RasterCamera
from panoless.kernels.reference import objective as definition
from panoless.kernels.reference.objective import photometric_masked, silhouette

__all__ = ["normal_consistency", "photometric_masked", "photometric_paper", "silhouette"]


def photometric_paper(
    image: Float[Tensor, "3 H W"], target: Float[Tensor, "3 H W"], lambda_ssim: float
) -> Float[Tensor, ""]:
    """(1 − λ_s) L1 + λ_s (1 − SSIM) of the composited image (Eqs. 9–11), D-SSIM not halved."""
    l1 = (image - target).abs().mean()
    return (1 - lambda_ssim) * l1 + lambda_ssim * (1 - ssim(image, target))


def normal_consistency(
    buffers: SurfaceBuffers, camera: RasterCamera, weight: Float[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """Weighted mean of 1 − N·n_surf (Eq. 12), n_surf the normal of the surface depth (Eq. 4)."""
    from_depth = depth_normals(buffers.surface_depth, camera.fx, camera.fy, camera.cx, camera.cy)
    return definition.normal_consistency(buffers.raster_normals_camera, buffers.alpha, from_depth, weight)
