"""Time the GPU kernels, and gsplat beside them where it is installed: `python -m tests.benchmarks.bench_gpu`.

The scene is the vase of `bench_rasterize`. First the images and gradients of the Triton kernels are compared with the
CPU's, because a wrong kernel may be as fast as it likes; then the rasterizer is timed alone, in other tile shapes
(`--sweep`), and in whole steps of a fit. `--device cpu` runs the same lines on the CPU, for comparison.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import torch
from torch import Tensor

from panoless.kernels.camera import RasterCamera
from panoless.splats.kernels.rasterize import RasterBuffers, rasterize
from tests.benchmarks.bench_rasterize import CASES, Vase, calibrated_vase, vase_camera
from tests.support.surfel_scenes import IMAGES

SHAPES = ((8, 1, 8), (8, 1, 16), (8, 1, 32), (8, 2, 16), (16, 1, 16), (16, 2, 16), (16, 4, 16))
"""Edge of a tile, warps, surfels between two looks at whether a tile is finished."""
KINDS = ((False, "flat"), (True, "curved"))
BATCHES = 7
BATCH_SECONDS = 0.3


@dataclass(frozen=True)
class Row:
    """One line of the result: medians, wall milliseconds."""

    what: str
    pixels: int
    surfels: int
    forward_ms: float | None
    """None where the forward is not timed alone."""
    step_ms: float


def milliseconds(device: torch.device, work: Callable[[], None]) -> float:
    """Median over batches of the wall time of one call, the device idle before and after each batch."""

    def batch(repeats: int) -> float:
        _wait(device)
        start = time.perf_counter()
        for _ in range(repeats):
            work()
        _wait(device)
        return (time.perf_counter() - start) / repeats

    batch(3)
    repeats = max(1, round(BATCH_SECONDS / batch(3)))
    return 1e3 * statistics.median(batch(repeats) for _ in range(BATCHES))


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def placed(surfels: Vase, device: torch.device) -> Vase:
    """Leaves on a device."""
    return Vase(**{f.name: getattr(surfels, f.name).detach().to(device).requires_grad_() for f in fields(surfels)})


def drawn(surfels: Vase, camera: RasterCamera, curved: bool) -> RasterBuffers:
    """Rasterize with the kernels of the surfels' device."""
    curvatures = surfels.curvatures if curved else None
    return rasterize(
        surfels.means, surfels.quats, surfels.scales, surfels.opacities, surfels.colors, curvatures, camera
    )


def cotangents(camera: RasterCamera, device: torch.device) -> dict[str, Tensor]:
    """Random gradients of all images."""
    generator = torch.Generator().manual_seed(1)
    image = (camera.height, camera.width)
    shapes = {name: (3, *image) if name in IMAGES[:2] else image for name in IMAGES}
    return {name: torch.randn(shape, generator=generator).to(device) for name, shape in shapes.items()}


def pulled(surfels: Vase, camera: RasterCamera, curved: bool, weights: dict[str, Tensor]) -> tuple[Tensor | None, ...]:
    """Gradients of Σ weights · images to all parameters."""
    buffers = drawn(surfels, camera, curved)
    images = [getattr(buffers, name) for name in weights]
    leaves = [getattr(surfels, f.name) for f in fields(surfels)]
    return torch.autograd.grad(images, leaves, list(weights.values()), allow_unused=True)


def disagreement(surfels: Vase, camera: RasterCamera, device: torch.device) -> str:
    """Differences of all images and gradients from the CPU kernels', each over its own largest value: the largest, and
    the share of the numbers that are apart by more than 0.001 of it.

    A fragment may be left out, and a pixel be finished, on one side of a limit or the other. The median depth is left
    out: where transmittances lie within rounding of one half, it jumps.
    """
    results = []
    for place in (torch.device("cpu"), device):
        here = placed(surfels, place)
        weights = cotangents(camera, place)
        del weights["median_depth"]
        buffers = drawn(here, camera, True)
        named = {name: getattr(buffers, name) for name in weights}
        leaves = [f"gradient of {f.name}" for f in fields(surfels)]
        named |= dict(zip(leaves, pulled(here, camera, True, weights), strict=True))
        results.append({name: value.detach().double().cpu() for name, value in named.items() if value is not None})
    apart = {name: (value - results[1][name]).abs() / value.abs().max() for name, value in results[0].items()}
    worst = max(apart, key=lambda name: float(apart[name].max()))
    share = sum(int((each > 1e-3).sum()) for each in apart.values()) / sum(each.numel() for each in apart.values())
    return f"largest relative difference {float(apart[worst].max()):.1e} ({worst}), above 0.001 in {share:.1e} of all"


