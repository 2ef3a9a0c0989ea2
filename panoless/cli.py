"""The `panoless` command: fit a dataset, export a finished fit."""

import sys
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

import tyro

from panoless.config import FitConfig, renamed_arguments, with_overrides
from panoless.presets import PRESETS
from shinypartial.core.errors import InputError, parse_and_run


@dataclass(frozen=True)
class Fit:
    """Fit a dataset: its surface, an environment map and a visibility map; then export the prediction."""

    dataset: Annotated[Path | None, tyro.conf.Positional] = None
    """Dataset folder, also a plain NeRF-synthetic one, or the name of a bundled one, such as tiny-vase; without it the
    newest below ./datasets."""
    preset: Literal[tuple(PRESETS)] = "default"  # type: ignore[valid-type]
    """Starting values of the configuration."""
    output: Path | None = None
    """Prediction folder; default predictions/DATASET-PRESET. The run folder has the same name below ./runs."""
    snapshots: int = 0
    """Keep this many moments of the fit: its end, half of the iterations, a quarter, and so on; see
    docs/how-to/compare-methods.md."""
    snapshot_seconds: tuple[float, ...] = ()
    """Keep the moments after these seconds of fitting."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the fit computes; `cuda` (NVIDIA or AMD) needs a GPU, torch for it and Triton; see
    docs/how-to/use-a-gpu.md."""
    set: Annotated[
        tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="OPTION=VALUE [OPTION=VALUE ...]")
    ] = ()
    """Change tuned numbers, such as plane.max_vertices=64; docs/reference/fit-options.md lists them."""
    config: FitConfig = field(default_factory=FitConfig)

    def run(self) -> None:
        """Fit, export and say what to do next."""
        from panoless.api import RUNS, fit

        config = with_overrides(self.config, tuple(chain(*self.set)))
        result = fit(
            self.dataset,
            output=self.output,
            snapshots=self.snapshots,
            snapshot_seconds=self.snapshot_seconds,
            device=self.device,
            config=config,
        )
        print(f"Prediction written to {result.folder}\nNext: shinypartial evaluate {result.folder}")
        if self.snapshots or self.snapshot_seconds:
            from panoless.geometry.registry import FAMILIES
            from panoless.reconstruct.snapshots import snapshot_folders

            run_folder = RUNS / result.folder.resolve().name
            if snapshot_folders(run_folder):
                print(f"Snapshots: panoless export {run_folder} --output {result.folder} --snapshots")
            else:
                label = FAMILIES[result.model].label
                print(f"No snapshots: this run took {label}, whose map is solved without steps.")
        if result.info.verdict:
            print(f"Verdict: {result.info.verdict.sentence()}")


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
                else f"{state.iteration} of {description.config.iterations} iterations",
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
        print(f"Prediction written to {prediction}\nNext: shinypartial evaluate {prediction}")
        if self.snapshots:
            print(f"Then: shinypartial evaluate {prediction} --snapshots")


def _preset_of(arguments: list[str]) -> str:
    """The preset chose the defaults of all other options, so it is read before the command line is derived."""
    for index, argument in enumerate(arguments):
        name, _, value = argument.partition("=")
        if name == "--preset":
            value = value or (arguments[index + 1] if index + 1 < len(arguments) else "")
            return value if value in PRESETS else "default"
    return "default"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns 0, 2 for bad input or usage, 130 when interrupted."""
    arguments = renamed_arguments(sys.argv[1:] if arguments is None else arguments)
    preset = _preset_of(arguments)
    fit_default = Fit(preset=preset, config=PRESETS[preset])
    kinds = (
        Annotated[Fit, tyro.conf.subcommand("fit", default=fit_default)]
        | Annotated[Export, tyro.conf.subcommand("export")]
    )

    def parse() -> Fit | Export:
        return tyro.cli(
            kinds,  # type: ignore[arg-type]
            args=arguments,
            prog="panoless",
            description="The environment that a shiny object reflects, from photographs of one side of it.",
        )

    return parse_and_run(parse)


if __name__ == "__main__":
    sys.exit(main())
