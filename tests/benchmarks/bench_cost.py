"""What a training step costs: `python -m tests.benchmarks.bench_cost --json out.json --plot out.svg`.

Time and peak memory of the default preset's steps against surfels, pixels and texels, one size varied at a time, on
views resampled as in `bench_step`. Every case is a process of its own, so its peak memory is its own; it includes the
preparation (views, hull, first environment), which is also given apart. The kernels are compiled before, by a small
case that isn't reported.

A pair is a pixel of a 4×4 block for which a surfel is evaluated. Exponents are slopes of log time against the log of a
size, by least squares: at most 1 where nothing grows faster than linearly, with 0.1 to spare for noise. A slope against
pairs says less for the series of surfels, where pairs grow slowly because surfels shrink as they become more. So the
processor time is also split into a share a step, a pair, a surfel, a pixel and a texel, all at least zero.
"""

import argparse
import json
import math
import statistics
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from shinypartial.io.system import peak_memory_bytes

# Torch and what needs it are imported where they are used. A process begins with the peak memory of the one that
# starts it, so the latter must stay small.


@dataclass(frozen=True)
class Case:
    """Sizes of a fit: pixels along an image side, surfels, texels along a face side of the cubemap."""

    pixels: int
    surfels: int
    texels: int = 128
    views: int = 16


SERIES = {
    "surfels": tuple(Case(400, count) for count in (1_000, 3_000, 10_000, 30_000, 100_000, 200_000)),
    "pixels": tuple(Case(side, 20_000) for side in (200, 400, 800, 1600)),
    "texels": tuple(Case(400, 8_000, side) for side in (64, 128, 256, 512, 1024)),
}
LARGEST = Case(1600, 100_000)
LARGEST_LIMIT_GIB = 6.0
REHEARSAL = Case(200, 1_000)
EXPONENT_LIMIT = 1.1
TITLES = {
    "surfels": "400² pixels, cubemap 6×128²",
    "pixels": "20,000 surfels, cubemap 6×128²",
    "texels": "400² pixels, 8,000 surfels",
}
LABELS = {"surfels": "surfels", "pixels": "pixels of an image side", "texels": "texels of a face side"}


@dataclass(frozen=True)
class Cost:
    """One case; times and pairs are medians over the same steps. `cpu_ms` counts all threads."""

    case: Case
    threads: int
    steps: int
    views: int
    wall_ms: float
    cpu_ms: float
    evaluated_pairs: float
    contributing_pairs: float
    pixels_in_crop: float
    """Of the mask's bounding box with its margin, all that a step works on."""
    prepared_peak_mib: float
    """Peak resident memory before the first step."""
    peak_mib: float
    """Peak resident memory of the whole process after the last step."""

    @property
    def cpu_ns_per_pair(self) -> float:
        """Processor time of a whole step for each evaluated pair."""
        return 1e6 * self.cpu_ms / self.evaluated_pairs


@dataclass(frozen=True)
class Exponent:
    """d log time / d log size over one set of cases."""

    cases: str
    size: str
    wall: float
    cpu: float

    @property
    def linear(self) -> bool:
        """Whether neither time grows faster than the size, but for noise."""
        return max(self.wall, self.cpu) <= EXPONENT_LIMIT


@dataclass(frozen=True)
class Shares:
    """cpu_ms = sum of each number times its count, fitted to all cases in relative error."""

    us_per_step: float
    ns_per_pair: float
    ns_per_surfel: float
    ns_per_pixel: float
    ns_per_texel: float
    worst_relative_error: float


def measure(dataset: Path, case: Case, steps: int, threads: int) -> Cost:
    """Cost of a fit's steps right after its warm-up, when all terms act. To be called in a fresh process."""
    from tests.benchmarks.bench_step import WARM_UP_STEPS

    trainer = _make_trainer(dataset, case, threads)
    prepared_peak = _peak_mib()
    start = round(1.5 * trainer.config.environment.warmup * trainer.config.splats.iterations)
    for iteration in range(start, start + WARM_UP_STEPS):
        trainer._step(iteration)
    iterations = range(start + WARM_UP_STEPS, start + WARM_UP_STEPS + steps)
    wall, cpu = [], []
    for iteration in iterations:
        before, busy = time.perf_counter(), time.process_time()
        trainer._step(iteration)
        wall.append(1e3 * (time.perf_counter() - before))
        cpu.append(1e3 * (time.process_time() - busy))
    peak = _peak_mib()
    viewed = [trainer._view_index(iteration) for iteration in iterations]
    counts = _count_views(trainer, set(viewed))
    cameras = [trainer.views.train[index].camera for index in viewed]
    return Cost(
        case=case,
        threads=threads,
        steps=steps,
        views=len(trainer.views.train),
        wall_ms=statistics.median(wall),
        cpu_ms=statistics.median(cpu),
        evaluated_pairs=statistics.median(counts[index].evaluated for index in viewed),
        contributing_pairs=statistics.median(counts[index].contributing for index in viewed),
        pixels_in_crop=statistics.median(camera.width * camera.height for camera in cameras),
        prepared_peak_mib=prepared_peak,
        peak_mib=peak,
    )


