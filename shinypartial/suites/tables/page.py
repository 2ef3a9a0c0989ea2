"""The page: each table with the paper's own figures first, and the best and the second best of each column marked."""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from shinypartial.io.files import write_text
from shinypartial.metrics.registry import Direction
from shinypartial.suites.tables.collect import Outcome, Results, merged, write_results
from shinypartial.suites.tables.plan import ORACLE, TABLES, Column, Table

FEWER_STEPS = "--config.iterations"
"""What a schedule has that is not the whole one of each method."""
Values = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Line:
    """A row: for each column the values of its seeds, none where it was not measured."""

    scene: str
    method: str
    values: Values

    def middle(self, column: int) -> float | None:
        """The median over seeds."""
        return statistics.median(self.values[column]) if self.values[column] else None


def numbers_of(page: Path) -> Path:
    """Where the numbers of a page are."""
    return page.with_suffix(".json")


def write_tables_page(page: Path, results: Results) -> Results:
    """Write PAGE and, beside it, its numbers as JSON, with what an earlier run left there; return these numbers."""
    numbers = numbers_of(page)
    every = merged(numbers, results)
    write_results(numbers, every)
    write_text(page, "\n".join(page_lines(every, numbers.name)) + "\n")
    return every


def page_lines(results: Results, numbers: str) -> Iterator[str]:
    """The page as Markdown."""
    size = results.size
    whole = FEWER_STEPS not in results.schedule
    title = "# Tables of the paper, by whole schedules" if whole else "# Tables of the paper"
    yield from (title, "", "<!-- `shinypartial tables` makes this page. -->", "")
    steps = "in all of their steps" if whole else "in fewer steps than published"
    options = f", with `{results.schedule}`" if results.schedule else ""
    yield f"{size.train} training and {size.test} test views of {size.resolution} × {size.resolution} pixels;"
    yield "[what the methods are](../explanation/compared-methods.md). Rows *as published* are the paper's figures, of"
    yield "its own scenes and its own size: compare orders, not levels. The paper's method and those that it compares"
    yield f"with are our implementations, {steps}{options}."
    yield "Of several seeds the median is given, with the lowest and the highest where they differ. **Best** and"
    yield "*second best* are marked among the rows of a scene that were measured here, and among those published; the"
    yield "[oracle baseline](../explanation/oracle-baseline.md), which knows the true normals, takes no part. Seconds"
    yield "are processor time of the whole command. Environment, normals and renders follow the paper's protocol where"
    yield f"nothing else is said. [Numbers]({numbers})"
    for table in TABLES.values():
        measured = list(_measured(table, results.outcomes))
        if measured:
            yield from ("", f"## {table.title}", "", table.text, "", *_table_lines(table, measured))
    failed = [each for each in results.outcomes if each.failure]
    if failed:
        yield from ("", "## Failed fits", "", "| Scene | Method | Seed | Last line |", "| --- | --- | --- | --- |")
        for each in failed:
            reason = each.failure.replace("|", "\\|").replace("<", "&lt;")
            yield f"| {each.scene} | {each.method} | {each.seed} | {reason} |"


def _measured(table: Table, outcomes: Sequence[Outcome]) -> Iterator[Line]:
    for scene in table.scenes:
        for condition in table.conditions:
            for method in table.methods:
                place = condition.of(scene), method.name
                found = [each for each in outcomes if (each.scene, each.method) == place and not each.failure]
                if found:
                    yield Line(*place, tuple(_of_column(column, found) for column in table.columns))


def _of_column(column: Column, outcomes: Sequence[Outcome]) -> tuple[float, ...]:
    return tuple(column.factor * each.figures[column.path] for each in outcomes if column.path in each.figures)


def published_lines(table: Table) -> list[Line]:
    """The paper's figures; columns that it does not have are empty."""
    empty = ((),) * (len(table.columns) - min((len(values) for values in table.figures.values()), default=0))
    return [
        Line(scene, method, (*(() if value is None else (value,) for value in values), *empty))
        for (scene, method), values in table.figures.items()
    ]


def averages(lines: Sequence[Line], scenes: Sequence[str]) -> list[Line]:
    """Means over the scenes, of the methods that have all of them."""
    methods = dict.fromkeys(line.method for line in lines)
    found = []
    for method in methods:
        own = [line for line in lines if line.method == method and line.scene in scenes]
        if {line.scene for line in own} == set(scenes):
            columns = range(len(own[0].values))
            middles = [[line.middle(column) for line in own] for column in columns]
            found.append(Line("mean", method, tuple(_mean(each) for each in middles)))
    return found


def _mean(values: Sequence[float | None]) -> tuple[float, ...]:
    known = [value for value in values if value is not None]
    return (statistics.fmean(known),) if len(known) == len(values) else ()


def _table_lines(table: Table, measured: list[Line]) -> Iterator[str]:
    groups = {"published": published_lines(table), "measured": measured}
    if table.averaged:
        groups = {name: [*lines, *averages(lines, table.scenes)] for name, lines in groups.items()}
    arrows = [column.direction.value.strip("·") for column in table.columns]
    headings = [f"{column.title} {arrow}".strip() for column, arrow in zip(table.columns, arrows, strict=True)]
    yield "| Scene | Method | " + " | ".join(headings) + " |"
    yield "| --- " * (2 + len(headings)) + "|"
    for scene in dict.fromkeys(line.scene for line in groups["measured"]):
        for name, lines in groups.items():
            own = [line for line in lines if line.scene == scene]
            marks = marked(table.columns, own)
            for line in own:
                label = f"{line.method}, as published" if name == "published" else line.method
                yield f"| {scene} | {label} | " + " | ".join(marks[line.method]) + " |"


def marked(columns: Sequence[Column], lines: Sequence[Line]) -> Mapping[str, list[str]]:
    """The cells of each method's row: best in bold, second best in italics, by what is printed; ties share a mark."""
    cells = {line.method: [_text(column, line.values[i]) for i, column in enumerate(columns)] for line in lines}
    for i, column in enumerate(columns):
        if column.direction is Direction.DESCRIPTION:
            continue
        sign = -1 if column.direction is Direction.HIGHER else 1
        middles = {line.method: line.middle(i) for line in lines if line.method != ORACLE}
        printed = {name: sign * round(value, column.digits) for name, value in middles.items() if value is not None}
        order = sorted(set(printed.values()))
        for name, value in printed.items():
            if len(printed) > 1 and value in order[:2]:
                mark = "**" if value == order[0] else "*"
                cells[name][i] = f"{mark}{cells[name][i]}{mark}"
    return cells


def _text(column: Column, values: tuple[float, ...]) -> str:
    if not values:
        return "–"
    texts = [f"{value:,.{column.digits}f}" for value in (statistics.median(values), min(values), max(values))]
    return texts[0] if len(set(texts)) == 1 else f"{texts[0]} ({texts[1]} to {texts[2]})"
