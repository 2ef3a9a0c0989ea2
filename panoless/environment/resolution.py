"""How fine a map should be for its rays."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.environment.rays import Rays
from panoless.kernels.cubemap import sample_cubemap, scatter_cubemap
from panoless.numeric.robust import bounded_error

ERROR_SCALE = 0.1
"""Residual s (linear radiance) of held-out errors ‖e‖²/(‖e‖² + s²), here and in model selection. Not tuned."""
RESOLUTIONS = (64, 128, 256)
RAYS_PER_TEXEL = 4
"""Fewest in the median observed texel of a map. Chosen on Vase at 160 px, where 64, 128 and 256 texels with 18, 4.6
and 1.1 rays give 28.0, 28.7 and 28.4 dB."""


def densest_resolution(rays: Sequence[Rays]) -> int:
    """Texels along a face side: the finest of 64, 128, 256 with four rays or more in the median observed texel.

    For geometry whose normals are as exact as their pixels: then no held-out view speaks against detail.
    """
    coarsest = RESOLUTIONS[0]
    count = count_rays(rays, coarsest)
    observed = count[count >= 1]
    median = float(observed.median()) if len(observed) else 0.0
    dense = (fine for fine in RESOLUTIONS if median * (coarsest / fine) ** 2 >= RAYS_PER_TEXEL)
    return max(dense, default=coarsest)


def count_rays(rays: Sequence[Rays], resolution: int) -> Float[Tensor, "6 1 L L"]:
    """How many rays fell on each texel."""
    count = torch.zeros(6, 1, resolution, resolution, device=rays[0].directions.device if rays else None)
    for batch in rays:
        count += scatter_cubemap(torch.ones_like(batch.radiance[:, :1]), batch.directions, resolution)
    return count


def prediction_error(rays: Sequence[Rays], environment: Float[Tensor, "6 3 L L"], scale: float = ERROR_SCALE) -> float:
    """Mean of ‖e‖²/(‖e‖² + s²) over rays, weighted by trust: 0 where a map explains them, 1 where nothing fits
    or there are none.
    """
    summed, weights = 0.0, 0.0
    for batch in rays:
        error = sample_cubemap(environment, batch.directions) - batch.radiance
        weight = batch.initial_weight()
        summed += float((weight * bounded_error(error, scale)).sum())
        weights += float(weight.sum())
    return summed / weights if weights > 0 else 1.0
