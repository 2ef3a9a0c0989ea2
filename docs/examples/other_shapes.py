"""Fit shapes that are no scenes of the benchmark, whose first surfaces are far off, and write their figures.

    python docs/examples/other_shapes.py                      # every shape: about an hour on one core
    python docs/examples/other_shapes.py --shapes brick torus --set free_form.starts=false
    python docs/examples/other_shapes.py --shapes torus --worse rotation=0.5 room=10

Each shape is rendered, fitted with the preset `fast` and scored by commands in processes of their own. With --worse,
all named axes of `shinypartial stability` make its photographs worse; the truth is that of the clean dataset, or of
the one that is rendered so. Finished ones are skipped, so the same line continues. Figures, but no times, go to
docs/results/other-shapes.json, unless the fit has other options; keys are such as torus.rotation-0.5.
"""

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from main_scenes import figures, make_folders

from shinypartial.blender.runtime import studio_light
from shinypartial.io.files import write_json, write_text
from shinypartial.io.images import read_exr_rgb, write_exr_rgb
from shinypartial.prediction.format import read_info
from shinypartial.suites.stability.axes import BY_NAME, Axis

FOLDER = Path("build/other-shapes")
NUMBERS = Path("docs/results/other-shapes.json")
WORLD, BLEND = "world.exr", "monkey.blend"


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
    more: tuple[str, ...] = ()
    """Further parts: shape and offset of each."""
    ground: float = 1.0
    """Factor of the light from below the horizon."""
    strength: float = 1.0
    """Factor of all light."""

    def recipe(self, name: str) -> str:
        """As scene.toml."""
        parts = "".join(f"\n[[object.parts]]\n{part}\n" for part in self.more)
        kind = f'kind = "studiolight"\nname = "{self.world}"'
        if self.ground != 1:
            kind = f'kind = "file"\npath = "{WORLD}"\nlicense = "CC0-1.0"\nsource = "{self.world} of Blender"'
        shown = f"""kind = "assembly"

[[object.parts]]
stretch = {list(self.stretch)}
turn_deg = {list(self.turn_deg)}
shape = {{ {self.shape} }}
{parts}"""
        if self.shape == MONKEY:
            shown = f'kind = "blend"\npath = "{BLEND}"\nobject = "{MONKEY}"\n'
        return f"""format = 1
name = "{name}"
title = "Trial shape {name}"
provenance = "Made for this benchmark."
license = "CC0-1.0"
split = "development"

[object]
{shown}
[world]
{kind}
strength = {self.strength}

[camera]
path = "{self.path}"
radius = {self.radius}
facing_azimuth_deg = {self.facing_azimuth_deg}
azimuth_deg = [{-self.azimuth_deg}, {self.azimuth_deg}]
elevation_deg = {list(self.elevation_deg)}
"""

    def write(self, path: Path, name: str) -> None:
        """The recipe, and beside it the world or the mesh that it names where recipes know none such."""
        write_text(path, self.recipe(name))
        if self.ground != 1:
            radiance = read_exr_rgb(studio_light(self.world))
            radiance[len(radiance) // 2 :] *= self.ground
            write_exr_rgb(path.parent / WORLD, radiance)
        if self.shape == MONKEY:
            write_monkey(path.parent / BLEND)


def write_monkey(path: Path) -> None:
    """Blender's monkey, 1.6 across and subdivided four times."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_monkey_add(size=1.6)
    bpy.context.object.name = MONKEY
    modifier = bpy.context.object.modifiers.new("subdivision", "SUBSURF")
    modifier.levels = modifier.render_levels = 4
    bpy.ops.object.modifier_apply(modifier=modifier.name)
    bpy.ops.object.shade_smooth()
    bpy.ops.wm.save_as_mainfile(filepath=str(path.resolve()))


BENT = "[[-0.8, 0.0, 0.25, 0.5, 2.0], [-0.45, 0.0, -0.05, 0.55, 2.0], [0.0, 0.0, -0.18, 0.6, 2.0], \
[0.45, 0.0, -0.05, 0.55, 2.0], [0.8, 0.0, 0.25, 0.5, 2.0]]"
HANDLE = """shape = { kind = "tube", path = [[0.45, 0.0, 0.45], [0.85, 0.0, 0.5], [1.05, 0.0, 0.15], \
[0.9, 0.0, -0.25], [0.5, 0.0, -0.45]], radii = [0.1, 0.1, 0.1, 0.1, 0.1] }"""
SPOUT = """shape = { kind = "tube", path = [[-0.5, 0.0, -0.3], [-0.8, 0.0, -0.05], [-0.95, 0.0, 0.3], \
[-1.08, 0.0, 0.5]], radii = [0.22, 0.16, 0.11, 0.1] }"""
SPOUT_END = """shape = { kind = "sphere", radius = 0.1 }
offset = [-1.08, 0.0, 0.5]"""
EAR = """shape = { kind = "tube", path = [[0.5, 0.0, 0.35], [0.75, 0.0, 0.4], [0.92, 0.0, 0.15], [0.88, 0.0, -0.15], \
[0.7, 0.0, -0.35], [0.5, 0.0, -0.4]], radii = [0.07, 0.07, 0.07, 0.07, 0.07, 0.07] }"""
MONKEY = "Suzanne"
"""Blender's own head, of a file that is written beside the recipe, in place of a shape of recipes."""
BUST = "[[0.0, 0.1, 0.4, 0.55, 1.4], [0.02, -0.08, 0.0, 0.42, 1.0], [0.0, -0.52, 0.14, 0.2, 0.7], \
[0.0, 0.1, -0.5, 0.4, 1.1], [0.5, 0.12, -0.8, 0.4, 1.0], [-0.5, 0.08, -0.8, 0.4, 1.0], [0.0, 0.1, -0.85, 0.4, 0.6], \
[0.23, -0.55, 0.33, 0.2, -1.6], [-0.21, -0.55, 0.34, 0.2, -1.6], [0.0, -0.6, -0.18, 0.17, -1.2], \
[0.6, 0.1, 0.3, 0.2, 0.9], [-0.6, 0.12, 0.3, 0.2, 0.9]]"
EIGHT = [
    [round(f, 3) for f in (0.85 * math.sin(t), 0.3 * math.cos(t), 0.62 * math.sin(2 * t))]
    for t in (2 * math.pi * k / 24 for k in range(24))
]
BALL = """shape = { kind = "superquadric", size = [1.0, 0.95, 1.05], exponents = [2.0, 2.0] }
offset = [0.1, 0.05, 0.62]"""
BACK = """shape = { kind = "superquadric", size = [1.3, 0.42, 1.3], exponents = [4.0, 4.0] }
turn_deg = [-8.0, 0.0, 20.0]
offset = [-0.14, 0.4, 0.55]"""
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
    "crate": Trial(
        'kind = "superquadric", size = [0.95, 0.8, 0.7], exponents = [10.0, 10.0]',
        (-12.0, 20.0, 35.0),
        "city",
        "plus",
        3.7,
        200.0,
        50.0,
        (-10.0, 55.0),
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
    "jug": Trial(
        'kind = "surface_of_revolution", profile = [[0.0, -0.85], [0.5, -0.8], [0.72, -0.35], [0.6, 0.2], [0.4, 0.5], \
[0.38, 0.66], [0.22, 0.78], [0.0, 0.82]]',
        (0.0, 0.0, 0.0),
        "city",
        "plus",
        3.8,
        -70.0,
        50.0,
        (-15.0, 50.0),
        more=(HANDLE, SPOUT, SPOUT_END),
    ),
    "bust": Trial(
        f'kind = "soft_balls", radius = 1.2, resolution = 160, balls = {BUST}',
        (0.0, 0.0, 0.0),
        "courtyard",
        "plus",
        3.8,
        -90.0,
        55.0,
        (-20.0, 50.0),
    ),
    "eight": Trial(
        f'kind = "tube", closed = true, path = {EIGHT}, radii = {[0.2] * len(EIGHT)}',
        (10.0, 0.0, 30.0),
        "interior",
        "plus",
        3.7,
        -60.0,
        50.0,
        (-20.0, 50.0),
    ),
    "ingot": Trial(
        'kind = "superquadric", size = [1.5, 1.0, 1.1], exponents = [8.0, 6.0]',
        (8.0, -12.0, 35.0),
        "courtyard",
        "plus",
        3.7,
        -40.0,
        45.0,
        (-15.0, 50.0),
        ground=0.1,
        strength=0.5,
    ),
    "die": Trial(
        'kind = "superquadric", size = [1.1, 1.3, 1.0], exponents = [5.0, 4.0]',
        (-15.0, 10.0, 60.0),
        "night",
        "plus",
        3.6,
        30.0,
        45.0,
        (-15.0, 50.0),
    ),
    "drum": Trial(
        'kind = "superquadric", size = [1.6, 1.1, 1.0], exponents = [2.0, 8.0]',
        (35.0, 15.0, 20.0),
        "sunrise",
        "plus",
        3.7,
        -80.0,
        50.0,
        (-15.0, 50.0),
        ground=0.3,
    ),
    "tray": Trial(
        'kind = "surface_of_revolution", profile = [[0.0, -0.3], [0.45, -0.28], [0.85, -0.1], [1.02, 0.14], \
[0.98, 0.24], [0.86, 0.18], [0.7, 0.04], [0.4, -0.06], [0.0, -0.09]]',
        (60.0, 0.0, 35.0),
        "city",
        "plus",
        3.7,
        -70.0,
        45.0,
        (-15.0, 50.0),
        (1.05, 0.75, 1.0),
    ),
    "crown": Trial(
        'kind = "ring", radius = 0.78, thickness = 0.26, waves = 5, bend = 0.1, swell = 0.12, phase_deg = 60.0',
        (55.0, -15.0, 0.0),
        "forest",
        "plus",
        3.7,
        -80.0,
        50.0,
        (-15.0, 50.0),
    ),
    "pawn": Trial(
        'kind = "superquadric", size = [1.6, 1.3, 0.4], exponents = [3.0, 3.0]',
        (5.0, -5.0, 25.0),
        "sunrise",
        "plus",
        3.7,
        -50.0,
        50.0,
        (-10.0, 55.0),
        more=(BALL,),
    ),
    "chair": Trial(
        'kind = "superquadric", size = [1.3, 1.2, 0.42], exponents = [4.0, 4.0]',
        (0.0, 0.0, 20.0),
        "interior",
        "plus",
        3.8,
        -70.0,
        50.0,
        (-10.0, 50.0),
        more=(BACK,),
    ),
    "bowl": Trial(
        'kind = "surface_of_revolution", profile = [[0.0, -0.45], [0.4, -0.45], [0.45, -0.35], [0.8, -0.1], \
[1.0, 0.25], [1.05, 0.45]]',
        (0.0, 0.0, 0.0),
        "courtyard",
        "arc",
        3.4,
        40.0,
        60.0,
        (-5.0, 50.0),
    ),
    "cup": Trial(
        'kind = "surface_of_revolution", profile = [[0.0, -0.6], [0.45, -0.6], [0.5, -0.54], [0.52, -0.1], \
[0.55, 0.4], [0.57, 0.6]]',
        (0.0, 0.0, 0.0),
        "city",
        "arc",
        3.2,
        100.0,
        60.0,
        (-5.0, 50.0),
    ),
    "plate": Trial(
        'kind = "surface_of_revolution", profile = [[0.0, -0.1], [0.5, -0.1], [0.56, -0.06], [0.62, -0.03], \
[0.98, 0.12], [1.0, 0.15], [0.97, 0.16], [0.6, 0.03], [0.54, -0.01], [0.45, -0.03], [0.0, -0.03]]',
        (0.0, 0.0, 0.0),
        "interior",
        "zigzag",
        3.8,
        60.0,
        60.0,
        (20.0, 65.0),
    ),
    "basin": Trial(
        'kind = "surface_of_revolution", profile = [[0.0, -0.5], [0.4, -0.5], [0.48, -0.4], [0.8, -0.1], [1.0, 0.3], \
[1.02, 0.36], [0.98, 0.4], [0.92, 0.34], [0.7, 0.0], [0.4, -0.25], [0.0, -0.32]]',
        (0.0, 0.0, 0.0),
        "sunset",
        "arc",
        3.6,
        20.0,
        60.0,
        (0.0, 55.0),
    ),
    "mug": Trial(
        'kind = "surface_of_revolution", profile = [[0.0, -0.6], [0.42, -0.6], [0.5, -0.55], [0.53, -0.45], \
[0.55, 0.5], [0.54, 0.58], [0.5, 0.6], [0.45, 0.57], [0.43, 0.45], [0.41, -0.35], [0.36, -0.45], [0.0, -0.47]]',
        (0.0, 0.0, 0.0),
        "city",
        "arc",
        3.5,
        -70.0,
        60.0,
        (0.0, 50.0),
        more=(EAR,),
    ),
    "monkey": Trial(
        MONKEY,
        (0.0, 0.0, 0.0),
        "city",
        "plus",
        2.75,
        -90.0,
        50.0,
        (-15.0, 45.0),
    ),
    "goblet": Trial(
        'kind = "surface_of_revolution", profile = [[0.0, -0.85], [0.45, -0.85], [0.42, -0.8], [0.15, -0.73], \
[0.1, -0.65], [0.1, -0.25], [0.12, -0.15], [0.4, 0.05], [0.55, 0.35], [0.58, 0.65], [0.55, 0.85]]',
        (0.0, 0.0, 0.0),
        "courtyard",
        "arc",
        3.4,
        30.0,
        65.0,
        (-10.0, 45.0),
    ),
}


Level = tuple[Axis, float]


def level(text: str) -> Level:
    """An axis and its level of AXIS=LEVEL."""
    name, _, value = text.partition("=")
    axis = BY_NAME.get(name)
    if axis is None or axis.own_truth:
        known = ", ".join(name for name, axis in BY_NAME.items() if not axis.own_truth)
        raise argparse.ArgumentTypeError(f"expected AXIS=LEVEL with one of {known}, found {text!r}")
    return axis, float(value)


def named(name: str, worse: Sequence[Level]) -> str:
    """A shape and what is worse, in a word."""
    return ".".join([name, *(f"{axis.name}-{at:g}" for axis, at in worse)])


def make(name: str, options: Sequence[str], worse: Sequence[Level]) -> Path:
    """Render, fit and score a shape, as far as that is not done; the prediction's folder."""
    scene = FOLDER / "scenes" / name / "scene.toml"
    scene.parent.mkdir(parents=True, exist_ok=True)
    TRIALS[name].write(scene, name)
    rendered = [each for each in worse if each[0].rendered]
    truth, photographs = named(name, rendered), FOLDER / "datasets" / named(name, worse)
    fitted = FOLDER / "predictions" / "-".join([photographs.name, *options]).replace("/", "_")
    make_folders(
        FOLDER / "datasets" / truth,
        fitted,
        FOLDER / "predictions" / f"{truth}-oracle",
        ("--scene", scene, "--resolution", 160, "--train", 50, "--test", 6, *words(rendered)),
        ("--preset", "fast", *(word for option in options for word in ("--set", option))),
        (photographs, words([each for each in worse if not each[0].rendered])),
    )
    return fitted


def words(worse: Sequence[Level]) -> list[str]:
    """As options of `shinypartial generate` or `perturb`."""
    return [word for axis, at in worse for word in axis.arguments(at)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Make what is missing, and write the figures after every shape."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", nargs="*", choices=TRIALS, default=list(TRIALS))
    parser.add_argument("--set", action="append", default=[], help="SECTION.OPTION=VALUE of `panoless fit`")
    parser.add_argument("--worse", nargs="*", type=level, default=[], metavar="AXIS=LEVEL", help="of the photographs")
    options = parser.parse_args(arguments)
    for name in options.shapes:
        folder = make(name, options.set, options.worse)
        found, verdict = figures(folder) or {}, read_info(folder).verdict
        found = {key: value for key, value in found.items() if not key.startswith("seconds")}
        found["verdict"] = verdict and str(verdict.verdict)
        name = named(name, options.worse)
        print(json.dumps({name: found}, indent=1))
        if not options.set:
            numbers = json.loads(NUMBERS.read_text(encoding="utf-8")) if NUMBERS.exists() else {}
            write_json(NUMBERS, {**numbers, name: found})


if __name__ == "__main__":
    main()
