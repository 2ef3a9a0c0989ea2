"""Photographs of a ball to a score: `python -m tests.benchmarks.bench_ball --output /tmp/ball --json out.json`.

Each recipe is filmed once (a folder that is there is used as it is); then `panoless capture --object ball` works on 1,
2, 3, 6 and 12 of its poses, with all exposures of each. What it finds is compared with the truth:

- **silhouette**: the ball's ellipse by the captured camera against that by the true one, in pixels of the photograph;
- **rotation**: turns between captured and true cameras after the best common rotation, in degrees;
- **position**: how far cameras are off after that rotation, in radii of the ball;
- **fit**: scores of `panoless fit` on that dataset, unless `--no-fit`.

`--recipes chrome-ball-cans --counts 1 3 --resolution 800 --no-fit` is a short run, `--recipes NAME=FOLDER` takes a film
that is there. Without `--resolution` both films take about eight minutes of the processor.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float

from shinypartial.core.camera import Camera
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.same_world import align
from shinypartial.dataset.schema import Dataset
from shinypartial.generate.film import FRAMES, TRUTH
from shinypartial.io.files import link_or_copy, read_json, write_json

REPOSITORY = Path(__file__).resolve().parents[2]
RECIPES = ("chrome-ball-cans", "chrome-ball-brackets")
SCORES = {
    "environment_psnr": "environment.as_predicted.full.psnr_srgb",
    "environment_psnr_seen": "environment.as_predicted.observed.psnr_srgb",
    "render_psnr": "render.psnr",
    "normals_median_deg": "normals.median_angular_error_deg",
}


@dataclass(frozen=True)
class Options:
    """Film balls, capture some of their photographs, and compare with the truth."""

    output: Path
    """Folder for films, datasets, fits and logs; what is there is not made again, but for captures and fits."""
    recipes: tuple[str, ...] = RECIPES
    """Names of recipes, paths of their files, or NAME=FOLDER of films that are there."""
    counts: tuple[int, ...] = (1, 2, 3, 6, 12)
    """Numbers of poses; those that a film doesn't have are left out."""
    resolution: int | None = None
    """Width of the photographs; the recipe's when not given."""
    samples: int | None = None
    """Samples per pixel; the recipe's when not given."""
    fit: bool = True
    """Also fit and score."""
    preset: str = "fast"
    """Of the fit."""
    json: Path | None = None
    """Also write the summary here."""


@dataclass(frozen=True)
class Spread:
    """Median and largest value."""

    median: float
    largest: float


@dataclass(frozen=True)
class Found:
    """What capture made of some poses."""

    recipe: str
    given: int
    posed: int
    seconds: float
    center_px: Spread
    """Distance of the ellipse's center."""
    radius_px: Spread
    """Difference of half the ellipse's mean diameter."""
    rotation_deg: Spread
    position_radii: Spread
    focal_share: float
    mask_error: Spread
    """One less intersection over union."""
    scores: dict[str, float | None] | None


@dataclass(frozen=True)
class Failed:
    """A command that ended with an error."""

    recipe: str
    given: int
    command: str
    message: str


class CommandError(Exception):
    """A command's name and the end of what it wrote."""


def main() -> None:
    """Compare and print the summary as JSON."""
    options = tyro.cli(Options, description=__doc__)
    results: list[Found | Failed] = []
    for recipe in options.recipes:
        name, folder = _filmed(recipe, options)
        poses = poses_of(folder)
        for count in options.counts:
            if count > len(poses):
                continue
            try:
                results.append(_compared(name, folder, poses, count, options))
            except CommandError as error:
                results.append(Failed(name, count, *error.args))
            print(json.dumps(asdict(results[-1])), file=sys.stderr)
    summary = [asdict(result) for result in results]
    print(json.dumps(summary, indent=1))
    if options.json:
        write_json(options.json, {"results": summary})


def poses_of(folder: Path) -> list[list[Path]]:
    """The photographs of each pose of a film, in the order of their names."""
    shots: dict[str, list[Path]] = {}
    for path in sorted((folder / FRAMES).glob("*.jpg")):
        shots.setdefault("_".join(path.stem.split("_")[:2]), []).append(path)
    return list(shots.values())


def chosen(poses: list[list[Path]], count: int) -> list[Path]:
    """Photographs of so many poses, evenly spaced along the path."""
    places = np.floor((np.arange(count) + 0.5) * len(poses) / count).astype(int)
    return [path for place in places for path in poses[place]]


