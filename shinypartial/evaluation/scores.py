"""What an evaluation found: typed scores, their file, and the flat rows that reports and tables print.

The fields of the score types carry the names of `metrics.registry`, so a row knows its title, unit and direction.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shinypartial.core.command_line import command_line
from shinypartial.core.errors import InputError
from shinypartial.io.files import read_json, write_json
from shinypartial.io.records import read_record, write_record
from shinypartial.metrics.angular import AngularStatistics
from shinypartial.metrics.balls import BallScores
from shinypartial.metrics.calibration import CalibrationScores
from shinypartial.metrics.environment import Regions, UnweightedScores
from shinypartial.metrics.paper import PaperScores
from shinypartial.metrics.registry import METRICS, Metric, metric
from shinypartial.prediction.format import ORACLE_SUFFIX, SCORES

FORMAT = "shinypartial-scores"
FORMAT_VERSION = 3
PROTOCOL = "linear-v1"


@dataclass(frozen=True)
class PerceptualScores:
    """LPIPS; None where it was left out."""

    lpips_alex: float | None
    lpips_vgg: float | None


@dataclass(frozen=True)
class EnvironmentScores:
    """The environment map as predicted, and after the one global exposure that brings it closest to the truth."""

    as_predicted: Regions
    exposure_stops: float
    best_exposure: Regions
    unweighted: UnweightedScores
    perceptual: PerceptualScores
    balls: BallScores | None = None
    """None where another version evaluated."""


@dataclass(frozen=True)
class SurroundingsScores:
    """How far the surroundings are, over directions that training views see; None where they see none."""

    inverse_distance_error: float | None


@dataclass(frozen=True)
class RenderScores:
    """Renders of the test views: means over views, but `alpha_iou`, which pools pixels."""

    psnr: float
    psnr_foreground: float | None
    ssim: float
    l1: float
    alpha_iou: float | None
    lpips_alex: float | None


@dataclass(frozen=True)
class ViewScores:
    """One test view, for plots and paired comparisons."""

    name: str
    psnr: float
    ssim: float
    mean_angular_error_deg: float | None


@dataclass(frozen=True)
class LeftOut:
    """A metric or a group of metrics that could not be computed, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class Counts:
    """How much was compared."""

    train_views: int
    test_views: int
    normal_pixels: int
    normal_holes: int


@dataclass(frozen=True)
class Scores:
    """Everything that one evaluation found; None for a group that was left out, which `left_out` names.

    All groups follow `protocol` but `paper`, which names its own. `oracle` is the folder of the dataset's oracle
    baseline when it is not the usual one. `normals_environment` takes pixels whose mirror ray leaves the scene.
    `surroundings` is None, and no group that was left out, where the dataset doesn't know how far they are.
    """

    protocol: str
    dataset: str
    dataset_hash: str
    dataset_hash_matches: bool
    coverage: float | None
    resolved_coverage: float | None
    environment: EnvironmentScores | None
    normals: AngularStatistics | None
    normals_environment: AngularStatistics | None
    render: RenderScores | None
    calibration: CalibrationScores | None
    paper: PaperScores | None
    oracle: str | None
    views: tuple[ViewScores, ...]
    left_out: tuple[LeftOut, ...]
    counts: Counts
    surroundings: SurroundingsScores | None = None
    split: str = "unknown"
    """Of the scene: development, held-out, or unknown where the dataset doesn't say."""


@dataclass(frozen=True)
class ScoreRow:
    """One number with its place in the scores, such as `environment.as_predicted.full.psnr_srgb`."""

    path: str
    metric: Metric
    value: float | None

    @property
    def group(self) -> str:
        """The path without the name of the metric."""
        return self.path.rpartition(".")[0]


def score_rows(scores: Scores) -> tuple[ScoreRow, ...]:
    """Every registered metric found in the scores, in the order of their definition; groups left out have no rows."""
    return tuple(_rows("", scores))


def _rows(prefix: str, value: Any) -> list[ScoreRow]:
    names = {entry.name for entry in METRICS}
    rows = []
    for field in dataclasses.fields(value):
        child, path = getattr(value, field.name), prefix + field.name
        if field.name in names:
            rows.append(ScoreRow(path, metric(field.name), child))
        elif dataclasses.is_dataclass(child):
            rows += _rows(path + ".", child)
    return rows


def write_scores(prediction: Path, scores: Scores) -> None:
    """Write PREDICTION/scores.json (strict JSON; a metric that was left out is null)."""
    write_json(prediction / SCORES, {"format": FORMAT, "format_version": FORMAT_VERSION, **write_record(scores)})


def read_scores(prediction: Path) -> Scores:
    """Read PREDICTION/scores.json; raises InputError when it is missing, of another version or incomplete."""
    path = prediction / SCORES
    if not path.is_file():
        raise InputError(
            expected=f"scores at {path}",
            found="no such file",
            remedy=f"Evaluate first: `{command_line('shinypartial', 'evaluate', prediction)}`.",
        )
    content = read_json(path, "the scores")
    content = content if isinstance(content, dict) else {}
    remedy = f"Evaluate again: `{command_line('shinypartial', 'evaluate', prediction)}`."
    if content.pop("format", None) != FORMAT or content.pop("format_version", None) != FORMAT_VERSION:
        raise InputError(
            expected=f"{SCORES} with format {FORMAT} version {FORMAT_VERSION}", found="another format", remedy=remedy
        )
    return read_record(Scores, content, str(path), remedy=remedy)


def read_oracle_baseline(prediction: Path, scores: Scores) -> Scores | None:
    """Scores of the dataset's oracle, from the folder that the scores name or the sibling DATASET-oracle.

    None when there is no such sibling that can be read, when it is the prediction itself, or when it was made from
    another version of the dataset; a folder that was named must hold scores of the same dataset, else InputError.
    """
    if scores.oracle is not None:
        return require_oracle_baseline(Path(scores.oracle), prediction, scores.dataset, scores.dataset_hash)
    folder = prediction.resolve().parent / (scores.dataset + ORACLE_SUFFIX)
    if folder.resolve() == prediction.resolve():
        return None
    try:
        baseline = read_scores(folder)
    except InputError:
        return None
    return baseline if _is_oracle_of(baseline, scores.dataset_hash) else None


def require_oracle_baseline(folder: Path, prediction: Path, dataset: str, dataset_hash: str) -> Scores | None:
    """Scores of the oracle of that dataset from the folder that was named; None where it is the prediction itself.

    Raises InputError when the folder holds no such scores.
    """
    if folder.resolve() == prediction.resolve():
        return None
    baseline = read_scores(folder)
    if not _is_oracle_of(baseline, dataset_hash):
        raise InputError(
            expected=f"the oracle of {dataset} (hash {dataset_hash[:12]}…) in {folder}",
            found=f"that of {baseline.dataset} (hash {baseline.dataset_hash[:12]}…)",
            remedy=f"Make it: `{command_line('shinypartial', 'oracle', dataset)}`, or leave out --oracle.",
        )
    return baseline


def _is_oracle_of(baseline: Scores, dataset_hash: str) -> bool:
    return baseline.dataset_hash == dataset_hash and baseline.dataset_hash_matches
