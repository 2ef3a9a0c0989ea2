"""Median times of cubemap lookup, depth to normals and SSIM, each forward and backward, kernel against definition.

Run with `python -m tests.benchmarks.bench_image_operators [threads]`. First calls, which may compile, are not timed.
"""

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from panoless.kernels.cubemap import sample_cubemap, scatter_cubemap
from panoless.splats.kernels.image import depth_normals, ssim

NUM_RAYS = 100_000
FACE_SIZE = 128
IMAGE_SIZES = (400, 800)


@dataclass(frozen=True)
class Case:
    """One operator on one input, as a function of the backend."""

    name: str
    run: Callable[[str], object]


def median_ms(function: Callable[[], object], repeats: int) -> float:
    """Median wall time after two unmeasured calls."""
    durations = []
    for repeat in range(repeats + 2):
        start = time.perf_counter()
        function()
        if repeat >= 2:
            durations.append(time.perf_counter() - start)
    return 1e3 * statistics.median(durations)


def cubemap_cases() -> list[Case]:
    """Rays in random directions (the worst for the cache) and as neighboring pixels see them reflected."""
    torch.manual_seed(0)
    cubemap = torch.rand(6, 3, FACE_SIZE, FACE_SIZE, requires_grad=True)
    cotangent = torch.randn(NUM_RAYS, 3)
    index = torch.arange(NUM_RAYS)
    row, column = (index // 316) / 316, (index % 316) / 316
    smooth = torch.stack([torch.sin(6 * column - 3), torch.cos(4 * row - 2), 2 * row * column - 0.9], -1)
    cases = []
    for name, directions in (("random", torch.randn(NUM_RAYS, 3)), ("coherent", smooth)):
        directions.requires_grad_()

        def look_up_and_back(backend, directions=directions):
            values = sample_cubemap(cubemap, directions, backend=backend)
            torch.autograd.grad(values, (cubemap, directions), cotangent)

        def look_up(backend, directions=directions):
            sample_cubemap(cubemap.detach(), directions.detach(), backend=backend)

        def scatter(backend, directions=directions):
            scatter_cubemap(cotangent, directions, FACE_SIZE, backend=backend)

        cases += [
            Case(f"cubemap L={FACE_SIZE}, {NUM_RAYS} {name} rays, forward", look_up),
            Case(f"cubemap L={FACE_SIZE}, {NUM_RAYS} {name} rays, forward and backward", look_up_and_back),
            Case(f"cubemap L={FACE_SIZE}, {NUM_RAYS} {name} rays, scatter", scatter),
        ]
    return cases


def image_cases(size: int) -> list[Case]:
    """Operators on a square image of `size` pixels."""
    torch.manual_seed(0)
    depth = (3 + torch.rand(size, size)).requires_grad_()
    image, target = torch.rand(3, size, size, requires_grad=True), torch.rand(3, size, size)
    cotangent = torch.randn(3, size, size)

    def normals_and_back(backend):
        normals = depth_normals(depth, 1.4 * size, 1.4 * size, size / 2, size / 2, backend=backend)
        torch.autograd.grad(normals, depth, cotangent)

    def similarity_and_back(backend):
        torch.autograd.grad(ssim(image, target, backend=backend), image)

    def similarity(backend):
        ssim(image.detach(), target, backend=backend)

    return [
        Case(f"depth to normals, {size} px, forward and backward", normals_and_back),
        Case(f"SSIM, 3×{size}×{size}, value", similarity),
        Case(f"SSIM, 3×{size}×{size}, value and gradient", similarity_and_back),
    ]


def main() -> None:
    if len(sys.argv) > 1:
        torch.set_num_threads(int(sys.argv[1]))
    print(f"{torch.get_num_threads()} threads, medians in milliseconds")
    print(f"{'operator':<66}{'Numba':>9}{'torch':>9}")
    for case in [*cubemap_cases(), *(case for size in IMAGE_SIZES for case in image_cases(size))]:
        kernel = median_ms(lambda case=case: case.run("cpu"), repeats=25)
        definition = median_ms(lambda case=case: case.run("reference"), repeats=5)
        print(f"{case.name:<66}{kernel:>9.2f}{definition:>9.1f}")


if __name__ == "__main__":
    main()