def ellipse(camera: Camera, radius: float) -> tuple[Float[np.ndarray, "2"], float]:
    """Center, in pixels, and √(ab) of the silhouette of a ball about the origin, a and b the half axes.

    In rays the cone is xᵀ(c cᵀ − (|c|² − r²) I) x = 0, c the ball's center in the camera's frame; C is that of pixels,
    K⁻ᵀ(…)K⁻¹ = [[A, b], [bᵀ, f]]. Its center is −A⁻¹b, and √(ab) = √|f − bᵀA⁻¹b| / |det A|^¼.
    """
    c = -camera.camera_to_world[:3, :3].T @ camera.position_world
    cone = np.outer(c, c) - (c @ c - radius**2) * np.eye(3)
    rays = np.linalg.inv(np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]))
    conic = rays.T @ cone @ rays
    a, b, f = conic[:2, :2], conic[:2, 2], conic[2, 2]
    center = -np.linalg.solve(a, b)
    return center, float(np.sqrt(np.abs(f + b @ center)) / np.abs(np.linalg.det(a)) ** 0.25)


def silhouette_errors(aligned: Dataset, truth: Dataset) -> tuple[list[float], list[float]]:
    """Of each view: how far the ellipse's center is off, and its radius, in pixels of the true camera's picture."""
    radius = truth.object_radius
    assert radius is not None
    true = {frame.stem.name: frame.camera for frame in truth.train}
    centers, radii = [], []
    for frame in aligned.train:
        expected, size = ellipse(true[frame.stem.name], radius)
        scale = true[frame.stem.name].width / frame.camera.width
        found, found_size = ellipse(frame.camera, radius)
        centers.append(float(np.linalg.norm(scale * found - expected)))
        radii.append(abs(scale * found_size - size))
    return centers, radii


def _filmed(recipe: str, options: Options) -> tuple[str, Path]:
    name, _, folder = recipe.partition("=")
    if folder:
        return name, Path(folder).resolve()
    name = str(Path(name).resolve()) if name.endswith(".toml") else name
    root = (options.output / "films" / Path(name).stem).resolve()
    varied = [f"--{key}={value}" for key in ("resolution", "samples") if (value := getattr(options, key)) is not None]
    _run(options.output, "shinypartial", "film", f"--scene={name}", f"--output={root}", *varied)
    return Path(name).stem, root


def _compared(name: str, folder: Path, poses: list[list[Path]], count: int, options: Options) -> Found:
    root = (options.output / f"{name}-{count}").resolve()
    shutil.rmtree(root, ignore_errors=True)
    photographs, captured, aligned = root / "photographs", root / "captured", root / "aligned"
    for path in chosen(poses, count):
        link_or_copy(path, photographs / path.name)
    begin = time.perf_counter()
    _run(root, "panoless", "capture", *map(str, sorted(photographs.iterdir())), "--object=ball", f"--output={captured}")
    seconds = time.perf_counter() - begin
    try:
        found = align(captured, folder / TRUTH, aligned, "ball")
    except InputError as error:
        raise CommandError("align", str(error)) from None
    truth = open_dataset(folder / TRUTH)
    centers, radii = silhouette_errors(open_dataset(aligned), truth)
    distances = {frame.stem.name: np.linalg.norm(frame.camera.position_world) for frame in truth.train}
    assert truth.object_radius is not None
    positions = [
        share * distances[view] / truth.object_radius
        for view, share in zip(found.views, found.distance_share, strict=True)
    ]
    return Found(
        name,
        count,
        len(found.views),
        round(seconds, 1),
        _spread(centers),
        _spread(radii),
        _spread(found.rotation_deg),
        _spread(positions),
        found.focal_share,
        _spread([1 - each for each in found.mask_overlap]),
        _scores(root, folder, options.preset) if options.fit else None,
    )


def _scores(root: Path, folder: Path, preset: str) -> dict[str, float | None]:
    """Of a fit of the aligned dataset."""
    prediction = root / "prediction"
    exposures_merged = any((root / "aligned" / "train").glob("*.exr"))
    light = ["--config.environment.range=hdr"] if exposures_merged else []
    fit = [str(root / "aligned"), "--model=sphere", f"--preset={preset}", f"--output={prediction}", *light]
    _run(root, "panoless", "fit", *fit)
    _run(root, "shinypartial", "evaluate", str(prediction), f"--dataset={folder / TRUTH}")
    scores = read_json(prediction / "scores.json", "the scores")
    return {key: _at(scores, path) for key, path in SCORES.items()}


def _at(scores: Any, path: str) -> float | None:
    for key in path.split("."):
        scores = scores and scores.get(key)
    return scores


def _run(place: Path, program: str, *arguments: str) -> None:
    """Run a command of this checkout in a folder; CommandError with the end of its messages where it fails."""
    place.mkdir(parents=True, exist_ok=True)
    paths = os.pathsep.join([str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", f"{program}.cli", *arguments]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": paths})
    if done.returncode:
        raise CommandError(f"{program} {arguments[0]}", done.stderr.strip()[-500:])


def _spread(values: Any) -> Spread:
    return Spread(round(float(np.median(values)), 4), round(float(np.max(values)), 4))


if __name__ == "__main__":
    main()