def _make_trainer(dataset: Path, case: Case, threads: int) -> Any:
    from dataclasses import replace

    from tests.benchmarks.bench_step import PRESETS, new_trainer, resampled_views, torch

    torch.set_num_threads(threads)
    config = PRESETS["default"]
    config = replace(
        config,
        splats=replace(config.splats, surfels=replace(config.splats.surfels, count=case.surfels)),
        environment=replace(config.environment, resolution=case.texels),
    )
    views = resampled_views(dataset, case.pixels, config.crop_margin_px, case.views)
    return new_trainer(views, config)


def _count_views(trainer: Any, indices: set[int]) -> dict[int, Any]:
    """Pairs of the given views, of all their tiles: with a silhouette term none is left out."""
    from tests.benchmarks.lane_counts import count_lanes

    surfels = trainer.optimizer.surfels.detached()
    parameters = (
        surfels.means,
        surfels.quats,
        surfels.scales,
        surfels.opacities,
        surfels.albedo,
        surfels.curvatures,
    )
    return {index: count_lanes(parameters, trainer.views.train[index].camera) for index in indices}


def _peak_mib() -> float:
    return peak_memory_bytes() / 2**20


def _synthetic_root(folder: Path) -> Path:
    from tests.benchmarks.bench_step import synthetic_dataset

    return synthetic_dataset(folder)


def measure_all(dataset: Path | None, steps: int, threads: int) -> list[Cost]:
    """Every case once, each in a fresh process, after the rehearsal."""
    cases = dict.fromkeys([*(case for series in SERIES.values() for case in series), LARGEST])
    costs = []
    with (
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as processes,
    ):
        root = dataset or processes.submit(_synthetic_root, Path(folder)).result()
        processes.submit(measure, root, REHEARSAL, 1, threads).result()
        print(
            "pixels surfels texels | wall ms   cpu ms | M pairs evaluated, contributing | cpu ns a pair | peak MiB"
            " (of which before the steps)"
        )
        for case in cases:
            cost = processes.submit(measure, root, case, steps, threads).result()
            costs.append(cost)
            print(
                f"{case.pixels:6d} {case.surfels:7d} {case.texels:6d} | {cost.wall_ms:7.1f} {cost.cpu_ms:8.1f} | "
                f"{cost.evaluated_pairs / 1e6:8.2f} {cost.contributing_pairs / 1e6:8.2f} | "
                f"{cost.cpu_ns_per_pair:6.2f} | {cost.peak_mib:6.0f} ({cost.prepared_peak_mib:.0f})",
                flush=True,
            )
    return costs


def find_exponents(costs: list[Cost]) -> list[Exponent]:
    """Against each series' own size, and against pairs where these change."""
    found = []
    for size, cases in SERIES.items():
        series = [cost for cost in costs if cost.case in cases]
        found.append(_exponent(size, size, series, [_size(cost, size) for cost in series]))
    one_cubemap = [cost for cost in costs if cost.case.texels == LARGEST.texels]
    for name, cases in (("surfels", SERIES["surfels"]), ("pixels", SERIES["pixels"])):
        series = [cost for cost in costs if cost.case in cases]
        found.append(_exponent(name, "pairs", series, [cost.evaluated_pairs for cost in series]))
    found.append(_exponent("all of one cubemap", "pairs", one_cubemap, [cost.evaluated_pairs for cost in one_cubemap]))
    return found


def _size(cost: Cost, name: str) -> float:
    """Pixels and texels as areas, so that linear means exponent 1."""
    return {
        "surfels": cost.case.surfels,
        "pixels": cost.pixels_in_crop,
        "texels": 6 * cost.case.texels**2,
    }[name]


def _exponent(cases: str, size: str, costs: list[Cost], sizes: list[float]) -> Exponent:
    times = np.log([[cost.wall_ms, cost.cpu_ms] for cost in costs])
    wall, cpu = np.polyfit(np.log(sizes), times, 1)[0]
    return Exponent(cases, size, float(wall), float(cpu))


def find_shares(costs: list[Cost]) -> Shares:
    """Least squares of (model − time) / time over all cases, no share below zero."""
    from scipy.optimize import nnls

    sizes = [[1e3, c.evaluated_pairs, c.case.surfels, c.pixels_in_crop, _size(c, "texels")] for c in costs]
    relative = np.array(sizes) / np.array([[1e6 * c.cpu_ms] for c in costs])
    solution, _ = nnls(relative, np.ones(len(costs)))
    worst = np.abs(relative @ solution - 1).max()
    return Shares(*map(float, [*solution, worst]))


