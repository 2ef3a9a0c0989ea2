"""The tables as data: rows that are commands, columns that are scores, and the jobs that make them."""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from shinypartial.metrics.registry import Direction, metric
from shinypartial.suites.jobs import Job, Size, require_known
from shinypartial.suites.tables import published
from shinypartial.suites.tables.published import (
    DR,
    MATERIAL,
    NO_NORMAL,
    NO_SILHOUETTE,
    PAPER,
    REF,
    RHO,
    SHADER,
    SILHOUETTE,
)

TableName = Literal["main", "fairness", "start", "ablation", "roughness", "matter", "self-reflection", "pose-jitter"]
SIZE = Size(400, 100, 20)
"""Of its datasets unless another is requested; those of the paper have 800 pixels, 100 training and 200 test views."""
OURS, ORACLE = "ours", "oracle baseline"
CellKey = tuple[str, str, int]
"""Scene with condition, method, seed."""


@dataclass(frozen=True)
class Method:
    """A row of a table: a command with {dataset}, {prediction}, {seed} and perhaps {schedule}."""

    name: str
    command: str

    @property
    def slug(self) -> str:
        """Its name in files."""
        return re.sub(r"[^a-z0-9]+", "-", self.name.lower().replace("ρ", "rho")).strip("-")


@dataclass(frozen=True)
class Condition:
    """What a dataset is made with; nothing for the scene as it is."""

    name: str = ""
    render: str = ""
    """Options of `shinypartial generate`."""
    perturb: str = ""
    """Options of `shinypartial perturb`; the copy is scored against the dataset that it was made of."""

    def of(self, scene: str) -> str:
        """What a row says of the scene."""
        return f"{scene}, {self.name}" if self.name else scene


@dataclass(frozen=True)
class Column:
    """A score, by its path in the scores; or CPU `seconds` of the command, or `parameters`."""

    path: str
    title: str
    digits: int = 2
    factor: float = 1.0

    @property
    def direction(self) -> Direction:
        """Which values are better; nothing is said of parameters."""
        if self.path in OF_COST:
            return Direction.LOWER if self.path == "seconds" else Direction.DESCRIPTION
        return metric(self.path.rpartition(".")[2]).direction


OF_COST = ("seconds", "parameters")


ENVIRONMENT = (
    Column("paper.environment.psnr_reinhard", "Environment PSNR"),
    Column("paper.environment.ssim_reinhard", "SSIM", 3),
    Column("paper.environment.lpips_alex", "LPIPS", 3),
    Column("paper.environment.l1_reinhard", "L1", 3),
)
NORMALS = (
    Column("paper.normals.mean_angular_error_deg", "Normals mean °"),
    Column("paper.normals.median_angular_error_deg", "median °"),
    Column("paper.normals.rmse_angular_error_deg", "RMSE °"),
    Column("paper.normals.fraction_within_5deg", "< 5° %", factor=100),
    Column("paper.normals.fraction_within_11_25deg", "< 11.25° %", factor=100),
    Column("paper.normals.fraction_within_22_5deg", "< 22.5° %", factor=100),
)
RENDER = (
    Column("paper.render.psnr", "Render PSNR"),
    Column("paper.render.ssim", "SSIM", 3),
    Column("render.lpips_alex", "LPIPS", 3),
    Column("paper.render.l1", "L1", 3),
)
SECONDS = Column("seconds", "CPU seconds", 0)
COST = (SECONDS, Column("parameters", "Parameters", 0))
OBSERVED = Column("environment.as_predicted.observed.psnr_linear", "Environment, observed, linear PSNR")
SEES_ENVIRONMENT = (
    Column("normals_environment.mean_angular_error_deg", "Normals that see the environment, mean °"),
    Column("normals_environment.median_angular_error_deg", "median °"),
)


@dataclass(frozen=True)
class Table:
    """Rows and columns under a heading."""

    title: str
    text: str
    scenes: tuple[str, ...]
    methods: tuple[Method, ...]
    columns: tuple[Column, ...]
    figures: published.Figures
    conditions: tuple[Condition, ...] = (Condition(),)
    averaged: bool = False
    """Whether means over scenes are shown, too."""
    shown: tuple[Column, ...] = (ENVIRONMENT[0], NORMALS[0])
    """Columns of the page; its numbers have all."""


