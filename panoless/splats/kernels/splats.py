"""3D Gaussians as splats (Kerbl et al. 2023): their projection, and a differentiable blend of any channels."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from panoless.kernels.backend import Backend, choose_backend
from panoless.kernels.camera import RasterCamera
from panoless.splats.kernels.reference import splats as reference


@dataclass(frozen=True)
class Splats:
    """Projected Gaussians exp(−½ dᵀ Q d), d the pixel less the center, in pixels."""

    centers: Float[Tensor, "K 2"]
    precisions: Float[Tensor, "K 3"]
    """Q_xx, Q_xy and Q_yy, 1/px²."""
    depths: Float[Tensor, " K"]
    """z of the centers in the camera frame, scene units."""
    drawn: Bool[Tensor, " K"]
    """Beyond the near plane, finite, with a rotation and positive scales. The others' numbers mean nothing."""


@dataclass(frozen=True)
class SplatImages:
    """Images of splats, zero where there is none, with weights w = transmittance · fragment alpha."""

    channels: Float[Tensor, "C H W"]
    """Σ w · attribute."""
    alpha: Float[Tensor, "H W"]
    """Σ w, in [0, 1]."""


def project_gaussians(
    means: Float[Tensor, "K 3"], quats: Float[Tensor, "K 4"], scales: Float[Tensor, "K 3"], camera: RasterCamera
) -> Splats:
    """Gaussians with the covariance R S² Rᵀ as splats: Q⁻¹ = J W R S² Rᵀ Wᵀ Jᵀ + 0.3 px² (Zwicker et al. 2001).

    W rotates into the camera and J is the derivative of the projection at the center, whose tangents are held within
    1.3 times those of the picture's edges. `means` and `scales` are in scene units, `quats` wxyz of any norm but zero.
    Gradients: to all three. Plain torch on every device, since it is small beside the blend.
    """
    return Splats(*reference.project_gaussians(means, quats, scales, camera))


def blend_splats(
    splats: Splats,
    opacities: Float[Tensor, " K"],
    attributes: Float[Tensor, "K C"],
    size: tuple[int, int],
    *,
    backend: Backend = "auto",
) -> SplatImages:
    """Blend splats front to back over height × width pixels with centers at (i + ½, j + ½), ordered by depth (ties by
    index).

    A fragment's alpha is min(0.99, o·exp(−½ dᵀ Q d)); below 1/255 it is skipped, and a pixel is finished before the
    fragment that would bring its transmittance below 10⁻⁴: the rules of `panoless.splats.kernels.rasterize`.

    Gradients flow from both images to centers, precisions, opacities and attributes; those of splats that are not drawn
    are zero. Raises ValueError for wrong shapes, mixed dtypes or devices, or a backend that can't take these tensors.
    """
    count = len(opacities)
    if attributes.ndim != 2 or len(attributes) != count or len(splats.centers) != count:
        raise ValueError(
            f"expected attributes (K, C) of the {len(splats.centers)} splats, and as many opacities; "
            f"found {tuple(attributes.shape)} and {tuple(opacities.shape)}."
        )
    if min(size) < 1:
        raise ValueError(f"expected a picture of positive height and width; found {size}.")
    parameters = splats.centers, splats.precisions, opacities, attributes
    names = "centers", "precisions", "opacities", "attributes"
    chosen = choose_backend(backend, **dict(zip(names, parameters, strict=True)))
    if chosen == "cpu":
        from panoless.splats.kernels.cpu.splats import blend_splats as implementation
    elif chosen == "gpu":
        from panoless.splats.kernels.gpu.splats import blend_splats as implementation
    else:
        implementation = reference.blend_splats
    drawn = splats.drawn & (opacities.detach() >= reference.ALPHA_MIN)
    channels, alpha = implementation(*parameters, splats.depths.detach(), drawn, *size)
    return SplatImages(channels, alpha)