def time_rasterizer(surfels: Vase, camera: RasterCamera, device: torch.device, curved: bool, what: str) -> Row:
    """Forward alone, and forward with backward from all images to all parameters."""
    here, weights = placed(surfels, device), cotangents(camera, device)
    camera = replace(camera, world_to_camera=camera.world_to_camera.to(device))

    def forward() -> None:
        with torch.no_grad():
            drawn(here, camera, curved)

    def step() -> None:
        pulled(here, camera, curved, weights)

    return Row(what, camera.width, len(here.means), milliseconds(device, forward), milliseconds(device, step))


@dataclass(frozen=True)
class Gsplat:
    """The same surfels, flat, by gsplat's `rasterization_2dgs`: color, depth, normals and distortion.

    It also makes normals of the depth in torch; its median and accumulated depths are those of the surfels' centers.
    """

    leaves: tuple[Tensor, ...]
    images: Callable[[], list[Tensor]]

    @classmethod
    def of(cls, surfels: Vase, camera: RasterCamera, device: torch.device) -> "Gsplat | None":
        """None where it is not installed."""
        try:
            from gsplat import rasterization_2dgs
        except ImportError:
            return None
        here = placed(surfels, device)
        flat = torch.cat([here.scales, torch.ones_like(here.scales[:, :1])], 1).detach().requires_grad_()
        # One camera's colors: with depth it takes them for each camera only.
        leaves = here.means, here.quats, flat, here.opacities, here.colors.detach()[None].requires_grad_()
        intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]], device=device)

        def images() -> list[Tensor]:
            colors, alphas, normals, _, distortion, median, _ = rasterization_2dgs(
                *leaves,
                camera.world_to_camera.to(device)[None].float(),
                intrinsics[None],
                camera.width,
                camera.height,
                near_plane=camera.near,
                far_plane=camera.far,
                packed=False,
                render_mode="RGB+D",
                distloss=True,
            )
            return [colors, alphas, normals, distortion, median]

        return cls(leaves, images)

    def disagreement(self, surfels: Vase, camera: RasterCamera, device: torch.device) -> Tensor:
        """Largest difference of color and alpha from ours in each pixel."""
        with torch.no_grad():
            ours, (colors, alphas, *_) = drawn(placed(surfels, device), camera, False), self.images()
        theirs = torch.cat([colors[0, ..., :3], alphas[0]], 2)
        return (theirs - torch.cat([ours.colors, ours.alpha[None]]).permute(1, 2, 0)).abs().amax(2)

    def time(self, camera: RasterCamera, device: torch.device) -> Row:
        """Forward alone, and forward with backward."""
        weights = [torch.randn_like(image) for image in self.images()]

        def forward() -> None:
            with torch.no_grad():
                self.images()

        def step() -> None:
            torch.autograd.grad(self.images(), self.leaves, weights, allow_unused=True)

        times = milliseconds(device, forward), milliseconds(device, step)
        return Row("gsplat rasterization_2dgs", camera.width, len(self.leaves[0]), *times)


