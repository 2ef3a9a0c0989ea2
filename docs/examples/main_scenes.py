"""Gather statistics, bounds and scores of datasets into one JSON file and one Markdown table.

Make the folders first, for each scene S of vase, cola and mirror:

    shinypartial generate --scene S --resolution 400
    shinypartial oracle datasets/S-400
    panoless fit datasets/S-400
    shinypartial evaluate predictions/S-400-default

Usage: python docs/examples/main_scenes.py OUTPUT.json DATASET…
"""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from shinypartial.dataset.read import open_dataset
from shinypartial.evaluation.scores import Scores, read_scores
from shinypartial.io.files import write_json
from shinypartial.prediction.format import DEFAULT_FOLDER, read_info


def method_row(folder: Path) -> dict[str, Any] | None:
    """The figures of one prediction folder, or None when it isn't there."""
    if not (folder / "scores.json").exists():
        return None
    scores: Scores = read_scores(folder)
    info = read_info(folder)
    environment = scores.environment.as_predicted if scores.environment else None
    return {
        "method": info.method,
        "environment_psnr_linear_full_db": environment and environment.full.psnr_linear,
        "environment_psnr_linear_observed_db": environment
        and environment.observed
        and environment.observed.psnr_linear,
        "environment_psnr_linear_resolved_db": environment
        and environment.resolved
        and environment.resolved.psnr_linear,
        "normals_mean_deg": scores.normals and scores.normals.mean_angular_error_deg,
        "normals_median_deg": scores.normals and scores.normals.median_angular_error_deg,
        "render_psnr_db": scores.render and scores.render.psnr,
        "visibility_error_auroc": scores.calibration and scores.calibration.visibility_error_auroc,
        "seconds": sum(info.seconds.values()),
        "seconds_by_stage": info.seconds,
        "hardware": info.hardware,
        "surfels": info.primitives,
    }


def main(output: Path, roots: list[Path]) -> None:
    """Write the JSON file, copy contact height fields beside it and print the table."""
    scenes = {}
    for root in roots:
        dataset = open_dataset(root)
        rows = [method_row(DEFAULT_FOLDER / f"{dataset.name}-{kind}") for kind in ("oracle", "default")]
        scenes[dataset.name] = {
            "statistics": dataset.manifest.get("statistics"),
            "methods": [row for row in rows if row],
        }
        height_fields = [path for path in root.glob("contact_sheet.*")]
        for height_field in height_fields:
            shutil.copyfile(height_field, output.parent / f"{dataset.name}-contact-height field{height_field.suffix}")
    write_json(output, scenes)
    print("| Dataset | Method | Environment, all / observed / resolved dB | Normals, mean / median ° | Render dB | s |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, scene in scenes.items():
        for row in scene["methods"]:
            environment = " / ".join(
                number(row[f"environment_psnr_linear_{part}_db"]) for part in ("full", "observed", "resolved")
            )
            normals = f"{number(row['normals_mean_deg'])} / {number(row['normals_median_deg'])}"
            render = number(row["render_psnr_db"])
            print(f"| {name} | {row['method']} | {environment} | {normals} | {render} | {row['seconds']:.0f} |")
    print(json.dumps({name: scene["statistics"] for name, scene in scenes.items()}, indent=1))


def number(value: float | None) -> str:
    """Two decimals, or a dash."""
    return "–" if value is None else f"{value:.2f}"


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(argument) for argument in sys.argv[2:]])
