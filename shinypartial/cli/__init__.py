"""The command line `shinypartial`: one class a command. Imports every other room, inside the command that needs it."""

from collections.abc import Sequence

import tyro

from shinypartial.cli.converting import Convert, Import, Relight
from shinypartial.cli.datasets import (
    Align,
    ExportCameras,
    FindLight,
    ImportDataset,
    Perturb,
    Release,
    Subset,
    Validate,
)
from shinypartial.cli.presenting import Chart, Leaderboard, Report
from shinypartial.cli.scenes import Film, Generate
from shinypartial.cli.scoring import Compare, Evaluate, EvaluateDirect, Oracle, Postprocess, Weights
from shinypartial.cli.stability import Stability
from shinypartial.cli.tables import Tables
from shinypartial.core.errors import parse_and_run

Command = (
    Generate
    | Film
    | Subset
    | FindLight
    | ImportDataset
    | Perturb
    | Align
    | ExportCameras
    | Validate
    | Evaluate
    | EvaluateDirect
    | Oracle
    | Postprocess
    | Convert
    | Relight
    | Import
    | Compare
    | Weights
    | Report
    | Release
    | Leaderboard
    | Chart
    | Stability
    | Tables
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse and run; return 0, 2 for bad usage or bad input, 130 when interrupted."""

    def parse() -> Command:
        return tyro.cli(
            Command,  # type: ignore[arg-type]
            args=arguments,
            prog="shinypartial",
            description="Scenes, ground truth and scores for environments seen in partial reflections.",
        )

    return parse_and_run(parse)
