"""The command line `shinypartial`: one class a command. Imports every other room, inside the command that needs it."""

import sys
from collections.abc import Sequence

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
from shinypartial.core.program import Program

PROGRAM = Program(
    "shinypartial",
    "Scenes, ground truth and scores for environments seen in partial reflections.",
    {
        "Make a dataset": {"generate": Generate, "film": Film, "import-dataset": ImportDataset},
        "Change or check a dataset": {
            "perturb": Perturb,
            "subset": Subset,
            "align": Align,
            "find-light": FindLight,
            "export-cameras": ExportCameras,
            "validate": Validate,
            "release": Release,
        },
        "Score predictions": {
            "evaluate": Evaluate,
            "report": Report,
            "oracle": Oracle,
            "evaluate-direct": EvaluateDirect,
            "weights": Weights,
        },
        "Use a prediction": {"convert": Convert, "relight": Relight, "postprocess": Postprocess, "import": Import},
        "Compare many": {
            "compare": Compare,
            "leaderboard": Leaderboard,
            "chart": Chart,
            "stability": Stability,
            "tables": Tables,
        },
    },
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse and run; return 0, 2 for bad usage or bad input, 130 when interrupted."""
    return PROGRAM.main(sys.argv[1:] if arguments is None else arguments)
