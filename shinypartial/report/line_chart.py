"""Line charts and color legends as inline SVG and HTML, without scripts; colors follow the page's variables."""

import html
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


def is_logarithmic(series: Series) -> bool:
    """Whether the chart of the series has a logarithmic axis."""
    return min(series.y) > 0 and max(series.y) / min(series.y) > LOGARITHMIC_SPAN


def line_chart(series: Series) -> str:
    """The series as an SVG with its smallest, middle and largest value on the axes."""
    logarithmic = is_logarithmic(series)
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
    marks = [_horizontal_mark(low + share * (high - low), share, logarithmic) for share in (0.0, 0.5, 1.0)]
    ends = [
        f'<text x="{place}" y="{HEIGHT - 8}" text-anchor="{anchor}">{html.escape(text)}</text>'
        for place, anchor, text in (
            (LEFT, "start", f"{low_x:g}"),
            (LEFT + plot_width / 2, "middle", series.x_title),
            (WIDTH - RIGHT, "end", f"{high_x:g}"),
        )
    ]
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(series.title, quote=True)}">'
        f'{"".join(marks)}{"".join(ends)}<polyline class="line" points="{points}"/></svg>'
    )


def _horizontal_mark(level: float, share: float, logarithmic: bool) -> str:
    place = TOP + (1 - share) * (HEIGHT - TOP - BOTTOM)
    value = 10**level if logarithmic else level
    return (
        f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{place:.1f}" y2="{place:.1f}"/>'
        f'<text x="{LEFT - 6}" y="{place + 4:.1f}" text-anchor="end">{short_number(value)}</text>'
    )


def short_number(value: float) -> str:
    """Three digits, or all digits of a larger number below a million."""
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def _thin(values: Sequence[float]) -> list[float]:
    if len(values) <= MAX_POINTS:
        return list(values)
    edges = [round(i * len(values) / MAX_POINTS) for i in range(MAX_POINTS + 1)]
    return [sum(values[edges[i] : edges[i + 1]]) / (edges[i + 1] - edges[i]) for i in range(MAX_POINTS)]


def legend(scale: Scale) -> str:
    """A bar with the colors of the scale and its ends in numbers."""
    colors = colormap_colors(scale.colormap)
    picked = [colors[round(i * 255 / (LEGEND_STOPS - 1))] for i in range(LEGEND_STOPS)]
    gradient = ", ".join(f"rgb({red} {green} {blue})" for red, green, blue in picked)
    return (
        f'<div class="legend"><span>{scale.low:g}{scale.unit}</span>'
        f'<i style="background: linear-gradient(to right, {gradient})"></i>'
        f"<span>{'' if scale.bounded else '≥ '}{scale.high:g}{scale.unit}</span></div>"
    )
