"""One step of Adam in plain torch."""

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from panoless.splats.kernels.adam import AdamTensor


def adam_step_reference(tensor: "AdamTensor", betas: tuple[float, float], epsilon: float) -> None:
    """See `panoless.splats.kernels.adam.adam_step`, for one tensor, in place."""
    tensor.mean.lerp_(tensor.gradient, 1 - betas[0])
    tensor.square.mul_(betas[1]).addcmul_(tensor.gradient, tensor.gradient, value=1 - betas[1])
    spread = (tensor.square / (1 - betas[1] ** tensor.steps)).sqrt() + epsilon
    tensor.parameter.addcdiv_(tensor.mean, spread, value=-tensor.rate / (1 - betas[0] ** tensor.steps))
    if tensor.bounds != (-math.inf, math.inf):
        tensor.parameter.clamp_(*tensor.bounds)
