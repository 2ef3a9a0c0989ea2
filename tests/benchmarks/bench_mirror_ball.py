"""Real photographs of a chrome ball against what they show directly: `python -m tests.benchmarks.bench_mirror_ball
--photographs FOLDER --output /tmp/mirror-ball --page docs/results/mirror-ball.md`.

All photographs are captured once, so that all cameras have a pose in one world. Those of one half of the ring, within
90° of the first one's azimuth, are for training: 1, 2, 3, 6 and 18 of them, evenly spread, are fitted. Each map is
compared with what the cameras of the other half see past the ball, `shinypartial evaluate-direct`. With `--alone`, the
photographs of a count are also captured without the others, and that world is turned to the one of all by its cameras.

What is in the output folder is not made again. Under two minutes of the processor for the capture, one for each fit.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from shinypartial.core.camera import Camera, opencv_to_opengl
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import Frame
from shinypartial.dataset.subset import files_of
from shinypartial.evaluation.direct_views import DIRECT_SCORES
from shinypartial.io.files import link_or_copy, read_json, write_between, write_json

REPOSITORY = Path(__file__).resolve().parents[2]
LEVEL_DEG = 15.0
"""Cameras below this elevation look at walls and ceiling, the others at the floor and the table."""


@dataclass(frozen=True)
class Options:
    """Capture a ring of photographs of a ball, fit some of one half, and compare with what the other half sees."""

    photographs: Path
    """Folder of JPEGs."""
    output: Path
    """Folder for datasets, fits and logs."""
    counts: tuple[int, ...] = (1, 2, 3, 6, 18)
    """Numbers of training cameras; more than the half has stand for all of it."""
    alone: tuple[int, ...] = (1, 2, 3, 6)
    """Numbers of photographs that are also captured without the others."""
    json: Path | None = None
    """Also write the results here."""
    page: Path | None = None
    """Also write the table into this page, between its markers."""


@dataclass(frozen=True)
class Result:
    """Of one fit; `level` are the medians over held-out cameras below LEVEL_DEG alone."""

    poses: Literal["all", "alone"]
    """Whether the poses are those of the capture of all photographs."""
    cameras: int
    scores: dict[str, Any] | None
    level: dict[str, float | None] | None
    turn_left_deg: float
    """Largest turn left between cameras of both captures after the common rotation; 0 for poses of all."""
    message: str = ""
    """Of what failed."""


def main() -> None:
    """Run what is missing, print and write."""
    options = tyro.cli(Options, description=__doc__)
    everything = (options.output / "all").resolve()
    if not (everything / "transforms_train.json").exists():
        photographs = sorted(map(str, options.photographs.resolve().glob("*.jpg")))
        _run("panoless", "capture", *photographs, "--object=ball", f"--output={everything}")
    frames = open_dataset(everything).train
    training = half_of(frames)
    held_out = [frame.stem.name for frame in frames if frame not in training]
    results = []
    tasks = [("all", count) for count in options.counts] + [("alone", count) for count in options.alone]
    for poses, count in tasks:
        chosen = spread(training, count)
        try:
            if poses == "all":
                dataset, left = options.output / f"of-{count}", 0.0
                write_part(everything, dataset, chosen)
            else:
                dataset, left = _alone(chosen, options, options.output / f"alone-{count}")
            prediction = options.output / f"fit-{dataset.name}"
            _fit(dataset, prediction)
            if not (prediction / DIRECT_SCORES).exists():
                compared = [f"--dataset={everything}", "--hold-out", *held_out]
                _run("shinypartial", "evaluate-direct", str(prediction), *compared)
            results.append(_result(poses, len(chosen), prediction, frames, left))
        except CommandError as error:
            results.append(Result(poses, len(chosen), None, None, 0.0, str(error)))
        print(json.dumps(asdict(results[-1])), file=sys.stderr)
    if options.json:
        write_json(options.json, {"held_out": held_out, "results": [asdict(each) for each in results]})
    lines = table(results)
    print("\n".join(lines))
    if options.page:
        write_between(options.page, "mirror-ball", lines)


class CommandError(Exception):
    """The end of what a command wrote."""


def half_of(frames: Sequence[Frame]) -> list[Frame]:
    """Those within 90° of the first one's azimuth, in the order of their azimuths."""
    x, y, _ = np.stack([frame.camera.position_world for frame in frames]).T
    azimuth = np.angle((x + 1j * y) / (x[0] + 1j * y[0]))
    return [frames[i] for i in np.argsort(azimuth) if abs(azimuth[i]) < np.pi / 2]


def spread(frames: Sequence[Frame], count: int) -> list[Frame]:
    """So many, evenly spaced in their order; all where there are fewer."""
    count = min(count, len(frames))
    return [frames[int((i + 0.5) * len(frames) / count)] for i in range(count)]


