"""Time the CPU rasterizer on a synthetic vase: `python -m tests.benchmarks.bench_rasterize --json out.json`.

The vase covers about 40 % of the image, with about twelve surfels that contribute to a covered pixel; every image
receives a gradient and every parameter wants one. A pair is a surfel that is evaluated for a pixel; the number of
instructions in the two loops bounds pairs a second and core, whatever the share of them that contributes.
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from panoless.kernels.camera import RasterCamera
from panoless.splats.kernels.rasterize import rasterize
from tests.benchmarks.lane_counts import count_lanes

CASES = ((200, 5_000), (400, 20_000), (800, 50_000))
PAIRS_PER_COVERED_PIXEL = 12.0
FORWARD_BOUND = 2.7e9
BACKWARD_BOUND = 0.86e9
"""Pairs a second and core that the instruction count of the loops allows at 4 GHz, two vector instructions a cycle."""


@dataclass(frozen=True)
class Vase:
    """Surfels on a surface of revolution."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    curvatures: Tensor


@dataclass(frozen=True)
class Timing:
    """One line of the result; times are wall milliseconds."""

    pixels: int
    surfels: int
    curved: bool
    threads: int
    coverage: float
    pairs_per_covered_pixel: float
    forward_median_ms: float
    forward_min_ms: float
    step_median_ms: float
    step_min_ms: float
    contributing_share: float
    """Of the pairs that are evaluated."""
    contributing_share_without_culling: float
    forward_pairs_per_second_and_core: float
    backward_pairs_per_second_and_core: float
    forward_share_of_bound: float
    backward_share_of_bound: float


def vase(count: int, size: float) -> Vase:
    """Scatter surfels over a bulging body of unit half height, tangent to it but for a little noise; `size` scales
    the radii.
    """
    generator = torch.Generator().manual_seed(0)
    uniform = torch.rand(4, 4 * count, generator=generator)
    height = 2 * uniform[0] - 1
    radius, slope = 0.5 + 0.2 * torch.cos(2.5 * height - 0.8), -0.5 * torch.sin(2.5 * height - 0.8)
    # Accept in proportion to the area of a ring, so that surfels are spread evenly.
    area = radius * (1 + slope**2).sqrt()
    kept = (uniform[1] * area.max() < area).nonzero()[:count, 0]
    height, radius, slope, azimuth = height[kept], radius[kept], slope[kept], 2 * math.pi * uniform[2, kept]
    around, upward = torch.cos(azimuth), torch.sin(azimuth)
    means = torch.stack([radius * around, radius * upward, height], -1)
    normals = torch.nn.functional.normalize(torch.stack([around, upward, -slope], -1), dim=-1)
    spacing = math.sqrt(4 * math.pi * float(area.mean()) / count)
    return Vase(
        means=means,
        quats=toward_normals(normals, 2 * math.pi * uniform[3, kept], generator),
        scales=size * spacing * torch.exp(torch.rand(count, 2, generator=generator) - 0.5),
        opacities=0.5 + 0.49 * torch.rand(count, generator=generator),
        colors=torch.rand(count, 3, generator=generator),
        curvatures=torch.randn(count, 3, generator=generator),
    )


def toward_normals(normals: Tensor, spin: Tensor, generator: torch.Generator) -> Tensor:
    """Quaternions that turn z to the normals, after a spin about z, with noise of a few degrees."""
    x, y, z = normals.unbind(-1)
    bend = torch.stack([1 + z, -y, x, torch.zeros_like(z)], -1)
    bend = torch.nn.functional.normalize(bend, dim=-1)
    cosine, sine = torch.cos(spin / 2), torch.sin(spin / 2)
    w, i, j, _ = bend.unbind(-1)
    quats = torch.stack([w * cosine, i * cosine + j * sine, j * cosine - i * sine, w * sine], -1)
    return quats + 0.05 * torch.randn(quats.shape, generator=generator)


def vase_camera(pixels: int) -> RasterCamera:
    """Four units away, a little above, so that the vase fills about 40 % of the image."""
    elevation, distance = 0.35, 4.0
    back = torch.tensor([math.cos(elevation), 0.0, math.sin(elevation)])
    right = torch.tensor([0.0, 1.0, 0.0])
    matrix = torch.eye(4)
    matrix[:3, :3] = torch.stack([right, torch.linalg.cross(-back, right), -back])
    matrix[2, 3] = distance
    focal = 1.75 * pixels
    return RasterCamera(matrix, focal, focal, pixels / 2, pixels / 2, pixels, pixels)


def coverage_and_pairs(surfels: Vase, camera: RasterCamera) -> tuple[float, float]:
    """Fraction of the image with alpha over one half, and contributing surfels a covered pixel, from a sample of the
    pixels.
    """
    from panoless.splats.kernels.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
    from panoless.splats.kernels.reference import rasterize as reference

    zeros = torch.zeros_like(surfels.means)
    parameters = (surfels.means, surfels.quats, surfels.scales, surfels.opacities, surfels.colors, zeros, zeros[:, :2])
    footprint = reference.sort_by_depth(reference.project(parameters, camera))
    generator = torch.Generator().manual_seed(1)
    size = torch.tensor([camera.width, camera.height])
    sample = (torch.rand(600, 2, generator=generator) * size).floor() + 0.5
    covered = pairs = 0
    for chunk in sample.split(60):
        alpha = footprint.opacities * torch.exp(-0.5 * reference.intersect(footprint, chunk, camera).rho)
        alpha = torch.where(alpha >= ALPHA_MIN, alpha.clamp(max=ALPHA_MAX), torch.zeros_like(alpha))
        alpha = alpha * (torch.cumprod(1 - alpha, -1) >= TRANSMITTANCE_MIN)
        opaque = 1 - torch.prod(1 - alpha, -1) > 0.5
        covered += int(opaque.sum())
        pairs += int((alpha[opaque] > 0).sum())
    return covered / len(sample), pairs / max(covered, 1)


