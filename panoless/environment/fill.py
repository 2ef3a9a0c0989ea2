"""Directions that no ray met, filled smoothly from those around them."""

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d

from panoless.environment.cubemap import by_face, by_texel, resample
from shinypartial.core.sphere import cube_to_directions, flat_texels

#: A level of L texels a side is relaxed this often over L: the coarse ones, which carry far and cost little, most.
RELAXED_TEXELS = 256
DAMPING = 0.8


def fill_unobserved(values: Float[Tensor, "6 C L L"], weight: Float[Tensor, "6 L L"]) -> Float[Tensor, "6 C L L"]:
    """A harmonic fill of gaps: a texel of weight 0 is the mean of its four neighbors, as far as some sweeps reach.

    Solved from coarse to fine. What is known is averaged to coarser levels (the push of Gortler et al. 1996), and each
    level starts from the coarser one and is relaxed. A texel whose weight w is at least one keeps its value, below that
    it is w of itself and 1 − w of the mean of its neighbors, so nothing leaves the range of what is known.
    """
    confidence = weight.clamp(max=1)[:, None]
    pyramid = [(values * confidence, confidence)]
    while pyramid[-1][0].shape[-1] > 1:
        color, known = (4 * avg_pool2d(level, 2, ceil_mode=True, count_include_pad=False) for level in pyramid[-1])
        scale = 1 / known.clamp(min=1)
        pyramid.append((color * scale, known * scale))
    color, known = pyramid[-1]
    everywhere = color.sum(0, keepdim=True) / known.sum(0, keepdim=True).clamp(min=1e-9)
    filled = color + (1 - known) * everywhere
    for color, known in reversed(pyramid[:-1]):
        filled = _relax(color, known, resample(filled, color.shape[-1]))
    return filled


def _relax(
    color: Float[Tensor, "6 C L L"], known: Float[Tensor, "6 1 L L"], start: Float[Tensor, "6 C L L"]
) -> Float[Tensor, "6 C L L"]:
    """Damped Jacobi sweeps of u = color + (1 − known) · mean of the four neighbors, across edges too."""
    resolution = color.shape[-1]
    gaps = torch.nonzero(known.flatten() < 1)[:, 0]
    if not len(gaps):
        return color
    around = texel_neighbors(resolution).to(gaps.device)[:, gaps]
    free = (1 - known.flatten()[gaps])[:, None]
    fixed = by_texel(color)[gaps]
    texels = by_texel(color + (1 - known) * start)
    for _ in range(math.ceil(RELAXED_TEXELS / resolution)):
        texels[gaps] = torch.lerp(texels[gaps], fixed + free * texels[around].mean(0), DAMPING)
    return by_face(texels, resolution).contiguous()


@lru_cache(maxsize=16)
def texel_neighbors(resolution: int) -> Int[Tensor, "4 P"]:
    """Flat indices of the texels to either side of each along s and t; at a border, of the one straight across."""
    centers = 2 * (np.arange(resolution) + 0.5) / resolution - 1
    face, t, s = np.meshgrid(np.arange(6), centers, centers, indexing="ij")
    beyond = 1 + 1e-6
    neighbors = []
    for shift in np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]) * 2 / resolution:
        shifted = np.clip(np.stack([s, t], -1) + shift, -beyond, beyond)
        neighbors.append(flat_texels(cube_to_directions(face, shifted), resolution).ravel())
    return torch.from_numpy(np.stack(neighbors))
