"""The `panoless` command: make a dataset of photographs, fit it, export or view a finished fit."""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from panoless.config import FitConfig, renamed_arguments, with_overrides
from panoless.export.extension import Extension
from panoless.photographs.options import LEAST_VIEWS, CaptureOptions
from panoless.photographs.print_board import PrintBoard
from panoless.presets import PRESETS
from shinypartial.core.command_line import command_line
from shinypartial.core.errors import InputError
from shinypartial.core.program import Program
from shinypartial.io.events import LongCommand, note, report_result
from shinypartial.io.records import check_record

if TYPE_CHECKING:
    from panoless.api import Reconstruction
    from panoless.photographs.ball.find import FoundBall
    from panoless.photographs.make import Request
    from panoless.photographs.masks import Hint
    from panoless.viewer.server import Viewer


@dataclass(frozen=True)
class Fit(LongCommand):
    """Fit a dataset: its surface, an environment map and a visibility map; then export the prediction."""

    FIRST: ClassVar = (
        "dataset preset output time_limit viewer device set config.model config.tint config.downscale "
        "config.environment.range"
    )
    dataset: Annotated[Path | None, tyro.conf.Positional] = None
    """Dataset folder, also plain NeRF-synthetic, or a bundled one: tiny-vase; else the newest in ./datasets."""
    preset: Annotated[Literal[tuple(PRESETS)], tyro.conf.arg(metavar="NAME")] = "default"  # type: ignore[valid-type]
    """What the configuration starts from: `fast`, `default`, `best`, `paper`, or a compared method, as `3dgs-dr`."""
    output: Path | None = None
    """Prediction folder; default predictions/DATASET-PRESET. The run folder has the same name below ./runs."""
    snapshots: int = 0
    """Keep this many moments of the fit: its end, half of the iterations, a quarter, and so on; see
    docs/how-to/compare-methods.md."""
    snapshot_seconds: tuple[float, ...] = ()
    """Keep the moments after these seconds of fitting."""
    viewer: bool = False
    """Show the fit in the browser while it runs, and the result afterwards."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the fit computes; `cuda` (NVIDIA or AMD) needs torch for it and Triton: docs/how-to/use-a-gpu.md."""
    time_limit: float | None = None
    """Minutes after which the fit completes what it has; the same command with more goes on."""
    set: Annotated[
        tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="OPTION=VALUE [OPTION=VALUE ...]")
    ] = ()
    """Change options of a stage, such as surroundings.degree=2; docs/reference/fit-options.md lists them."""
    config: FitConfig = field(default_factory=FitConfig)

    def work(self) -> None:
        """Fit, export and say what to do next."""
        from panoless.api import RUNS, fit

        config = with_overrides(self.config, tuple(chain(*self.set)))
        viewer = self._viewer(config) if self.viewer else None
        result = fit(
            self.dataset,
            output=self.output,
            snapshots=self.snapshots,
            snapshot_seconds=self.snapshot_seconds,
            device=self.device,
            time_limit=self.time_limit,
            config=config,
        )
        print(f"Prediction written to {result.folder}")
        print("Next:", command_line("shinypartial", "evaluate", result.folder))
        print("For Blender and others:", command_line("shinypartial", "convert", result.folder, "--to", "blender"))
        if self.snapshots or self.snapshot_seconds:
            from panoless.geometry.registry import FAMILIES
            from panoless.reconstruct.snapshots import snapshot_folders

            run_folder = RUNS / result.folder.resolve().name
            if snapshot_folders(run_folder):
                words = "panoless", "export", run_folder, "--output", result.folder, "--snapshots"
                print("Snapshots:", command_line(*words))
            else:
                label = FAMILIES[result.model].label
                print(f"No snapshots: this run took {label}, whose map is solved without steps.")
        if result.info.surroundings:
            print(f"Surroundings: {result.info.surroundings.sentence()}")
        if result.info.verdict:
            print(f"Verdict: {result.info.verdict.sentence()}")
        report_result(
            {"prediction": result.folder, "run": RUNS / result.folder.resolve().name},
            [] if result.info.surroundings is None else [f"Surroundings: {result.info.surroundings.sentence()}"],
            verdict=_stated(result),
        )
        if viewer is not None:
            from panoless.viewer.server import serve

            serve(viewer)

    def _viewer(self, config: FitConfig) -> "Viewer":
        from panoless.api import RUNS, prediction_folder
        from panoless.viewer.server import Viewer, follow_run
        from shinypartial.dataset.bundled import resolve_dataset
        from shinypartial.dataset.read import open_dataset

        dataset = open_dataset(resolve_dataset(self.dataset))
        prediction = prediction_folder(dataset, config, self.output)
        viewer = Viewer(dataset, prediction)
        print(f"Viewer: {viewer.url}")
        follow_run(viewer, RUNS / prediction.resolve().name)
        return viewer


