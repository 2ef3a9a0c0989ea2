"""Time the CPU rasterizer beside other CPU rasterizers: `python -m tests.benchmarks.bench_peers --opensplat FOLDER`.

Every side draws the vase of `bench_rasterize` with the same centers, orientations, sizes, opacities, colors and camera,
and differentiates with respect to all of them, including positions in the image. Runs of all sides alternate, so that
other load on the machine meets each of them; compare ratios first, milliseconds second.

- **panoless**: surfels, ten planes (color, normal, depth, alpha, median depth, distortion), a gradient on each.
- **OpenSplat** (github.com/pierotofy/OpenSplat, AGPL-3.0; measured, never copied): 3D Gaussians a hundred times thinner
  than wide, three planes, a gradient on each. Its own C++ and its own autograd function are compiled unchanged, with
  the flags of its release build and with the tuned ones below. Its projection is torch and uses all threads, its
  blending uses one. Where a surfel has a low-pass disk it adds 0.3 square pixels to each footprint's covariance; its
  Gaussians are made so much smaller that a footprint seen from the front has the surfel's size.
- **the definition**: `panoless/splats/kernels/reference`, plain torch and dense, on the smallest picture only.

A pair is a splat that contributes to a pixel, counted in pixels with alpha over one half: all of them for OpenSplat, a
sample of 600 pixels of the picture for panoless.
"""

import functools
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType

import torch
import tyro
from torch import Tensor

from panoless.kernels.backend import Backend
from panoless.kernels.camera import RasterCamera
from panoless.splats.kernels.rasterize import RasterBuffers, rasterize
from shinypartial.core.errors import InputError
from shinypartial.io.files import write_json
from tests.benchmarks.bench_rasterize import CASES, Vase, calibrated_vase, vase_camera

REPOSITORY = Path(__file__).resolve().parents[2]
BUILD_FOLDER = REPOSITORY / "build" / "peers"
DENSE_CASE = (48, 300)
"""Pixels and splats that the definition, which evaluates every splat at every pixel, can afford."""
THICKNESS = 0.01
"""Third standard deviation of a Gaussian as a fraction of its smaller tangential one."""
OPENSPLAT_BLUR = 0.3
"""Square pixels that OpenSplat adds to the covariance of every footprint."""
OPENSPLAT_FLAGS = {
    "release": ["-O3", "-DNDEBUG"],  # What CMake's build type Release adds, OpenSplat's default.
    "tuned": ["-O3", "-DNDEBUG", "-march=native"],
}
OPENSPLAT_SOURCES = ("rasterizer/gsplat-cpu/gsplat_cpu.cpp", "project_gaussians.cpp", "rasterize_gaussians.cpp")
HOW_TO_GET_OPENSPLAT = (
    "To compare with OpenSplat: git clone https://github.com/pierotofy/OpenSplat build/peers/OpenSplat, then add "
    "--opensplat build/peers/OpenSplat. A C++ compiler and ninja are needed; compiling takes minutes, once."
)
BINDING = """
#include <torch/extension.h>
#include "project_gaussians.hpp"
#include "rasterize_gaussians.hpp"

using torch::Tensor;

std::vector<Tensor> project(Tensor means, Tensor scales, Tensor quats, Tensor view, Tensor full,
                            std::array<double, 4> intrinsics, int height, int width) {
    return ProjectGaussiansCPU::apply(means, scales, 1, quats, view, full, intrinsics[0], intrinsics[1], intrinsics[2],
                                      intrinsics[3], height, width);
}

Tensor rasterize(Tensor centers, Tensor radii, Tensor conics, Tensor colors, Tensor opacities, Tensor covariances,
                 Tensor depths, int height, int width, Tensor background) {
    return RasterizeGaussiansCPU::apply(centers, radii, conics, colors, opacities, covariances, depths, height, width,
                                        background);
}

std::vector<Tensor> count(Tensor centers, Tensor, Tensor conics, Tensor colors, Tensor opacities,
                          Tensor covariances, Tensor depths, int height, int width, Tensor background) {
    auto [image, transmittance, lists] = rasterize_forward_tensor_cpu(width, height, centers, conics, colors, opacities,
                                                                      background, covariances, depths);
    Tensor counts = torch::empty({height, width}, torch::kInt32);
    for (int pixel = 0; pixel < height * width; pixel++) counts.data_ptr<int>()[pixel] = lists[pixel].size();
    delete[] lists;
    return {image, transmittance, counts};
}

PYBIND11_MODULE(TORCH_EXTENSION_NAME, module) {
    module.def("project", &project);
    module.def("rasterize", &rasterize);
    module.def("count", &count);
}
"""


