"""How well each direction of the environment was observed (paper Sec. 3.5)."""

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.kernels.cubemap import cubemap_solid_angles, scatter_cubemap

SATURATING_QUANTILE = 0.9


def accumulate(
    evidence: Float[Tensor, "6 L L"],
    directions: Float[Tensor, "P 3"],
    alpha: Float[Tensor, "P"],
    alpha_threshold: float,
) -> None:
    """Add to `evidence`, in place, alpha at the reflection direction of every pixel with alpha > τ."""
    kept = alpha > alpha_threshold
    evidence += scatter_cubemap(alpha[kept][:, None], directions[kept], evidence.shape[-1])[:, 0]


def visibility_from_evidence(evidence: Float[Tensor, "6 L L"]) -> Float[Tensor, "6 L L"]:
    """Map evidence to [0, 1]: log(1 + e/Ω) over its 90 % quantile among observed texels; Ω is the relative solid angle.

    Zero exactly where no ray fell.
    """
    relative = cubemap_solid_angles(evidence.shape[-1]).to(evidence.dtype)
    density = torch.log1p(evidence / (relative / relative.mean()))
    observed = density[density > 0]
    if not len(observed):
        return torch.zeros_like(evidence)
    return (density / torch.quantile(observed[:: max(1, len(observed) // 100_000)], SATURATING_QUANTILE)).clamp(0, 1)
