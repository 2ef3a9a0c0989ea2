"""Commands that turn scores into pages."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from shinypartial.cli.newest import announce_newest


@dataclass(frozen=True)
class Report:
    """Turn scores into one HTML page with pictures and tables."""

    prediction: tyro.conf.Positional[Path | None] = None
    """Prediction folder; the newest one below predictions/ when not given."""
    output: Path | None = None
    """File to write; inside the prediction folder when not given."""

    def run(self) -> None:
        """Write the report, print the summary and where the page lies."""
        from shinypartial.prediction.format import newest_prediction
        from shinypartial.report.page import summary_lines, write_report

        prediction = self.prediction or announce_newest("prediction", newest_prediction())
        page = write_report(prediction, self.output)
        print("\n".join(summary_lines(prediction)))
        print(f"Report: {page}")


@dataclass(frozen=True)
class Leaderboard:
    """Rank all scored predictions below a folder in one static page and a CSV."""

    predictions: tyro.conf.Positional[Path] = Path("predictions")
    """Folder that holds prediction folders, at any depth."""
    output: Path = Path("leaderboard")
    """Folder to write index.html and leaderboard.csv into."""

    def run(self) -> None:
        """Write page and table, and name what could not be compared."""
        from shinypartial.report.leaderboard import PAGE, write_leaderboard

        board = write_leaderboard(self.predictions, self.output)
        for group in board.groups:
            print(f"{group.dataset}: {len(group.lines)} {'prediction' if len(group.lines) == 1 else 'predictions'}")
        for one in board.excluded:
            print(f"not compared: {one.folder}: {one.reason}. {one.remedy}")
        print(f"Leaderboard: {self.output / PAGE}")


@dataclass(frozen=True)
class Chart:
    """Draw quality against fitting time and model size for the predictions of one dataset, with the Pareto front."""

    predictions: tyro.conf.Positional[tuple[Path, ...]] = (Path("predictions"),)
    """Scored prediction folders, or folders that hold them at any depth."""
    output: Path = Path("chart")
    """Folder to write chart.html, chart.csv and the SVG pictures into."""
    dataset: str | None = None
    """Name of the dataset, where there are predictions of several."""
    hardware: str | None = None
    """Words of the hardware to show, where predictions were made on several."""
    size: Literal["parameters", "primitives", "bytes"] = "parameters"
    """What the size of a model is."""

    def run(self) -> None:
        """Write page, pictures and table, and name what could not be drawn."""
        from shinypartial.report.chart import PAGE, write_chart

        drawn = write_chart(self.predictions, self.output, dataset=self.dataset, hardware=self.hardware, size=self.size)
        runs = sum(len(point.folders) for point in drawn.points)
        snapshots = sum(moment.iteration is not None for p in drawn.points for curve in p.curves for moment in curve)
        print(f"{drawn.dataset}: {len(drawn.points)} points of {runs} predictions, {snapshots} snapshots")
        for one in drawn.excluded:
            print(f"not drawn: {one.folder}: {one.reason}. {one.remedy}")
        print(f"Chart: {self.output / PAGE}")
