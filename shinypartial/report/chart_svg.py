"""A chart of quality against cost as one SVG that explains itself; alone it is light, in a page it takes its colors."""

import html
import math
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from shinypartial.comparison.pareto import Spread
from shinypartial.report.line_chart import short_number

WIDTH, PLOT_HEIGHT = 560, 300
LEFT, RIGHT, TOP, BOTTOM = 62, 16, 40, 46
LINE_PX = 15
#: Characters of a line of the legend.
LEGEND_WIDTH = 88
#: Colors that people with color blindness can tell apart (Okabe and Ito 2008), taken in turn.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#56b4e9", "#7f5539", "#7f7f7f")
#: Positive values that span more than this factor get a logarithmic axis.
LOGARITHMIC_SPAN = 20.0
MAX_TICKS = 8
STYLE = (
    ".qc text{font:11px system-ui,sans-serif;fill:var(--dim,#5d6470)}"
    ".qc .name{font-size:13px;font-weight:600;fill:var(--ink,#1b1d21)}"
    ".qc .grid{stroke:var(--rule,#dfe1e5)}.qc .page{fill:var(--card,#fff)}"
    ".qc .bound{stroke:var(--ink,#1b1d21);stroke-dasharray:7 4}"
    ".qc .front{fill:none;stroke:var(--dim,#5d6470);stroke-dasharray:2 3}"
)


@dataclass(frozen=True)
class Axis:
    """Values from `low` to `high` on pixels from `start_px` to `end_px`; logarithmic ones are positive."""

    title: str
    low: float
    high: float
    logarithmic: bool
    start_px: float
    end_px: float

    def place(self, value: float) -> float:
        """The pixel of a value."""
        low, high, at = (math.log10(v) if self.logarithmic else v for v in (self.low, self.high, value))
        return self.start_px + (at - low) / (high - low) * (self.end_px - self.start_px)

    def ticks(self) -> list[float]:
        """Round values on the axis: 1, 2, 5 times powers of ten, or powers alone where those are too many."""
        if self.logarithmic:
            first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
            for digits in ((1, 2, 5), (1,)):
                found = [d * 10.0**power for power in range(first, last + 1) for d in digits]
                found = [value for value in found if self.low <= value <= self.high]
                if 3 <= len(found) <= MAX_TICKS:
                    return found
        return _round_values(self.low, self.high)


@dataclass(frozen=True)
class Mark:
    """A point with its number, color and spread, and whether it is on the Pareto front."""

    number: int
    x: Spread
    y: Spread
    on_front: bool

    @property
    def color(self) -> str:
        """Of the mark and its curves."""
        return COLORS[(self.number - 1) % len(COLORS)]


@dataclass(frozen=True)
class Curve:
    """Quality against time within one fit of the mark with this number."""

    number: int
    x: Sequence[float]
    y: Sequence[float]


@dataclass(frozen=True)
class Plot:
    """What a chart shows; `bound` is drawn as a line, `legend` below the plot, a line an entry."""

    title: str
    x_title: str
    y_title: str
    marks: Sequence[Mark]
    curves: Sequence[Curve]
    bound: float | None
    legend: Sequence[str]


def draw(plot: Plot, *, alone: bool = False) -> str:
    """The plot as SVG: spreads as bars, points on the Pareto front filled and joined by a dotted staircase.

    In a page the colors follow its variables; `alone`, they are fixed, for few programs but browsers know variables.
    """
    x, y = _axes(plot)
    style = re.sub(r"var\(--\w+,(#\w+)\)", r"\1", STYLE) if alone else STYLE
    lines = [line for entry in plot.legend for line in textwrap.wrap(entry, LEGEND_WIDTH, subsequent_indent="    ")]
    height = PLOT_HEIGHT + LINE_PX * len(lines) + 8
    parts = [
        f'<rect class="page" width="{WIDTH}" height="{height}"/>',
        f'<text class="name" x="{LEFT}" y="22">{html.escape(plot.title)}</text>',
        *_grid(x, y),
        *_oracle_line(plot, y),
        *(_curve(curve, x, y) for curve in plot.curves),
        *_front(plot.marks, x, y),
        *(_mark(mark, x, y) for mark in plot.marks),
        *_numbers(plot.marks, x, y),
        *(
            f'<text x="{LEFT}" y="{PLOT_HEIGHT + LINE_PX * row}" xml:space="preserve">{html.escape(line)}</text>'
            for row, line in enumerate(lines, 1)
        ),
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="qc" viewBox="0 0 {WIDTH} {height}" role="img" '
        f'aria-label="{html.escape(plot.title, quote=True)}"><style>{style}</style>{"".join(parts)}</svg>'
    )


def _axes(plot: Plot) -> tuple[Axis, Axis]:
    spreads = [(mark.x, mark.y) for mark in plot.marks]
    across = [v for x, _ in spreads for v in (x.low, x.high)] + [v for curve in plot.curves for v in curve.x]
    upward = [v for _, y in spreads for v in (y.low, y.high)] + [v for curve in plot.curves for v in curve.y]
    upward += [] if plot.bound is None else [plot.bound]
    logarithmic = min(upward) > 0 and max(upward) / min(upward) > LOGARITHMIC_SPAN
    x = _axis(plot.x_title, across, True, LEFT, WIDTH - RIGHT)
    return x, _axis(plot.y_title, upward, logarithmic, PLOT_HEIGHT - BOTTOM, TOP)


