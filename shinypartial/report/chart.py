"""Quality against cost as one page, one SVG for each pair of axes, and a table of the points.

The page needs no network and no other file. What the charts hold is decided in `chart_points`.
"""

import csv
import html
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from shinypartial.comparison.pareto import (
    COSTS,
    MEASURES,
    QUALITIES,
    Comparable,
    Measure,
    Point,
    Size,
    Spread,
    collect_points,
    pareto_front,
)
from shinypartial.comparison.runs import HASH_DIGITS
from shinypartial.core.errors import InputError
from shinypartial.io.files import write_text
from shinypartial.report.chart_svg import Curve, Mark, Plot, draw
from shinypartial.report.line_chart import short_number
from shinypartial.report.style import STYLE
from shinypartial.report.tables import excluded_section

PAGE, TABLE = "chart.html", "chart.csv"
GENERATOR = '<meta name="generator" content="shinypartial chart">'
PAGE_STYLE = ".charts { grid-template-columns: repeat(auto-fill, minmax(min(460px, 100%), 1fr)); }"


@dataclass(frozen=True)
class Chart:
    """One pair of axes: the file name, the plot, and for each drawn point whether it is on the Pareto front."""

    file_name: str
    plot: Plot
    front: dict[int, bool]


def write_chart(
    paths: Sequence[Path],
    output: Path,
    *,
    dataset: str | None = None,
    hardware: str | None = None,
    size: Size = "parameters",
) -> Comparable:
    """Write chart.html, chart.csv and an SVG for each chart into `output`; return what they show.

    Raises InputError when the predictions can't share a chart, or `output` has a page of something else.
    """
    page = output / PAGE
    if page.exists() and GENERATOR not in page.read_text(encoding="utf-8", errors="replace"):
        raise InputError(
            expected=f"a new folder or earlier charts at {output}",
            found=f"a {PAGE} of something else",
            remedy="Choose another --output.",
        )
    comparable = collect_points(paths, dataset, hardware)
    charts = make_charts(comparable, size)
    for chart in charts:
        write_text(output / chart.file_name, draw(chart.plot, alone=True) + "\n")
    write_text(output / TABLE, chart_csv(comparable, charts))
    write_text(page, chart_html(comparable, charts))
    return comparable


def make_charts(comparable: Comparable, size: Size) -> list[Chart]:
    """Every quality against seconds and against the size, where at least one point has both."""
    pairs = [(COSTS[cost], quality) for quality in QUALITIES for cost in ("seconds", size)]
    return [chart for cost, quality in pairs if (chart := _chart(comparable, cost, quality)) is not None]


def _chart(comparable: Comparable, cost: Measure, quality: Measure) -> Chart | None:
    drawn = [
        (number, point)
        for number, point in enumerate(comparable.points, 1)
        if cost.name in point.values and quality.name in point.values
    ]
    if not drawn:
        return None
    places = [(point.values[cost.name], point.values[quality.name]) for _, point in drawn]
    front = pareto_front(
        [x.median for x, _ in places], [y.median for _, y in places], higher_is_better=quality.higher_is_better
    )
    numbers = [number for number, _ in drawn]
    marks = [Mark(number, x, y, best) for number, (x, y), best in zip(numbers, places, front, strict=True)]
    curves = [curve for number, point in drawn for curve in _curves(number, point, quality)]
    plot = Plot(
        title=f"{comparable.dataset}: {quality.title} against {cost.title}",
        x_title=cost.title,
        y_title=quality.title,
        marks=marks,
        curves=curves if cost.name == "seconds" else [],
        bound=comparable.bound.get(quality.name),
        legend=[*(_legend(number, point) for number, point in drawn), *_facts(comparable)],
    )
    return Chart(f"{quality.name}_by_{cost.name}.svg", plot, dict(zip(numbers, front, strict=True)))


def _curves(number: int, point: Point, quality: Measure) -> list[Curve]:
    curves = []
    for moments in point.curves:
        known = [moment.values for moment in moments if quality.name in moment.values]
        if len(known) > 1:
            curves.append(Curve(number, [v["seconds"] for v in known], [v[quality.name] for v in known]))
    return curves


def _legend(number: int, point: Point) -> str:
    runs = f", median of {len(point.folders)} runs" if len(point.folders) > 1 else ""
    return f"{number}  {point.label}{runs}"


def _facts(comparable: Comparable) -> list[str]:
    return [f"Hardware: {comparable.hardware}", f"Dataset {_version(comparable)} · protocol {comparable.protocol}"]


