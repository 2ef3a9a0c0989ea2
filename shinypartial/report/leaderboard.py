"""The comparison of all scored predictions as one static page and as CSV; submitting is copying a prediction folder.

The page needs no network and no other file: its few lines of script sort tables, and without script the order is that
of the first column.
"""

import csv
import html
import io
from collections.abc import Iterable
from pathlib import Path

from shinypartial.comparison.runs import HASH_DIGITS, Excluded, Group, Leaderboard, Line, collect
from shinypartial.core.errors import InputError
from shinypartial.evaluation.scores import PROTOCOL
from shinypartial.io.files import write_text
from shinypartial.io.progress import format_seconds
from shinypartial.metrics.registry import Direction
from shinypartial.report.style import STYLE
from shinypartial.report.tables import excluded_section

PAGE = "index.html"
TABLE = "leaderboard.csv"
DEFAULT_FOLDER = Path("leaderboard")
GENERATOR = '<meta name="generator" content="shinypartial leaderboard">'

TABLE_STYLE = """
body { max-width: 1500px; }
table.board { min-width: 100%; width: max-content; }
.board th, .board td { padding: .4rem .7rem .4rem 0; text-align: right; white-space: nowrap; }
.board th { vertical-align: bottom; white-space: normal; max-width: 7.6rem; }
.board th button { all: unset; cursor: pointer; color: inherit; }
.board th button:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
.board th[aria-sort] button { color: var(--accent); }
.board .name { text-align: left; position: sticky; left: 0; background: var(--page); min-width: 8rem; max-width: 16rem;
  white-space: normal; overflow-wrap: anywhere; z-index: 1; }
.board .name small { display: block; color: var(--dim); }
.board .plain { text-align: left; max-width: 18rem; white-space: normal; }
.board .best { font-weight: 700; color: var(--accent); }
.board .best::before { content: "★ "; font-size: .75em; }
.board .bound td { font-style: italic; color: var(--dim); border-bottom-width: 3px; }
@media (max-width: 520px) { .board .name { max-width: 7.5rem; min-width: 6rem; } }
"""

SCRIPT = """
for (const button of document.querySelectorAll('.board th button')) button.addEventListener('click', () => {
  const head = button.parentElement, body = head.closest('table').tBodies[0];
  const column = head.cellIndex, falling = head.getAttribute('aria-sort') === 'none' || !head.hasAttribute('aria-sort')
    ? head.dataset.first === 'descending' : head.getAttribute('aria-sort') === 'ascending';
  for (const other of head.parentElement.cells) other.removeAttribute('aria-sort');
  head.setAttribute('aria-sort', falling ? 'descending' : 'ascending');
  const key = row => row.cells[column].dataset.value;
  const compare = (a, b) => {
    if (key(a) === '' || key(b) === '') return (key(a) === '') - (key(b) === '');
    const order = head.dataset.kind === 'text' ? key(a).localeCompare(key(b)) : key(a) - key(b);
    return falling ? -order : order;
  };
  const rows = [...body.rows].sort((a, b) =>
    b.classList.contains('bound') - a.classList.contains('bound') || compare(a, b));
  body.append(...rows);
});
"""


def write_leaderboard(predictions: Path, output: Path) -> Leaderboard:
    """Write index.html and leaderboard.csv into `output`, and return what they say.

    Raises InputError when there is no prediction below `predictions`, or `output` has a page of something else.
    """
    page = output / PAGE
    if page.exists() and GENERATOR not in page.read_text(encoding="utf-8", errors="replace"):
        raise InputError(
            expected=f"a new folder or an earlier leaderboard at {output}",
            found=f"an {PAGE} of something else",
            remedy="Choose another --output.",
        )
    board = collect(predictions)
    write_text(output / TABLE, leaderboard_csv(board.groups))
    write_text(page, leaderboard_html(board))
    return board


