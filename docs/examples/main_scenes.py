"""Make the tables of results: render what is missing, fit it, score it, and write the tables into README and docs.

    make results                                   # 400 px, every scene with a split
    make results RESOLUTION=200 SCENES="vase idol"
    python docs/examples/main_scenes.py --collect  # only write the tables of what is there

Every step is a command in a process of its own; finished ones are skipped and interrupted ones continue, so the same
line may be started again at any moment. Delete a prediction and its folder in runs/ to have it made again. The numbers
lie in docs/results/main-scenes.json, one entry a dataset; the tables show each scene at its largest resolution there.
"""

import argparse
import json
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from shinypartial.dataset.read import DEFAULT_FOLDER as DATASETS
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import CHECKSUMS
from shinypartial.evaluation.scores import read_scores
from shinypartial.io.files import write_between, write_json
from shinypartial.prediction.format import DEFAULT_FOLDER as PREDICTIONS
from shinypartial.prediction.format import DESCRIPTION, ORACLE_SUFFIX, read_info

SCENES = Path("blender_scenes")
NUMBERS = Path("docs/results/main-scenes.json")
PAGES = {"results": Path("README.md"), "scenes": Path("docs/results/index.md")}
"""The page of each table, which stands there between `<!-- NAME:begin -->` and `<!-- NAME:end -->`."""
SPLITS = ("development", "held-out")
PUBLISHED = {
    "vase": "18.51 dB, 3.97° / 2.73°",
    "cola": "9.26 dB, 6.25° / 3.21°",
    "mirror": "13.31 dB, 4.64° / 4.62°",
}
"""The paper's environment and normals (mean / median) of its scenes, by its data and protocol; in README."""
SCORES = "scores.json"


def splits() -> dict[str, str]:
    """The split of every scene that declares one, the development scenes first."""
    found = {}
    for path in sorted(SCENES.glob("*/scene.toml")):
        recipe = tomllib.loads(path.read_text(encoding="utf-8"))
        if recipe.get("split") in SPLITS:
            found[path.parent.name] = recipe["split"]
    return dict(sorted(found.items(), key=lambda item: SPLITS.index(item[1])))


def make(scene: str, resolution: int) -> None:
    """Render, fit and score a scene, as far as that is not done."""
    dataset = DATASETS / f"{scene}-{resolution}"
    prediction, oracle = PREDICTIONS / f"{dataset.name}-default", PREDICTIONS / f"{dataset.name}{ORACLE_SUFFIX}"
    make_folders(dataset, prediction, oracle, ("--scene", scene, "--resolution", resolution))


def make_folders(
    dataset: Path,
    prediction: Path,
    oracle: Path,
    scene: Sequence[object],
    settings: Sequence[object] = (),
    worse: tuple[Path, Sequence[object]] | None = None,
) -> None:
    """The same of any scene, by arguments of `shinypartial generate` and of `panoless fit`; by photographs of a worse
    copy, where its folder and arguments of `shinypartial perturb` are given.
    """
    if not (dataset / CHECKSUMS).exists():
        run("shinypartial", "generate", *scene, "--output", dataset)
    if not is_scored(oracle):
        run("shinypartial", "oracle", dataset, "--output", oracle)
    photographs, options = (dataset, ()) if worse is None else worse
    if worse is not None and not (photographs / CHECKSUMS).exists():
        run("shinypartial", "perturb", dataset, *options, "--link", "--output", photographs)
    if not (prediction / DESCRIPTION).exists():
        run("panoless", "fit", photographs, *settings, "--output", prediction)
    if not is_scored(prediction):
        run("shinypartial", "evaluate", prediction, "--dataset", dataset, "--oracle", oracle)


def is_scored(folder: Path) -> bool:
    """Whether scores are there, and younger than what they score."""
    scores, description = folder / SCORES, folder / DESCRIPTION
    return scores.exists() and description.exists() and scores.stat().st_mtime >= description.stat().st_mtime


def run(program: str, *arguments: object) -> None:
    """A command of this environment; SystemExit with its status where it fails."""
    words = [program, *map(str, arguments)]
    print("—", *words, flush=True)
    status = subprocess.run([Path(sys.executable).parent / program, *words[1:]], check=False).returncode
    if status:
        sys.exit(status)


