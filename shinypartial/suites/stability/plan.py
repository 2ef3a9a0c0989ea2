"""What the suite does, as data: cells, the jobs that make them, and the command of each job."""

import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from shinypartial.core.errors import InputError
from shinypartial.scene import DEVELOPMENT, load_scene, scene_names
from shinypartial.suites.jobs import Job, Size, require_known
from shinypartial.suites.stability.axes import ANCHORS, AXES, BY_NAME, Axis

FAST, DEFAULT, PAPER = (
    f"panoless fit {{dataset}} --preset {preset} --config.seed {{seed}} --output {{prediction}}"
    for preset in ("fast", "default", "paper")
)
METHODS = {"fast": FAST, "default": DEFAULT, "paper": PAPER}
SCENES = ("vase", "mirror", "sculpture", "pebble", "twisted-column")
"""Those of a plan by default."""
#: The small plan takes what comes with the package, so that it needs no Blender.
TINY = "tiny-vase"
SIMPLE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
SIZE = Size(160, 50, 8)
"""Of its datasets unless another is requested."""
Plans = Literal["core", "all", "clean", "tiny"]


@dataclass(frozen=True)
class Cell:
    """One fit: a method on a scene at a level of an axis; without either, on the clean dataset."""

    scene: str
    split: str
    method: str
    axis: str | None
    level: float | None
    seed: int

    @property
    def condition(self) -> str:
        """Scene, axis and level in a word."""
        return self.scene if self.axis is None else f"{self.scene}.{self.axis}-{self.level:g}"

    @property
    def name(self) -> str:
        """The name of its prediction folder."""
        return f"{self.condition}.{self.seed}.{self.method}"


@dataclass(frozen=True)
class Plan:
    """All cells and the jobs that make them, in the order in which they are written down."""

    size: Size
    cells: tuple[Cell, ...]
    jobs: tuple[Job, ...]

    @property
    def facts(self) -> dict[str, Any]:
        """What is stored beside the jobs."""
        return {"size": asdict(self.size), "cells": list(map(asdict, self.cells))}


def conditions(plan: Plans, axes: Sequence[str] = ()) -> Iterator[tuple[str | None, float | None]]:
    """Axis and level of every cell of a scene: clean, the chosen axes, and the anchors."""
    yield None, None
    require_known("axes", axes, BY_NAME)
    if plan in ("clean", "tiny"):
        yield from (("rotation", 0.5), ("rotation", 2.0)) if plan == "tiny" else ()
        return
    taken = [axis for axis in AXES if axis.name in axes or (not axes and axis.kind in ("core", _further(plan)))]
    found = [(axis.name, float(level)) for axis in taken for level in axis.levels]
    yield from dict.fromkeys([*found, *ANCHORS])


def _further(plan: Plans) -> str:
    return "further" if plan == "all" else "core"


def make_plan(
    plan: Plans,
    methods: dict[str, str],
    seeds: Sequence[int],
    *,
    scenes: Sequence[str] = (),
    axes: Sequence[str] = (),
    size: Size = SIZE,
) -> Plan:
    """Every cell and job. Raises InputError for scenes, axes or methods that can't be used."""
    usual: Sequence[str] = (TINY,) if plan == "tiny" else SCENES
    splits = {TINY: DEVELOPMENT} if plan == "tiny" else {name: load_scene(name).split for name in scene_names()}
    require_known("scenes", scenes, splits)
    _check_methods(methods)
    cells: list[Cell] = []
    jobs: dict[str, Job] = {}
    for scene in scenes or usual:
        for axis, level in conditions(plan, axes):
            for seed in seeds:
                data = _dataset_jobs(scene, BY_NAME.get(axis or ""), level, seed, size)
                jobs |= {job.name: job for job in data}
                for method, template in methods.items():
                    cell = Cell(scene, splits[scene], method, axis, level, seed)
                    cells.append(cell)
                    jobs |= {job.name: job for job in _fit_jobs(cell, template, data)}
    return Plan(size, tuple(cells), tuple(jobs.values()))


def parse_methods(names: Sequence[str], templates: Sequence[str]) -> dict[str, str]:
    """Presets by name and other methods as NAME=COMMAND; InputError for anything else."""
    for name in names:
        if name not in METHODS:
            remedy = "Choose some of them, or give another one as --method NAME='COMMAND'."
            raise InputError(expected=f"methods: {', '.join(METHODS)}", found=repr(name), remedy=remedy)
    pairs = [each.partition("=") for each in templates]
    return {**{name: METHODS[name] for name in names}, **{name: command for name, _, command in pairs}}


def _check_methods(methods: dict[str, str]) -> None:
    for name, template in methods.items():
        try:
            known = template.format(dataset="", prediction="", seed=0) != template
        except (KeyError, IndexError, ValueError):
            known = False
        if not known or not SIMPLE_NAME.fullmatch(name) or "{dataset}" not in template:
            raise InputError(
                expected="methods as NAME='COMMAND {dataset} {prediction}', where {seed} may stand, too",
                found=f"{name}={template}",
                remedy="Write other braces twice; a name has letters, digits, - and _ only.",
            )
    if not methods:
        raise InputError(expected="at least one method", found="none", remedy="Name one with --methods or --method.")


def _dataset_jobs(scene: str, axis: Axis | None, level: float | None, seed: int, size: Size) -> list[Job]:
    """The jobs that make a dataset, its own last; the first one's name is that of the clean dataset."""

    def rendered(name: str, *options: str) -> Job:
        return Job(f"render/{name}", " ".join((size.rendering(scene), *options, f"--output datasets/{name}")))

    if scene == TINY:
        clean = Job(f"perturb/{scene}", f"shinypartial perturb {scene} --output datasets/{scene}")
    else:
        clean = rendered(scene)
    if axis is None or level is None:
        return [clean]
    name, options = f"{scene}.{axis.name}-{level:g}", shlex.join(axis.arguments(level))
    if axis.rendered:
        return [clean, rendered(name, options)]
    before = [clean, rendered(f"{scene}.{axis.name}", axis.around)] if axis.around else [clean]
    source, name = before[-1].name.partition("/")[2], f"{name}.{seed}"
    copy = f"shinypartial perturb datasets/{source} --output datasets/{name} --link --seed {seed} {options}"
    return [*before, Job(f"perturb/{name}", copy, (before[-1].name,))]


def _fit_jobs(cell: Cell, template: str, data: Sequence[Job]) -> Iterator[Job]:
    axis = BY_NAME.get(cell.axis or "")
    folders = [f"datasets/{job.name.partition('/')[2]}" for job in data]
    truth = folders[-1] if axis is None or axis.rendered or axis.own_truth else folders[-2]
    prediction = f"predictions/{cell.name}"
    command = template.format(dataset=folders[-1], prediction=prediction, seed=cell.seed)
    yield Job(f"fit/{cell.name}", command, (data[-1].name,))
    score = f"shinypartial evaluate {prediction} --dataset {truth}"
    yield Job(f"score/{cell.name}", score, (f"fit/{cell.name}", *dict.fromkeys((data[0].name, data[-1].name))))
