"""The environment as the shading kernel reads it, and its gradient as it comes back: faces with a ring of neighbors.

Channels are whole images here, each with its padded faces one after another, so that rows are copied as they are. What
the ring shows is in a table of (padded texel, texel, weight), which makes both directions one short loop.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit

from panoless.kernels.cpu.compilation import VECTORIZED_LOOPS
from panoless.kernels.cpu.simd_memory import fetch_add
from panoless.kernels.reference.cubemap import cubemap_padding

CHANNELS = 3
LINES_PER_CLAIM = 32
f32 = np.float32


class Ring(NamedTuple):
    """`places` are flat indices of padded texels, `texels` those of the texel's first channel in (6, 3, L, L)."""

    places: Int[np.ndarray, "N"]
    texels: Int[np.ndarray, "N"]
    weights: Float[np.ndarray, "N"]


@lru_cache(maxsize=8)
def ring_of(resolution: int) -> Ring:
    """What the texels around the faces show: the texel across the edge, or at a corner the mean of three."""
    padding = cubemap_padding(resolution, torch.device("cpu"))
    sources, corners = padding.sources.numpy(), padding.corners.numpy()
    on_ring = np.ones(sources.shape, dtype=bool)
    on_ring[:, 1:-1, 1:-1] = False
    places, area = np.flatnonzero(on_ring), resolution**2
    shown = sources.reshape(-1)[places]
    at_corner = shown >= 6 * area
    texels = np.concatenate([shown[~at_corner], corners[shown[at_corner] - 6 * area].reshape(-1)])
    weights = np.concatenate([np.ones((~at_corner).sum()), np.full(3 * at_corner.sum(), 1 / 3)])
    places = np.concatenate([places[~at_corner], np.repeat(places[at_corner], 3)])
    first_channel = texels // area * CHANNELS * area + texels % area
    return Ring(places, first_channel, weights.astype(np.float32))


@njit(**VECTORIZED_LOOPS)
def spread_faces(counter, cubemap, texture):
    """Copy (6, 3, L, L) into the inner part of (3, 6, L + 2, L + 2); the ring becomes zero."""
    resolution = cubemap.shape[3]
    lines = 6 * (resolution + 2)
    while True:
        begin = fetch_add(counter, LINES_PER_CLAIM)
        if begin >= CHANNELS * lines:
            return
        for line in range(begin, min(begin + LINES_PER_CLAIM, CHANNELS * lines)):
            channel, face, row = line // lines, line % lines // (resolution + 2), line % (resolution + 2)
            out = texture[channel, face, row]
            if row == 0 or row == resolution + 1:
                out[:] = f32(0)
                continue
            texels = cubemap[face, channel, row - 1]
            out[0] = f32(0)
            out[resolution + 1] = f32(0)
            for i in range(resolution):
                out[i + 1] = texels[i]


@njit(**VECTORIZED_LOOPS)
def show_ring(cubemap, ring, area, texture):
    """Add to the ring of `texture`, (3, padded texels), what it shows of the flat cubemap."""
    for i in range(ring.places.size):
        for channel in range(CHANNELS):
            texture[channel, ring.places[i]] += ring.weights[i] * cubemap[ring.texels[i] + channel * area]


@njit(**VECTORIZED_LOOPS)
def collect_faces(counter, faces, cubemap):
    """Copy the inner part of (6, L + 2, L + 2, 4) to (6, 3, L, L)."""
    resolution = cubemap.shape[3]
    while True:
        begin = fetch_add(counter, LINES_PER_CLAIM)
        if begin >= 6 * resolution:
            return
        for line in range(begin, min(begin + LINES_PER_CLAIM, 6 * resolution)):
            face, row = line // resolution, line % resolution
            texels = faces[face, row + 1].reshape(-1)
            for channel in range(CHANNELS):
                out = cubemap[face, channel, row]
                for i in range(resolution):
                    out[i] = texels[4 * i + 4 + channel]


@njit(**VECTORIZED_LOOPS)
def fold_ring(faces, ring, area, cubemap):
    """Add what lies in the ring of `faces`, (padded texels, 4), to the texels of the flat cubemap that it shows."""
    for i in range(ring.places.size):
        for channel in range(CHANNELS):
            cubemap[ring.texels[i] + channel * area] += ring.weights[i] * faces[ring.places[i], channel]
