"""The comparison of all scored predictions as one static page and as CSV; submitting is copying a prediction folder.

The page needs no network and no other file: its few lines of script sort tables, and without script the order is that
of the first column.
"""

import csv
import io
from collections.abc import Iterable
from pathlib import Path

from shinypartial.comparison.runs import HASH_DIGITS, Group, Leaderboard, collect
from shinypartial.evaluation.scores import PROTOCOL
from shinypartial.io.files import write_text
from shinypartial.io.progress import format_seconds
from shinypartial.report.html import require_own_page, write_page

PAGE = "index.html"
TABLE = "leaderboard.csv"


def write_leaderboard(predictions: Path, output: Path) -> Leaderboard:
    """Write index.html and leaderboard.csv into `output`, and return what they say.

    Raises InputError when there is no prediction below `predictions`, or `output` has a page of something else.
    """
    require_own_page(output / PAGE, "leaderboard")
    board = collect(predictions)
    write_text(output / TABLE, leaderboard_csv(board.groups))
    write_page(
        output / PAGE,
        "leaderboard.html.j2",
        generator="leaderboard",
        title=f"Leaderboard, protocol {PROTOCOL}",
        groups=board.groups,
        excluded=board.excluded,
        hash_digits=HASH_DIGITS,
        format_seconds=format_seconds,
    )
    return board


def leaderboard_csv(groups: Iterable[Group]) -> str:
    """Every score of every compared prediction at full precision; a column is named by its place in scores.json."""
    entries = [line.entry for group in groups for line in group.lines]
    paths = list(dict.fromkeys(row.path for entry in entries for row in entry.rows))
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    facts = [
        "dataset",
        "dataset_hash",
        "protocol",
        "method",
        "folder",
        "seconds",
        "parameters",
        "hardware",
        "verdict",
        "risk",
    ]
    writer.writerow([*facts, *paths])
    for entry in entries:
        values = {row.path: row.value for row in entry.rows}
        made = [entry.info.method, entry.folder, entry.seconds or "", entry.parameters or "", entry.info.hardware_text]
        verdict = entry.info.verdict
        made += ["", ""] if verdict is None else [verdict.verdict, "" if verdict.risk is None else verdict.risk]
        compared = [entry.scores.dataset, entry.scores.dataset_hash, entry.scores.protocol]
        writer.writerow([*compared, *made, *("" if values.get(path) is None else values[path] for path in paths)])
    return stream.getvalue()
