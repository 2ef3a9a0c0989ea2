"""Fit shapes that are no scenes of the benchmark, whose first surfaces are far off, and write their figures.

    python docs/examples/other_shapes.py                      # every shape: about an hour on one core
    python docs/examples/other_shapes.py --shapes brick torus --set free_form.descent.rounds='[]'

Each shape is rendered, fitted with the preset `fast` and scored by commands in processes of their own. Finished ones
are skipped, so the same line continues. Figures, but no times, go to docs/results/other-shapes.json, unless the fit has
other options.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from main_scenes import figures, make_folders

from shinypartial.io.files import write_json, write_text

FOLDER = Path("build/other-shapes")
NUMBERS = Path("docs/results/other-shapes.json")


@dataclass(frozen=True)
class Trial:
    """A shape in a world, and cameras around it."""

    shape: str
    turn_deg: tuple[float, float, float]
    world: str
    path: str
    radius: float
    facing_azimuth_deg: float
    azimuth_deg: float
    elevation_deg: tuple[float, float]
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def recipe(self, name: str) -> str:
        """As scene.toml."""
        return f"""format = 1
name = "{name}"
title = "Trial shape {name}"
provenance = "Made for this benchmark."
license = "CC0-1.0"
split = "development"

[object]
kind = "assembly"

[[object.parts]]
stretch = {list(self.stretch)}
turn_deg = {list(self.turn_deg)}
shape = {{ {self.shape} }}

[world]
kind = "studiolight"
name = "{self.world}"

[camera]
path = "{self.path}"
radius = {self.radius}
facing_azimuth_deg = {self.facing_azimuth_deg}
azimuth_deg = [{-self.azimuth_deg}, {self.azimuth_deg}]
elevation_deg = {list(self.elevation_deg)}
"""


BENT = "[[-0.8, 0.0, 0.25, 0.5, 2.0], [-0.45, 0.0, -0.05, 0.55, 2.0], [0.0, 0.0, -0.18, 0.6, 2.0], \
[0.45, 0.0, -0.05, 0.55, 2.0], [0.8, 0.0, 0.25, 0.5, 2.0]]"
TRIALS = {
    "brick": Trial(
        'kind = "superquadric", size = [1.3, 0.7, 1.0], exponents = [6.0, 5.0]',
        (15.0, -10.0, 50.0),
        "interior",
        "plus",
        3.8,
        70.0,
        45.0,
        (-15.0, 50.0),
    ),
    "twist": Trial(
        'kind = "superquadric", size = [0.9, 0.8, 1.3], exponents = [3.0, 2.5], twist_deg = 30.0',
        (10.0, 5.0, 40.0),
        "courtyard",
        "plus",
        3.6,
        30.0,
        50.0,
        (-15.0, 50.0),
    ),
    "lump": Trial(
        'kind = "radial_harmonics", seed = 7, degree = 8, variation = 0.11, radius = 1.05',
        (0.0, 25.0, 0.0),
        "forest",
        "plus",
        3.8,
        140.0,
        45.0,
        (-20.0, 45.0),
        (0.9, 1.0, 1.1),
    ),
    "torus": Trial(
        'kind = "ring", radius = 0.8, thickness = 0.32',
        (60.0, 20.0, 0.0),
        "interior",
        "golden_spiral",
        3.6,
        -60.0,
        55.0,
        (-20.0, 50.0),
    ),
    "banana": Trial(
        f'kind = "soft_balls", radius = 1.2, resolution = 96, balls = {BENT}',
        (10.0, 0.0, 20.0),
        "city",
        "plus",
        3.8,
        -90.0,
        50.0,
        (-10.0, 55.0),
    ),
    "ellipsoid": Trial(
        'kind = "superquadric", size = [1.2, 0.8, 0.95], exponents = [2.0, 2.0]',
        (20.0, 10.0, 0.0),
        "studio",
        "plus",
        3.6,
        10.0,
        50.0,
        (-20.0, 50.0),
    ),
}


def make(name: str, options: Sequence[str]) -> Path:
    """Render, fit and score a shape, as far as that is not done; the prediction's folder."""
    scene, dataset = FOLDER / "scenes" / name / "scene.toml", FOLDER / "datasets" / name
    fitted = FOLDER / "predictions" / "-".join([name, *options]).replace("/", "_")
    oracle = FOLDER / "predictions" / f"{name}-oracle"
    scene.parent.mkdir(parents=True, exist_ok=True)
    write_text(scene, TRIALS[name].recipe(name))
    generated = ("--scene", scene, "--resolution", 160, "--train", 50, "--test", 6)
    settings = [word for option in options for word in ("--set", option)]
    make_folders(dataset, fitted, oracle, generated, ("--preset", "fast", *settings))
    return fitted


def main(arguments: Sequence[str] | None = None) -> None:
    """Make what is missing, and write the figures after every shape."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", nargs="*", choices=TRIALS, default=list(TRIALS))
    parser.add_argument("--set", action="append", default=[], help="SECTION.OPTION=VALUE of `panoless fit`")
    options = parser.parse_args(arguments)
    for name in options.shapes:
        found = figures(make(name, options.set)) or {}
        found = {key: value for key, value in found.items() if not key.startswith("seconds")}
        print(json.dumps({name: found}, indent=1))
        if not options.set:
            numbers = json.loads(NUMBERS.read_text(encoding="utf-8")) if NUMBERS.exists() else {}
            write_json(NUMBERS, {**numbers, name: found})


if __name__ == "__main__":
    main()