@dataclass(frozen=True)
class Options:
    """Compare CPU rasterizers in one run."""

    opensplat: Path | None = None
    """Checkout of github.com/pierotofy/OpenSplat."""
    json: Path | None = None
    """Also write the results here."""
    threads: int = 2
    """Threads that every side may use."""
    repeats: int = 51
    """Timed runs of each side on each picture."""
    largest: int = 800
    """Leave out pictures with more pixels a side than this."""


@dataclass(frozen=True)
class Side:
    """One rasterizer with its scene: what is timed, and what the scene amounts to on this side."""

    name: str
    forward: Callable[[], list[Tensor]]
    """Differentiable images."""
    parameters: list[Tensor]
    cotangents: list[Tensor]
    colors: Tensor
    """H W 3."""
    coverage: float
    pairs_per_covered_pixel: float


@dataclass(frozen=True)
class Duration:
    """Seconds of one run; a step is forward and backward."""

    forward_wall: float
    step_wall: float
    step_cpu: float


@dataclass(frozen=True)
class Timing:
    """One line of the result. CPU time is added up over threads."""

    pixels: int
    splats: int
    side: str
    forward_median_ms: float
    forward_min_ms: float
    step_median_ms: float
    step_min_ms: float
    step_cpu_median_ms: float
    step_cpu_ns_per_pair: float
    coverage: float
    pairs_per_covered_pixel: float
    mean_color_difference: float
    """Mean absolute difference from panoless's colors, which lie in [0, 1], over the whole picture."""


def panoless_side(name: str, backend: Backend, splats: Vase, camera: RasterCamera, pairs: float) -> Side:
    """Flat surfels, every image wanted."""
    tensors = (splats.means, splats.quats, splats.scales, splats.opacities, splats.colors)
    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    means, quats, scales, opacities, colors = leaves
    offsets = torch.zeros(len(means), 2, requires_grad=True)

    def draw() -> RasterBuffers:
        return rasterize(means, quats, scales, opacities, colors, None, camera, screen_offsets=offsets, backend=backend)

    def forward() -> list[Tensor]:
        buffers = draw()
        return [
            buffers.colors,
            buffers.normals_camera,
            buffers.accumulated_depth,
            buffers.alpha,
            buffers.median_depth,
            buffers.distortion,
        ]

    with torch.no_grad():
        buffers = draw()
    return Side(
        name=name,
        forward=forward,
        parameters=[*leaves, offsets],
        cotangents=cotangents_of(forward()),
        colors=buffers.colors.permute(1, 2, 0),
        coverage=float((buffers.alpha > 0.5).float().mean()),
        pairs_per_covered_pixel=pairs,
    )


def opensplat_side(build: str, extension: ModuleType, splats: Vase, camera: RasterCamera) -> Side:
    """Thin Gaussians, through the autograd function that OpenSplat trains with."""
    tensors = (splats.means, gaussian_scales(splats, camera), splats.quats, splats.opacities[:, None], splats.colors)
    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    means, scales, quats, opacities, colors = leaves
    view, background = camera.world_to_camera, torch.zeros(3)
    full = perspective(camera) @ view
    intrinsics, size = [camera.fx, camera.fy, camera.cx, camera.cy], (camera.height, camera.width)

    def project() -> list[Tensor]:
        centers, radii, conics, covariances, depths = extension.project(
            means, scales, quats, view, full, intrinsics, *size
        )
        # OpenSplat sorts by these depths as if they were contiguous. They come as a column of a matrix, so that its
        # own order is not that of the depths, and its picture is another one.
        return [centers, radii, conics, colors, opacities, covariances, depths.contiguous()]

    with torch.no_grad():
        image, transmittance, counts = extension.count(*project(), *size, background)
    covered = transmittance < 0.5
    return Side(
        name=f"OpenSplat, {build}",
        forward=lambda: [extension.rasterize(*project(), *size, background)],
        parameters=leaves,
        cotangents=cotangents_of([image]),
        colors=image,
        coverage=float(covered.float().mean()),
        pairs_per_covered_pixel=float(counts[covered].float().mean()),
    )


