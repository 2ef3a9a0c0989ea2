"""A command `panoless` that knows the truth: it takes the place of a long fit and reports as that does.

`python -m tests.support.knowing_fit fit DATASET --output PREDICTION` writes the truth of a dataset of the unit ball as
a prediction. Where `WAIT` lies in the working folder, it waits there for as long.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from shinypartial.core.errors import run_command
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import Dataset
from shinypartial.io.events import begin_stage, json_lines, report_result, warn
from shinypartial.io.progress import Progress
from shinypartial.prediction.format import Trust, read_info, write_info
from tests.shinypartial.conversion.test_surface import write_ply
from tests.support.truth_prediction import write_truth_prediction

WAIT = "WAIT"
ROWS = 96


def write_ball(path: Path, radius: float = 1.0, rows: int = ROWS) -> None:
    """A sphere about the origin as a PLY with its exact normals."""
    polar, azimuth = np.meshgrid(np.pi * np.arange(rows + 1) / rows, np.pi * np.arange(2 * rows) / rows, indexing="ij")
    normals = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    index = np.arange(polar.size).reshape(polar.shape)
    after = np.roll(index, -1, 1)
    faces = np.stack([index[:-1], index[1:], after[1:], after[:-1]], -1).reshape(-1, 4)
    write_ply(path, radius * normals.reshape(-1, 3), faces, normals.reshape(-1, 3))


def write_known_prediction(root: Path, dataset: Dataset) -> Path:
    """The truth of a dataset of the unit ball, with its surface and a verdict."""
    write_truth_prediction(root, dataset)
    write_ball(root / "sphere.ply")
    write_info(root, replace(read_info(root), verdict=Trust("trust", "it is the truth")))
    return root


def _fit(dataset: Path, output: Path) -> None:
    begin_stage("Stage 1 of at most 1: the truth")
    while Path(WAIT).exists():
        time.sleep(0.05)
    warn("this fit only knows the truth")
    Progress("knowing", 1).advance()
    made = write_known_prediction(output, open_dataset(dataset))
    verdict = read_info(made).verdict
    assert verdict is not None
    report_result({"prediction": made}, verdict=(verdict.verdict, verdict.reason, verdict.remedy))


def main(arguments: list[str]) -> int:
    """Run the command."""

    def command() -> None:
        with json_lines("fit"):
            _fit(Path(arguments[1]), Path(arguments[arguments.index("--output") + 1]))

    if arguments[:1] != ["fit"] or "--json-progress" not in arguments:
        print("an unknown command", file=sys.stderr)
        return 2
    return run_command(command)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
