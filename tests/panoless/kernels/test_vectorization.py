"""The inner loops of the image-space kernels must stay vector code: LLVM gives up silently, at a cost of many times."""

import re

import pytest
from numba import float32, int32, int64, njit

from panoless.kernels.cpu import cubemap
from panoless.kernels.cpu.compilation import VECTORIZED_LOOPS
from panoless.splats.kernels.cpu import image

LINE, ROWS, PLANES = float32[::1], float32[:, ::1], float32[:, :, ::1]
CAMERA = (float32,) * 4
LOOPS = {
    image._products: (LINE, LINE, ROWS),
    image._push_row: (ROWS, int64, int64, int64, int64, int64),
    image._mean_down: (ROWS, int64, int64, LINE, int64),
    image._statistics: (ROWS, float32, int64),
    image._chain: (LINE, LINE, ROWS, LINE),
    image._normals_of_row: (ROWS, *CAMERA, int64, PLANES),
    image._normals_send: (ROWS, *CAMERA, PLANES, int64, PLANES, int64),
    image._normals_gather: (PLANES, int64, LINE),
    # Rays are passed flat: as a matrix, their loop is vectorized too, but for a wrongly guessed row length.
    cubemap.locate: (LINE, int64, int32[::1], LINE, LINE, LINE),
    cubemap._pull_through_projection: (LINE, int64, LINE, LINE, LINE),
}


def vector_operations(function, signature) -> int:
    """How many floating-point operations on whole vectors the optimized code of a function holds."""
    fresh = njit(**{**VECTORIZED_LOOPS, "cache": False})(function)
    fresh.compile(signature)
    code = fresh.inspect_llvm(fresh.signatures[0])
    return len(re.findall(r"= f(?:add|sub|mul|div) [^\n]*<\d+ x float>", code))


@pytest.mark.parametrize("kernel", LOOPS, ids=lambda kernel: kernel.py_func.__name__)
def test_the_loop_is_vectorized(kernel):
    assert vector_operations(kernel.py_func, LOOPS[kernel]) >= 2


def test_a_loop_that_can_not_be_vectorized_is_told_apart():
    def running_product(rows, scale, width):
        for i in range(1, width):
            rows[0, i] = rows[0, i - 1] * scale + rows[1, i] * rows[0, i - 1]

    assert vector_operations(running_product, (ROWS, float32, int64)) == 0
