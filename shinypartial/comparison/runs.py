"""Collect every scored prediction below a folder and compare those of one dataset.

Reads `prediction.json` and `scores.json` only. What can't be compared is excluded with the reason, so that nothing is
ranked and nothing disappears silently.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from shinypartial.core.command_line import command_line
from shinypartial.core.errors import InputError
from shinypartial.evaluation.key_metrics import KeyMetric, key_metrics
from shinypartial.evaluation.scores import PROTOCOL, SCORES, ScoreRow, Scores, read_scores, score_rows
from shinypartial.metrics.registry import Direction
from shinypartial.prediction.format import DESCRIPTION, PredictionInfo, prediction_folders, read_info

#: A prediction by this method is the oracle baseline; it stands first and takes no part in the ranking.
ORACLE = "oracle"

#: Of a dataset's hash, as many digits are shown.
HASH_DIGITS = 12


@dataclass(frozen=True)
class Entry:
    """A scored prediction that can be compared with others of its dataset."""

    folder: str
    info: PredictionInfo
    scores: Scores
    rows: tuple[ScoreRow, ...]

    @property
    def is_oracle(self) -> bool:
        """Whether it is the oracle baseline rather than a method."""
        return self.info.method == ORACLE

    def value(self, path: str) -> float | None:
        """The score at a place such as `render.psnr`; None when it was left out."""
        return next((row.value for row in self.rows if row.path == path), None)

    @property
    def seconds(self) -> float:
        """Wall time of all stages; 0 when the method states none."""
        return sum(self.info.seconds.values())

    @property
    def parameters(self) -> int:
        """Number of optimized values; 0 when the method states none."""
        return sum(self.info.parameter_counts.values())


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
class Group:
    """The ranking on one dataset: oracle baselines first, then the methods, best first by the first column."""

    dataset: str
    dataset_hash: str
    columns: tuple[KeyMetric, ...]
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
    evaluate = command_line("shinypartial", "evaluate", folder)
    again = f"Evaluate it again: `{evaluate}`."
    try:
        info = read_info(folder)
        if not (folder / SCORES).is_file():
            return Excluded(name, "not scored yet", f"Run `{evaluate}`.")
        scores = read_scores(folder)
        entry = Entry(name, info, scores, score_rows(scores))
        _check_entry(entry)
    except InputError as error:
        return Excluded(name, f"expected {error.expected}, found {error.found}", error.remedy)
    except ValueError as error:
        return Excluded(name, f"{DESCRIPTION} or {SCORES} holds something unreadable ({error})", again)
    if scores.protocol != PROTOCOL:
        return Excluded(name, f"scored under the protocol {scores.protocol}, not {PROTOCOL}", again)
    if not scores.dataset_hash_matches or scores.dataset_hash != info.dataset_hash:
        reason = f"made from another version of {scores.dataset} than it was scored on: the hashes differ"
        return Excluded(name, reason, "Make the prediction again from the dataset that it is scored on.")
    return entry


def _check_entry(entry: Entry) -> None:
    """ValueError for what no page can show: other hands may have written the files."""
    if not math.isfinite(entry.seconds):
        raise ValueError("seconds that are not finite")
    if not entry.info.hardware_text.isprintable():
        raise ValueError("hardware that is not one line")


def _group(entries: Sequence[Entry]) -> Group:
    """Columns that at least one prediction has, lines in order, and the best methods of each column marked."""
    columns = tuple(
        key for key in key_metrics("ranking") if any(entry.value(key.path) is not None for entry in entries)
    )
    best = [_best(entries, column) for column in columns]
    lines = [
        Line(entry, tuple(_cell(entry, column, text) for column, text in zip(columns, best, strict=True)))
        for entry in entries
    ]
    lines.sort(key=lambda line: _order(line, columns))
    return Group(entries[0].scores.dataset, entries[0].scores.dataset_hash, columns, tuple(lines))


def _best(entries: Iterable[Entry], column: KeyMetric) -> str | None:
    """The best value of all methods as it is shown, so that values that look equal are treated as equal."""
    values = [value for entry in entries if not entry.is_oracle and (value := entry.value(column.path)) is not None]
    if not values or column.metric.direction is Direction.DESCRIPTION:
        return None
    return column.metric.text(max(values) if column.metric.direction is Direction.HIGHER else min(values))


def _cell(entry: Entry, column: KeyMetric, best: str | None) -> Cell:
    value = entry.value(column.path)
    text = column.metric.text(value)
    return Cell(text, value, value is not None and text == best and not entry.is_oracle)


def _order(line: Line, columns: Sequence[KeyMetric]) -> tuple[bool, float, str]:
    """Oracle baselines first, then the best of the first column, then predictions that lack it."""
    value = line.cells[0].value if columns else None
    if value is None:
        return not line.entry.is_oracle, math.inf, line.entry.folder
    falling = columns[0].metric.direction is Direction.HIGHER
    return not line.entry.is_oracle, -value if falling else value, line.entry.folder