def _version(comparable: Comparable) -> str:
    return f"{comparable.dataset} · hash {comparable.dataset_hash[:HASH_DIGITS]}"


def chart_csv(comparable: Comparable, charts: Sequence[Chart]) -> str:
    """A row for each point and each snapshot of its runs: median, lowest and highest value of every measure.

    A column `front_…` for each chart is 1 for a point on its Pareto front, 0 for another, empty where it isn't drawn.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    facts = ["dataset", "dataset_hash", "protocol", "hardware", "kind", "label", "folders", "seeds", "iteration"]
    statistics = [f"{measure.name}{ending}" for measure in MEASURES for ending in ("", "_low", "_high")]
    fronts = [f"front_{chart.file_name.removesuffix('.svg')}" for chart in charts]
    writer.writerow([*facts, *statistics, *fronts])
    common = [comparable.dataset, comparable.dataset_hash, comparable.protocol, comparable.hardware]
    if comparable.bound:
        bound = {name: Spread(value, value, value) for name, value in comparable.bound.items()}
        writer.writerow([*common, "bound", "oracle", "", "", "", *_statistics(bound), *("" for _ in charts)])
    for number, point in enumerate(comparable.points, 1):
        made = [point.label, " ".join(point.folders), " ".join(point.seeds)]
        fronts = ["" if number not in chart.front else str(int(chart.front[number])) for chart in charts]
        writer.writerow([*common, "result", *made, "", *_statistics(point.values), *fronts])
        for moment in (moment for curve in point.curves for moment in curve if moment.iteration is not None):
            values = {name: Spread(value, value, value) for name, value in moment.values.items()}
            made = [point.label, moment.folder, "", str(moment.iteration)]
            writer.writerow([*common, "snapshot", *made, *_statistics(values), *("" for _ in charts)])
    return stream.getvalue()


def _statistics(values: dict[str, Spread]) -> list[str]:
    found = [values.get(measure.name) for measure in MEASURES]
    return [text for one in found for text in (["", "", ""] if one is None else map(repr, vars(one).values()))]


def chart_html(comparable: Comparable, charts: Sequence[Chart]) -> str:
    """The page as text."""
    title = f"Quality against cost: {comparable.dataset}"
    note = (
        "Filled marks are on the Pareto front: no other point costs at most as much and is at least as good. The "
        "dotted line is the best that is reached at each cost. Several runs are shown by their median, and by a bar "
        "from the lowest to the highest. A solid curve is one fit over time, from its snapshots: the seconds until "
        "then and those of solving the environment from there. Snapshots take no part in the Pareto front."
    )
    figures = "".join(f"<figure>{draw(chart.plot)}</figure>" for chart in charts)
    empty = '<p class="warn">No point has both a cost and a quality.</p>'
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">{GENERATOR}'
        f"<title>{html.escape(title)}</title><style>{STYLE}{PAGE_STYLE}</style></head><body>\n"
        f"<h1>{html.escape(title)}</h1>\n"
        + "".join(f"<p>{html.escape(fact)}</p>\n" for fact in _facts(comparable))
        + f'<p class="dim">{note}</p>\n<div class="charts">{figures or empty}</div>\n'
        + _points_section(comparable, charts)
        + excluded_section("Not charted", [(one.folder, one.reason, one.remedy) for one in comparable.excluded])
        + "\n</body></html>\n"
    )


def _points_section(comparable: Comparable, charts: Sequence[Chart]) -> str:
    shown = [measure for measure in MEASURES if any(measure.name in point.values for point in comparable.points)]
    head = "".join(f'<th class="number">{html.escape(measure.title)}</th>' for measure in shown)
    rows = []
    for number, point in enumerate(comparable.points, 1):
        cells = "".join(f'<td class="number">{_text(point.values.get(measure.name))}</td>' for measure in shown)
        fronts = sum(chart.front.get(number, False) for chart in charts)
        folders = "<br>".join(html.escape(folder) for folder in point.folders)
        rows.append(
            f'<tr><td>{number}  {html.escape(point.method)}<br><span class="dim">{folders}</span></td>{cells}'
            f'<td class="number">{fronts} of {len(charts)}</td></tr>'
        )
    return (
        f'<h2>Points</h2><div class="scroll"><table><tr><th>Method</th>{head}<th class="number">on the front</th></tr>'
        f"{''.join(rows)}</table></div>\n"
    )


def _text(spread: Spread | None) -> str:
    if spread is None:
        return "–"
    if spread.low == spread.high:
        return short_number(spread.median)
    return f"{short_number(spread.median)} ({short_number(spread.low)} to {short_number(spread.high)})"