def _axis(title: str, values: Sequence[float], logarithmic: bool, start_px: float, end_px: float) -> Axis:
    """An axis with a margin of a tenth around the values."""
    low, high = (math.log10(f(values)) if logarithmic else f(values) for f in (min, max))
    margin = 0.1 * (high - low) or (0.15 if logarithmic else 0.05 * abs(high) or 0.5)
    ends = (10 ** (low - margin), 10 ** (high + margin)) if logarithmic else (low - margin, high + margin)
    note = ", logarithmic axis" if logarithmic else ""
    return Axis(title + note, *ends, logarithmic, start_px, end_px)


def _round_values(low: float, high: float) -> list[float]:
    """At most seven multiples of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / 6
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * digit for digit in (1, 2, 5, 10) if power * digit >= rough)
    return [index * step for index in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _grid(x: Axis, y: Axis) -> list[str]:
    parts = []
    for value in y.ticks():
        at = y.place(value)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{short_number(value)}</text>')
    for value in x.ticks():
        at, base = x.place(value), PLOT_HEIGHT - BOTTOM
        parts.append(f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" y2="{base}"/>')
        parts.append(f'<text x="{at:.1f}" y="{base + 15}" text-anchor="middle">{short_number(value)}</text>')
    middle_x, middle_y = (LEFT + WIDTH - RIGHT) / 2, (TOP + PLOT_HEIGHT - BOTTOM) / 2
    parts.append(f'<text x="{middle_x}" y="{PLOT_HEIGHT - 12}" text-anchor="middle">{html.escape(x.title)}</text>')
    turned = f'transform="translate(13 {middle_y}) rotate(-90)" text-anchor="middle"'
    return [*parts, f"<text {turned}>{html.escape(y.title)}</text>"]


def _oracle_line(plot: Plot, y: Axis) -> list[str]:
    if plot.bound is None:
        return []
    at = y.place(plot.bound)
    return [
        f'<line class="bound" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>',
        f'<text x="{LEFT + 4}" y="{at - 5:.1f}">bound (oracle) {short_number(plot.bound)}</text>',
    ]


def _curve(curve: Curve, x: Axis, y: Axis) -> str:
    color = COLORS[(curve.number - 1) % len(COLORS)]
    places = [(x.place(a), y.place(b)) for a, b in zip(curve.x, curve.y, strict=True)]
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in places)
    dots = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2" fill="{color}"/>' for a, b in places)
    return f'<polyline points="{points}" fill="none" stroke="{color}" stroke-opacity="0.6"/>{dots}'


def _front(marks: Sequence[Mark], x: Axis, y: Axis) -> list[str]:
    """The best that is reached at each cost: level until the next point of the front."""
    places = sorted((x.place(mark.x.median), y.place(mark.y.median)) for mark in marks if mark.on_front)
    if not places:
        return []
    path = f"M{places[0][0]:.1f} {places[0][1]:.1f}" + "".join(f"H{a:.1f}V{b:.1f}" for a, b in places[1:])
    return [f'<path class="front" d="{path}H{x.end_px}"/>']


def _mark(mark: Mark, x: Axis, y: Axis) -> str:
    a, b = x.place(mark.x.median), y.place(mark.y.median)
    bars = ""
    if mark.x.high > mark.x.low:
        bars += f"M{x.place(mark.x.low):.1f} {b:.1f}H{x.place(mark.x.high):.1f}"
    if mark.y.high > mark.y.low:
        bars += f"M{a:.1f} {y.place(mark.y.low):.1f}V{y.place(mark.y.high):.1f}"
    bar = f'<path d="{bars}" stroke="{mark.color}" stroke-width="1.2"/>' if bars else ""
    fill = mark.color if mark.on_front else "none"
    return (
        f'{bar}<circle class="mark" cx="{a:.1f}" cy="{b:.1f}" r="5.5" stroke="{mark.color}" stroke-width="2" '
        f'fill="{fill}"/>'
    )


def _numbers(marks: Sequence[Mark], x: Axis, y: Axis) -> list[str]:
    """Each mark's number, at the first of eight places around it where it covers no mark and no other number."""
    centers = [(x.place(mark.x.median), y.place(mark.y.median)) for mark in marks]
    taken, texts = list(centers), []
    for mark, (a, b) in zip(marks, centers, strict=True):
        around = [(a + dx, b + dy) for dy in (-11, 11, 0) for dx in (11, -11, 0) if dx or dy]
        inside = [p for p in around if LEFT < p[0] < WIDTH - RIGHT and TOP < p[1] < PLOT_HEIGHT - BOTTOM] or around
        spot = max(inside, key=lambda p: (min(min(math.dist(p, t), 10.0) for t in taken), -inside.index(p)))
        taken.append(spot)
        texts.append(
            f'<text x="{spot[0]:.1f}" y="{spot[1] + 4:.1f}" text-anchor="middle" '
            f'style="fill:{mark.color};font-weight:700">{mark.number}</text>'
        )
    return texts
