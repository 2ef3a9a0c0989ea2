"""Small line charts and color bars, drawn by templates without scripts; colors follow the page's variables."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from shinypartial.evaluation.pictures import Scale, colormap_colors

WIDTH, HEIGHT = 360, 190
LEFT, RIGHT, TOP, BOTTOM = 54, 10, 10, 26
#: More points than this are thinned by averaging: a chart is no wider.
MAX_POINTS = 300
#: A positive series that spans more than this factor is drawn on a logarithmic axis.
LOGARITHMIC_SPAN = 50.0
LEGEND_STOPS = 12


@dataclass(frozen=True)
class Series:
    """One line: `y` against `x`, both of one length of at least two."""

    title: str
    x: Sequence[float]
    y: Sequence[float]
    x_title: str


@dataclass(frozen=True)
class LevelMark:
    """A level of the vertical axis, in pixels and as text."""

    y: float
    text: str


@dataclass(frozen=True)
class LineChart:
    """What line_chart.svg.j2 draws: pixels of the line, and the ends of the axes as text."""

    title: str
    x_title: str
    points: str
    first: str
    last: str
    marks: tuple[LevelMark, ...]
    logarithmic: bool
    width: int = WIDTH
    height: int = HEIGHT
    left: int = LEFT
    right: int = WIDTH - RIGHT


@dataclass(frozen=True)
class ColorBar:
    """The colors of a scale as stops of a CSS gradient, and its ends in numbers."""

    low: str
    high: str
    gradient: str


def line_chart(series: Series) -> LineChart:
    """The series with its smallest, middle and largest value on the axes."""
    logarithmic = min(series.y) > 0 and max(series.y) / min(series.y) > LOGARITHMIC_SPAN
    x, y = _thin(series.x), _thin(series.y)
    levels = [math.log10(value) for value in y] if logarithmic else y
    low_x, high_x, low, high = min(x), max(x), min(levels), max(levels)
    if high == low:
        low, high = low - 0.5, high + 0.5
    span_x = (high_x - low_x) or 1.0
    plot_width, plot_height = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
    points = " ".join(
        f"{LEFT + (a - low_x) / span_x * plot_width:.1f},{TOP + (high - b) / (high - low) * plot_height:.1f}"
        for a, b in zip(x, levels, strict=True)
    )
    marks = []
    for share in (0.0, 0.5, 1.0):
        level = low + share * (high - low)
        text = short_number(10**level if logarithmic else level)
        marks.append(LevelMark(round(TOP + (1 - share) * plot_height, 1), text))
    return LineChart(series.title, series.x_title, points, f"{low_x:g}", f"{high_x:g}", tuple(marks), logarithmic)


def short_number(value: float) -> str:
    """Three digits, or all digits of a larger number below a million."""
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def _thin(values: Sequence[float]) -> list[float]:
    if len(values) <= MAX_POINTS:
        return list(values)
    edges = [round(i * len(values) / MAX_POINTS) for i in range(MAX_POINTS + 1)]
    return [sum(values[edges[i] : edges[i + 1]]) / (edges[i + 1] - edges[i]) for i in range(MAX_POINTS)]


def color_bar(scale: Scale) -> ColorBar:
    """The bar below a picture in the colors of that scale."""
    colors = colormap_colors(scale.colormap)
    stops = [colors[round(i * 255 / (LEGEND_STOPS - 1))] for i in range(LEGEND_STOPS)]
    gradient = ", ".join(f"rgb({red} {green} {blue})" for red, green, blue in stops)
    high = f"{'' if scale.bounded else '≥ '}{scale.high:g}{scale.unit}"
    return ColorBar(f"{scale.low:g}{scale.unit}", high, gradient)
