"""The report's tables: every metric with its direction and the oracle baseline's beside it, protocol by protocol."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from shinypartial.evaluation.scores import ScoreRow, Scores, score_rows
from shinypartial.metrics.registry import Metric

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
    ("environment.balls.mirror", "A mirror ball in the map"),
    ("environment.balls.glossy", "A glossy ball in the map"),
    ("environment.balls.diffuse", "A diffuse ball in the map"),
    ("environment.balls", "Light"),
    ("environment", "Global exposure"),
    ("surroundings", "How far the surroundings are, over directions that training views see"),
    ("", "Dataset"),
)
PAPER_GROUPS = (
    ("paper.environment", "Environment, tone-mapped picture of 512 × 1024"),
    ("paper.normals", "Normals where the prediction has alpha above ½; holes don't count"),
    ("paper.render", "Renders of test views, 8 bits"),
)
#: The oracle has the true geometry, so these groups and this path say nothing.
WITHOUT_ORACLE = {"normals", "normals_environment", "paper.normals", "", "render.alpha_iou"}

OracleRows = Mapping[str, ScoreRow]


@dataclass(frozen=True)
class TableLine:
    """A metric and its values as texts, a column each."""

    metric: Metric
    texts: tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """Metrics below each other; with an oracle every second column is its. A single column has no heading."""

    title: str
    columns: tuple[str, ...]
    lines: tuple[TableLine, ...]
    with_oracle: bool


def oracle_rows(oracle: Scores | None) -> OracleRows:
    """The oracle baseline's rows by path, without those that say nothing."""
    rows = () if oracle is None else score_rows(oracle)
    return {row.path: row for row in rows if not {row.group, row.path} & WITHOUT_ORACLE and row.value is not None}


def oracle_note(row: ScoreRow, oracle: OracleRows) -> str:
    """The oracle baseline's value in parentheses, for running text; empty when it is unknown."""
    return f" (oracle {row.metric.text(oracle[row.path].value)})" if row.path in oracle else ""


def metric_tables(rows: Sequence[ScoreRow], oracle: OracleRows) -> list[Table]:
    """All tables of the benchmark's own protocol."""
    tables = []
    for place, title in REGION_TABLES:
        columns = [(heading, _group(rows, f"{place}.{region}")) for region, heading in REGIONS]
        tables.append(_table(title, columns, oracle))
    return [table for table in tables if table.lines] + _group_tables(rows, oracle, GROUPS)


def paper_tables(rows: Sequence[ScoreRow], oracle: OracleRows) -> list[Table]:
    """Numbers of the other protocol, in a section of their own, so that nobody takes one for the other."""
    return _group_tables(rows, oracle, PAPER_GROUPS)


def _group_tables(rows: Sequence[ScoreRow], oracle: OracleRows, groups: Sequence[tuple[str, str]]) -> list[Table]:
    tables = [_table(title, [("prediction", _group(rows, group))], oracle) for group, title in groups]
    return [table for table in tables if any(text != "–" for line in table.lines for text in line.texts[:1])]


def _group(rows: Sequence[ScoreRow], group: str) -> list[ScoreRow]:
    return [row for row in rows if row.group == group]


def _table(title: str, columns: Sequence[tuple[str, Sequence[ScoreRow]]], oracle: OracleRows) -> Table:
    """Columns have the same metrics in the same order; those without any are dropped."""
    columns = [(heading, rows) for heading, rows in columns if rows]
    with_oracle = any(row.path in oracle for _, rows in columns for row in rows)
    headings = tuple(text for heading, _ in columns for text in ((heading, "oracle") if with_oracle else (heading,)))
    lines = []
    for same_metric in zip(*(rows for _, rows in columns), strict=True):
        texts = []
        for row in same_metric:
            texts.append(row.metric.text(row.value))
            if with_oracle:
                texts.append(row.metric.text(oracle[row.path].value) if row.path in oracle else "–")
        lines.append(TableLine(same_metric[0].metric, tuple(texts)))
    return Table(title, headings if len(headings) > 1 else (), tuple(lines), with_oracle)
