"""Time rendering against Blender's own settings: `python -m tests.benchmarks.bench_render --json out.json`.

Equal error: the root mean square of linear light clipped to [0, 1] over the object, each side against path tracing
with 1,024 samples of its own pixel filter. With two references A and B of different seeds, the mean of (x − A)(x − B)
has no share of their noise. The fewest samples of ours that come out no worse than 128 of Blender's are timed:
Blender's side without reading its file, ours from the camera to the arrays of a view. Times of the two alternate, so
that other load on the machine meets both; compare ratios, not seconds.
"""

import argparse
import json
import os
import statistics
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from shinypartial.blender.passes import ALPHA_CHANNEL, COLOR_CHANNELS, PASSES, read_passes, stacked
from shinypartial.blender.region import Region, image_region, set_border
from shinypartial.blender.render import RenderedView, Renderer, open_renderer
from shinypartial.blender.runtime import quiet
from shinypartial.blender.sparse_pixels import SPARSE
from shinypartial.blender.worker_pool import PoolPlan, open_pool
from shinypartial.core.camera import Camera, opencv_to_opengl
from shinypartial.core.trajectory import plan_cameras
from shinypartial.scene import SceneSpec, load_scene, override, scene_names

PLAIN_SAMPLES = 128
REFERENCE_SAMPLES = 1024
OUR_SAMPLES = (16, 32, 48, 64, 96, 128, 192, 256)
REFERENCE_SEEDS = 77, 78
SEEDS = 0, 1
REPEATS = 3


@dataclass(frozen=True)
class Settings:
    """A side's path tracing of the whole view; ours crops it, and Blender's where only its pixels matter."""

    samples: int
    plain: bool
    seed: int = 0
    cropped: bool = False


@dataclass(frozen=True)
class Errors:
    """Root mean squares over views and seeds; noise is that of one reference."""

    plain: float
    ours: dict[int, float]
    plain_reference_noise: float
    our_reference_noise: float


@dataclass(frozen=True)
class SceneResult:
    """One scene; times are seconds a frame, medians.

    Where even the most samples of ours come out worse, these are timed, and the speed-up is none at equal error.
    """

    scene: str
    is_mirror: bool
    resolution: int
    error_resolution: int
    views: int
    covered: float
    errors: Errors
    our_samples: int
    equal_error_reached: bool
    plain_s: float
    ours_s: float
    speedup: float
    speedup_spread: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class PoolResult:
    """Frames a second of one division of the cores, relative to one process with all threads."""

    workers: int
    threads: int
    resolution: int
    frames: int
    median_s: float
    speedup_over_one_worker: float


@dataclass(frozen=True)
class MemoryResult:
    """Largest resident memory in MiB of the rendering process, after each tenth of the frames, and of the parent."""

    frames: int
    frames_per_worker: int
    workers_started: int
    worker_mib: list[float]
    parent_mib: list[float]


def apply(renderer: Renderer, camera: Camera, settings: Settings) -> None:
    """Set everything up for path tracing one view."""
    scene = renderer.bpy.context.scene
    cycles, world = scene.cycles, scene.world.cycles
    cycles.samples, cycles.seed = settings.samples, settings.seed
    cycles.pixel_filter_type = "BLACKMAN_HARRIS" if settings.plain else "BOX"
    cycles.filter_width = 1.5 if settings.plain else 1.0
    world.sampling_method = "AUTOMATIC" if settings.plain else "MANUAL"
    whole = settings.plain and not settings.cropped
    region = image_region(camera, renderer.body_vertices_world)
    set_border(scene, Region(0, 0, camera.width, camera.height) if whole else region, camera)
    scene.camera.matrix_world = opencv_to_opengl(camera.camera_to_world).T.tolist()
    scene.render.filepath = str(renderer.scratch / "timed.exr")


def render(renderer: Renderer, camera: Camera, settings: Settings) -> float:
    """Seconds to path trace and write one view."""
    apply(renderer, camera, settings)
    begin = time.perf_counter()
    with quiet():
        renderer.bpy.ops.render.render(write_still=True)
    return time.perf_counter() - begin