def gaussian_scales(splats: Vase, camera: RasterCamera) -> Tensor:
    """K 3: the surfels' scales less what OpenSplat's blur adds to a footprint seen from the front, and a thickness."""
    depths = splats.means @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    blur = OPENSPLAT_BLUR * (depths[:, None] / camera.fx) ** 2
    tangential = torch.maximum((splats.scales**2 - blur).clamp(min=0).sqrt(), 1e-2 * splats.scales)
    return torch.cat([tangential, THICKNESS * tangential.amin(-1, keepdim=True)], -1)


def perspective(camera: RasterCamera) -> Tensor:
    """From camera to clip coordinates, +z forward, for a principal point at the center of the image."""
    near, far = camera.near, camera.far
    matrix = torch.zeros(4, 4)
    matrix[0, 0], matrix[1, 1] = 2 * camera.fx / camera.width, 2 * camera.fy / camera.height
    matrix[2, 2], matrix[2, 3], matrix[3, 2] = far / (far - near), -far * near / (far - near), 1
    return matrix


def cotangents_of(images: list[Tensor]) -> list[Tensor]:
    """Normal numbers in the images' shapes."""
    generator = torch.Generator().manual_seed(2)
    return [torch.randn(image.shape, generator=generator) for image in images]


@functools.cache
def load_opensplat(checkout: Path, build: str) -> ModuleType:
    """Compile OpenSplat's CPU rasterizer behind the binding, or take what is compiled already."""
    from torch.utils import cpp_extension

    if not (checkout / OPENSPLAT_SOURCES[0]).is_file():
        raise InputError(
            expected=f"a checkout of OpenSplat with {OPENSPLAT_SOURCES[0]}",
            found=f"no such file in {checkout}",
            remedy=HOW_TO_GET_OPENSPLAT,
        )
    folder = BUILD_FOLDER / f"opensplat-{build}"
    folder.mkdir(parents=True, exist_ok=True)
    binding = folder / "binding.cpp"
    if not binding.is_file() or binding.read_text(encoding="utf-8") != BINDING:
        binding.write_text(BINDING, encoding="utf-8")
    return cpp_extension.load(
        name=f"opensplat_{build}",
        sources=[str(binding), *(str(checkout / source) for source in OPENSPLAT_SOURCES)],
        extra_include_paths=[str(checkout), str(checkout / "rasterizer")],
        extra_cflags=OPENSPLAT_FLAGS[build],
        build_directory=str(folder),
    )


def timed(side: Side) -> Duration:
    """Run forward and backward once."""
    cpu, start = time.process_time(), time.perf_counter()
    images = side.forward()
    middle = time.perf_counter()
    torch.autograd.grad(images, side.parameters, side.cotangents)
    return Duration(middle - start, time.perf_counter() - start, time.process_time() - cpu)


def compare(sides: list[Side], pixels: int, splats: int, repeats: int) -> list[Timing]:
    """Time all sides in turn, after three rounds that are not counted; the first side's colors are the standard."""
    rounds = [[timed(side) for side in sides] for _ in range(repeats + 3)][3:]
    timings = []
    for side, durations in zip(sides, zip(*rounds, strict=True), strict=True):
        forward = [1e3 * duration.forward_wall for duration in durations]
        step = [1e3 * duration.step_wall for duration in durations]
        cpu = 1e3 * statistics.median(duration.step_cpu for duration in durations)
        timings.append(
            Timing(
                pixels=pixels,
                splats=splats,
                side=side.name,
                forward_median_ms=statistics.median(forward),
                forward_min_ms=min(forward),
                step_median_ms=statistics.median(step),
                step_min_ms=min(step),
                step_cpu_median_ms=cpu,
                step_cpu_ns_per_pair=1e6 * cpu / (side.coverage * pixels**2 * side.pairs_per_covered_pixel),
                coverage=side.coverage,
                pairs_per_covered_pixel=side.pairs_per_covered_pixel,
                mean_color_difference=float((side.colors - sides[0].colors).abs().mean()),
            )
        )
    return timings


