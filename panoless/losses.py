"""Terms of the training objective (paper Eqs. 9–14)."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, normalize

from panoless.kernels.image import depth_normals, ssim
from panoless.kernels.rasterize import RasterCamera
from panoless.shading import SurfaceBuffers

CHARBONNIER = 1e-2
ALPHA_MARGIN = 1e-4
SURFACE_ALPHA = 0.5


def photometric_paper(
    image: Float[Tensor, "3 H W"], target: Float[Tensor, "3 H W"], lambda_ssim: float
) -> Float[Tensor, ""]:
    """(1 − λ_s) L1 + λ_s (1 − SSIM) of the composited image (Eqs. 9–11), D-SSIM not halved."""
    l1 = (image - target).abs().mean()
    return (1 - lambda_ssim) * l1 + lambda_ssim * (1 - ssim(image, target))


def photometric_masked(
    color: Float[Tensor, "P 3"], target: Float[Tensor, "P 3"], robust_scale: float
) -> Float[Tensor, ""]:
    """Weighted mean over pixels of √(‖e‖² + ε²), ε = 0.01: quadratic near zero, linear beyond.

    With `robust_scale` s > 0 each pixel weighs (1 + ‖e‖²/s²)⁻² (Geman–McClure, held constant in the gradient), so
    that pixels which see the object itself instead of the environment lose their vote. Zero when there is no pixel.
    """
    squared = (color - target).square().sum(1)
    distance = torch.sqrt(squared + CHARBONNIER**2)
    if robust_scale <= 0:
        return distance.sum() / max(len(color), 1)
    weight = (1 + squared.detach() / robust_scale**2) ** -2
    return (weight * distance).sum() / max(len(color), 1)


def silhouette(alpha: Float[Tensor, "H W"], mask: Float[Tensor, "H W"]) -> Float[Tensor, ""]:
    """Binary cross-entropy between accumulated opacity and mask (Eq. 13)."""
    return binary_cross_entropy(alpha.clamp(ALPHA_MARGIN, 1 - ALPHA_MARGIN), mask)


def normal_consistency(
    buffers: SurfaceBuffers, camera: RasterCamera, weight: Float[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """Weighted mean of 1 − N·n_surf (Eq. 12); both normals in the camera frame, which changes nothing.

    `weight` chooses pixels, e.g. the mask; pixels without a depth normal (the border, holes) don't count.
    """
    from_depth = depth_normals(buffers.surface_depth, camera.fx, camera.fy, camera.cx, camera.cy)
    raster = normalize(buffers.raster_normals_camera, dim=0, eps=1e-8)
    valid = weight * (buffers.alpha.detach() > SURFACE_ALPHA) * (from_depth.detach() != 0).any(0)
    return ((1 - (raster * from_depth).sum(0)) * valid).sum() / valid.sum().clamp(min=1)
