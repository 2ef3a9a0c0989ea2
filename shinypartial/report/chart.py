"""Quality against cost as one page, one SVG for each pair of axes, and a table of the points.

The page needs no network and no other file. What the charts hold is decided in `comparison.pareto`.
"""

import csv
import io
from collections.abc import Iterator, Sequence
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
    collect_points,
    pareto_front,
)
from shinypartial.comparison.runs import HASH_DIGITS
from shinypartial.comparison.significance import Spread, summarize
from shinypartial.io.files import write_text
from shinypartial.report.chart_svg import Curve, Mark, Plot, draw, follow_page_colors
from shinypartial.report.html import require_own_page, trusted, write_page
from shinypartial.report.line_chart import short_number

PAGE, TABLE = "chart.html", "chart.csv"


@dataclass(frozen=True)
class Chart:
    """One pair of axes: the file name, the plot, and for each drawn point whether it is on the Pareto front."""

    file_name: str
    plot: Plot
    front: dict[int, bool]


@dataclass(frozen=True)
class PointLine:
    """A point as the page's table shows it: its values as texts, and how many fronts it is on."""

    method: str
    folders: tuple[str, ...]
    texts: tuple[str, ...]
    fronts: int


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
    require_own_page(output / PAGE, "chart")
    comparable = collect_points(paths, dataset, hardware)
    charts = make_charts(comparable, size)
    pictures = [draw(chart.plot) for chart in charts]
    for chart, picture in zip(charts, pictures, strict=True):
        write_text(output / chart.file_name, picture)
    write_text(output / TABLE, chart_csv(comparable, charts))
    measures = [measure for measure in MEASURES if any(measure.name in point.values for point in comparable.points)]
    write_page(
        output / PAGE,
        "chart.html.j2",
        generator="chart",
        title=f"Quality against cost: {comparable.dataset}",
        facts=_facts(comparable),
        pictures=[trusted(follow_page_colors(picture)) for picture in pictures],
        measures=measures,
        points=list(_point_lines(comparable, charts, measures)),
        excluded=comparable.excluded,
    )
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
    labels = [_label(number, point) for number, point in drawn]
    numbers = [number for number, _ in drawn]
    marks = [Mark(*mark) for mark in zip(numbers, labels, *zip(*places, strict=True), front, strict=True)]
    curves = [curve for number, point in drawn for curve in _curves(number, point, quality)]
    plot = Plot(
        title=f"{comparable.dataset}: {quality.title} against {cost.title.lower()}",
        x_title=cost.label,
        y_title=quality.label,
        marks=marks,
        curves=curves if cost.name == "seconds" else [],
        oracle=comparable.oracle.get(quality.name),
        facts=_facts(comparable),
    )
    return Chart(f"{quality.name}_by_{cost.name}.svg", plot, dict(zip(numbers, front, strict=True)))


def _curves(number: int, point: Point, quality: Measure) -> Iterator[Curve]:
    for moments in point.curves:
        known = [moment.values for moment in moments if quality.name in moment.values]
        if len(known) > 1:
            yield Curve(number, [values["seconds"] for values in known], [values[quality.name] for values in known])


def _label(number: int, point: Point) -> str:
    runs = f", median of {len(point.folders)} runs" if len(point.folders) > 1 else ""
    return f"{number}  {point.label}{runs}"


def _facts(comparable: Comparable) -> list[str]:
    version = f"{comparable.dataset} · hash {comparable.dataset_hash[:HASH_DIGITS]}"
    return [f"Hardware: {comparable.hardware}", f"Dataset {version} · protocol {comparable.protocol}"]


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
    no_fronts = [""] * len(charts)
    if comparable.oracle:
        oracle = {name: summarize([value]) for name, value in comparable.oracle.items()}
        writer.writerow([*common, "oracle baseline", "oracle", "", "", "", *_statistics(oracle), *no_fronts])
    for number, point in enumerate(comparable.points, 1):
        made = [point.label, " ".join(point.folders), " ".join(point.seeds)]
        fronts = ["" if number not in chart.front else str(int(chart.front[number])) for chart in charts]
        writer.writerow([*common, "result", *made, "", *_statistics(point.values), *fronts])
        for moment in (moment for curve in point.curves for moment in curve if moment.iteration is not None):
            values = {name: summarize([value]) for name, value in moment.values.items()}
            made = [point.label, moment.folder, "", str(moment.iteration)]
            writer.writerow([*common, "snapshot", *made, *_statistics(values), *no_fronts])
    return stream.getvalue()


def _statistics(values: dict[str, Spread]) -> list[str]:
    spreads = [values.get(measure.name) for measure in MEASURES]
    return [text for s in spreads for text in (map(repr, (s.median, s.low, s.high)) if s else ("", "", ""))]


def _point_lines(comparable: Comparable, charts: Sequence[Chart], measures: Sequence[Measure]) -> Iterator[PointLine]:
    for number, point in enumerate(comparable.points, 1):
        texts = tuple(_text(point.values.get(measure.name)) for measure in measures)
        yield PointLine(point.method, point.folders, texts, sum(chart.front.get(number, False) for chart in charts))


def _text(spread: Spread | None) -> str:
    if spread is None:
        return "–"
    if spread.low == spread.high:
        return short_number(spread.median)
    return f"{short_number(spread.median)} ({short_number(spread.low)} to {short_number(spread.high)})"
