"""Make the tables of docs/results/ablations.md: one part left out, surfels flat and curved, the paper's method.

    for S in vase cola mirror deformed-mirror sculpture; do shinypartial generate --scene $S --resolution 400; done
    for S in vase cola mirror deformed-mirror sculpture; do shinypartial oracle datasets/$S-400; done
    python docs/examples/ablations.py

Every row is `panoless fit` and `shinypartial evaluate` in a process of its own. What was scored before is kept, so the
command continues where it stopped; delete predictions/ablations and the runs of these names to begin again. Normals and
renders are scored on every fifth test view. `--seeds 0 1 2` sets the seeds, `--tables levers counts` makes some tables
only, `--collect` none. The numbers lie in docs/results/ablations.json, and the tables between the marks of the page.
"""

import argparse
import functools
import json
import statistics
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from shinypartial.evaluation.scores import Scores, read_scores
from shinypartial.io.files import write_between, write_json
from shinypartial.prediction.format import read_info

PAGE = Path("docs/results/ablations.md")
NUMBERS = Path("docs/results/ablations.json")
PREDICTIONS = Path("predictions/ablations")
THINNED = Path("build/ablations")
TEST_VIEW_EVERY = 5
PAPER_DOWNSCALE = 4


@dataclass(frozen=True)
class Row:
    """One configuration on one scene; `arguments` follow `panoless fit DATASET`."""

    name: str
    scene: str
    arguments: tuple[str, ...] = ()
    one_seed: bool = False


@dataclass(frozen=True)
class PaperFigures:
    """Scores under the protocol paper-v1: dB, degrees."""

    environment: float
    normal_mean: float
    normal_median: float
    render: float


@dataclass(frozen=True)
class Figures:
    """Scores of one prediction: dB, degrees, seconds."""

    full: float | None
    observed: float | None
    normal_mean: float | None
    normal_median: float | None
    render: float | None
    auroc: float | None
    seconds: float
    model: str
    parameters: int
    paper: PaperFigures | None


@dataclass(frozen=True)
class Table:
    """Rows under a heading, with a sentence that says how to read them."""

    title: str
    text: str
    rows: tuple[Row, ...]
    figure: tuple[str, ...] = ("observed",)
    """The place of what is shown among the figures of a fit; nothing: the text alone."""


