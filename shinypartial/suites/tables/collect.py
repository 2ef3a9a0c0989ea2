"""Finished cells to one small file."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from shinypartial.core.errors import InputError
from shinypartial.evaluation.scores import read_scores, score_rows
from shinypartial.io.files import read_json, write_json
from shinypartial.io.records import read_record as record_of
from shinypartial.prediction.format import read_info
from shinypartial.suites.attempt import read_record
from shinypartial.suites.jobs import Size
from shinypartial.suites.tables.plan import OF_COST, TABLES, Cell, CellKey, TablePlan

FORMAT, FORMAT_VERSION = "shinypartial-tables", 1
DIGITS = 6
PATHS = {column.path for table in TABLES.values() for column in table.columns} - set(OF_COST)


@dataclass(frozen=True)
class Outcome:
    """What became of a cell: figures by the path of their column, or the reason of its failure."""

    scene: str
    """With its condition."""
    method: str
    seed: int
    figures: dict[str, float] = field(default_factory=dict)
    failure: str = ""

    @property
    def key(self) -> CellKey:
        """As that of its cell."""
        return self.scene, self.method, self.seed


@dataclass(frozen=True)
class Results:
    """All outcomes, and what they were made with."""

    size: Size
    schedule: str
    outcomes: tuple[Outcome, ...]


def collect(folder: Path, plan: TablePlan) -> Results:
    """The outcomes of all cells that have ended."""
    found = (_outcome(folder, cell) for cell in plan.cells)
    return Results(plan.size, plan.schedule, tuple(each for each in found if each is not None))


def _outcome(folder: Path, cell: Cell) -> Outcome | None:
    fit, score = (read_record(folder, f"{kind}/{cell.name}") for kind in ("fit", "score"))
    if fit is None or score is None:
        return None
    if fit.reason or score.reason:
        return Outcome(*cell.key, failure=fit.reason or score.reason)
    prediction = folder / "predictions" / cell.name
    known = {row.path: row.value for row in score_rows(read_scores(prediction)) if row.path in PATHS}
    counts = read_info(prediction).parameter_counts
    known |= {"seconds": fit.cpu_seconds, "parameters": float(sum(counts.values())) if counts else None}
    return Outcome(*cell.key, {path: _rounded(value) for path, value in known.items() if value is not None})


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def merged(path: Path, results: Results) -> Results:
    """The results with those of an earlier file at `path` that are not made again.

    Raises InputError where these are of another size or schedule.
    """
    if not path.exists():
        return results
    earlier = read_results(path)
    if (earlier.size, earlier.schedule) != (results.size, results.schedule):
        raise InputError(
            expected=f"results as in {path}: {earlier.size}, {earlier.schedule or 'as published'}",
            found=f"{results.size}, {results.schedule or 'as published'}",
            remedy="Choose another --page, or the options of the earlier run.",
        )
    known = {each.key: each for each in (*earlier.outcomes, *results.outcomes)}
    return replace(results, outcomes=tuple(known.values()))


def read_measured(path: Path) -> frozenset[CellKey]:
    """The keys of cells that have figures in a file; none where there is no file."""
    outcomes = read_results(path).outcomes if path.exists() else ()
    return frozenset(each.key for each in outcomes if not each.failure)


def write_results(path: Path, results: Results) -> None:
    """Write the file."""
    write_json(path, {"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(results)})


def read_results(path: Path) -> Results:
    """Read it; InputError for another file."""
    content = read_json(path, "results of tables")
    fields: Mapping[str, object] = content if isinstance(content, dict) else {}
    if (fields.get("format"), fields.get("format_version")) != (FORMAT, FORMAT_VERSION):
        raise InputError(expected=f"{FORMAT} {FORMAT_VERSION} in {path}", found="another format", remedy="Delete it.")
    plain = {name: value for name, value in fields.items() if name not in ("format", "format_version")}
    return record_of(Results, plain, str(path))
