"""Which explanations a fit gives for one error and for two at once: `python -m tests.benchmarks.bench_confusion`.

A development scene is rendered, spoiled by one of twelve errors or by two of them, and fitted by `panoless fit`. A case
is right if the fit states what was wrong and nothing else: nuisance blocks that were kept, roughness and blur.
Noise and JPEG compression are controls, which nothing should explain. `--errors poses exposures` is a short run.
Folders that are complete are used as they are, so a run that was stopped goes on.
"""

import subprocess
import sys
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import tyro

from shinypartial.io.files import read_json, write_between, write_json

RENDERED = {"rough": ["--roughness=0.15"], "near room": ["--surroundings-radii=5"]}
"""Errors of what is photographed: options of `shinypartial generate`."""
PERTURBED = {
    "poses": ["--cameras.rotation-deg=0.3"],
    "focal length": ["--cameras.focal-factor=1.02"],
    "distortion": ["--sensor.k1=0.05"],
    "exposures": ["--sensor.exposure-sigma-stops=0.15"],
    "white balances": ["--sensor.white-balance-sigma-stops=0.1"],
    "larger masks": ["--masks.dilate-px=1"],
    "masks of views": ["--masks.offset-px=1"],
    "blur": ["--sensor.blur-px=0.7"],
    "noise": ["--sensor.shot-noise=0.02", "--sensor.read-noise=0.01"],
    "JPEG": ["--sensor.srgb8", "--sensor.jpeg-quality=90"],
}
"""Errors of photographs: options of `shinypartial perturb`."""
EXPLAINED = {
    "poses": {"poses"},
    "focal length": {"focal length"},
    "distortion": {"distortion"},
    "exposures": {"exposures"},
    "white balances": {"white balances", "exposures"},
    "larger masks": {"mask offset"},
    "masks of views": {"mask offsets"},
    "near room": {"walls"},
    "rough": {"roughness"},
    "blur": {"blur"},
    "noise": set[str](),
    "JPEG": set[str](),
}
"""What each should be explained by. Gains of channels that are drawn one by one change the exposure, too."""


@dataclass(frozen=True)
class Options:
    """Render, spoil and fit."""

    output: Path = Path("confusion")
    """Folder for datasets and fits."""
    scene: str = "vase"
    resolution: int = 160
    train: int = 40
    errors: tuple[str, ...] = tuple(EXPLAINED)
    """Errors that take part, alone and in pairs."""
    pairs: bool = True
    """Whether pairs follow the single ones."""
    run: bool = True
    """Whether cases that are not complete are run, or left out."""
    page: Path | None = None
    """Also write the table into this page, and what was found beside it as JSON."""


def main() -> None:
    """Print the table."""
    options = tyro.cli(Options, description=__doc__)
    cases: list[tuple[str, ...]] = [(), *((each,) for each in options.errors)]
    cases += [*combinations(options.errors, 2)] if options.pairs else []
    results = []
    for case in cases:
        if not options.run and not (options.output / f"{_name(case)}-fit" / "scores.json").exists():
            continue
        results.append(_found(case, options))
        print(_row(results[-1]), flush=True)
        if options.page:
            head = {"scene": options.scene, "resolution": options.resolution, "train": options.train}
            write_json(options.page.with_suffix(".json"), {**head, "results": results})
            write_between(options.page, "confusion", _table(results))


def _name(case: tuple[str, ...]) -> str:
    """Of the dataset; that of the fit ends with -fit."""
    return "-".join(each.replace(" ", "_") for each in case or ("clean",))


def _found(case: tuple[str, ...], options: Options) -> dict[str, Any]:
    fit = options.output / f"{_name(case)}-fit"
    if not (fit / "scores.json").exists():
        clean = _rendered(case, options)
        dataset = options.output / _name(case)
        spoiled = [option for each in case for option in PERTURBED.get(each, [])]
        if not spoiled:
            dataset = clean
        elif not dataset.exists():
            _run("shinypartial", "perturb", str(clean), *spoiled, "--seed=3", f"--output={dataset}")
        _run("panoless", "fit", str(dataset), f"--output={fit}")
        _run("shinypartial", "evaluate", str(fit), f"--dataset={clean}")
    info, scores = read_json(fit / "prediction.json", "a prediction"), read_json(fit / "scores.json", "scores")
    chosen = info["model_selection"]["candidates"][-1]
    evidence = info["verdict"]["evidence"]
    stated = {each["name"] for each in chosen.get("blocks") or () if each["kept"]}
    stated |= {each for each, size in (("roughness", "roughness"), ("blur", "blur_px")) if evidence.get(size)}
    wanted = set().union(*(EXPLAINED[each] for each in case)) if case else set[str]()
    return {
        "errors": case,
        "stated": sorted(stated),
        "missed": sorted(wanted - stated),
        "false": sorted(stated - wanted),
        "verdict": info["verdict"]["verdict"],
        "normals_deg": scores["normals"]["median_angular_error_deg"],
        "seconds": round(sum(info["seconds"].values())),
    }


def _rendered(case: tuple[str, ...], options: Options) -> Path:
    """The dataset without errors of photographs."""
    flags = [option for each in case for option in RENDERED.get(each, [])]
    dataset = options.output / "-".join(["rendered", *(each.replace(" ", "_") for each in case if each in RENDERED)])
    if not dataset.exists():
        size = [f"--resolution={options.resolution}", f"--train={options.train}", "--test=5"]
        _run("shinypartial", "generate", f"--scene={options.scene}", *size, *flags, f"--output={dataset}")
    return dataset


def _row(result: dict[str, Any]) -> str:
    """What was wrong, what the fit states, what is false in that, and how good it is."""
    stated = [f"**{each}**" if each in result["false"] else each for each in result["stated"]]
    columns = (stated, result["missed"], [f"{result['normals_deg']:.2f}°"], [result["verdict"]])
    return (
        " | ".join(["| " + (" + ".join(result["errors"]) or "none"), *(", ".join(each) or "–" for each in columns)])
        + " |"
    )


def _table(results: list[dict[str, Any]]) -> list[str]:
    """A matrix of the errors of normals, with the singles on its diagonal, and the rows that are not right."""
    by_case = {frozenset(each["errors"]): each for each in results}
    wrong = [each for each in results if each["missed"] or each["false"]]
    names = [name for name in EXPLAINED if any(name in case for case in by_case)]

    def cell(row: str, column: str) -> str:
        found = by_case.get(frozenset((row, column)))
        if found is None or names.index(row) > names.index(column):
            return ""
        degrees = f"{found['normals_deg']:.2f}"
        return f"**{degrees}**" if found in wrong else degrees

    clean = by_case.get(frozenset())
    return [
        f"{len(results) - len(wrong)} of {len(results)} cases end with their explanations and no others; "
        "the rest is bold." + (f" Without an error: {clean['normals_deg']:.2f}°." if clean else ""),
        "",
        "| Normals, degrees | " + " | ".join(names) + " |",
        "|---" * (len(names) + 1) + "|",
        *("| " + " | ".join([row, *(cell(row, column) for column in names)]) + " |" for row in names),
        "",
        *(["| What is wrong | Stated | Missed | Normals | Verdict |", "|---|---|---|---|---|"] if wrong else []),
        *map(_row, wrong),
    ]


def _run(program: str, *arguments: str) -> None:
    subprocess.run([str(Path(sys.executable).parent / program), *arguments], check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    main()
