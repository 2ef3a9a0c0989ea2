"""Adam in Numba: one pass over memory, and one hand-out of work for all tensors."""

import math

import numpy as np
from numba import njit

from panoless.kernels.cpu.compilation import VECTORIZED_LOOPS
from panoless.kernels.cpu.simd_memory import fetch_add
from panoless.kernels.cpu.workers import run_shared

NUMBERS_PER_CLAIM = 1 << 14
TENSORS = 8
"""Tensors are filled up with empty ones to a multiple of this, because each number of them is compiled again."""
f32 = np.float32


def adam_step_cpu(tensors, betas, epsilon) -> None:
    """See `panoless.splats.kernels.adam.adam_step`; float32 and contiguous."""
    arrays = tuple(
        (_flat(each.parameter), _flat(each.gradient), _flat(each.mean), _flat(each.square)) for each in tensors
    )
    nothing = np.zeros(0, f32)
    arrays += ((nothing,) * 4,) * (-len(arrays) % TENSORS)
    numbers = np.array(
        [
            (
                each.rate / (1 - betas[0] ** each.steps),
                1 / math.sqrt(1 - betas[1] ** each.steps),
                epsilon,
                *each.bounds,
            )
            for each in tensors
        ],
        f32,
    )
    decays = np.array([1 - betas[0], 1 - betas[1]], f32)
    run_shared(_adam, arrays, numbers, decays)


def _flat(tensor):
    return tensor.detach().numpy().reshape(-1)


@njit(**VECTORIZED_LOOPS)
def _adam(counter, arrays, numbers, decays):
    while True:
        claim = fetch_add(counter, 1)
        # Tensors one after another, each in as many claims as it needs.
        which = 0
        while which < len(arrays):
            claims = (arrays[which][0].size + NUMBERS_PER_CLAIM - 1) // NUMBERS_PER_CLAIM
            if claim < claims:
                break
            claim -= claims
            which += 1
        if which == len(arrays):
            return
        parameter, gradient, mean, square = arrays[which]
        begin = claim * NUMBERS_PER_CLAIM
        part = slice(begin, min(begin + NUMBERS_PER_CLAIM, parameter.size))
        _move(parameter[part], gradient[part], mean[part], square[part], numbers[which], decays)


@njit(**VECTORIZED_LOOPS)
def _move(parameter, gradient, mean, square, numbers, decays):
    rate, correction, epsilon = numbers[0], numbers[1], numbers[2]
    low, high = numbers[3], numbers[4]
    first, second = decays[0], decays[1]
    for i in range(parameter.size):
        g = gradient[i]
        m = mean[i] + first * (g - mean[i])
        v = square[i] + second * (g * g - square[i])
        mean[i] = m
        square[i] = v
        moved = parameter[i] - rate * m / (f32(math.sqrt(v)) * correction + epsilon)
        # Comparisons that let a value pass that is not a number.
        moved = low if moved < low else moved
        parameter[i] = high if moved > high else moved
