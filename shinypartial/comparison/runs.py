"""Collect every scored prediction below a folder and compare those of one dataset.

Reads `prediction.json` and `scores.json` only. What can't be compared is kept apart with the reason, so that nothing is
ranked and nothing disappears silently.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from shinypartial.core.errors import InputError
from shinypartial.evaluation.scores import PROTOCOL, SCORES, ScoreRow, Scores, read_scores, score_rows
from shinypartial.metrics.registry import Direction, Metric
from shinypartial.prediction.format import DESCRIPTION, PredictionInfo, prediction_folders, read_info

#: A prediction by this method is a bound to compare with; it stands first and takes no part in the comparison.
BOUND = "oracle"

#: Of a dataset's hash, as many digits are shown.
HASH_DIGITS = 12

#: Where a column's number lies in the scores, and what the column is called.
COLUMNS = (
    ("environment.as_predicted.full.psnr_srgb", "Environment PSNR, full"),
    ("environment.as_predicted.observed.psnr_srgb", "Environment PSNR, observed"),
    ("environment.as_predicted.resolved.psnr_srgb", "Environment PSNR, resolved"),
    ("environment.as_predicted.full.ssim_srgb", "Environment SSIM, full"),
    ("normals.mean_angular_error_deg", "Normals, mean error"),
    ("normals.median_angular_error_deg", "Normals, median error"),
    ("render.psnr", "Render PSNR"),
    ("calibration.visibility_error_auroc", "Visibility AUROC"),
    ("calibration.sparsification_area", "Sparsification area"),
)


@dataclass(frozen=True)
class Entry:
    """A scored prediction that can be compared with others of its dataset."""

    folder: str
    info: PredictionInfo
    scores: Scores
    rows: tuple[ScoreRow, ...]

    @property
    def is_oracle(self) -> bool:
        """Whether it is the oracle rather than a method."""
        return self.info.method == BOUND

    def row(self, path: str) -> ScoreRow | None:
        """The score at a place such as `render.psnr`; None when its group was left out."""
        return next((row for row in self.rows if row.path == path), None)

    @property
    def seconds(self) -> float:
        """Wall time of all stages; 0 when the method states none."""
        return sum(self.info.seconds.values())

    @property
    def parameters(self) -> int:
        """Number of optimized values; 0 when the method states none."""
        return sum(self.info.parameter_counts.values())

    @property
    def hardware(self) -> str:
        """What it ran on, in one line."""
        return ", ".join(str(value) for value in self.info.hardware.values() if value not in ("", None))


@dataclass(frozen=True)
class Cell:
    """A number as it is shown, and whether no method of the group has a better one."""

    text: str
    value: float | None
    best: bool


@dataclass(frozen=True)
class Line:
    """One prediction and its cells, one for each column of its group."""

    entry: Entry
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Column:
    """A heading, and the metric that says in which direction it improves."""

    title: str
    metric: Metric


@dataclass(frozen=True)
class Group:
    """The comparison on one dataset: bounds first, then the methods, best first by the first column."""

    dataset: str
    dataset_hash: str
    columns: tuple[Column, ...]
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Excluded:
    """A prediction that can't be compared: why, and what to do."""

    folder: str
    reason: str
    remedy: str


@dataclass(frozen=True)
class Leaderboard:
    """Everything that was found below a folder of predictions."""

    groups: tuple[Group, ...]
    excluded: tuple[Excluded, ...]


def collect(predictions: Path) -> Leaderboard:
    """Read every prediction below a folder, at any depth but snapshots, and sort what can be compared by dataset."""
    folders = prediction_folders(predictions)
    if not folders:
        raise InputError(
            expected=f"prediction folders below {predictions.resolve()}",
            found=f"none (no folder holds {DESCRIPTION})",
            remedy="Copy prediction folders there, or name the folder that holds them.",
        )
    entries: list[Entry] = []
    excluded: list[Excluded] = []
    for folder in folders:
        found = read_entry(folder, folder.relative_to(predictions).as_posix())
        if isinstance(found, Entry):
            entries.append(found)
        else:
            excluded.append(found)
    keys = sorted({(entry.scores.dataset, entry.scores.dataset_hash) for entry in entries})
    groups = [_group([e for e in entries if (e.scores.dataset, e.scores.dataset_hash) == key]) for key in keys]
    return Leaderboard(tuple(groups), tuple(excluded))


