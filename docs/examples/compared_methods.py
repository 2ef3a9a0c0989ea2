"""Make docs/results/compared-methods.md: other methods beside this one, on the same photographs.

    python docs/examples/compared_methods.py --datasets FOLDER

FOLDER holds the datasets `vase` and `mirror`: 50 training views of 160 × 160 px. Every row is `panoless fit` and
`shinypartial evaluate` in a process of its own; what was scored before is kept, so the command continues where it
stopped. `--rows vase` makes the rows of some datasets only, and `--collect` writes the page from what is there.
"""

import argparse
import resource
import subprocess
from dataclasses import asdict, dataclass
from pathlib import Path

from shinypartial.evaluation.scores import read_scores
from shinypartial.io.files import atomic_write, read_json, write_json
from shinypartial.prediction.format import read_info

PAGE = Path("docs/results/compared-methods.md")
NUMBERS = Path("docs/results/compared-methods.json")
PREDICTIONS = Path("predictions/compared-methods")
STEPS = {"vase": (1000, 3000), "mirror": (1000,), "tiny-vase": (1000,)}
SHARED = (
    *("--config.surfels.count", "3000"),
    *("--config.density.max-surfels", "8000"),
    *("--config.environment.resolution", "64"),
    *("--config.downscale", "2"),
)
METHODS = ("3dgs-dr", "gaussian-shader", "ref-gaussian", "material-refgs", "material-refgs-silhouette")
STARTS = {"thin-plate": "our first surface", "random": "random, as published"}
TITLES = {"vase": "Vase", "mirror": "Mirror", "tiny-vase": "Tiny Vase"}


@dataclass(frozen=True)
class Row:
    """One fit."""

    dataset: str
    method: str
    start: str
    arguments: tuple[str, ...]
    steps: int = 0
    """Zero where a preset says how many."""

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.dataset}-{self.method}-{self.start}-{self.steps}".replace(" ", "-")

    @property
    def key(self) -> tuple[str, str, str, int]:
        """What tells its figures from others."""
        return self.dataset, self.method, self.start, self.steps


@dataclass(frozen=True)
class Figures:
    """Scores in dB of linear light and in degrees, CPU seconds of the fit, and the number of primitives."""

    dataset: str
    method: str
    start: str
    steps: int
    observed: float | None
    normal_median: float | None
    normal_mean: float | None
    render: float
    cpu_seconds: float
    primitives: int

    @property
    def key(self) -> tuple[str, str, str, int]:
        """As that of its row."""
        return self.dataset, self.method, self.start, self.steps


def rows(datasets: list[str]) -> list[Row]:
    """Ours first, then the others on our first surface, then as published."""
    found = []
    for dataset in datasets:
        found.append(Row(dataset, "panoless", "chosen kind", ("--preset", "fast")))
        found.append(Row(dataset, "panoless", "surfels", ("--preset", "fast", "--model", "surfels")))
    for start in STARTS:
        for method in METHODS:
            for dataset in datasets:
                for steps in STEPS[dataset]:
                    how = "--config.iterations", str(steps), "--config.surfels.initial", start
                    found.append(Row(dataset, method, start, ("--preset", method, *SHARED, *how), steps))
    return found


def source_of(dataset: str, folder: Path) -> str:
    """Where a dataset lies; that which comes with the package has a name only."""
    return dataset if dataset == "tiny-vase" else str(folder / dataset)


def made(row: Row, folder: Path) -> Figures:
    """Fit and score one row."""
    prediction, dataset = PREDICTIONS / row.name, source_of(row.dataset, folder)
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    subprocess.run(["panoless", "fit", dataset, *row.arguments, "--output", str(prediction)], check=True)
    seconds = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    subprocess.run(["shinypartial", "evaluate", str(prediction)], check=True)
    scores, info = read_scores(prediction), read_info(prediction)
    observed, normals = scores.environment.as_predicted.observed, scores.normals
    return Figures(
        dataset=row.dataset,
        method=row.method,
        start=row.start,
        steps=row.steps,
        observed=None if observed is None else observed.psnr_linear,
        normal_median=None if normals is None else normals.median_angular_error_deg,
        normal_mean=None if normals is None else normals.mean_angular_error_deg,
        render=scores.render.psnr,
        cpu_seconds=round(seconds, 1),
        primitives=info.primitives or 0,
    )


def page(figures: list[Figures]) -> str:
    """A table for each dataset."""
    lines = [
        "# Compared methods",
        "",
        "<!-- `python docs/examples/compared_methods.py` makes this page. -->",
        "",
        "[What the methods are](../explanation/compared-methods.md).",
        "Others take far fewer steps than their presets, 30,000 to 61,000, by schedules that are scaled to them, with",
        "3,000 primitives at the start and 8,000 at most, on images of half the size and with a map of 64 texels a",
        "face side. Nothing here says how well they do in all of their steps. `panoless` is the preset `fast`. Times",
        "are CPU seconds of one core of a shared machine, with the start of the program, export and verdict.",
        "`python docs/examples/compared_methods.py --datasets FOLDER` makes this page from",
        "[compared-methods.json](compared-methods.json).",
        "",
    ]
    for dataset in dict.fromkeys(each.dataset for each in figures):
        lines += [
            f"## {TITLES[dataset]}",
            "",
            "| Method | Start | Steps | Environment, observed dB | Normals, median ° | mean ° | Render dB "
            "| CPU s | Primitives |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        ]
        for each in figures:
            if each.dataset == dataset:
                numbers = each.observed, each.normal_median, each.normal_mean, each.render
                cells = ["–" if number is None else f"{number:.2f}" for number in numbers]
                start = STARTS.get(each.start, each.start)
                steps = f"{each.steps:,}" if each.steps else "–"
                row = (each.method, start, steps, *cells, f"{each.cpu_seconds:.0f}", f"{each.primitives:,}")
                lines.append("| " + " | ".join(row) + " |")
        lines.append("")
    return "\n".join(lines)


def write(figures: list[Figures]) -> None:
    """Numbers and page."""
    write_json(NUMBERS, [asdict(each) for each in figures])
    with atomic_write(PAGE) as temporary:
        temporary.write_text(page(figures), encoding="utf-8")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--datasets", type=Path, default=Path("datasets"))
    parser.add_argument("--rows", nargs="+", default=list(TITLES), choices=list(TITLES))
    parser.add_argument("--collect", action="store_true")
    arguments = parser.parse_args()
    known = [Figures(**each) for each in read_json(NUMBERS, "the figures")] if NUMBERS.exists() else []
    for row in [] if arguments.collect else rows(arguments.rows):
        if row.key not in {each.key for each in known}:
            known.append(made(row, arguments.datasets))
            write(known)
    write(known)


if __name__ == "__main__":
    main()
