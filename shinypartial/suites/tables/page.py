"""The page: a row a method, the paper's figures first, with the best and the second best of each column marked."""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from shinypartial.io.files import write_between, write_text
from shinypartial.metrics.registry import Direction
from shinypartial.suites.tables.collect import Outcome, Results, merged, write_results
from shinypartial.suites.tables.plan import ORACLE, SECONDS, TABLES, Column, Table

FEWER_STEPS = "--config.iterations"
"""What a schedule has that is not the whole one of each method."""
MARKS = "tables"
"""Between these marks of a page its tables stand; a page without them has nothing else."""
MEAN = "mean"
"""In place of a scene: means over the scenes."""
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
    lines = list(page_lines(every, numbers.name))
    if not write_between(page, MARKS, lines):
        write_text(page, "\n".join(["# Tables of the paper", "", *lines]) + "\n")
    return every


def page_lines(results: Results, numbers: str) -> Iterator[str]:
    """The page as Markdown."""
    size = results.size
    steps = "in fewer steps than published" if FEWER_STEPS in results.schedule else "in all of their steps"
    options = f", with `{results.schedule}`" if results.schedule else ""
    yield f"{size.train} training and {size.test} test views of {size.resolution} × {size.resolution} pixels. Rows"
    yield "*as published* are of the paper's scenes at its size: compare orders, not levels. The other methods are"
    yield "[re-implementations](../explanation/compared-methods.md),"
    yield f"{steps}{options}."
    yield "Cells are medians over seeds, with the range where seeds differ. **Best** and *second best* are marked,"
    yield "without the [oracle baseline](../explanation/oracle-baseline.md). Scores follow the paper's protocol."
    yield f"Seconds are means over scenes. [Numbers]({numbers}) have more columns."
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
            found.append(Line(MEAN, method, tuple(_mean(each) for each in middles)))
    return found


def _mean(values: Sequence[float | None]) -> tuple[float, ...]:
    known = [value for value in values if value is not None]
    return (statistics.fmean(known),) if known and len(known) == len(values) else ()


def _table_lines(table: Table, measured: list[Line]) -> Iterator[str]:
    groups = {"published": published_lines(table), "measured": measured}
    if table.averaged:
        groups = {name: [*lines, *averages(lines, table.scenes)] for name, lines in groups.items()}
    places = list(dict.fromkeys(line.scene for line in groups["measured"]))
    shown = [(table.columns.index(column), column) for column in table.shown if column != SECONDS]
    headings = [
        place if k else f"{column.title} {column.direction.value}: {place}"
        for _, column in shown
        for k, place in enumerate(places)
    ]
    if SECONDS in table.shown:
        headings.append(f"{SECONDS.title} {SECONDS.direction.value}")
    yield "| Method | " + " | ".join(headings) + " |"
    yield "|---" * (1 + len(headings)) + "|"
    for name, lines in groups.items():
        marks = {place: marked(table.columns, [line for line in lines if line.scene == place]) for place in places}
        seconds = marked((SECONDS,), list(_seconds(table, lines)))
        for method in dict.fromkeys(line.method for line in lines if line.scene in places):
            rows = [marks[place].get(method) for place in places]
            cells = [row[i] if row else "–" for i, _ in shown for row in rows]
            cells += seconds[method] if SECONDS in table.shown else []
            label = f"{method}, as published" if name == "published" else method
            yield f"| {label} | " + " | ".join(cells) + " |"


def _seconds(table: Table, lines: Sequence[Line]) -> Iterator[Line]:
    """Of each method, the mean over what it was measured on."""
    column = table.columns.index(SECONDS)
    for method in dict.fromkeys(line.method for line in lines):
        middles = [line.middle(column) for line in lines if line.method == method and line.scene != MEAN]
        yield Line("", method, (_mean([each for each in middles if each is not None]),))


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
    return texts[0] if len(set(texts)) == 1 else f"{texts[0]} ({texts[1]}–{texts[2]})"