@dataclass(frozen=True)
class Export:
    """Write the prediction folder and the PLY of a finished run again."""

    run_folder: Annotated[Path | None, tyro.conf.Positional] = None
    """Run folder; without it the newest below ./runs."""
    output: Path | None = None
    """Prediction folder; default predictions/RUN."""
    snapshots: bool = False
    """Write the snapshots of the run, too, each as a prediction folder below PREDICTION/snapshots."""

    def run(self) -> None:
        """Read the checkpoint and export it."""
        from panoless.api import RUNS, announce_compilation, prepare_threads, refuse_run_folder

        prepare_threads()
        from panoless.export.prediction import export_prediction, export_snapshots
        from panoless.geometry.registry import FAMILIES
        from panoless.reconstruct.state import CHECKPOINT, DESCRIPTION, load_state, read_description
        from shinypartial.dataset.read import open_dataset
        from shinypartial.io.files import folder_lock, newest_folder
        from shinypartial.prediction.format import acquire_prediction

        announce_compilation()
        folder = self.run_folder or newest_folder(RUNS, DESCRIPTION, "a run", "Make one: `panoless fit`.")
        description = read_description(folder)
        state = load_state(folder)
        if state is None or state.environment is None:
            raise InputError(
                expected=f"a finished run in {folder}",
                found=f"no {CHECKPOINT}"
                if state is None
                else f"{state.iteration} of {description.config.splats.iterations} iterations",
                remedy="Run the same `panoless fit` command again: it continues where it stopped.",
            )
        if self.snapshots and state.training is None:
            raise InputError(
                expected=f"a run of surfels in {folder}, for --snapshots",
                found=f"a run that took {FAMILIES[state.geometry.kind].label}, which is fitted without steps: "
                "there are no moments in between",
                remedy="Leave --snapshots out; or fit surfels: "
                "`panoless fit --model surfels --snapshots 6 --output NEW`.",
            )
        prediction = self.output or Path("predictions") / folder.resolve().name
        refuse_run_folder(prediction, folder)
        with folder_lock(prediction):
            acquire_prediction(prediction)
            dataset = open_dataset(description.dataset)
            export_prediction(dataset, state, description.config, prediction)
            if self.snapshots:
                written = export_snapshots(dataset, folder, description.config, prediction)
                print(f"{len(written)} snapshots below {prediction}")
        print(f"Prediction written to {prediction}")
        print("Next:", command_line("shinypartial", "evaluate", prediction))
        if self.snapshots:
            print("Then:", command_line("shinypartial", "evaluate", prediction, "--snapshots"))


@dataclass(frozen=True)
class View:
    """Show a prediction, or a run that goes on, in the browser: surface, cameras, environment, rays, errors."""

    prediction: Annotated[Path | None, tyro.conf.Positional] = None
    """Prediction folder; without it the newest below ./predictions."""
    host: str = "127.0.0.1"
    """Where to listen; 0.0.0.0 opens it to the network."""
    port: int = 8080
    """Port; the next free one where it is taken."""

    def run(self) -> None:
        """Open the viewer and stay."""
        from panoless.viewer.server import Address, open_prediction, serve
        from shinypartial.io.files import newest_folder
        from shinypartial.prediction.format import DEFAULT_FOLDER, DESCRIPTION

        folder = self.prediction or newest_folder(
            DEFAULT_FOLDER, DESCRIPTION, "a prediction", "Make one: `panoless fit`."
        )
        serve(open_prediction(folder, Address(self.host, self.port)))


