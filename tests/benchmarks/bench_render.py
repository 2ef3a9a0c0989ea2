"""Time rendering against Blender's own settings: `python -m tests.benchmarks.bench_render --json out.json`.

Equal error: both are compared with 1,024 samples of their own pixel filter, as the root mean square of linear light
clipped to [0, 1] over the object; the fewest samples of ours that come out no worse than 128 of Blender's are timed.
Times of the two alternate, so that other load on the machine meets both; compare ratios, not seconds.
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

from shinypartial.blender.crew import CrewPlan, open_crew
from shinypartial.blender.region import Region, image_region, set_border
from shinypartial.blender.render import RenderedView, Renderer, open_renderer
from shinypartial.blender.runtime import quiet
from shinypartial.camera import Camera, opencv_to_opengl
from shinypartial.scene import SceneSpec, load_scene, override
from shinypartial.trajectory import plan_cameras

PLAIN_SAMPLES = 128
REFERENCE_SAMPLES = 1024
OUR_SAMPLES = (16, 32, 64, 128)
REFERENCE_SEED = 77
REPEATS = 3


@dataclass(frozen=True)
class Settings:
    """What the two sides set differently."""

    samples: int
    plain: bool
    seed: int = 0


@dataclass(frozen=True)
class SceneResult:
    """One scene; times are seconds of `bpy.ops.render.render` and its file, medians.

    Where even the most samples of ours come out worse, these are timed, and the speed-up is none at equal error.
    """

    scene: str
    resolution: int
    error_resolution: int
    covered: float
    plain_error: float
    our_errors: dict[int, float]
    our_samples: int
    equal_error_reached: bool
    plain_s: float
    ours_s: float
    speedup: float
    speedup_spread: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class CrewResult:
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
    """Set everything up for one view."""
    scene = renderer.bpy.context.scene
    cycles, world = scene.cycles, scene.world.cycles
    cycles.samples, cycles.seed = settings.samples, settings.seed
    cycles.pixel_filter_type = "BLACKMAN_HARRIS" if settings.plain else "BOX"
    cycles.filter_width = 1.5 if settings.plain else 1.0
    world.sampling_method = "AUTOMATIC" if settings.plain else "MANUAL"
    whole = Region(0, 0, camera.width, camera.height)
    set_border(scene, whole if settings.plain else image_region(camera, renderer.body_vertices_world), camera)
    scene.camera.matrix_world = opencv_to_opengl(camera.camera_to_world).T.tolist()
    scene.render.filepath = str(renderer.scratch / "timed.exr")


def render(renderer: Renderer, camera: Camera, settings: Settings) -> float:
    """Seconds to render and write one view."""
    apply(renderer, camera, settings)
    begin = time.perf_counter()
    with quiet():
        renderer.bpy.ops.render.render(write_still=True)
    return time.perf_counter() - begin


def clipped(renderer: Renderer, camera: Camera, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Clipped linear light and the object's mask."""
    import OpenEXR

    render(renderer, camera, settings)
    with OpenEXR.File(str(renderer.scratch / "timed.exr"), separate_channels=True) as file:
        planes = {name.partition(".")[2]: c.pixels for part in file.parts for name, c in part.channels.items()}
    light = np.stack([planes[f"Combined.{name}"] for name in "RGB"], -1)
    return np.clip(light, 0, 1), planes["Combined.A"] > 0


