"""The report's tables: every metric with its direction and the oracle's beside it, protocol by protocol."""

import html
from collections.abc import Mapping, Sequence

from shinypartial.evaluation.scores import ScoreRow, Scores, score_rows

REGION_TABLES = (
    ("environment.as_predicted", "Environment, weighted by solid angle"),
    ("environment.best_exposure", "Environment after the best global exposure"),
)
REGIONS = (("full", "all directions"), ("observed", "seen"), ("resolved", "resolved"))
GROUPS = (
    ("normals", "Normals of test views, pooled over mask pixels"),
    ("normals_environment", "Normals of test views, pixels that see the environment and not the object itself"),
    ("render", "Renders of test views"),
    ("calibration", "Visibility against environment error"),
    ("environment.unweighted", "Environment as a plain picture"),
    ("environment.perceptual", "Environment, perceptual"),
    ("environment", "Global exposure"),
    ("", "Dataset"),
)
PAPER_GROUPS = (
    ("paper.environment", "Environment, tone-mapped picture of 512 × 1024"),
    ("paper.normals", "Normals where the prediction has alpha above ½; holes don't count"),
    ("paper.render", "Renders of test views, 8 bits"),
)
METRICS_NOTE = "↑ higher is better, ↓ lower is better, · a description. Definitions: docs/metrics.md."
ORACLE_NOTE = (
    " Oracle: the best environment map that the training views allow with ground-truth normals; its renders are that "
    "map in a perfect mirror without self-reflection, so they are a reference and no bound."
)
PAPER_NOTE = (
    "The steps of published tables as far as they are known, for comparison with those only: tone-mapped, 8 bits, not "
    "weighted by solid angle, holes in the normals not counted."
)
#: The oracle has the true geometry, so these groups and this path say nothing.
WITHOUT_BOUND = ("normals", "normals_environment", "paper.normals", "", "render.alpha_iou")

Bounds = Mapping[str, ScoreRow]


def bounds_by_path(oracle: Scores | None) -> Bounds:
    """The oracle's rows by path, without those that say nothing."""
    rows = () if oracle is None else score_rows(oracle)
    return {row.path: row for row in rows if not {row.group, row.path} & set(WITHOUT_BOUND) and row.value is not None}


def beside(row: ScoreRow, bounds: Bounds) -> str:
    """The oracle's value in parentheses, for running text; empty when it is unknown."""
    return f" (oracle {row.metric.text(bounds[row.path].value)})" if row.path in bounds else ""


def metrics_section(rows: Sequence[ScoreRow], bounds: Bounds, protocol: str) -> str:
    """All tables of the benchmark's own protocol."""
    tables = [_region_table(rows, bounds, *table) for table in REGION_TABLES]
    tables += [_group_table(rows, bounds, *group) for group in GROUPS]
    note = METRICS_NOTE + (ORACLE_NOTE if bounds else "")
    return f'<h2>Metrics, protocol {html.escape(protocol)}</h2><p class="dim">{note}</p>{"".join(tables)}'


def paper_section(rows: Sequence[ScoreRow], bounds: Bounds, scores: Scores) -> str:
    """Numbers of the other protocol, in a section of their own, so that nobody takes one for the other."""
    if scores.paper is None:
        return ""
    tables = [_group_table(rows, bounds, *group) for group in PAPER_GROUPS]
    title = f"Metrics, protocol {html.escape(scores.paper.protocol)}: for comparison only"
    return f'<h2>{title}</h2><p class="dim">{PAPER_NOTE}</p>{"".join(tables)}' if any(tables) else ""


def _group_table(rows: Sequence[ScoreRow], bounds: Bounds, group: str, title: str) -> str:
    found = [row for row in rows if row.group == group]
    if all(row.value is None for row in found):
        return ""
    with_bound = any(row.path in bounds for row in found)
    head = '<tr><th></th><th class="number">prediction</th><th class="number">oracle</th><th></th></tr>'
    body = "".join(
        f'<tr><td>{html.escape(row.metric.title)} <code class="name">{html.escape(row.metric.name)}</code></td>'
        f'<td class="number">{html.escape(row.metric.text(row.value))}</td>'
        f"{_bound_cell(row, bounds) if with_bound else ''}<td>{row.metric.direction.value}</td></tr>"
        for row in found
    )
    table = f"<table>{head if with_bound else ''}{body}</table>"
    return f"<h3>{html.escape(title)}</h3><div class='scroll'>{table}</div>"


def _bound_cell(row: ScoreRow, bounds: Bounds) -> str:
    text = row.metric.text(bounds[row.path].value) if row.path in bounds else "–"
    return f'<td class="number dim">{html.escape(text)}</td>'


def _region_table(rows: Sequence[ScoreRow], bounds: Bounds, place: str, heading: str) -> str:
    columns = [(title, [row for row in rows if row.group == f"{place}.{region}"]) for region, title in REGIONS]
    columns = [(title, found) for title, found in columns if found]
    if not columns:
        return ""
    oracle = '<th class="number">oracle</th>' if bounds else ""
    head = "".join(f'<th class="number">{html.escape(title)}</th>{oracle}' for title, _ in columns)
    lines = []
    for i, row in enumerate(columns[0][1]):
        cells = "".join(
            f'<td class="number">{found[i].metric.text(found[i].value)}</td>'
            f"{_bound_cell(found[i], bounds) if bounds else ''}"
            for _, found in columns
        )
        name = f'{html.escape(row.metric.title)} <code class="name">{row.metric.name}</code>'
        lines.append(f"<tr><td>{name}</td>{cells}<td>{row.metric.direction.value}</td></tr>")
    return (
        f"<h3>{html.escape(heading)}</h3>"
        f'<div class="scroll"><table><tr><th></th>{head}<th></th></tr>{"".join(lines)}</table></div>'
    )


def excluded_section(title: str, rows: Sequence[tuple[str, str, str]]) -> str:
    """A table of what was left apart: folder, reason and remedy; empty without rows."""
    if not rows:
        return ""
    body = "".join(
        f'<tr><th scope="row">{html.escape(folder)}</th><td class="text">{html.escape(reason)}.</td>'
        f'<td class="text">{html.escape(remedy)}</td></tr>'
        for folder, reason, remedy in rows
    )
    return f'<h2>{html.escape(title)}</h2><div class="scroll"><table>{body}</table></div>'