@dataclass(frozen=True)
class Capture(LongCommand):
    """Make a dataset of photographs or a video: poses, masks and undistorted pictures; see docs/how-to/capture.md.

    Poses come from a COLMAP model or a transforms.json that is there, from a printed board, or from what is seen around
    the object. Without masks, a rectangle or clicks, the object is what moves against the patterned ground below it.
    Run again to continue where an earlier run stopped.
    """

    FIRST: ClassVar = "sources output object focal_mm colmap board masks segmenter box box_in clicks"
    sources: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folder of photographs, a video, or photographs."""
    output: Path | None = None
    """Dataset folder to write; default datasets/SOURCE."""
    object: Literal["auto", "ball", "any"] = "auto"
    """`ball`: a mirror ball, from one photograph on, without masks and poses; `auto`: that, where less than eight
    photographs show one."""
    focal_mm: float | None = None
    """Focal length on 35 mm film, for a ball; None for what EXIF states."""
    background: bool = False
    """What is seen past a ball is data for the map, too, beside what it mirrors."""
    colmap: Path | None = None
    """Folder of a COLMAP model, text or binary, for these photographs; found where it is SOURCE/sparse/0."""
    board: Literal["A4", "Letter", "A3", "none"] | None = None
    """The board of `panoless board` that lies under the object, by its paper; when not given, it is known by its
    markers, where neither a COLMAP model nor a transforms.json is there."""
    square_mm: float | None = None
    """Side of a square of the board as measured on the print, in millimeters."""
    masks: Path | None = None
    """Folder of masks by the names of the photographs, white on the object; found where it is SOURCE/masks or beside a
    video, and has a mask for each of them."""
    segmenter: Path | None = None
    """Without masks: an ONNX model that segments the object from its surroundings; docs/how-to/capture.md says what it
    is given and has to return."""
    box: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="X0,Y0,X1,Y1")] = ()
    """Without masks: a rectangle about the object, in pixels of the photograph that --box-in names. May be repeated."""
    box_in: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")] = ()
    """Name of the photograph of each rectangle, without its suffix."""
    clicks: Path | None = None
    """Without masks: a JSON file of points on the object and beside it, {"NAME": {"on": [[x, y], ...], "off": [[x, y],
    ...]}}, in pixels of the photographs. Without a rectangle the object lies between those beside it."""
    upright: bool = True
    """Turn pictures as their EXIF tag says; poses of other programs may be for pixels as they are stored."""
    options: CaptureOptions = CaptureOptions()

    def work(self) -> None:
        """Make the dataset and say what was measured."""
        from panoless.photographs.make import Request, capture, check_options
        from shinypartial.dataset.read import DEFAULT_FOLDER

        check_record(self.options, "--options", remedy="Correct that value.")
        request = Request(
            self.sources[0],
            self.output or DEFAULT_FOLDER / _name_of(self.sources),
            colmap=self.colmap,
            board=self.board,
            square_mm=self.square_mm,
            masks=self.masks,
            segmenter=self.segmenter,
            hints=self._hints(),
            upright=self.upright,
            options=self.options,
        )
        check_options(request)
        files = _files_of(self.sources)
        balls = self._balls(files, request.hints)
        if balls is not None:
            self._capture_ball(files, request, balls)
            return
        if len(self.sources) != 1:
            raise InputError(
                expected="one folder of photographs, or one video",
                found=f"{len(self.sources)} sources without a mirror ball",
                remedy="Name the folder; or add --object ball.",
            )
        _say_captured(request.output, "masks.jpg", capture(request).summary())

    def _balls(self, files: tuple[Path, ...], hints: "Mapping[str, Hint]") -> "dict[Path, FoundBall] | None":
        """Where a ball is photographed, those that were found to know it: that is stated, or less than eight
        photographs are given with nothing else about them. None of other objects.
        """
        if self.object != "auto":
            return {} if self.object == "ball" else None
        from panoless.photographs.ball.find import find_ball
        from panoless.photographs.shot import read_shot
        from panoless.photographs.video import VIDEO_SUFFIXES

        named = self.colmap or self.masks or self.segmenter or self.board not in (None, "none")
        if named or any(file.suffix.lower() in VIDEO_SUFFIXES for file in files):
            return None
        few, balls = len(files) < LEAST_VIEWS, {}
        if few and hints:
            return {}
        try:
            for file in dict.fromkeys((files[0], files[len(files) // 2], files[-1])):
                balls[file] = find_ball(read_shot(file), focal_film_mm=self.focal_mm)
        except InputError as error:
            if not few:
                return None
            raise InputError(
                expected=f"a mirror ball, or at least {LEAST_VIEWS} photographs of another object",
                found=f"{len(files)} photographs; {error.found} in {file.name}",
                remedy=f"Take more photographs. If it is a ball: {error.remedy}",
            ) from None
        if few:
            return balls
        note("Note: these photographs show a round thing. If it is a mirror ball, --object ball is simpler.")
        return None

    def _capture_ball(self, files: tuple[Path, ...], request: "Request", balls: "dict[Path, FoundBall]") -> None:
        from panoless.photographs.ball.make import BallRequest, capture_ball
        from panoless.photographs.models import find_model

        model = request.colmap or find_model(request.source)
        captured = capture_ball(
            BallRequest(files, request.output, self.focal_mm, request.hints, balls, self.background, model)
        )
        light = ("--config.environment.range", "hdr") if captured.high_dynamic_range else ()
        _say_captured(request.output, "ball.jpg", captured.summary(), *light)

    def _hints(self) -> "dict[str, Hint]":
        from panoless.photographs.masks import Hint, read_clicks

        hints = {} if self.clicks is None else read_clicks(self.clicks)
        return hints | {name: replace(hints.get(name, Hint()), box=box) for name, box in self._boxes().items()}

    def _boxes(self) -> dict[str, tuple[float, float, float, float]]:
        try:
            boxes = [tuple(float(value) for value in box.split(",")) for box in self.box]
            if not all(map(math.isfinite, chain(*boxes))):
                raise ValueError("a side that is nowhere")
            return {name: (x0, y0, x1, y1) for name, (x0, y0, x1, y1) in zip(self.box_in, boxes, strict=True)}
        except ValueError:
            raise InputError(
                expected="--box X0,Y0,X1,Y1 with four numbers, and --box-in NAME for each",
                found=f"--box {' '.join(self.box) or 'nothing'}, --box-in {' '.join(self.box_in) or 'nothing'}",
                remedy="Give both for each rectangle.",
            ) from None


@dataclass(frozen=True)
class Light(LongCommand):
    """Photographs of a mirror ball to a light: an HDR lat-long, a Blender world and a page; see docs/how-to/ball.md."""

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Photographs, or a folder of them: one, two, three or fifty, also of several exposures."""
    output: Path | None = None
    """Folder to write; default lights/NAME."""
    focal_mm: float | None = None
    """Focal length on 35 mm film; None for what EXIF states."""
    clicks: Path | None = None
    """Where the ball is not found: a JSON file of points on it, {"NAME": {"on": [[x, y]]}}, in pixels."""
    background: bool = False
    """What is seen past the ball is data for the map, too, beside what it mirrors."""

    def work(self) -> None:
        """Capture, fit, convert, and say what to look at."""
        from panoless.api import light
        from panoless.photographs.masks import read_clicks

        hints = {} if self.clicks is None else read_clicks(self.clicks)
        output = self.output or Path("lights") / _name_of(self.sources)
        made = light(_files_of(self.sources), output, focal_mm=self.focal_mm, hints=hints, background=self.background)
        print("\n".join(made.lines))
        if made.reconstruction.verdict:
            print(f"Verdict: {made.reconstruction.verdict.sentence()}")
        print(f"Look at {made.folder}/index.html. Written: {', '.join(made.files)}")
        if "scene.blend" not in made.files:
            print("No Blender world: pip install 'panoless[blender]' adds Blender's module.")
        made_of = {"folder": made.folder, "dataset": made.folder / "dataset", "prediction": made.reconstruction.folder}
        files = {name: made.folder / name for name in made.files if (made.folder / name).is_file()}
        report_result(made_of | files, made.lines, verdict=_stated(made.reconstruction))