def draw(costs: list[Cost], path: Path) -> None:
    """A panel for each series: step time (left) and peak memory (right), all axes logarithmic."""
    import matplotlib
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 3.6), dpi=100, layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    memories = [panel.twinx() for panel in panels]
    for panel, memory, (size, cases) in zip(panels, memories, SERIES.items(), strict=True):
        lines = _draw_costs(panel, memory, size, [cost for cost in costs if cost.case in cases])
        sides = [getattr(case, size) for case in cases]
        panel.set(title=TITLES[size], xlabel=LABELS[size], xscale="log", yscale="log")
        panel.set_xticks(sides, [f"{side / 1000:g}k" if side >= 10_000 else f"{side:,}" for side in sides], fontsize=8)
        panel.set_xticks([], minor=True)
        panel.grid(alpha=0.25)
        memory.set_yscale("log", base=2)
        memory.yaxis.set_major_formatter("{x:,.0f}")
        memory.set_ylim(*_powers(2, [cost.peak_mib for cost in costs]))
        memory.tick_params(labelright=memory is memories[-1])
    largest = [cost for cost in costs if cost.case == LARGEST]
    _draw_costs(panels[1], memories[1], "pixels", largest, linestyle="none", fillstyle="none")
    panels[1].text(0.04, 0.92, f"hollow: {LARGEST.surfels:,} surfels", transform=panels[1].transAxes, fontsize=8)
    panels[0].set_ylim(*_powers(10, [time for cost in costs for time in (cost.wall_ms, cost.cpu_ms)]))
    panels[0].set_ylabel("ms a step")
    memories[-1].set_ylabel("peak resident MiB")
    figure.legend(lines, ["wall", "processor, all threads", "peak memory"], loc="outside upper center", ncols=3)
    with matplotlib.rc_context({"svg.hashsalt": "bench-cost"}):
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def _draw_costs(panel: Any, memory: Any, size: str, costs: list[Cost], **style: str) -> list[Any]:
    x = [getattr(cost.case, size) for cost in costs]
    return [
        *panel.plot(x, [cost.wall_ms for cost in costs], marker="o", color="#1b6ca8", **style),
        *panel.plot(x, [cost.cpu_ms for cost in costs], marker="^", color="#7fb2d9", **style),
        *memory.plot(x, [cost.peak_mib for cost in costs], marker="s", color="#d95f02", **style),
    ]


def _powers(base: int, values: list[float]) -> tuple[float, float]:
    """The powers of a base that enclose the values."""
    exponents = np.log(values) / np.log(base)
    return float(base) ** math.floor(exponents.min()), float(base) ** math.ceil(exponents.max())


def main() -> None:
    """Measure and print every case, what follows from them, and write the files requested."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dataset", type=Path, help="dataset of square images; default: a synthetic mirror sphere")
    parser.add_argument("--steps", type=int, default=15, help="timed steps of a case")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path, help="also write the results here")
    parser.add_argument("--plot", type=Path, help="also draw them here (.svg or .png)")
    arguments = parser.parse_args()
    costs = measure_all(arguments.dataset, arguments.steps, arguments.threads)
    exponents, shares = find_exponents(costs), find_shares(costs)
    for exponent in exponents:
        verdict = "at most" if exponent.linear else "ABOVE"
        print(
            f"series of {exponent.cases}: time against {exponent.size} has exponent {exponent.wall:.2f} (wall), "
            f"{exponent.cpu:.2f} (cpu): {verdict} {EXPONENT_LIMIT}"
        )
    print("processor time: " + ", ".join(f"{name} {value:.3g}" for name, value in asdict(shares).items()))
    peak_gib = next(cost.peak_mib for cost in costs if cost.case == LARGEST) / 1024
    fits = peak_gib < LARGEST_LIMIT_GIB
    print(
        f"{LARGEST.pixels}² pixels, {LARGEST.surfels:,} surfels: peak {peak_gib:.2f} GiB, "
        f"{'under' if fits else 'NOT under'} {LARGEST_LIMIT_GIB:.0f} GiB"
    )
    if arguments.json:
        content = {
            "costs": [{**asdict(cost), "cpu_ns_per_pair": cost.cpu_ns_per_pair} for cost in costs],
            "exponents": [{**asdict(exponent), "linear": exponent.linear} for exponent in exponents],
            "exponent_limit": EXPONENT_LIMIT,
            "processor_time": asdict(shares),
            "largest": {**asdict(LARGEST), "peak_gib": peak_gib, "limit_gib": LARGEST_LIMIT_GIB, "fits": fits},
        }
        arguments.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    if arguments.plot:
        draw(costs, arguments.plot)
    if not fits:
        sys.exit(1)


if __name__ == "__main__":
    main()