def sides_of(pixels: int, count: int, opensplat: Path | None) -> list[Side]:
    """Everything that can draw this many pixels and splats, panoless first."""
    camera = vase_camera(pixels)
    splats, _, pairs = calibrated_vase(count, camera)
    sides = [panoless_side("panoless", "cpu", splats, camera, pairs)]
    if opensplat:
        for build in OPENSPLAT_FLAGS:
            sides.append(opensplat_side(build, load_opensplat(opensplat, build), splats, camera))
    if (pixels, count) == DENSE_CASE:
        sides.append(panoless_side("the definition", "reference", splats, camera, pairs))
    return sides


def commit_of(folder: Path) -> str:
    """What git calls the checkout, with `-dirty` where files differ from the commit."""
    if not (folder / ".git").exists():  # Git would answer for a repository further up.
        return "not a git checkout"
    command = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty"]
    described = subprocess.run(command, capture_output=True, text=True, check=False)
    return described.stdout.strip() or "unknown"


def compiler_flags(build: str) -> str:
    """The flags that the compiler was given, from ninja's file, without folders and definitions for Python."""
    lines = (BUILD_FOLDER / f"opensplat-{build}" / "build.ninja").read_text(encoding="utf-8").splitlines()
    flags = next(line for line in lines if line.startswith("cflags =")).split()[2:]
    return " ".join(flag for flag in flags if flag.startswith(("-O", "-m", "-f", "-std", "-DNDEBUG")))


def cpu_model() -> str:
    """The processor's name."""
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()


def circumstances(options: Options, load_before: list[float]) -> dict[str, object]:
    """What a reader needs to judge the times."""
    facts: dict[str, object] = {
        "date": datetime.now(UTC).date().isoformat(),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load_average_before": load_before,
        "load_average_after": list(os.getloadavg()),
        "omp_wait_policy": os.environ.get("OMP_WAIT_POLICY", "not set"),
        "repeats": options.repeats,
        "torch": torch.__version__,
        "panoless_commit": commit_of(REPOSITORY),
    }
    if options.opensplat:
        facts["opensplat_commit"] = commit_of(options.opensplat)
        facts["opensplat_flags"] = {build: compiler_flags(build) for build in OPENSPLAT_FLAGS}
    return facts


def main() -> None:
    """Compare on every picture and print a line for each side."""
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(options.threads)
    if options.opensplat is None:
        print(HOW_TO_GET_OPENSPLAT)
    load_before = list(os.getloadavg())
    print(
        "pixels splats               side | forward median/min ms |     with backward | CPU ms |  covered, pairs | diff"
    )
    timings = []
    for pixels, count in [DENSE_CASE, *(case for case in CASES if case[0] <= options.largest)]:
        for timing in compare(sides_of(pixels, count, options.opensplat), pixels, count, options.repeats):
            timings.append(timing)
            print(
                f"{timing.pixels:6d} {timing.splats:6d} {timing.side:>18} | "
                f"{timing.forward_median_ms:9.2f} / {timing.forward_min_ms:9.2f} | "
                f"{timing.step_median_ms:7.2f} / {timing.step_min_ms:7.2f} | {timing.step_cpu_median_ms:6.1f} | "
                f"{timing.coverage:8.3f}, {timing.pairs_per_covered_pixel:5.2f} | {timing.mean_color_difference:.4f}",
                flush=True,
            )
    facts = circumstances(options, load_before)
    print(*(f"{name}: {value}" for name, value in facts.items()), sep="\n")
    if options.json:
        write_json(options.json, {"circumstances": facts, "timings": [asdict(timing) for timing in timings]})


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        raise SystemExit(str(error)) from None
