"""The photometric term of the paper (Eqs. 9–11). The other terms are part of `kernels.objective`."""

from jaxtyping import Float
from torch import Tensor

from panoless.splats.kernels.image import ssim

LAMBDA_SSIM = 0.2
"""λ_s, the weight of D-SSIM."""


def photometric_paper(
    image: Float[Tensor, "3 H W"], target: Float[Tensor, "3 H W"], lambda_ssim: float = LAMBDA_SSIM
) -> Float[Tensor, ""]:
    """(1 − λ_s) L1 + λ_s (1 − SSIM) of the composited image (Eqs. 9–11), D-SSIM not halved."""
    l1 = (image - target).abs().mean()
    return (1 - lambda_ssim) * l1 + lambda_ssim * (1 - ssim(image, target))
