"""A chart of quality against cost as one SVG that explains itself, drawn by matplotlib."""

import io
import re
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from shinypartial.comparison.significance import Spread
from shinypartial.report.line_chart import short_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

SIZE_INCHES = (5.8, 3.1)
#: Colors that people with color blindness can distinguish (Okabe and Ito 2008), taken in turn.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#56b4e9", "#7f5539", "#7f7f7f")
#: Colors of a light page, and the variables that a page has for them.
INK, DIM, RULE, CARD = "#1b1d21", "#5d6470", "#dfe1e5", "#fefefe"
VARIABLES = {INK: "--ink", DIM: "--dim", RULE: "--rule", CARD: "--card"}
#: Positive values that span more than this factor get a logarithmic axis.
LOGARITHMIC_SPAN = 20.0
#: A logarithmic axis over a smaller factor has ticks at even distances, as it would hold hardly a power of ten; over a
#: larger one than the second it has them at powers of ten alone.
DECADE, MANY_DECADES = 10.0, 500.0
MARGIN = 0.08
#: Characters of a line of facts.
FACTS_WIDTH = 84
SETTINGS: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "shinypartial",
    "font.family": "sans-serif",
    "font.size": 8,
    "axes.edgecolor": RULE,
    "axes.labelcolor": DIM,
    "text.color": DIM,
    "xtick.labelcolor": DIM,
    "ytick.labelcolor": DIM,
    "xtick.color": RULE,
    "ytick.color": RULE,
    "grid.color": RULE,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


@dataclass(frozen=True)
class Mark:
    """A point with its number, entry in the legend and spread, and whether it is on the Pareto front."""

    number: int
    label: str
    x: Spread
    y: Spread
    on_front: bool


@dataclass(frozen=True)
class Curve:
    """Quality against time within one fit of the mark with this number."""

    number: int
    x: Sequence[float]
    y: Sequence[float]


@dataclass(frozen=True)
class Plot:
    """What a chart shows; `oracle` is drawn as a line, `facts` stand below the legend."""

    title: str
    x_title: str
    y_title: str
    marks: Sequence[Mark]
    curves: Sequence[Curve]
    oracle: float | None
    facts: Sequence[str]


def draw(plot: Plot) -> str:
    """The plot as SVG text, the same for the same plot: a file of its own, or part of a page."""
    return svg_text(lambda: make_figure(plot), plot.title)


def svg_text(make: Callable[[], "Figure"], salt: str) -> str:
    """A figure, made in our style, as SVG text that holds nothing of when it was made; `salt` distinguishes its ids."""
    import matplotlib

    stream = io.StringIO()
    with matplotlib.rc_context({**SETTINGS, "svg.hashsalt": salt}):
        make().savefig(stream, format="svg", bbox_inches="tight", metadata={"Date": None})
    text = stream.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    return text.replace("<svg ", '<svg role="img" ', 1)


def follow_page_colors(svg: str) -> str:
    """The same picture for a page, in the colors of its variables; few programs but browsers know variables."""
    for color, variable in VARIABLES.items():
        svg = svg.replace(color, f"var({variable})")
    return svg


def make_figure(plot: Plot) -> "Figure":
    """Spreads as bars, points on the Pareto front filled and joined by a dotted staircase, numbers in the marks."""
    from matplotlib.figure import Figure

    figure = Figure(SIZE_INCHES, facecolor=CARD)
    axes = figure.add_subplot(facecolor="none")
    axes.set_title(plot.title, loc="left", color=INK, fontsize=8, fontweight="bold")
    axes.set_axisbelow(True)
    axes.grid(linewidth=0.6)
    across = [value for mark in plot.marks for value in (mark.x.low, mark.x.high)]
    upward = [value for mark in plot.marks for value in (mark.y.low, mark.y.high)]
    across += [value for curve in plot.curves for value in curve.x]
    upward += [value for curve in plot.curves for value in curve.y] + ([] if plot.oracle is None else [plot.oracle])
    logarithmic = min(upward) > 0 and max(upward) / min(upward) > LOGARITHMIC_SPAN
    axes.set_xscale("log")
    axes.set_yscale("log" if logarithmic else "linear")
    axes.set_xlabel(f"{plot.x_title}, logarithmic axis")
    axes.set_ylabel(plot.y_title + (", logarithmic axis" if logarithmic else ""))
    axes.set_xlim(_limits(across, True))
    axes.set_ylim(_limits(upward, logarithmic))
    set_ticks(axes.xaxis, across, True)
    set_ticks(axes.yaxis, upward, logarithmic)
    for curve in plot.curves:
        axes.plot(curve.x, curve.y, ".-", color=_color(curve.number), linewidth=0.9, markersize=3, alpha=0.7)
    if plot.oracle is not None:
        axes.axhline(plot.oracle, color=INK, linestyle=(0, (7, 4)), linewidth=0.9, gid="oracle")
        text = f"oracle baseline {short_number(plot.oracle)}"
        axes.annotate(text, (0, plot.oracle), (3, 3), xycoords=("axes fraction", "data"), textcoords="offset points")
    front = sorted((mark.x.median, mark.y.median) for mark in plot.marks if mark.on_front)
    if front:
        front.append((axes.get_xlim()[1], front[-1][1]))
        axes.step(*zip(*front, strict=True), where="post", color=DIM, linestyle=":", linewidth=1)
    for mark in plot.marks:
        _draw_mark(axes, mark)
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.2), frameon=False, borderaxespad=0, handlelength=1.2)
    below = -0.24 - 0.073 * len(plot.marks)
    lines = [line for fact in plot.facts for line in textwrap.wrap(fact, FACTS_WIDTH, subsequent_indent="    ")]
    axes.text(0, below, "\n".join(lines), transform=axes.transAxes, va="top", fontsize=7)
    return figure


def _draw_mark(axes: "Axes", mark: Mark) -> None:
    color, center = _color(mark.number), (mark.x.median, mark.y.median)
    axes.hlines(center[1], mark.x.low, mark.x.high, color=color, linewidth=1)
    axes.vlines(center[0], mark.y.low, mark.y.high, color=color, linewidth=1)
    face = color if mark.on_front else CARD
    axes.plot(
        *center, "o", color=color, markerfacecolor=face, markersize=10, label=mark.label, gid=f"mark{mark.number}"
    )
    ink = "#ffffff" if mark.on_front else color
    axes.annotate(str(mark.number), center, color=ink, ha="center", va="center_baseline", fontsize=6.5, weight="bold")


def _color(number: int) -> str:
    return COLORS[(number - 1) % len(COLORS)]


def _limits(values: Sequence[float], logarithmic: bool) -> tuple[float, float]:
    """The range of the values and a margin; a single value gets a range of its own size."""
    low, high = min(values), max(values)
    if logarithmic:
        factor = (high / low) ** MARGIN if high > low else 1.5
        return low / factor, high * factor
    margin = MARGIN * (high - low) or 0.05 * abs(high) or 0.5
    return low - margin, high + margin


def set_ticks(axis: "Axis", values: Sequence[float], logarithmic: bool) -> None:
    """Ticks at round values, or at 1, 2 and 5 times powers of ten over more than one of these; short numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    factor = max(values) / min(values) if logarithmic else 1.0
    digits = (1.0, 2.0, 5.0) if factor < MANY_DECADES else (1.0,)
    axis.set_major_locator(LogLocator(subs=digits) if factor > DECADE else MaxNLocator(6, steps=[1, 2, 5, 10]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: short_number(value)))
