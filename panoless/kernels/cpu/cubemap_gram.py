"""The matrix AᵀWA of cubemap lookups in Numba: five numbers a padded texel, and its product with a cubemap.

Fixed shares of the rays add to buffers of their own, which are summed in a fixed order, as those of `cubemap` are. The
product reads padded faces as one long row: what would join the end of a line to the next one is zero.
"""

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from panoless.kernels.cpu.compilation import VECTORIZED_LOOPS
from panoless.kernels.cpu.cubemap import (
    LINES_PER_CLAIM,
    RAYS_PER_BLOCK,
    TOGETHER,
    flat,
    folded,
    locate,
    padded_texture,
    useful_shares,
)
from panoless.kernels.cpu.simd_memory import fetch_add
from panoless.kernels.cpu.workers import run_shared

NUMBERS = 5


def lookup_gram(
    directions: Float[Tensor, "P 3"], weights: Float[Tensor, "P"], resolution: int
) -> Float[Tensor, "6 padded padded 5"]:
    """Definition of `panoless.kernels.cubemap.lookup_gram`."""
    shares = useful_shares(len(directions), resolution)
    buffers = np.empty((shares, 6, resolution + 2, resolution + 2, NUMBERS), np.float32)
    run_shared(_gather, flat(directions), flat(weights), buffers.reshape(shares, -1), resolution)
    return torch.from_numpy(buffers[0] if shares == 1 else buffers.sum(0))


def apply_gram(gram: Float[Tensor, "6 padded padded 5"], cubemap: Float[Tensor, "6 C L L"]) -> Float[Tensor, "6 C L L"]:
    """Definition of `panoless.kernels.cubemap.apply_gram`."""
    texture = padded_texture(cubemap).numpy()
    result = np.empty((1, *texture.shape), np.float32)
    groups, stride = len(texture), texture.shape[2]
    run_shared(_apply, flat(gram), texture.reshape(groups, -1), result.reshape(groups, -1), stride)
    return folded(result, cubemap.shape[1])


@njit(**VECTORIZED_LOOPS)
def _gather(counter, directions, weights, buffers, resolution):
    """Clear each buffer and add its share of the rays to it."""
    count, line = len(weights), NUMBERS * (resolution + 2)
    cells, places = np.empty(RAYS_PER_BLOCK, np.int32), np.empty((3, RAYS_PER_BLOCK), np.float32)
    while True:
        task = fetch_add(counter, 1)
        if task >= len(buffers):
            return
        gram = buffers[task]
        gram[:] = np.float32(0)
        last = (task + 1) * count // len(buffers)
        for begin in range(task * count // len(buffers), last, RAYS_PER_BLOCK):
            end = min(begin + RAYS_PER_BLOCK, last)
            locate(directions[3 * begin : 3 * end], resolution, cells, places[0], places[1], places[2])
            for i in range(end - begin):
                right, down = places[0, i], places[1, i]
                left, up = places[2, i] - right, places[2, i] - down
                weight, cell = weights[begin + i], NUMBERS * np.int64(cells[i])
                below, across = cell + line, left * right
                gram[cell] += weight * up * up * left * left
                gram[cell + 1] += weight * up * up * across
                gram[cell + 2] += weight * up * down * left * left
                gram[cell + 3] += weight * up * down * across
                gram[cell + NUMBERS] += weight * up * up * right * right
                gram[cell + NUMBERS + 2] += weight * up * down * right * right
                gram[cell + NUMBERS + 4] += weight * up * down * across
                gram[below] += weight * down * down * left * left
                gram[below + 1] += weight * down * down * across
                gram[below + NUMBERS] += weight * down * down * right * right


@njit(**VECTORIZED_LOOPS)
def _apply(counter, gram, texture, result, stride):
    """Lines of padded texels, each a sum over itself and its eight neighbors."""
    lines = len(texture) * 6 * stride
    while True:
        first = fetch_add(counter, LINES_PER_CLAIM)
        if first >= lines:
            return
        for line in range(first, min(first + LINES_PER_CLAIM, lines)):
            group, begin = line // (6 * stride), line % (6 * stride) * stride
            _apply_line(gram, texture[group], result[group], begin, stride)


@njit(**VECTORIZED_LOOPS)
def _apply_line(gram, texels, result, begin, stride):
    """One line; before the first texel comes the last."""
    count = gram.size // NUMBERS
    for i in range(begin, begin + stride):
        out = result[TOGETHER * i : TOGETHER * (i + 1)]
        for lane in range(TOGETHER):
            out[lane] = gram[NUMBERS * i] * texels[TOGETHER * i + lane]
        for neighbor, step in ((1, 1), (2, stride), (3, stride + 1), (4, stride - 1)):
            after = i + step if i + step < count else i + step - count
            before = i - step if i >= step else i - step + count
            to_after, to_before = gram[NUMBERS * i + neighbor], gram[NUMBERS * before + neighbor]
            for lane in range(TOGETHER):
                out[lane] += to_after * texels[TOGETHER * after + lane]
                out[lane] += to_before * texels[TOGETHER * before + lane]