def leaderboard_csv(groups: Iterable[Group]) -> str:
    """Every score of every compared prediction at full precision; a column is named by its place in scores.json."""
    entries = [line.entry for group in groups for line in group.lines]
    paths = list(dict.fromkeys(row.path for entry in entries for row in entry.rows))
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    facts = ["dataset", "dataset_hash", "protocol", "method", "folder", "seconds", "parameters", "hardware"]
    writer.writerow([*facts, *paths])
    for entry in entries:
        values = {row.path: row.value for row in entry.rows}
        made = [entry.info.method, entry.folder, entry.seconds or "", entry.parameters or "", entry.hardware]
        compared = [entry.scores.dataset, entry.scores.dataset_hash, entry.scores.protocol]
        writer.writerow([*compared, *made, *("" if values.get(path) is None else values[path] for path in paths)])
    return stream.getvalue()


def leaderboard_html(board: Leaderboard) -> str:
    """The page as text."""
    title = f"Leaderboard, protocol {PROTOCOL}"
    note = (
        "Every prediction is scored from its files by <code>shinypartial evaluate</code>. Activate a heading to sort. "
        "★ marks the best method of a column; ↑ higher is better, ↓ lower is better. Of the environment, full is all "
        "directions, observed those that training views see, resolved those that they see large enough. An oracle, "
        "where there is one, is a bound and takes no part. Times on different hardware don't compare."
    )
    sections = [_section(group) for group in board.groups]
    if not sections:
        sections = ["<p>No prediction can be compared yet.</p>"]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">{GENERATOR}'
        f"<title>{title}</title><style>{STYLE}{TABLE_STYLE}</style></head><body>\n"
        f'<header><h1>{title}</h1><p class="dim">{note}</p></header>\n'
        + "\n".join([*sections, _excluded_section(board.excluded)])
        + f"\n<script>{SCRIPT}</script></body></html>\n"
    )


def _section(group: Group) -> str:
    columns = [
        _heading(f"{column.title}\u00a0{_arrow(column.metric.direction)}", column.metric.direction is Direction.HIGHER)
        for column in group.columns
    ]
    head = "".join(
        [
            _heading("Method", False, "text", "name"),
            *columns,
            _heading("Time", False),
            _heading("Parameters", False),
            _heading("Hardware", False, "text", "plain"),
        ]
    )
    counts = group.lines[0].entry.scores.counts
    version = f"hash {group.dataset_hash[:HASH_DIGITS]}"
    facts = f"{counts.train_views} training views · {counts.test_views} test views · {version}"
    body = "\n".join(_line(line) for line in group.lines)
    return (
        f'<h2>{html.escape(group.dataset)}</h2><p class="dim">{html.escape(facts)}</p><div class="scroll">'
        f'<table class="board"><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'
    )


def _arrow(direction: Direction) -> str:
    return "" if direction is Direction.DESCRIPTION else direction.value


def _heading(title: str, falling: bool, kind: str = "number", css: str = "number") -> str:
    """A heading that sorts: best first when it is activated for the first time."""
    first = "descending" if falling else "ascending"
    return (
        f'<th scope="col" class="{css}" data-kind="{kind}" data-first="{first}">'
        f'<button type="button">{html.escape(title.strip())}</button></th>'
    )


def _line(line: Line) -> str:
    entry = line.entry
    method, folder = html.escape(entry.info.method, quote=True), html.escape(entry.folder)
    cells = [f'<td class="name" data-value="{method}">{method}<small>{folder}</small></td>']
    for cell in line.cells:
        css = "number best" if cell.best else "number"
        cells.append(_cell(cell.text, "" if cell.value is None else repr(float(cell.value)), css))
    seconds, parameters = entry.seconds, entry.parameters
    cells.append(_cell(format_seconds(seconds) if seconds else "–", repr(float(seconds)) if seconds else "", "number"))
    cells.append(_cell(f"{parameters:,}" if parameters else "–", str(parameters or ""), "number"))
    cells.append(_cell(entry.hardware or "–", entry.hardware, "plain"))
    css = ' class="bound"' if entry.is_oracle else ""
    return f"<tr{css}>{''.join(cells)}</tr>"


def _cell(text: str, value: str, css: str) -> str:
    return f'<td class="{css}" data-value="{html.escape(value, quote=True)}">{html.escape(text)}</td>'


def _excluded_section(excluded: Iterable[Excluded]) -> str:
    return excluded_section("Not compared", [(one.folder, one.reason, one.remedy) for one in excluded])
