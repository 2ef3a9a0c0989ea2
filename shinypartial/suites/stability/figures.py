"""Curves of quality along each axis, and pictures of maps that break."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from shinypartial.core.color import to_display
from shinypartial.io.files import write_text
from shinypartial.io.picture_sheet import write_picture_sheet
from shinypartial.metrics.environment import to_protocol_size
from shinypartial.prediction.format import DESCRIPTION, read_environment_map
from shinypartial.report.chart_svg import CARD, COLORS, INK, set_ticks, svg_text
from shinypartial.suites.stability.axes import BY_NAME, Axis
from shinypartial.suites.stability.collect import Outcome, Results, mean

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_INCHES = (7.2, 2.5)
#: Scenes and axes of which maps are shown.
SHOWN = (("vase", "rotation"), ("pebble", "rotation"), ("vase", "masks-dilated"), ("tiny-vase", "rotation"))
MAP_HEIGHT = 128
Value = Callable[[Outcome], float | None]


def write_curves(path: Path, results: Results, axis: Axis) -> None:
    """One picture: environment and normals side by side, a curve a method, with the range over seeds."""
    write_text(path, svg_text(lambda: make_curves(results, axis), axis.name))


def make_curves(results: Results, axis: Axis) -> "Figure":
    """Levels stand at even distances, because they grow unevenly."""
    from matplotlib.figure import Figure

    figure = Figure(SIZE_INCHES, facecolor=CARD, layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw(left, results, axis, "Environment, observed directions [dB]", lambda each: each.environment_db)
    _draw(right, results, axis, "Normals, mean error [°]", lambda each: each.normals_mean_deg)
    shown = [point for line in right.lines for point in line.get_ydata()]
    if shown and min(shown) > 0:
        right.set_yscale("log")
        set_ticks(right.yaxis, shown, True)
    left.legend(frameon=False, fontsize=7)
    return figure


def _draw(axes: "Axes", results: Results, axis: Axis, title: str, value: Value) -> None:
    axes.set_facecolor("none")
    axes.set_title(title, loc="left", color=INK, fontsize=8)
    axes.set_xlabel(axis.title)
    axes.grid(linewidth=0.6)
    ticks = sorted({position for method in results.methods for position in results.along(axis, method)})
    axes.set_xticks(range(len(ticks)), [axis.text(each).strip() if each else "clean" for each in ticks])
    for method, color in zip(results.methods, COLORS * len(results.methods), strict=False):
        places, middle, low, high = [], [], [], []
        for position, level in results.along(axis, method).items():
            seeds = sorted({each.cell.seed for each in level})
            means = [mean(value(each) for each in level if each.cell.seed == seed) for seed in seeds]
            known = [each for each in means if each is not None]
            if known:
                places.append(ticks.index(position))
                middle.append(sum(known) / len(known))
                low.append(min(known))
                high.append(max(known))
        axes.plot(places, middle, "o-", color=color, markersize=3, linewidth=1.2, label=method)
        axes.fill_between(places, low, high, color=color, alpha=0.2, linewidth=0)


def write_pictures(folder: Path, suite: Path, results: Results, method: str) -> list[tuple[str, str]]:
    """Sheets of environment maps at growing levels, as file names and captions.

    Where the suite has no maps of them, a sheet that is there stays, and one that is not is left out.
    """
    made = []
    for scene, name in SHOWN:
        axis, pictures = BY_NAME[name], {}
        for position, level in results.along(axis, method, scene).items():
            prediction, decibels = suite / "predictions" / level[0].cell.name, level[0].environment_db
            if (prediction / DESCRIPTION).exists() and decibels is not None:
                title = f"{axis.text(position).strip() if position else 'clean'}: {decibels:.1f} dB"
                pictures[title] = to_display(to_protocol_size(read_environment_map(prediction), MAP_HEIGHT))
        path = folder / f"stability-{scene}-{name}.jpg"
        if len(pictures) > 1:
            write_picture_sheet(path, pictures, widths=(2 * MAP_HEIGHT,) * 3, height=MAP_HEIGHT, max_bytes=90_000)
        if path.exists():
            made.append((path.name, f"{scene}, {axis.title.lower()}, method {method}"))
    return made
