"""Whole training steps by stage: `python -m tests.benchmarks.bench_step --json out.json`.

Each case runs the steps of a real `SurfelTrainer` (rasterize, objective, backward, Adam) on views of a dataset,
resampled to the case's size. Without a dataset, the views are of a synthetic mirror sphere. The cold start is a
process of its own, from its first import to the end of its first step, with kernels from the disk cache.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import torch

from panoless.capture.views import Views, cropped, views_of
from panoless.presets import PRESETS
from panoless.splats import train as train_module
from panoless.splats.optimizer import SurfelOptimizer
from panoless.splats.train import SurfelTrainer
from shinypartial.core.camera import Camera
from shinypartial.dataset.read import open_dataset, read_view
from tests.support.surfel_training import new_trainer

CASES = ((200, 5_000), (400, 8_000), (800, 50_000))
NUM_VIEWS = 16
WARM_UP_STEPS = 5
STAGES = ("rasterize", "objective", "backward", "adam")


@dataclass(frozen=True)
class StepTiming:
    """One case; medians over steps, milliseconds. `cpu_ms` counts all threads."""

    pixels: int
    surfels: int
    threads: int
    steps: int
    wall_ms: float
    wall_min_ms: float
    cpu_ms: float
    stages_ms: dict[str, float]
    """Wall time by stage; the rest is the step's own bookkeeping."""


def resampled(image: np.ndarray, size: int) -> np.ndarray:
    """A square image at another size: means of blocks, or bilinear."""
    stack = torch.from_numpy(np.atleast_3d(image)).permute(2, 0, 1)[None]
    if size < image.shape[0]:
        found = torch.nn.functional.interpolate(stack, size=(size, size), mode="area")
    else:
        found = torch.nn.functional.interpolate(stack, size=(size, size), mode="bilinear", align_corners=False)
    return found[0].permute(1, 2, 0).numpy().reshape(size, size, *image.shape[2:])


def resampled_views(dataset: Path, size: int, crop_margin_px: int, count: int = NUM_VIEWS) -> Views:
    """Evenly chosen training views at the given size."""
    frames = open_dataset(dataset).train
    photographs = []
    for frame in frames[:: max(1, len(frames) // count)][:count]:
        view = read_view(frame)
        old, scale = frame.camera, size / frame.camera.width
        intrinsics = (scale * old.fx, scale * old.fy, scale * old.cx, scale * old.cy)
        camera = Camera(old.camera_to_world, *intrinsics, size, size)
        images = (resampled(image.clip(0, 1), size) for image in (view.radiance, view.alpha))
        photographs.append(cropped(camera, *images, crop_margin_px))
    return views_of(photographs)


def make_trainer(dataset: Path, size: int, count: int, preset: str) -> SurfelTrainer:
    """A fit right after its warm-up, when all terms act."""
    config = PRESETS[preset]
    config = replace(config, splats=replace(config.splats, surfels=replace(config.splats.surfels, count=count)))
    views = resampled_views(dataset, size, config.crop_margin_px)
    return new_trainer(views, config)


def stage_clock() -> Iterator[dict[str, list[float]]]:
    """Record the wall seconds of every stage of a step."""
    seconds: dict[str, list[float]] = defaultdict(list)

    def timed(stage: str, function: Callable) -> Callable:
        def run(*arguments, **options):
            start = time.perf_counter()
            result = function(*arguments, **options)
            seconds[stage].append(time.perf_counter() - start)
            return result

        return run

    places = (
        (train_module, "rasterize_surfels"),
        (train_module, "mirror_objective"),
        (torch.Tensor, "backward"),
        (SurfelOptimizer, "step"),
    )
    before = [getattr(*place) for place in places]
    for stage, (owner, name), function in zip(STAGES, places, before, strict=True):
        setattr(owner, name, timed(stage, function))
    try:
        yield seconds
    finally:
        for (owner, name), function in zip(places, before, strict=True):
            setattr(owner, name, function)


def measure(dataset: Path, size: int, count: int, steps: int, preset: str) -> StepTiming:
    """Time the steps of one case."""
    trainer = make_trainer(dataset, size, count, preset)
    first = round(1.5 * trainer.config.environment.warmup * trainer.config.splats.iterations)
    for iteration in range(first, first + WARM_UP_STEPS):
        trainer._step(iteration)
    wall, cpu = [], []
    with stage_clock() as seconds:
        for iteration in range(first + WARM_UP_STEPS, first + WARM_UP_STEPS + steps):
            start, busy = time.perf_counter(), time.process_time()
            trainer._step(iteration)
            wall.append(1e3 * (time.perf_counter() - start))
            cpu.append(1e3 * (time.process_time() - busy))
    return StepTiming(
        pixels=size,
        surfels=count,
        threads=torch.get_num_threads(),
        steps=steps,
        wall_ms=statistics.median(wall),
        wall_min_ms=min(wall),
        cpu_ms=statistics.median(cpu),
        stages_ms={stage: 1e3 * statistics.median(seconds[stage]) for stage in STAGES},
    )


COLD_START = """
import json, sys, time
start = time.perf_counter()
marks = {}
def mark(name):
    marks[name] = time.perf_counter() - start
import torch
mark("import torch")
import numba
mark("import numba")
from pathlib import Path
from tests.benchmarks.bench_step import make_trainer
mark("import panoless")
prepared = time.perf_counter()
trainer = make_trainer(Path(sys.argv[1]), 200, 5000, "default")
prepared = time.perf_counter() - prepared
step = time.perf_counter()
trainer._step(100)
marks["first step"] = time.perf_counter() - step
step = time.perf_counter()
trainer._step(101)
marks["second step"] = time.perf_counter() - step
marks["views and surfels"] = prepared
print(json.dumps(marks))
"""


def cold_start(dataset: Path) -> dict[str, float]:
    """Seconds of a fresh process: imports (each up to its end), the first and the second step, preparation apart."""
    command = [sys.executable, "-c", COLD_START, str(dataset)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def synthetic_dataset(folder: Path) -> Path:
    """A mirror sphere of 400 pixels."""
    from tests.support.synthetic_dataset import make_sphere_dataset

    return make_sphere_dataset(folder / "sphere", resolution=400, train=NUM_VIEWS, test=1).root


def main() -> None:
    """Measure and print every case, then the cold start."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dataset", type=Path, help="dataset of square images; default: a synthetic mirror sphere")
    parser.add_argument("--preset", default="default", choices=sorted(PRESETS))
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path, help="also write the results here")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    with tempfile.TemporaryDirectory() as folder:
        dataset = arguments.dataset or synthetic_dataset(Path(folder))
        timings = [measure(dataset, *case, arguments.steps, arguments.preset) for case in CASES]
        cold_start(dataset)
        start = cold_start(dataset)
    print(f"{'pixels':>6} {'surfels':>7} | wall median / min ms | cpu ms | " + "  ".join(STAGES))
    for timing in timings:
        stages = "  ".join(f"{timing.stages_ms[stage]:{len(stage)}.1f}" for stage in STAGES)
        wall = f"{timing.wall_ms:8.1f} / {timing.wall_min_ms:8.1f}"
        print(f"{timing.pixels:6d} {timing.surfels:7d} | {wall}  | {timing.cpu_ms:6.1f} | {stages}")
    print("cold start, seconds: " + ", ".join(f"{name} {value:.2f}" for name, value in start.items()))
    if arguments.json:
        content = {"steps": [asdict(timing) for timing in timings], "cold start": start}
        arguments.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
