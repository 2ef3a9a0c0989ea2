"""What `import panoless` offers: the commands as functions, and a prediction to look into.

Importing this module is cheap; torch is loaded by `fit`.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from panoless.config import FitConfig, with_overrides
from panoless.presets import PRESETS
from shinypartial.core.errors import InputError
from shinypartial.dataset.bundled import resolve_dataset
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import Dataset, Frame, View
from shinypartial.io.events import note
from shinypartial.io.files import folder_lock
from shinypartial.prediction.format import (
    DEFAULT_FOLDER,
    PredictionInfo,
    Trust,
    acquire_prediction,
    prediction_frame,
    read_environment_map,
    read_info,
    read_visibility,
)

if TYPE_CHECKING:
    from panoless.photographs.masks import Hint

RUNS = Path("runs")


@dataclass(frozen=True)
class Reconstruction:
    """A prediction folder, read when it is requested. Everything is in the world frame of the dataset."""

    folder: Path
    """The prediction folder, which `shinypartial.evaluate` scores."""

    @cached_property
    def info(self) -> PredictionInfo:
        """What prediction.json says: method, configuration, seconds, hardware, numbers of parameters."""
        return read_info(self.folder)

    @property
    def model(self) -> str:
        """The kind of geometry: `sphere`, `plane`, `panes`, `height_field`, `revolution`, `free_form`, `surfels`."""
        return self.info.model_selection.chosen if self.info.model_selection else ""

    @property
    def verdict(self) -> Trust | None:
        """How far the fit says that it is to be trusted: `trust`, `partly` or `do not trust`, and why."""
        return self.info.verdict

    @property
    def environment(self) -> Float[np.ndarray, "H W 3"]:
        """Linear radiance as a lat-long map, twice as wide as high: +Z is up, +X is in the middle."""
        return read_environment_map(self.folder)

    @property
    def visibility(self) -> Float[np.ndarray, "H W"]:
        """How well each direction of the lat-long map was observed, from 0 to 1."""
        visibility = read_visibility(self.folder)
        if visibility is None:
            raise InputError(
                expected=f"a visibility map in {self.folder}",
                found="none",
                remedy="Write one with the method's export.",
            )
        return visibility

    @cached_property
    def dataset(self) -> Dataset:
        """The dataset that was fitted; InputError when it isn't where it was."""
        return open_dataset(Path(self.info.dataset))

    def view(self, test_view: int | str = 0) -> View:
        """The prediction of a test view, by its number or its name such as `test/r_003`: radiance, alpha, normals,
        depth. InputError when the dataset has no such test view.
        """
        return read_view(prediction_frame(self.folder, self._frame(test_view)))

    def normals(self, test_view: int | str = 0) -> Float[np.ndarray, "H W 3"]:
        """Unit normals in a test view, in the world frame; zero where the object is not."""
        normals = self.view(test_view).normals_world
        assert normals is not None  # The format has them.
        return normals

    def save(self, folder: str | Path) -> "Reconstruction":
        """Copy the prediction folder to a new one; InputError when that holds something."""
        target = Path(folder)
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise InputError(expected=f"a new or empty folder at {target}", found="files", remedy="Choose another one.")
        shutil.copytree(self.folder, target, dirs_exist_ok=True)
        return Reconstruction(target)

    def _frame(self, test_view: int | str) -> Frame:
        frames = self.dataset.test
        for index, frame in enumerate(frames):
            if test_view in (index, frame.name):
                return frame
        raise InputError(
            expected=f"a test view from 0 to {len(frames) - 1}, or its name"
            if frames
            else f"test views in {self.dataset.root}",
            found=repr(test_view) if frames else "none",
            remedy="Look into transforms_test.json of the dataset.",
        )


def fit(
    dataset: str | Path | None = None,
    *,
    preset: str = "default",
    model: str | None = None,
    output: str | Path | None = None,
    snapshots: int = 0,
    snapshot_seconds: tuple[float, ...] = (),
    device: Literal["cpu", "cuda"] = "cpu",
    time_limit: float | None = None,
    set: tuple[str, ...] = (),
    config: FitConfig | None = None,
) -> Reconstruction:
    """Fit a dataset and write its prediction folder: what the command `panoless fit` does, by the same names.

    `dataset` is a folder, also a plain NeRF-synthetic one, or the name of a bundled dataset such as `tiny-vase`;
    without it the newest below ./datasets is taken. `config` replaces the preset's values, `model` and `set`, such
    as `("surroundings.degree=2",)`, change some of them.
    `output` is the prediction folder, predictions/DATASET-PRESET by default; checkpoints lie in the run folder of the
    same name below ./runs. After `time_limit` minutes the fit ends at its next checkpoint with what it has; the same
    call with more time goes on from there. A call that was interrupted continues after its last finished stage, and one
    that had ended returns what is there. Raises InputError for what can't be read or fitted.
    """
    if preset not in PRESETS:
        raise InputError(expected=f"a preset: {', '.join(PRESETS)}", found=repr(preset), remedy="Choose one of them.")
    config = PRESETS[preset] if config is None else config
    config = with_overrides(config, set if model is None else (f"model={model}", *set))
    prepare_threads()
    from panoless.export.prediction import export_prediction, is_exported
    from panoless.reconstruct.fit import find_device
    from panoless.reconstruct.fit import fit as reconstruct
    from panoless.reconstruct.snapshots import snapshot_schedule

    announce_compilation()
    data = open_dataset(resolve_dataset(dataset))
    prediction = prediction_folder(data, config, output)
    run_folder = RUNS / prediction.resolve().name
    place = find_device(device)
    schedule = snapshot_schedule(snapshots, snapshot_seconds, config.splats.iterations)
    refuse_run_folder(prediction, run_folder)
    with folder_lock(prediction):
        acquire_prediction(prediction)
        limit = None if time_limit is None else 60 * time_limit
        state = reconstruct(data, config, run_folder, schedule, place, limit)
        if not is_exported(prediction, state, config, data):
            export_prediction(data, state, config, prediction)
    return Reconstruction(prediction)


