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
    {
        "generate": "--scene vase --resolution 400",
        "film": "--scene chrome-ball",
        "import-dataset": "stanford-orb blender_HDR/teapot_scene001 --output datasets/teapot",
        "perturb": "datasets/vase --output datasets/vase-turned --cameras.rotation-deg 0.5",
        "subset": "refnerf/helmet --output datasets/helmet",
        "align": "datasets/film --truth films/vase/truth --output datasets/aligned",
        "find-light": "datasets/helmet --output datasets/helmet-lit",
        "export-cameras": "datasets/vase --output sparse/0 --to colmap",
        "validate": "datasets/vase",
        "release": "datasets/vase datasets/cola --output release --version 1.0",
        "evaluate": "predictions/vase-default --oracle predictions/vase-oracle",
        "report": "predictions/vase-default",
        "oracle": "datasets/vase",
        "evaluate-direct": "predictions/lobby-ball --dataset datasets/lobby-ball",
        "weights": "--folder weights",
        "convert": "predictions/vase-default --to blender glb",
        "relight": "predictions/vase-default --object teapot.glb",
        "postprocess": "predictions/vase-default --blur-deg 1",
        "import": "3dgs-dr output/vase --dataset datasets/vase --output predictions/3dgs-dr",
        "compare": "predictions/a-0 predictions/a-1 --against predictions/b-0 predictions/b-1",
        "leaderboard": "predictions/*",
        "chart": "predictions/* --output chart.svg",
        "stability": "--methods default --scenes vase --axes rotation --seeds 0",
        "tables": "--tables main --scenes vase --cores 2",
    },
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse and run; return 0, 2 for bad usage or bad input, 130 when interrupted."""
    return PROGRAM.main(sys.argv[1:] if arguments is None else arguments)