SCENES = ("vase", "cola", "mirror", "deformed-mirror", "sculpture")
LEVERS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("random surfels", ("--config.surfels.initial", "random")),
    ("flat surfels", ("--config.surfels.no-curved",)),
)
TABLES = {
    "levers": Table(
        "Leave one out",
        "Environment, linear PSNR over observed directions, of `panoless fit` and without one of its parts: medians "
        "over seeds.",
        (
            *(Row("default", scene) for scene in SCENES),
            *(Row("surfels", scene, ("--model", "surfels")) for scene in SCENES),
            *(Row(name, "sculpture", ("--model", "surfels", *arguments)) for name, arguments in LEVERS),
            *(
                Row(name, scene, (f"--config.environment.no-{option}",), one_seed=True)
                for name, option, scenes in (
                    ("with pixels that see the object again", "trace", SCENES[:3]),
                    ("no fill", "fill", ("mirror", "deformed-mirror")),
                )
                for scene in scenes
            ),
        ),
    ),
    "counts": Table(
        "Surfels, flat and curved",
        "The vase; charts by `shinypartial chart predictions/ablations/counts-* --size primitives`.\n\n"
        "![Environment PSNR (sRGB) against the number of surfels](../images/chart-counts.svg)\n"
        "![Median normal error against the number of surfels](../images/chart-counts-normals.svg)",
        tuple(
            Row(
                f"{count} {kind}",
                "vase",
                ("--model", "surfels", "--config.surfels.count", str(count), f"--config.surfels.{switch}"),
                one_seed=True,
            )
            for kind, switch in (("flat", "no-curved"), ("curved", "curved"))
            for count in (500, 1000, 2000, 4000, 8000, 16000)
        ),
        (),
    ),
    "paper": Table(
        "The paper's method",
        "All 45,000 steps at a quarter of the resolution, with 6,250 surfels at first and 12,500 at most, scored at "
        "400 pixels. Environment by the paper's protocol.",
        tuple(
            Row(
                preset,
                scene,
                (
                    *("--preset", preset, "--config.downscale", str(PAPER_DOWNSCALE)),
                    *("--config.surfels.count", str(100_000 // PAPER_DOWNSCALE**2)),
                    *("--config.density.max-surfels", str(200_000 // PAPER_DOWNSCALE**2)),
                ),
                one_seed=True,
            )
            for preset, scenes in (
                ("paper", SCENES),
                ("paper-rho-weighted", SCENES[:1]),
                ("paper-no-silhouette", SCENES[:1]),
                ("paper-no-normal", SCENES[:1]),
            )
            for scene in scenes
        ),
        ("paper", "environment"),
    ),
}


def figures_of(folder: Path) -> Figures:
    """Read a scored prediction folder. Normals are over pixels that see the environment."""
    scores, info = read_scores(folder), read_info(folder)
    environment = scores.environment.as_predicted if scores.environment else None
    normals = scores.normals_environment
    return Figures(
        full=environment and environment.full.psnr_linear,
        observed=environment and environment.observed and environment.observed.psnr_linear,
        normal_mean=normals and normals.mean_angular_error_deg,
        normal_median=normals and normals.median_angular_error_deg,
        render=scores.render and scores.render.psnr,
        auroc=scores.calibration and scores.calibration.visibility_error_auroc,
        seconds=sum(info.seconds.values()),
        model=(info.model or "").split(" ")[0],
        parameters=sum(count for name, count in info.parameter_counts.items() if not name.startswith("environment")),
        paper=paper_figures_of(scores),
    )


def paper_figures_of(scores: Scores) -> PaperFigures | None:
    """Read what was scored under the paper's protocol."""
    paper = scores.paper
    if paper is None or paper.environment is None or paper.normals is None or paper.render is None:
        return None
    return PaperFigures(
        environment=paper.environment.psnr_reinhard,
        normal_mean=paper.normals.mean_angular_error_deg,
        normal_median=paper.normals.median_angular_error_deg,
        render=paper.render.psnr,
    )


def folder_of(table: str, row: Row, seed: int) -> Path:
    """Where the prediction of a row and a seed lies."""
    words = "".join(letter if letter.isalnum() else "-" for letter in row.name.lower())
    return PREDICTIONS / f"{table}-{row.scene}-{words}-{seed}"


def thinned(dataset: Path) -> Path:
    """A dataset of the same files with every fifth test view."""
    target = THINNED / dataset.name
    target.mkdir(parents=True, exist_ok=True)
    for source in dataset.iterdir():
        link = target / source.name
        if source.name != "transforms_test.json" and not link.exists():
            link.symlink_to(source.resolve())
    transforms = json.loads((dataset / "transforms_test.json").read_text(encoding="utf-8"))
    transforms["frames"] = transforms["frames"][::TEST_VIEW_EVERY]
    if not (target / "transforms_test.json").exists():
        write_json(target / "transforms_test.json", transforms)
    return target


def make(table: str, row: Row, seed: int) -> None:
    """Fit and score a row, unless it is there."""
    folder = folder_of(table, row, seed)
    if (folder / "scores.json").exists():
        return
    dataset = thinned(Path("datasets") / f"{row.scene}-400")
    print(f"— {table}: {row.name}, {row.scene}, seed {seed}", flush=True)
    script = Path(sys.executable).parent
    arguments = [*row.arguments, "--config.seed", str(seed), "--output", str(folder)]
    subprocess.run([script / "panoless", "fit", dataset, *arguments], check=True)
    scoring = ["--dataset", dataset, "--protocol", "both" if table == "paper" else "linear-v1"]
    subprocess.run([script / "shinypartial", "evaluate", folder, *scoring], check=True)


def seeds_of(row: Row, seeds: list[int]) -> list[int]:
    """Long rows have one seed."""
    return seeds[:1] if row.one_seed else seeds


def found(table: str, row: Row, seeds: list[int]) -> list[Figures]:
    """What was scored of a row."""
    folders = [folder_of(table, row, seed) for seed in seeds_of(row, seeds)]
    return [figures_of(folder) for folder in folders if (folder / "scores.json").exists()]


def cell(made: dict[str, Any] | None, place: Sequence[str]) -> str:
    """Median over fits, in dB."""
    values = (
        [functools.reduce(lambda part, key: part and part[key], place, fit) for fit in made["fits"]] if made else []
    )
    return f"{statistics.median(values):.2f}" if values and None not in values else "–"


def markdown(content: Table, known: dict[tuple[str, str], dict[str, Any]]) -> Iterator[str]:
    """A table as Markdown, scenes by variants."""
    yield from (f"## {content.title}", "", content.text, "")
    if not content.figure:
        return
    names = list(dict.fromkeys(row.name for row in content.rows))
    yield f"| Scene | {' | '.join(names)} |"
    yield "|---" * (1 + len(names)) + "|"
    for scene in SCENES:
        cells = [cell(known.get((scene, name)), content.figure) for name in names]
        if set(cells) != {"–"}:
            yield f"| {scene} | {' | '.join(cells)} |"
    yield ""


def collect(seeds: list[int]) -> None:
    """Bring the numbers up to date with what is there, then the tables of the page."""
    numbers = json.loads(NUMBERS.read_text(encoding="utf-8")) if NUMBERS.exists() else {}
    lines = []
    for table, content in TABLES.items():
        known = {(made["scene"], made["name"]): made for made in numbers.get(table, [])}
        for row in content.rows:
            if fits := [asdict(each) for each in found(table, row, seeds)]:
                made = {"name": row.name, "scene": row.scene, "arguments": row.arguments, "fits": fits}
                known[row.scene, row.name] = made
        numbers[table] = list(known.values())
        lines += markdown(content, known)
    write_json(NUMBERS, numbers)
    write_between(PAGE, "ablations", lines[:-1])


def main() -> None:
    """Make the tables requested, then the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--tables", nargs="+", choices=sorted(TABLES), default=sorted(TABLES))
    parser.add_argument("--collect", action="store_true", help="write the page from what is there")
    arguments = parser.parse_args()
    if not arguments.collect:
        for table in arguments.tables:
            for row in TABLES[table].rows:
                for seed in seeds_of(row, arguments.seeds):
                    make(table, row, seed)
                    collect(arguments.seeds)
    collect(arguments.seeds)


if __name__ == "__main__":
    main()