def write_part(source: Path, root: Path, frames: Sequence[Frame]) -> None:
    """A dataset of some frames, in the same world and with what the capture knows of itself."""
    content = read_json(source / "transforms_train.json", "the cameras")
    names = {frame.stem.name for frame in frames}
    content["frames"] = [entry for entry in content["frames"] if Path(entry["file_path"]).stem in names]
    for frame in frames:
        for path in files_of(frame):
            link_or_copy(path, root / "train" / path.name)
    write_json(root / "transforms_train.json", content)


def common_rotation(one: Sequence[Camera], two: Sequence[Camera]) -> tuple[np.ndarray, float]:
    """R with R·R₁ᵢ ≈ R₂ᵢ of camera-to-world rotations, the nearest to their sum, and the largest angle (°) left."""
    pairs = [(a.camera_to_world[:3, :3], b.camera_to_world[:3, :3]) for a, b in zip(one, two, strict=True)]
    u, _, vt = np.linalg.svd(np.sum([b @ a.T for a, b in pairs], 0))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    left = [np.degrees(np.arccos(np.clip((np.trace(b.T @ rotation @ a) - 1) / 2, -1, 1))) for a, b in pairs]
    return rotation, float(max(left))


def _alone(frames: Sequence[Frame], options: Options, root: Path) -> tuple[Path, float]:
    """The photographs of some frames captured by themselves, turned to the world of all; the largest turn left."""
    captured, turned = root.resolve() / "captured", root.with_name(f"{root.name}-turned")
    if not (captured / "transforms_train.json").exists():
        photographs = [str(options.photographs.resolve() / f"{frame.stem.name}.jpg") for frame in frames]
        _run("panoless", "capture", *photographs, "--object=ball", f"--output={captured}")
    own = open_dataset(captured).train
    others = {frame.stem.name: frame.camera for frame in frames}
    rotation, left = common_rotation([each.camera for each in own], [others[each.stem.name] for each in own])
    write_part(captured, turned, own)
    content = read_json(turned / "transforms_train.json", "the cameras")
    move, both = np.eye(4), np.kron(np.eye(2), rotation)
    move[:3, :3] = rotation
    for entry, frame in zip(content["frames"], own, strict=True):
        entry["transform_matrix"] = opencv_to_opengl(move @ frame.camera.camera_to_world).tolist()
        if frame.pose_covariance is not None:
            entry["pose_covariance"] = (both @ frame.pose_covariance @ both.T).tolist()
    write_json(turned / "transforms_train.json", content)
    return turned, left


def _fit(dataset: Path, prediction: Path) -> None:
    if not (prediction / "prediction.json").exists():
        _run("panoless", "fit", str(dataset), f"--output={prediction}")


def _result(
    poses: Literal["all", "alone"], count: int, prediction: Path, frames: Sequence[Frame], left: float
) -> Result:
    scores = read_json(prediction / DIRECT_SCORES, "the scores")
    positions = {frame.stem.name: frame.camera.position_world for frame in frames}
    elevations = [np.arcsin(positions[name][2] / np.linalg.norm(positions[name])) for name in scores["views"]]
    level = [
        each
        for each, elevation in zip(scores["view_scores"], elevations, strict=True)
        if elevation < np.radians(LEVEL_DEG)
    ]
    medians = {
        name: float(np.median(known)) if (known := [each[name] for each in level if each[name] is not None]) else None
        for name in scores["median"]
    }
    return Result(poses, count, scores, medians, left)


def table(results: Sequence[Result]) -> list[str]:
    """Rows of Markdown: medians over all held-out cameras; of features, those of level ones behind the stroke."""
    lines = [
        "| Poses by | Cameras | Features off by | … across | Correlation | PSNR, sRGB |",
        "|---|---|---|---|---|---|",
    ]

    def row(title: str, count: str, median: dict[str, Any], level: dict[str, Any] | None) -> str:
        def text(figures: dict[str, Any], name: str, digits: int = 2) -> str:
            return "–" if figures[name] is None else f"{figures[name]:.{digits}f}"

        offsets = " / ".join(text(each, "offset_deg") for each in (median, level) if each is not None)
        cells = [f"{offsets}°", f"{text(median, 'across_deg')}°", text(median, "correlation")]
        cells.append(f"{text(median, 'psnr_srgb', 1)} dB")
        return f"| {' | '.join([title, count, *cells])} |"

    titles = {"all": "all photographs", "alone": "these alone"}
    chances = []
    for each in results:
        if each.scores is None or each.level is None:
            lines.append(f"| {titles[each.poses]} | {each.cameras} | failed: {each.message} | | | |")
            continue
        lines.append(row(titles[each.poses], str(each.cameras), each.scores["median"], each.level))
        chances.append(each.scores["chance"])
    if chances:
        medians = {name: float(np.median([each[name] for each in chances])) for name in chances[0]}
        lines.append(row("*chance: the map turned*", "", medians, None))
    return lines


def _run(program: str, *arguments: str) -> None:
    """Run a command of this checkout; CommandError with the end of its messages where it fails."""
    paths = os.pathsep.join([str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", f"{program}.cli", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": paths})
    if done.returncode:
        raise CommandError(f"{program} {arguments[0]}: {done.stderr.strip()[-300:]}")


if __name__ == "__main__":
    main()