@dataclass(frozen=True)
class Light:
    """A light from photographs of a mirror ball."""

    folder: Path
    reconstruction: Reconstruction
    lines: tuple[str, ...]
    """What was found, a line each."""
    files: dict[str, str]
    """Names of files in the folder, and what each is for."""


def light(
    photographs: Sequence[str | Path],
    output: str | Path,
    *,
    focal_mm: float | None = None,
    hints: "Mapping[str, Hint] | None" = None,
    background: bool = False,
) -> Light:
    """Photographs of a mirror ball to a light: an HDR lat-long, a Blender world and a page, in the folder `output`.

    What the command `panoless light` does; with `background`, what is seen past the ball is data for the map, too.
    Raises InputError where no ball is found, or reflections don't agree.
    """
    prepare_threads()
    from panoless.export.page import write_page
    from panoless.photographs.ball.make import BallRequest, capture_ball
    from shinypartial.io.images import write_exr_rgb, write_hdr

    folder = Path(output)
    dataset = folder / "dataset"
    shown = tuple(map(Path, photographs))
    captured = capture_ball(BallRequest(shown, dataset, focal_mm, hints or {}, background=background))
    options = ("environment.range=hdr",) if captured.high_dynamic_range else ()
    result = fit(dataset, output=folder / f"{folder.resolve().name}-prediction", set=options)
    write_hdr(folder / "light.hdr", result.environment)
    write_exr_rgb(folder / "light.exr", result.environment)
    files = {
        "light.hdr": "lat-long map of linear light, up is up: for any program that takes an HDRI",
        "light.exr": "the same as OpenEXR",
        result.folder.name: "the prediction: visibility, confidence, surface",
    }
    if _blender_world(result.folder, folder):
        files["scene.blend"] = "the light as a Blender world, with the ball"
    lines = (*captured.summary(), *((result.info.surroundings.sentence(),) if result.info.surroundings else ()))
    verdict = result.verdict
    write_page(
        folder / "index.html",
        f"A light from {len(captured.frames)} photograph{'s' if len(captured.frames) > 1 else ''} of a ball",
        ("", "") if verdict is None else (verdict.verdict, verdict.sentence()),
        lines,
        {
            result.folder / "environment.jpg": "Every direction around the ball, hatched where none saw it",
            dataset / "capture" / "ball.jpg": "What was found: the rim of the ball, green where it was seen",
            result.folder / "decomposition.jpg": "A photograph, normals, the light, how well it was seen",
        },
        files,
    )
    return Light(folder, result, lines, {**files, "index.html": "this page"})


def _blender_world(prediction: Path, folder: Path) -> bool:
    """Whether Blender's module is installed and has written the world; in a process of its own."""
    command = [sys.executable, "-m", "shinypartial.cli", "convert", str(prediction), "--to", "blender"]
    made = subprocess.run([*command, "--output", str(folder)], capture_output=True, check=False)
    return made.returncode == 0


def prediction_folder(dataset: Dataset, config: FitConfig, output: str | Path | None) -> Path:
    """Where a fit writes its prediction: to `output`, or to predictions/DATASET-PRESET."""
    return DEFAULT_FOLDER / f"{dataset.name}-{config.preset}" if output is None else Path(output)


def load(prediction: str | Path) -> Reconstruction:
    """A prediction folder that was written before; InputError when it is none."""
    found = Reconstruction(Path(prediction))
    assert found.info
    return found


def refuse_run_folder(prediction: Path, run_folder: Path) -> None:
    """Raise InputError when the prediction would be written into its run folder."""
    if prediction.resolve() == run_folder.resolve():
        raise InputError(
            expected="a prediction folder apart from the run folder",
            found=f"{prediction} for both",
            remedy="Choose an --output that is not below ./runs.",
        )


def prepare_threads() -> None:
    """Before torch loads: let idle OpenMP threads sleep, because spinning ones slow a busy machine tenfold."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@cache
def announce_compilation() -> None:
    """Say once that kernels are compiled, when that begins; those that lie on disk load in a second."""
    from numba.core import event

    class Announcement(event.Listener):
        made = False

        def on_start(self, event: object) -> None:
            if not self.made:
                self.made = True
                clear = "\r\x1b[2K" if sys.stderr.isatty() else ""
                print(clear, end="", file=sys.stderr)
                duration = "some 20 seconds in all if none is there yet; later runs find them on disk"
                note(f"Compiling kernels for this machine: {duration} …")

        def on_end(self, event: object) -> None:
            pass

    event.register("numba:compile", Announcement())