def calibrated_vase(count: int, camera: RasterCamera) -> tuple[Vase, float, float]:
    """The vase whose surfels are as large as the wanted number of pairs requires, with its coverage and pairs."""
    low, high = 0.15, 2.0
    for _ in range(7):
        surfels = vase(count, math.sqrt(low * high))
        coverage, pairs = coverage_and_pairs(surfels, camera)
        low, high = (low, math.sqrt(low * high)) if pairs > PAIRS_PER_COVERED_PIXEL else (math.sqrt(low * high), high)
    return surfels, coverage, pairs


def wall_times(work: Callable[[], tuple[float, float]], repeats: int) -> tuple[list[float], list[float]]:
    """Milliseconds of forward and of forward plus backward, after three warm-up runs."""
    for _ in range(3):
        work()
    forward, step = zip(*(work() for _ in range(repeats)), strict=True)
    return [1e3 * t for t in forward], [1e3 * t for t in step]


def measure(pixels: int, count: int, repeats: int) -> list[Timing]:
    """Time one size, flat and curved."""
    camera = vase_camera(pixels)
    surfels, coverage, pairs = calibrated_vase(count, camera)
    leaves = [tensor.requires_grad_() for tensor in asdict(surfels).values()]
    offsets = torch.zeros(count, 2, requires_grad=True)
    generator = torch.Generator().manual_seed(2)
    color_weight, normal_weight = torch.randn(2, 3, pixels, pixels, generator=generator)
    weights = [color_weight, normal_weight, *torch.randn(4, pixels, pixels, generator=generator)]
    timings = []
    for curved in (False, True):
        wanted = [*leaves[:5], offsets, *([leaves[5]] if curved else [])]

        def work(curved=curved, wanted=wanted) -> tuple[float, float]:
            start = time.perf_counter()
            buffers = rasterize(*leaves[:5], leaves[5] if curved else None, camera, screen_offsets=offsets)
            middle = time.perf_counter()
            images = [
                buffers.colors,
                buffers.normals_camera,
                buffers.accumulated_depth,
                buffers.alpha,
                buffers.median_depth,
                buffers.distortion,
            ]
            torch.autograd.grad(images, wanted, weights)
            return middle - start, time.perf_counter() - start

        forward, step = wall_times(work, repeats)
        counts = count_lanes((*leaves[:5], leaves[5] if curved else None), camera)
        threads = torch.get_num_threads()
        forward_median, step_median = statistics.median(forward), statistics.median(step)
        forward_rate = counts.evaluated / (1e-3 * forward_median * threads)
        backward_rate = counts.evaluated / (1e-3 * (step_median - forward_median) * threads)
        timings.append(
            Timing(
                pixels=pixels,
                surfels=count,
                curved=curved,
                threads=threads,
                coverage=coverage,
                pairs_per_covered_pixel=pairs,
                forward_median_ms=forward_median,
                forward_min_ms=min(forward),
                step_median_ms=step_median,
                step_min_ms=min(step),
                contributing_share=counts.share,
                contributing_share_without_culling=counts.share_without_culling,
                forward_pairs_per_second_and_core=forward_rate,
                backward_pairs_per_second_and_core=backward_rate,
                forward_share_of_bound=forward_rate / FORWARD_BOUND,
                backward_share_of_bound=backward_rate / BACKWARD_BOUND,
            )
        )
    return timings


def main() -> None:
    """Measure every case and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="also write the results here")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=21)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    print(
        "pixels surfels curved | forward median/min ms | forward+backward | G pairs/s/core forward, backward (of bound)"
        " | contributing: culled, not culled | coverage, contributing a pixel"
    )
    timings = []
    for pixels, count in CASES:
        for timing in measure(pixels, count, arguments.repeats):
            timings.append(timing)
            print(
                f"{timing.pixels:6d} {timing.surfels:7d} {timing.curved!s:>6} | "
                f"{timing.forward_median_ms:7.2f} / {timing.forward_min_ms:7.2f} | "
                f"{timing.step_median_ms:7.2f} / {timing.step_min_ms:7.2f} | "
                f"{timing.forward_pairs_per_second_and_core / 1e9:.2f} ({timing.forward_share_of_bound:.2f}), "
                f"{timing.backward_pairs_per_second_and_core / 1e9:.2f} ({timing.backward_share_of_bound:.2f}) | "
                f"{timing.contributing_share:.2f}, {timing.contributing_share_without_culling:.2f} | "
                f"{timing.coverage:.2f}, {timing.pairs_per_covered_pixel:.1f}",
                flush=True,
            )
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(timing) for timing in timings], indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