def _say_captured(dataset: Path, picture: str, lines: Sequence[str], *options: str) -> None:
    """What a capture made of photographs, and how a fit goes on."""
    print("\n".join(lines))
    print(f"Look at {dataset}/capture/{picture}. Next:", command_line("panoless", "fit", dataset, *options))
    paths = {"dataset": dataset, "picture": dataset / "capture" / picture}
    report_result(paths, lines, following=("panoless", "fit", dataset.resolve(), *options))


def _stated(result: "Reconstruction") -> tuple[str, str, str] | None:
    found = result.verdict
    return None if found is None else (found.verdict, found.reason, found.remedy)


def _name_of(sources: tuple[Path, ...]) -> str:
    """Of a photograph, a video or a folder; of several photographs that of their folder."""
    first = sources[0].resolve()
    if not first.is_file():
        return first.name
    return first.stem if len(sources) == 1 else first.parent.name


def _files_of(sources: tuple[Path, ...]) -> tuple[Path, ...]:
    """The photographs that are named, and those of folders."""
    from panoless.photographs.frames import source_files

    return tuple(file for each in sources for file in ([each] if each.is_file() else source_files(each)))


def _preset_of(arguments: list[str]) -> str:
    """The preset chose the defaults of all other options, so it is read before the command line is derived."""
    for index, argument in enumerate(arguments):
        name, _, value = argument.partition("=")
        if name == "--preset":
            value = value or (arguments[index + 1] if index + 1 < len(arguments) else "")
            return value if value in PRESETS else "default"
    return "default"


PROGRAM = Program(
    "panoless",
    "The environment that a shiny object reflects, from photographs of one side of it.",
    {
        "From photographs": {"light": Light, "capture": Capture, "board": PrintBoard},
        "From a dataset": {"fit": Fit, "view": View, "export": Export, "extension": Extension},
    },
    {
        "light": "IMG_0001.jpg IMG_0002.jpg IMG_0003.jpg",
        "capture": "photographs --focal-mm 26 --board A4",
        "board": "--paper A3",
        "fit": "datasets/vase --preset best --device cuda",
        "view": "predictions/vase-default",
        "export": "runs/vase-default",
        "extension": "--output panoless-blender.zip",
    },
)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns 0, 2 for bad input or usage, 130 when interrupted."""
    arguments = renamed_arguments(sys.argv[1:] if arguments is None else arguments)
    preset = _preset_of(arguments)
    return PROGRAM.main(arguments, {"fit": Fit(preset=preset, config=PRESETS[preset])})


if __name__ == "__main__":
    sys.exit(main())