def middle_cameras(spec: SceneSpec, count: int) -> list[Camera]:
    """Views spread over the path, away from its ends."""
    every = plan_cameras(spec.camera, spec.render.resolution).train
    return [every[(2 * i + 1) * len(every) // (2 * count)] for i in range(count)]


def errors(spec: SceneSpec, count: int) -> tuple[float, dict[int, float]]:
    """The error of Blender's settings and of ours, by samples."""
    plain: list[float] = []
    ours: dict[int, list[float]] = {samples: [] for samples in OUR_SAMPLES}
    with open_renderer(spec) as renderer:
        for camera in middle_cameras(spec, count):
            for is_plain, tried in ((True, (PLAIN_SAMPLES,)), (False, OUR_SAMPLES)):
                truth, mask = clipped(renderer, camera, Settings(REFERENCE_SAMPLES, is_plain, REFERENCE_SEED))
                for samples in tried:
                    light, _ = clipped(renderer, camera, Settings(samples, is_plain))
                    error = float(np.sqrt(((light - truth)[mask] ** 2).mean()))
                    (plain if is_plain else ours[samples]).append(error)
    return statistics.fmean(plain), {samples: statistics.fmean(values) for samples, values in ours.items()}


def measure_scene(name: str, resolution: int, error_resolution: int, views: int) -> SceneResult:
    """Errors at one resolution, times at another."""
    plain_error, our_errors = errors(override(load_scene(name), resolution=error_resolution), views)
    enough = [samples for samples in OUR_SAMPLES if our_errors[samples] <= plain_error]
    chosen = enough[0] if enough else OUR_SAMPLES[-1]
    spec = override(load_scene(name), resolution=resolution)
    camera = middle_cameras(spec, 1)[0]
    sides = Settings(PLAIN_SAMPLES, True), Settings(chosen, False)
    times: list[list[float]] = [[], []]
    with open_renderer(spec) as renderer:
        for side in sides:
            render(renderer, camera, Settings(1, side.plain))
        for _ in range(REPEATS):
            for side, taken in zip(sides, times, strict=True):
                taken.append(render(renderer, camera, side))
        covered = float((clipped(renderer, camera, Settings(1, False))[1]).mean())
    plain_s, ours_s = (statistics.median(taken) for taken in times)
    spread = sorted(round(a / b, 2) for a, b in zip(*times, strict=True))
    return SceneResult(
        scene=name,
        resolution=resolution,
        error_resolution=error_resolution,
        covered=covered,
        plain_error=plain_error,
        our_errors=our_errors,
        our_samples=chosen,
        equal_error_reached=bool(enough),
        plain_s=plain_s,
        ours_s=ours_s,
        speedup=plain_s / ours_s,
        speedup_spread=spread,
    )


def time_crew(spec: SceneSpec, plan: CrewPlan, frames: int) -> float:
    """Seconds for that many frames once every process has rendered one."""
    cameras = plan_cameras(spec.camera, spec.render.resolution).train
    with open_crew(spec, plan) as crew, ThreadPoolExecutor(plan.workers + 1) as pool:

        def one(index: int) -> RenderedView:
            return crew.render(cameras[index % len(cameras)], "a view")

        one(0)  # The first tells its device, after which the others start.
        list(pool.map(one, range(3 * plan.workers)))
        begin = time.perf_counter()
        for each in [pool.submit(one, i) for i in range(frames)]:
            each.result()
        return time.perf_counter() - begin


def measure_crews(name: str, resolution: int, frames: int) -> list[CrewResult]:
    """One process with all threads against several with a share of them."""
    cores = os.cpu_count() or 1
    plans = [CrewPlan(n, cores // n) for n in (1, 2, 4, 8) if n <= cores]
    spec = override(load_scene(name), resolution=resolution)
    times: list[list[float]] = [[] for _ in plans]
    for _ in range(REPEATS):
        for plan, taken in zip(plans, times, strict=True):
            taken.append(time_crew(spec, plan, frames))
    medians = [statistics.median(taken) for taken in times]
    return [
        CrewResult(plan.workers, plan.threads, resolution, frames, median, medians[0] / median)
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
    with open_crew(spec, CrewPlan(1, 1, frames_per_worker)) as crew:
        for i in range(frames):
            if i % (frames // 10) == 0:
                worker.append(0.0)
                parent.append(0.0)
            crew.render(cameras[i % len(cameras)], "a view")
            for each in crew._live:
                worker[-1] = max(worker[-1], round(resident_mib(each.process.pid), 1))
            parent[-1] = max(parent[-1], round(resident_mib(os.getpid()), 1))
        return MemoryResult(frames, frames_per_worker, crew.started, worker, parent)


def main() -> None:
    """Measure what is asked for and write one JSON file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--scene", nargs="*", default=["vase"])
    parser.add_argument("--resolution", type=int, default=800)
    parser.add_argument("--error-resolution", type=int, default=200, help="where references are affordable")
    parser.add_argument("--views", type=int, default=2, help="for the error")
    parser.add_argument("--frames", type=int, default=12, help="to compare divisions of the cores; 0 to leave out")
    parser.add_argument("--memory-frames", type=int, default=300, help="0 to leave out")
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
        crews = measure_crews(options.scene[0], options.resolution // 2, options.frames)
        result["crews"] = [asdict(each) for each in crews]
        save()
    result["scenes"] = []
    for name in options.scene:
        scene = measure_scene(name, options.resolution, options.error_resolution, options.views)
        result["scenes"].append(asdict(scene))
        save()


if __name__ == "__main__":
    main()