def _fit(preset: str, options: str = "{schedule}") -> str:
    return f"panoless fit {{dataset}} --preset {preset} {options} --config.seed {{seed}} --output {{prediction}}"


COMPARED = (
    Method(DR, _fit("3dgs-dr")),
    Method(SHADER, _fit("gaussian-shader")),
    Method(REF, _fit("ref-gaussian")),
    Method(MATERIAL, _fit("material-refgs")),
)
PAPERS = Method(PAPER, _fit("paper"))
DEFAULT = Method(OURS, _fit("default", ""))
BASELINE = Method(ORACLE, "shinypartial oracle {dataset} --output {prediction}")
ON_OURS = "--config.surfels.initial thin-plate"

TABLES: dict[TableName, Table] = {
    "main": Table(
        "Main table",
        "All methods on three scenes.",
        ("vase", "cola", "mirror"),
        (*COMPARED, PAPERS, DEFAULT, BASELINE),
        (*ENVIRONMENT, *NORMALS, *COST),
        published.MAIN,
        averaged=True,
        shown=(ENVIRONMENT[0], NORMALS[0], SECONDS),
    ),
    "fairness": Table(
        "The same silhouettes for all",
        "With the paper's silhouette term in the first steps.",
        ("cola", "vase", "mirror"),
        (Method(SILHOUETTE, _fit("material-refgs-silhouette")), PAPERS, DEFAULT),
        (NORMALS[0], NORMALS[1], NORMALS[3], *COST),
        published.FAIRNESS,
        shown=NORMALS[:1],
    ),
    "start": Table(
        "The same first surface for all",
        "As in the main table, but primitives start on our first surface.",
        ("vase", "cola", "mirror"),
        tuple(Method(f"{each.name} on our first surface", f"{each.command} {ON_OURS}") for each in (*COMPARED, PAPERS)),
        (*ENVIRONMENT, *NORMALS, *COST),
        {},
    ),
    "ablation": Table(
        "Ablation of the paper's method",
        "One part changed or left out.",
        ("vase",),
        (
            PAPERS,
            Method(RHO, _fit("paper-rho-weighted")),
            Method(NO_SILHOUETTE, _fit("paper-no-silhouette")),
            Method(NO_NORMAL, _fit("paper-no-normal")),
            DEFAULT,
            BASELINE,
        ),
        (*ENVIRONMENT, *RENDER, *COST),
        published.ABLATION,
        shown=(ENVIRONMENT[0], RENDER[0]),
    ),
    "roughness": Table(
        "Roughness",
        "The same scene of a rougher material.",
        ("vase",),
        (COMPARED[1], COMPARED[3], PAPERS, DEFAULT, BASELINE),
        (ENVIRONMENT[0], OBSERVED, *NORMALS[:2], RENDER[0], *COST),
        {},
        tuple(
            Condition(f"roughness {level}", render=f"--roughness {level}") if level else Condition()
            for level in (0, 0.1, 0.2, 0.3)
        ),
        shown=ENVIRONMENT[:1],
    ),
    "matter": Table(
        "More than a mirror",
        "Scenes with parts that are rough, colored or matte.",
        ("teapot", "coffee"),
        (*COMPARED, PAPERS, DEFAULT, BASELINE),
        (ENVIRONMENT[0], OBSERVED, *NORMALS[:2], RENDER[0], *COST),
        {},
        shown=(ENVIRONMENT[0], NORMALS[0], RENDER[0], SECONDS),
    ),
    "self-reflection": Table(
        "Self-reflection",
        "Scenes that see themselves; `not traced` takes every mirrored ray for one that meets the surroundings.",
        ("vase", "dish", "horseshoe"),
        (PAPERS, Method("ours, not traced", _fit("default", "--config.environment.no-trace")), DEFAULT, BASELINE),
        (ENVIRONMENT[0], OBSERVED, *NORMALS[:2], *SEES_ENVIRONMENT, *COST),
        {},
        shown=(OBSERVED,),
    ),
    "pose-jitter": Table(
        "Cameras that are turned",
        "Training cameras are turned by an angle about random axes.",
        ("vase",),
        (PAPERS, Method("ours, poses as stated", _fit("default", "--set corrections.poses=off")), DEFAULT),
        (*ENVIRONMENT, *NORMALS[:2], *COST),
        published.JITTER,
        (
            Condition(),
            *(Condition(f"cameras turned by {d}°", perturb=f"--cameras.rotation-deg {d}") for d in (0.5, 1)),
        ),
    ),
}