def time_fit(surfels: Vase, camera: RasterCamera, device: torch.device) -> Row:
    """Whole steps of a fit of the default preset on one view: lookup, losses, backward and Adam."""
    from panoless.capture.object_frame import ObjectFrame
    from panoless.capture.views import TrainView, Views
    from panoless.config import FitConfig
    from panoless.splats.mirror import SurfelMirror
    from panoless.splats.model import Surfels
    from panoless.splats.train import SurfelTrainer
    from panoless.splats.training import Training
    from tests.support.surfel_training import Unobserved

    with torch.no_grad():
        picture = drawn(placed(surfels, device), camera, True)
    mask = (picture.alpha > 0.5).float()
    view = TrainView(
        camera=replace(camera, world_to_camera=camera.world_to_camera.to(device)),
        radiance=(picture.colors * mask).clamp(0, 1),
        mask=mask,
        solid=torch.nonzero(mask.flatten())[:, 0],
    )
    here = placed(surfels, device)
    count, config = len(here.means), FitConfig()
    parameters = Surfels(
        means=here.means,
        quats=here.quats,
        log_scales=here.scales.log(),
        opacity_logits=here.opacities.logit(),
        albedo=torch.zeros_like(here.means),
        curvatures=here.curvatures,
        roughness_logits=torch.zeros_like(here.opacities),
    ).detached()
    length = config.environment.resolution
    environment = torch.full((6, 3, length, length), 0.5, device=device)
    training = Training(environment, torch.zeros(6, length, length, device=device))
    views = Views((view,), ObjectFrame(torch.zeros(3).numpy(), 1.0), camera.near)
    trainer = SurfelTrainer(views, SurfelMirror(parameters), training, config, Unobserved())
    warm = round(config.environment.warmup * config.splats.iterations) + 1

    def step() -> None:
        trainer._step(warm)

    return Row("step of a fit", camera.width, count, None, milliseconds(device, step))


def sweep(surfels: Vase, camera: RasterCamera, device: torch.device) -> list[Row]:
    """The rasterizer in other shapes of its tile kernels."""
    from panoless.kernels.gpu import launch

    rows, usual = [], launch.TILES
    try:
        for tile, warps, chunk in SHAPES:
            launch.TILES = launch.TileLaunch(tile, warps, chunk)
            rows.append(time_rasterizer(surfels, camera, device, True, f"tile {tile}, {warps} warps, chunk {chunk}"))
    finally:
        launch.TILES = usual
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Measure every case and print a table; 0 also where there is no GPU to measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--sweep", action="store_true", help="time other tile shapes, too")
    parser.add_argument("--cases", type=int, default=len(CASES), help="how many cases, smallest first")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    options = parser.parse_args(arguments)
    if options.device == "cuda" and not torch.cuda.is_available():
        print(f"Skipped: torch {torch.__version__} sees no GPU. `--device cpu` times the CPU kernels.", file=sys.stderr)
        return 0
    device = torch.device(options.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    print(f"{name}, torch {torch.__version__}")
    print("what                            pixels surfels | forward  | with backward")
    rows: list[Row] = []

    def report(*found: Row) -> None:
        for row in found:
            forward = "       –" if row.forward_ms is None else f"{row.forward_ms:8.3f}"
            rate = f"{1e3 / row.step_ms:8.1f}/s"
            print(
                f"{row.what:32} {row.pixels:4}² {row.surfels:6} | {forward} | {row.step_ms:8.3f} ms {rate}", flush=True
            )
        rows.extend(found)

    for pixels, count in CASES[: options.cases]:
        camera = vase_camera(pixels)
        surfels, _, _ = calibrated_vase(count, camera)
        for curved, what in KINDS:
            report(time_rasterizer(surfels, camera, device, curved, what))
        if device.type == "cuda":
            print(f"GPU and CPU kernels: {disagreement(surfels, camera, device)}", flush=True)
            report(*(sweep(surfels, camera, device) if options.sweep else []))
            if peer := Gsplat.of(surfels, camera, device):
                apart = peer.disagreement(surfels, camera, device)
                print(
                    f"gsplat and ours: largest difference of color or alpha {float(apart.max()):.1e}, above 1/255 in "
                    f"{float((apart > 1 / 255).float().mean()):.2%} of the pixels"
                )
                report(peer.time(camera, device))
        report(time_fit(surfels, camera, device))
    if options.json:
        options.json.write_text(json.dumps({"device": name, "rows": [asdict(row) for row in rows]}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