def read_entry(folder: Path, name: str) -> Entry | Excluded:
    """A prediction under a name, or why it can't be compared; never an exception for what its files hold."""
    again = f"Evaluate it again: `shinypartial evaluate {folder}`."
    try:
        info = read_info(folder)
        if not (folder / SCORES).is_file():
            return Excluded(name, "not scored yet", f"Run `shinypartial evaluate {folder}`.")
        scores = read_scores(folder)
        entry = Entry(name, info, scores, score_rows(scores))
        _check_numbers(entry)
    except InputError as error:
        return Excluded(name, f"expected {error.expected}, found {error.found}", error.remedy)
    except (TypeError, ValueError, AttributeError) as error:
        return Excluded(name, f"{DESCRIPTION} or {SCORES} holds something unreadable ({error})", again)
    if scores.protocol != PROTOCOL:
        return Excluded(name, f"scored under the protocol {scores.protocol}, not {PROTOCOL}", again)
    if not scores.dataset_hash_matches or scores.dataset_hash != info.dataset_hash:
        reason = f"made from another version of {scores.dataset} than it was scored on: the hashes differ"
        return Excluded(name, reason, "Make the prediction again from the dataset that it is scored on.")
    return entry


def _check_numbers(entry: Entry) -> None:
    """TypeError or ValueError unless every number is one: other hands may have written the files."""
    optional = (entry.info.primitives, entry.info.model_bytes, entry.info.iteration)
    stated = [number for number in optional if number is not None]
    numbers = [entry.seconds, entry.parameters, *stated, *(row.value for row in entry.rows if row.value is not None)]
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError("a number that is not finite")
    if not entry.hardware.isprintable():
        raise ValueError("hardware that is not one line")


def _group(entries: Sequence[Entry]) -> Group:
    """Columns that at least one prediction has, lines in order, and the best methods of each column marked."""
    places = []
    for path, title in COLUMNS:
        row = next((found for entry in entries if (found := entry.row(path)) and found.value is not None), None)
        if row:
            places.append((path, Column(title, row.metric)))
    best = [_best(entries, path, column.metric) for path, column in places]
    lines = [
        Line(entry, tuple(_cell(entry, path, top) for (path, _), top in zip(places, best, strict=True)))
        for entry in entries
    ]
    lines.sort(key=lambda line: _order(line, places[0][1] if places else None))
    columns = tuple(column for _, column in places)
    return Group(entries[0].scores.dataset, entries[0].scores.dataset_hash, columns, tuple(lines))


def _best(entries: Iterable[Entry], path: str, metric: Metric) -> str | None:
    """The best value of all methods as it is shown, so that values that look equal are treated as equal."""
    rows = [row for entry in entries if not entry.is_oracle and (row := entry.row(path))]
    values = [row.value for row in rows if row.value is not None]
    if not values or metric.direction is Direction.DESCRIPTION:
        return None
    return metric.text(max(values) if metric.direction is Direction.HIGHER else min(values))


def _cell(entry: Entry, path: str, best: str | None) -> Cell:
    row = entry.row(path)
    if row is None or row.value is None:
        return Cell("–", None, False)
    text = row.metric.text(row.value)
    return Cell(text, row.value, text == best and not entry.is_oracle)


def _order(line: Line, first: Column | None) -> tuple[bool, float, str]:
    """Bounds first, then the best of the first column, then predictions that lack it."""
    value = line.cells[0].value if first else None
    if first is None or value is None:
        return not line.entry.is_oracle, math.inf, line.entry.folder
    falling = first.metric.direction is Direction.HIGHER
    return not line.entry.is_oracle, -value if falling else value, line.entry.folder