@dataclass(frozen=True)
class Cell:
    """One fit; tables share those that they have in common."""

    scene: str
    condition: Condition
    method: Method
    seed: int

    @property
    def dataset(self) -> str:
        """The name of what it is fitted to."""
        words = (self.scene, re.sub(r"[^a-z0-9.]+", "-", self.condition.name).strip("-"))
        return ".".join(filter(None, words)) + (f".{self.seed}" if self.condition.perturb else "")

    @property
    def name(self) -> str:
        """The name of its prediction folder."""
        return f"{self.dataset}.{self.method.slug}.{self.seed}"

    @property
    def key(self) -> CellKey:
        """What distinguishes its figures."""
        return self.condition.of(self.scene), self.method.name, self.seed


@dataclass(frozen=True)
class TablePlan:
    """All cells and the jobs that make them."""

    size: Size
    schedule: str
    cells: tuple[Cell, ...]
    jobs: tuple[Job, ...]

    @property
    def facts(self) -> dict[str, Any]:
        """What is stored beside the jobs."""
        return {"size": asdict(self.size), "schedule": self.schedule}


def make_plan(
    tables: Sequence[TableName],
    seeds: Sequence[int],
    size: Size = SIZE,
    *,
    scenes: Sequence[str] = (),
    methods: Sequence[str] = (),
    schedule: str = "",
    without: Collection[CellKey] = (),
) -> TablePlan:
    """Every cell of the tables but those of `without`, once, and its jobs.

    `schedule` are options of `panoless fit` for all but ours.

    Raises InputError for scenes and methods of no table.
    """
    require_known("scenes", scenes, sorted({scene for table in TABLES.values() for scene in table.scenes}))
    require_known("methods", methods, sorted({method.slug for table in TABLES.values() for method in table.methods}))
    cells: dict[str, Cell] = {}
    jobs: dict[str, Job] = {}
    for name in tables:
        for cell in _cells(TABLES[name], seeds):
            requested = (not scenes or cell.scene in scenes) and (not methods or cell.method.slug in methods)
            if requested and cell.key not in without:
                cells[cell.name] = cell
                jobs |= {job.name: job for job in _jobs(cell, size, schedule)}
    return TablePlan(size, schedule, tuple(cells.values()), tuple(jobs.values()))


def _cells(table: Table, seeds: Sequence[int]) -> Iterator[Cell]:
    """The oracle draws nothing, so that one seed is enough for it where the dataset is the same."""
    for scene in table.scenes:
        for condition in table.conditions:
            for method in table.methods:
                drawn = "{seed}" in method.command or condition.perturb
                for seed in seeds if drawn else seeds[:1]:
                    yield Cell(scene, condition, method, seed)


def _jobs(cell: Cell, size: Size, schedule: str) -> Iterator[Job]:
    rendered = cell.scene if cell.condition.perturb else cell.dataset
    words = [size.rendering(cell.scene), cell.condition.render, f"--output datasets/{rendered}"]
    truth = Job(f"render/{rendered}", " ".join(filter(None, words)))
    data = truth
    yield truth
    if cell.condition.perturb:
        copy = f"shinypartial perturb datasets/{rendered} --output datasets/{cell.dataset} --link --seed {cell.seed}"
        data = Job(f"perturb/{cell.dataset}", f"{copy} {cell.condition.perturb}", (truth.name,))
        yield data
    prediction = f"predictions/{cell.name}"
    places = {"dataset": f"datasets/{cell.dataset}", "prediction": prediction, "seed": cell.seed, "schedule": schedule}
    yield Job(f"fit/{cell.name}", " ".join(cell.method.command.format(**places).split()), (data.name,))
    score = f"shinypartial evaluate {prediction} --dataset datasets/{rendered}"
    yield Job(f"score/{cell.name}", score, (f"fit/{cell.name}", truth.name))
