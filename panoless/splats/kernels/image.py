"""Operators on whole images: normals of a depth map, and structural similarity."""

from jaxtyping import Float
from torch import Tensor

from panoless.kernels.backend import Backend, choose_backend
from panoless.splats.kernels.reference import image as reference


def depth_normals(
    depth: Float[Tensor, "H W"], fx: float, fy: float, cx: float, cy: float, *, backend: Backend = "auto"
) -> Float[Tensor, "3 H W"]:
    """Unit camera-frame normals of the surface that a depth map shows (the paper's Eq. 4).

    n = normalize(∂P/∂j × ∂P/∂i), by central differences of P = ((i + ½ − cx)/fx·z, (j + ½ − cy)/fy·z, z) at
    column i and row j, in OpenCV axes (+x right, +y down, +z forward). For positive depths the normal always
    exists and faces the camera: n·P < 0.

    `depth` is z in the camera frame (not the distance along the ray), in scene units; the intrinsics are in pixels.
    The normal is zero, with zero gradient, on the outermost ring of pixels and wherever one of the four neighbors'
    depths is not positive and finite. (Central differences do not read the depth of the pixel itself.)

    Gradient: to `depth`. Raises ValueError for wrong shapes or a backend that can't take these tensors.
    """
    if depth.ndim != 2:
        raise ValueError(f"expected a depth map (H, W); found {tuple(depth.shape)}.")
    chosen = choose_backend(backend, depth=depth)
    if chosen == "reference":
        return reference.depth_normals(depth, fx, fy, cx, cy)
    if chosen == "gpu":
        from panoless.splats.kernels.gpu.image import DepthNormals as DepthNormalsGpu

        return DepthNormalsGpu.apply(depth, fx, fy, cx, cy)
    from panoless.splats.kernels.cpu.image import DepthNormals

    return DepthNormals.apply(depth, fx, fy, cx, cy)


def ssim(
    image: Float[Tensor, "C H W"], target: Float[Tensor, "C H W"], *, backend: Backend = "auto"
) -> Float[Tensor, ""]:
    """Mean structural similarity of an image and its target, over all channels and pixels.

    SSIM = (2 μ_x μ_y + C₁)(2 σ_xy + C₂) / ((μ_x² + μ_y² + C₁)(σ_x² + σ_y² + C₂)), with an 11×11 Gaussian window of
    σ = 1.5 px, population (not sample) moments, C₁ = 0.01² and C₂ = 0.03²; so the data range is taken to be 1.

    Both images are continued by zeros, and every pixel counts, as in the training losses of the 3DGS family. An
    evaluation that leaves out the border (skimage and most papers' tables) gives slightly different numbers.

    Gradient: to `image` only. Raises ValueError for wrong shapes, a target that requires a gradient, or a backend that
    can't take these tensors. Source: Wang, Bovik, Sheikh, Simoncelli 2004, doi:10.1109/TIP.2003.819861.
    """
    if image.ndim != 3 or image.shape != target.shape or image.numel() == 0:
        raise ValueError(
            f"expected an image and a target of the same shape (C, H, W), not empty; "
            f"found {tuple(image.shape)} and {tuple(target.shape)}."
        )
    if target.requires_grad:
        raise ValueError(
            "expected a constant target; found one that requires a gradient. Detach it, or swap it with the image "
            "(SSIM is symmetric)."
        )
    chosen = choose_backend(backend, image=image, target=target)
    if chosen == "reference":
        return reference.ssim(image, target)
    if chosen == "gpu":
        from panoless.splats.kernels.gpu.image import Ssim as SsimGpu

        return SsimGpu.apply(image, target)
    from panoless.splats.kernels.cpu.image import Ssim

    return Ssim.apply(image, target)
