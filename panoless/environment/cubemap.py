"""The cubemap: its start, look-up and resampling."""

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.config import EnvironmentConfig
from panoless.kernels.cubemap import cubemap_directions, sample_cubemap

GRAY = 0.5
"""Radiance of the first map."""
NOISE = 5.0
"""Half the width of the uniform noise on its logits."""
LEAST_GRAY = 1e-6
"""Of a map that starts through the sigmoid, so that its logits are finite."""


def initial_environment(
    config: EnvironmentConfig, generator: torch.Generator, gray: float = GRAY, noise: float = NOISE
) -> Float[Tensor, "6 3 L L"]:
    """Gray radiance for `clamp`; its logits and noise for `sigmoid`."""
    shape = (6, 3, config.resolution, config.resolution)
    if config.activation == "sigmoid":
        middle = torch.logit(torch.tensor(gray), eps=LEAST_GRAY)
        return (torch.rand(shape, generator=generator) * 2 - 1) * noise + middle
    return torch.full(shape, gray)


def look_up(
    environment: Float[Tensor, "6 3 L L"], directions: Float[Tensor, "P 3"], activation: str
) -> Float[Tensor, "P 3"]:
    """Specular radiance: σ(E(ω)) for `sigmoid` (Eq. 7), E(ω) for `clamp`; bilinear and seamless."""
    value = sample_cubemap(environment, directions)
    return torch.sigmoid(value) if activation == "sigmoid" else value


def resample(environment: Float[Tensor, "6 C L L"], resolution: int) -> Float[Tensor, "6 C M M"]:
    """The map at the texel centers of another resolution, bilinear and seamless."""
    directions = cubemap_directions(resolution, dtype=environment.dtype, device=environment.device).reshape(-1, 3)
    sampled = sample_cubemap(environment, directions)
    return by_face(sampled, resolution).contiguous()


def by_texel(image: Float[Tensor, "6 C L L"]) -> Float[Tensor, "T C"]:
    """The texels of all faces, row after row."""
    return image.movedim(1, -1).reshape(-1, image.shape[1])


def by_face(texels: Float[Tensor, "T C"], resolution: int) -> Float[Tensor, "6 C L L"]:
    """The image whose texels these are, the inverse of `by_texel`."""
    return texels.reshape(6, resolution, resolution, -1).movedim(-1, 1)
