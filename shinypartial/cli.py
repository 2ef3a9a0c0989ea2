"""The command line `shinypartial`: generate · validate · evaluate · report, derived from frozen dataclasses."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from shinypartial.errors import EXIT_BAD_INPUT, InputError, run_command


@dataclass(frozen=True)
class Generate:
    """Render a benchmark dataset from a scene recipe; run again to continue where an earlier run stopped."""

    scene: str
    """Name of a scene in blender_scenes, or the path of a scene.toml."""
    output: Path | None = None
    """Folder to write; datasets/SCENE-RESOLUTION when not given."""
    resolution: int | None = None
    """Pixels per side of the square images; the recipe's when not given (800 unless it says otherwise)."""
    samples: int | None = None
    """Samples per pixel; the recipe's when not given."""
    train: int | None = None
    """Number of training views; the recipe's when not given."""
    test: int | None = None
    """Number of test views; the recipe's when not given."""

    def run(self) -> None:
        """Make the dataset and say what to do next."""
        from shinypartial.dataset.read import DEFAULT_FOLDER
        from shinypartial.generate import generate
        from shinypartial.scene import load_scene, override

        spec = override(
            load_scene(self.scene),
            resolution=self.resolution,
            samples=self.samples,
            train=self.train,
            test=self.test,
        )
        made = generate(spec, self.output or DEFAULT_FOLDER / f"{spec.name}-{spec.render.resolution}")
        if made.rendered:
            kept = f" (and kept {made.kept} that were there)" if made.kept else ""
            print(f"Rendered {made.rendered} views{kept} into {made.root}")
        else:
            print(f"Complete: all {made.kept} views are in {made.root}")
        print("Next: panoless fit")


@dataclass(frozen=True)
class Validate:
    """Check every promise of the dataset format; list each break with its file and its remedy."""

    folder: tyro.conf.Positional[Path | None] = None
    """Dataset folder; the newest one below datasets/ when not given."""

    def run(self) -> None:
        """Print every break; raise InputError when there is one."""
        from shinypartial.dataset.read import newest_dataset
        from shinypartial.dataset.validate import validate

        folder = self.folder or _chosen("dataset", newest_dataset())
        breaks = validate(folder, progress=True)
        for each in breaks:
            print(f"{'warning: ' if each.warning else ''}{each.file}: {each.problem}. {each.remedy}")
        broken = sum(not each.warning for each in breaks)
        if broken:
            raise InputError(
                expected=f"a dataset that keeps every promise of the format in {folder}",
                found=f"{broken} broken {'promise' if broken == 1 else 'promises'}, listed above",
                remedy="Follow the remedies, then validate again.",
            )
        print(f"{folder} keeps every promise of the format.")


@dataclass(frozen=True)
class Evaluate:
    """Score a prediction folder against its dataset and write PREDICTION/scores.json."""

    prediction: tyro.conf.Positional[Path | None] = None
    """Prediction folder; the newest one below predictions/ when not given."""
    dataset: Path | None = None
    """Dataset folder; the one that the prediction names when not given."""

    def run(self) -> None:
        """Score and print the summary."""
        from shinypartial.evaluate import evaluate
        from shinypartial.prediction import newest_prediction
        from shinypartial.report import summary_lines

        prediction = self.prediction or _chosen("prediction", newest_prediction())
        evaluate(prediction, self.dataset)
        print("\n".join(summary_lines(prediction)))
        print("Next: shinypartial report")


@dataclass(frozen=True)
class Report:
    """Turn scores into one HTML page with pictures and tables."""

    prediction: tyro.conf.Positional[Path | None] = None
    """Prediction folder; the newest one below predictions/ when not given."""
    output: Path | None = None
    """File to write; inside the prediction folder when not given."""

    def run(self) -> None:
        """Write the report, print the summary and where the page lies."""
        from shinypartial.prediction import newest_prediction
        from shinypartial.report import summary_lines, write_report

        prediction = self.prediction or _chosen("prediction", newest_prediction())
        page = write_report(prediction, self.output)
        print("\n".join(summary_lines(prediction)))
        print(f"Report: {page}")


def _chosen(what: str, folder: Path) -> Path:
    """Say which folder was taken because none was named."""
    print(f"Newest {what}: {folder}")
    return folder


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse and run; return 0, 2 for bad usage or bad input, 130 when interrupted."""
    try:
        command: Generate | Validate | Evaluate | Report = tyro.cli(
            Generate | Validate | Evaluate | Report,  # type: ignore[arg-type]
            args=arguments,
            prog="shinypartial",
            description="Scenes, ground truth and scores for environments seen in partial reflections.",
        )
    except SystemExit as stop:
        return EXIT_BAD_INPUT if stop.code else 0
    return run_command(command.run)


if __name__ == "__main__":
    sys.exit(main())