def figures(folder: Path) -> dict[str, Any] | None:
    """The figures of a scored prediction folder, or None; dB, degrees and seconds."""
    if not is_scored(folder):
        return None
    scores, info = read_scores(folder), read_info(folder)
    environment = scores.environment.as_predicted if scores.environment else None
    normals, seen = scores.normals, scores.normals_environment
    return {
        "method": info.method,
        "model": info.model_selection.chosen if info.model_selection else info.model,
        "parameter_counts": info.parameter_counts,
        "primitives": info.primitives,
        "environment_psnr_linear_full_db": environment and environment.full.psnr_linear,
        "environment_psnr_linear_observed_db": environment
        and environment.observed
        and environment.observed.psnr_linear,
        "environment_psnr_linear_resolved_db": environment
        and environment.resolved
        and environment.resolved.psnr_linear,
        "normals_mean_deg": normals and normals.mean_angular_error_deg,
        "normals_median_deg": normals and normals.median_angular_error_deg,
        "normals_environment_mean_deg": seen and seen.mean_angular_error_deg,
        "normals_environment_median_deg": seen and seen.median_angular_error_deg,
        "render_psnr_db": scores.render and scores.render.psnr,
        "visibility_error_auroc": scores.calibration and scores.calibration.visibility_error_auroc,
        "seconds": round(sum(info.seconds.values()), 3),
        "seconds_by_stage": info.seconds,
        "hardware": info.hardware,
    }


def collect(resolution: int) -> None:
    """Bring the numbers up to date with what is there at this resolution, then the tables."""
    numbers = json.loads(NUMBERS.read_text(encoding="utf-8")) if NUMBERS.exists() else {}
    for scene, split in splits().items():
        name = f"{scene}-{resolution}"
        made = figures(PREDICTIONS / f"{name}-default")
        if made is not None:
            statistics = open_dataset(DATASETS / name).manifest.get("statistics")
            bound = figures(PREDICTIONS / f"{name}{ORACLE_SUFFIX}")
            numbers[name] = {
                "scene": scene,
                "split": split,
                "resolution": resolution,
                "statistics": statistics,
                "methods": [each for each in (bound, made) if each],
            }
    write_json(NUMBERS, numbers)
    for name, page in PAGES.items():
        write_between(page, name, table(numbers, ("observed",) if page.name == "README.md" else ("observed", "full")))


def table(numbers: dict[str, Any], regions: Sequence[str]) -> list[str]:
    """Markdown: a line for every scene with a split, at its largest resolution; PSNR in those regions of the map."""
    chosen: dict[str, dict[str, Any]] = {}
    for entry in numbers.values():
        if "split" in entry and entry["resolution"] >= chosen.get(entry["scene"], entry)["resolution"]:
            chosen[entry["scene"]] = entry
    words = "" if len(regions) == 1 else ": " + " / ".join("all" if each == "full" else each for each in regions)
    heads = ("Scene", "Split", "Model", f"Environment{words}", "Oracle baseline", "Normals, mean / median", "Seconds")
    heads += ("Paper",) * (len(regions) == 1)
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]

    def psnr(row: dict[str, Any]) -> str:
        return " / ".join(number(row.get(f"environment_psnr_linear_{each}_db"), 1) for each in regions) + " dB"

    for entry in sorted(chosen.values(), key=lambda each: SPLITS.index(each["split"])):
        made = next(each for each in entry["methods"] if each["method"] != "oracle")
        oracle = next((each for each in entry["methods"] if each["method"] == "oracle"), {})
        normals = " / ".join(f"{number(made[f'normals_environment_{each}_deg'], 2)}°" for each in ("mean", "median"))
        scene = entry["scene"].replace("-", " ").capitalize()
        cells = (scene, entry["split"], model_words(made), psnr(made), psnr(oracle), normals, f"{made['seconds']:.0f}")
        published = PUBLISHED.get(entry["scene"], "")
        lines.append("| " + " | ".join((*cells, published)[: len(heads)]) + " |")
    return lines


def model_words(made: dict[str, Any]) -> str:
    """The kind of geometry and how many numbers it has."""
    kind = (made["model"] or "?").split(" ")[0].replace("_", " ")
    if kind == "surfels":
        return f"{made['primitives']:,} curved surfels"
    count = sum(value for name, value in made["parameter_counts"].items() if not name.startswith("environment"))
    return f"{'surface of revolution' if kind == 'revolution' else kind}, {count:,} parameters"


def number(value: float | None, digits: int) -> str:
    """A value, or a dash."""
    return "–" if value is None else f"{value:.{digits}f}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Make what is missing, writing the tables after every scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", help="names of scenes; every scene with a split when not given")
    parser.add_argument("--resolution", type=int, default=400)
    parser.add_argument("--collect", action="store_true", help="only write the tables of what is there")
    options = parser.parse_args(arguments)
    known = splits()
    unknown = sorted(set(options.scenes or ()) - set(known))
    if unknown:
        parser.error(f"no scenes with a split: {', '.join(unknown)}; there are: {', '.join(known)}")
    for scene in () if options.collect else options.scenes or known:
        make(scene, options.resolution)
        collect(options.resolution)
    collect(options.resolution)


if __name__ == "__main__":
    main()