def render_ours(renderer: Renderer, camera: Camera, samples: int, seed: int = 0) -> tuple[float, RenderedView]:
    """Seconds from the camera to the view as a dataset's frames are made, and the view."""
    apply(renderer, camera, Settings(samples, False, seed))
    if renderer.mirror:
        cycles = renderer.bpy.data.scenes[SPARSE].cycles
        cycles.samples, cycles.seed = samples, seed
    begin = time.perf_counter()
    view = renderer.render(camera)
    return time.perf_counter() - begin, view


def clipped(renderer: Renderer, camera: Camera, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Clipped linear light and the object's mask."""
    render(renderer, camera, settings)
    passes = read_passes(renderer.scratch / "timed.exr", PASSES)
    return np.clip(stacked(passes, COLOR_CHANNELS), 0, 1), passes[ALPHA_CHANNEL] > 0


def middle_cameras(spec: SceneSpec, count: int) -> list[Camera]:
    """Views spread over the path, away from its ends."""
    every = plan_cameras(spec.camera, spec.render.resolution).train
    return [every[(2 * i + 1) * len(every) // (2 * count)] for i in range(count)]


class References:
    """Two path-traced images of different seeds."""

    def __init__(self, renderer: Renderer, camera: Camera, plain: bool) -> None:
        settings = [Settings(REFERENCE_SAMPLES, plain, seed, cropped=True) for seed in REFERENCE_SEEDS]
        (self.a, self.mask), (self.b, _) = (clipped(renderer, camera, each) for each in settings)

    @property
    def noise(self) -> float:
        """Mean square noise of one of them."""
        return float(((self.a - self.b)[self.mask] ** 2).mean()) / 2

    def error(self, light: np.ndarray) -> float:
        """Mean square error of clipped light, without the references' own."""
        return float(((light - self.a) * (light - self.b))[self.mask].mean())


def measure_errors(spec: SceneSpec, views: int) -> Errors:
    """The error of Blender's settings and of ours, by samples."""
    noise: tuple[list[float], list[float]] = [], []
    plain: list[float] = []
    ours: dict[int, list[float]] = {samples: [] for samples in OUR_SAMPLES}
    with open_renderer(spec) as renderer:
        for camera in middle_cameras(spec, views):
            theirs, own = References(renderer, camera, True), References(renderer, camera, False)
            noise[0].append(theirs.noise)
            noise[1].append(own.noise)
            for seed in SEEDS:
                light, _ = clipped(renderer, camera, Settings(PLAIN_SAMPLES, True, seed, cropped=True))
                plain.append(theirs.error(light))
                for samples, found in ours.items():
                    _, view = render_ours(renderer, camera, samples, seed)
                    found.append(own.error(np.clip(view.radiance, 0, 1)))

    def root(squares: list[float]) -> float:
        return float(np.sqrt(max(statistics.fmean(squares), 0)))

    by_samples = {samples: root(squares) for samples, squares in ours.items()}
    return Errors(root(plain), by_samples, root(noise[0]), root(noise[1]))


def measure_scene(name: str, resolution: int, error_resolution: int, views: int) -> SceneResult:
    """Errors at one resolution, times at another."""
    errors = measure_errors(override(load_scene(name), resolution=error_resolution), views)
    enough = [samples for samples in OUR_SAMPLES if errors.ours[samples] <= errors.plain]
    chosen = enough[0] if enough else OUR_SAMPLES[-1]
    spec = override(load_scene(name), resolution=resolution)
    camera = middle_cameras(spec, 1)[0]
    times: tuple[list[float], list[float]] = [], []
    with open_renderer(spec) as renderer:
        for _ in range(REPEATS):
            # Data is kept between frames, but the other side's settings have undone some of it.
            render(renderer, camera, Settings(1, True))
            times[0].append(render(renderer, camera, Settings(PLAIN_SAMPLES, True)))
            render_ours(renderer, camera, 1)
            taken, view = render_ours(renderer, camera, chosen)
            times[1].append(taken)
        is_mirror = renderer.mirror is not None
    plain_s, ours_s = (statistics.median(taken) for taken in times)
    return SceneResult(
        scene=name,
        is_mirror=is_mirror,
        resolution=resolution,
        error_resolution=error_resolution,
        views=views,
        covered=float((view.alpha > 0).mean()),
        errors=errors,
        our_samples=chosen,
        equal_error_reached=bool(enough),
        plain_s=plain_s,
        ours_s=ours_s,
        speedup=plain_s / ours_s,
        speedup_spread=sorted(round(a / b, 2) for a, b in zip(*times, strict=True)),
    )


def time_pool(spec: SceneSpec, plan: PoolPlan, frames: int) -> float:
    """Seconds for that many frames once every process has rendered one."""
    cameras = plan_cameras(spec.camera, spec.render.resolution).train
    with open_pool(spec, plan) as pool, ThreadPoolExecutor(plan.workers + 1) as callers:

        def one(index: int) -> RenderedView:
            return pool.render(cameras[index % len(cameras)], "a view")

        one(0)  # The first states its device, after which the others start.
        list(callers.map(one, range(3 * plan.workers)))
        begin = time.perf_counter()
        for each in [callers.submit(one, i) for i in range(frames)]:
            each.result()
        return time.perf_counter() - begin


def measure_pools(name: str, resolution: int, frames: int) -> list[PoolResult]:
    """One process with all threads against several with a share of them."""
    cores = os.cpu_count() or 1
    plans = [PoolPlan(n, cores // n) for n in (1, 2, 4, 8) if n <= cores]
    spec = override(load_scene(name), resolution=resolution)
    times: list[list[float]] = [[] for _ in plans]
    for _ in range(REPEATS):
        for plan, taken in zip(plans, times, strict=True):
            taken.append(time_pool(spec, plan, frames))
    medians = [statistics.median(taken) for taken in times]
    return [
        PoolResult(plan.workers, plan.threads, resolution, frames, median, medians[0] / median)
        for plan, median in zip(plans, medians, strict=True)
    ]


def resident_mib(pid: int) -> float:
    """Resident memory of a process now (Linux)."""
    lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def measure_memory(name: str, frames: int, frames_per_worker: int, resolution: int) -> MemoryResult:
    """Many small frames through one process at a time."""
    spec = override(load_scene(name), resolution=resolution, samples=1)
    cameras = plan_cameras(spec.camera, resolution).train
    worker: list[float] = []
    parent: list[float] = []
    with open_pool(spec, PoolPlan(1, 1, frames_per_worker)) as pool:
        for i in range(frames):
            if i % (frames // 10) == 0:
                worker.append(0.0)
                parent.append(0.0)
            pool.render(cameras[i % len(cameras)], "a view")
            for each in pool._live:
                worker[-1] = max(worker[-1], round(resident_mib(each.process.pid), 1))
            parent[-1] = max(parent[-1], round(resident_mib(os.getpid()), 1))
        return MemoryResult(frames, frames_per_worker, pool.started, worker, parent)


def main() -> None:
    """Measure what is requested and write one JSON file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--scene", nargs="*", default=list(scene_names()))
    parser.add_argument("--resolution", type=int, default=800)
    parser.add_argument("--error-resolution", type=int, default=200, help="where references are affordable")
    parser.add_argument("--views", type=int, default=2, help="for the error")
    parser.add_argument("--frames", type=int, default=0, help="to compare divisions of the cores; 12 are enough")
    parser.add_argument("--memory-frames", type=int, default=0, help="to watch memory; 300 are enough")
    options = parser.parse_args()
    result: dict[str, Any] = {"cores": os.cpu_count(), "load_before": os.getloadavg()}

    def save() -> None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")

    if options.memory_frames:
        frames = options.memory_frames
        kept = [measure_memory("sphere", frames, each, 64) for each in (frames, frames // 3)]
        result["memory"] = [asdict(each) for each in kept]
        save()
    if options.frames:
        pools = measure_pools(options.scene[0], options.resolution // 2, options.frames)
        result["pools"] = [asdict(each) for each in pools]
        save()
    result["scenes"] = []
    for name in options.scene:
        scene = measure_scene(name, options.resolution, options.error_resolution, options.views)
        result["scenes"].append(asdict(scene))
        save()


if __name__ == "__main__":
    main()
