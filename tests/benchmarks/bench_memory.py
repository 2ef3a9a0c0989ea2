"""Whether memory stays flat over a long fit: `python -m tests.benchmarks.bench_memory --json docs/results/memory.json`.

Surfels of the bundled vase are trained, and the resident memory of the process is noted after every hundredth step. The
slope is that of a straight line through the second half, by least squares; ten minutes.
"""

import argparse
import json
import resource
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from panoless.capture.configured import configured_views
from panoless.config import FitConfig
from panoless.presets import PRESETS
from panoless.splats.descent import PUBLISHED
from panoless.splats.start import first_mirror, first_training
from panoless.splats.train import train_surfels
from shinypartial.dataset.bundled import bundled_dataset
from shinypartial.dataset.read import open_dataset
from shinypartial.io.files import write_json
from tests.support.surfel_training import Unobserved

NOTED_EVERY = 100


@dataclass(frozen=True)
class Flatness:
    """Resident memory over a fit, in MiB, and its slope over the second half of the steps."""

    preset: str
    steps: int
    surfels: int
    """At the end."""
    after_first_thousand_mib: float
    at_half_mib: float
    largest_of_second_half_mib: float
    end_mib: float
    slope_mib_per_1000_steps: float


class _MemoryWatch(Unobserved):
    """Notes the resident memory (MiB) after every hundredth step."""

    def __init__(self) -> None:
        self.resident: list[float] = []

    def after_step(self, iteration: int, seconds: float, current: object) -> None:
        """Note what is resident."""
        if iteration % NOTED_EVERY == 0:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            self.resident.append(pages * resource.getpagesize() / 2**20)


def watch(preset: str, steps: int, count: int) -> Flatness:
    """Train that many surfels for so many steps; density control, where the preset has it, goes on to the end."""
    config: FitConfig = PRESETS[preset]
    method = config.splats.surfels.shading
    PUBLISHED[method] = replace(PUBLISHED[method], grows_until=PUBLISHED[method].steps)
    config = replace(
        config,
        splats=replace(
            config.splats,
            iterations=steps,
            surfels=replace(config.splats.surfels, count=count),
            density=replace(config.splats.density, max_surfels=2 * count),
        ),
        downscale=2,
        first_surface=replace(config.first_surface, hull_resolution=40),
        environment=replace(config.environment, resolution=32, rays=100_000),
    )
    views, config = configured_views(open_dataset(bundled_dataset("tiny-vase")), config)
    mirror, noted = first_mirror(views, config), _MemoryWatch()
    geometry, _ = train_surfels(views, mirror, first_training(views, mirror, config), config, noted)
    resident = np.array(noted.resident)
    half = len(resident) // 2
    slope = np.polyfit(np.arange(half, len(resident)) * NOTED_EVERY / 1000, resident[half:], 1)[0]
    figures = resident[1000 // NOTED_EVERY - 1], resident[half], resident[half:].max(), resident[-1], slope
    return Flatness(preset, steps, geometry.num_primitives, *(round(float(value), 2) for value in figures))


def main() -> None:
    """Watch a preset without and one with density control."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--surfels", type=int, default=500)
    options = parser.parse_args()
    found = []
    for preset in ("fast", "paper"):
        found.append(asdict(watch(preset, options.steps, options.surfels)))
        print(json.dumps(found[-1]), flush=True)
        write_json(options.json, found)


if __name__ == "__main__":
    main()
