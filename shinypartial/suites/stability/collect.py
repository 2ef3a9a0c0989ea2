"""Finished cells to one small file, and to the figures that the page states."""

import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from shinypartial.core.errors import InputError
from shinypartial.evaluation.scores import read_scores
from shinypartial.io.files import read_json, write_text
from shinypartial.metrics.calibration import auroc
from shinypartial.prediction.format import read_info
from shinypartial.suites.attempt import read_record
from shinypartial.suites.jobs import Size
from shinypartial.suites.stability.axes import BY_NAME, Axis
from shinypartial.suites.stability.plan import Cell, Plan

FORMAT, FORMAT_VERSION = "shinypartial-stability", 1
#: A fit is lost where its environment is this much worse than that of the clean fit.
LOST_DB = 3.0
#: The verdict on a fit that is of no use.
REFUSED = "do not trust"
DIGITS = 4


@dataclass(frozen=True)
class Outcome:
    """What became of a cell. PSNR of linear light over the directions that the true training views observe."""

    cell: Cell
    environment_db: float | None = None
    environment_paper_db: float | None = None
    """PSNR of the whole map by the paper's protocol."""
    normals_mean_deg: float | None = None
    normals_median_deg: float | None = None
    verdict: str | None = None
    risk: float | None = None
    evidence: dict[str, float] = field(default_factory=dict)
    seconds: float | None = None
    """Of the method's command."""
    failure: str = ""


@dataclass(frozen=True)
class Results:
    """All outcomes, and how large the datasets were."""

    size: Size
    outcomes: tuple[Outcome, ...]

    @property
    def methods(self) -> list[str]:
        """Names of the methods, in the order of the plan."""
        return list(dict.fromkeys(each.cell.method for each in self.outcomes))

    @property
    def scenes(self) -> list[str]:
        """Names of the scenes, in the order of the plan."""
        return list(dict.fromkeys(each.cell.scene for each in self.outcomes))

    @property
    def axes(self) -> list[Axis]:
        """Axes with a cell, but for anchors."""
        names = {each.cell.axis for each in self.outcomes}
        return [axis for axis in BY_NAME.values() if axis.name in names and axis.kind != "anchor"]

    def along(self, axis: Axis, method: str, scene: str | None = None) -> dict[float, list[Outcome]]:
        """Outcomes by their position on an axis, the clean ones first."""
        found: dict[float, list[Outcome]] = {}
        for each in self.outcomes:
            cell = each.cell
            if cell.axis in (None, axis.name) and cell.method == method and scene in (None, cell.scene):
                found.setdefault(axis.position(cell.level), []).append(each)
        return dict(sorted(found.items()))


def collect(folder: Path, plan: Plan) -> Results:
    """The outcomes of all cells that have ended."""
    found = (_outcome(folder, cell) for cell in plan.cells)
    return Results(plan.size, tuple(each for each in found if each is not None))


def _outcome(folder: Path, cell: Cell) -> Outcome | None:
    fit, score = (read_record(folder, f"{kind}/{cell.name}") for kind in ("fit", "score"))
    if fit is None or score is None:
        return None
    seconds = fit.seconds if fit.code is not None else None
    if fit.reason or score.reason:
        return Outcome(cell, seconds=seconds, failure=fit.reason or score.reason)
    prediction = folder / "predictions" / cell.name
    scores, trust = read_scores(prediction), read_info(prediction).verdict
    environment, paper = scores.environment, scores.paper
    observed = environment.as_predicted.observed if environment else None
    normals = scores.normals_environment or scores.normals
    return Outcome(
        cell,
        _rounded(observed.psnr_linear if observed else None),
        _rounded(paper.environment.psnr_reinhard if paper and paper.environment else None),
        _rounded(normals.mean_angular_error_deg if normals else None),
        _rounded(normals.median_angular_error_deg if normals else None),
        trust.verdict if trust else None,
        _rounded(trust.risk if trust else None),
        {name: float(f"{value:.{DIGITS}g}") for name, value in trust.evidence.items()} if trust else {},
        seconds,
    )


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.{DIGITS}g}")


def write_results(path: Path, results: Results) -> None:
    """Write the file, a line a cell."""
    import json

    lines = (json.dumps({**asdict(each.cell), **_facts(each)}, allow_nan=False) for each in results.outcomes)
    head = json.dumps({"format": FORMAT, "format_version": FORMAT_VERSION, "size": asdict(results.size)})
    write_text(path, head[:-1] + ', "cells": [\n' + ",\n".join(lines) + "\n]}\n")


def _facts(outcome: Outcome) -> dict[str, object]:
    content = asdict(outcome)
    return {name: value for name, value in content.items() if name != "cell" and value not in (None, "", {})}


def read_results(path: Path) -> Results:
    """What `write_results` wrote. Raises InputError where the file is something else."""
    content = read_json(path, "the numbers of a stability page")
    try:
        found = content["format"], content["format_version"]
        if found != (FORMAT, FORMAT_VERSION):
            raise KeyError("format")
        return Results(Size(**content["size"]), tuple(map(_read_outcome, content["cells"])))
    except (KeyError, TypeError) as error:
        raise InputError(
            expected=f"numbers of a stability page ({FORMAT}, version {FORMAT_VERSION}) in {path}",
            found=f"a file that lacks or misuses {error}",
            remedy="Give a stability.json that `shinypartial stability --page` wrote.",
        ) from None


def _read_outcome(content: dict[str, Any]) -> Outcome:
    names = {each.name for each in fields(Cell)}
    cell = Cell(**{name: content[name] for name in names})
    return Outcome(cell, **{name: value for name, value in content.items() if name not in names})


def join_results(results: Results, others: Iterable[Results]) -> Results:
    """Results, then the cells that only others have. Raises InputError where datasets differ in size."""
    outcomes = {each.cell: each for each in results.outcomes}
    for other in others:
        if other.size != results.size:
            raise InputError(
                expected=f"results of datasets of one size, {asdict(results.size)}",
                found=f"others of {asdict(other.size)}",
                remedy="Join results of runs with the same --resolution, --train and --test.",
            )
        for each in other.outcomes:
            outcomes.setdefault(each.cell, each)
    return Results(results.size, tuple(outcomes.values()))


def crossing(positions: Sequence[float], losses: Sequence[float | None], limit: float) -> float | None:
    """Where a loss reaches its limit first, linear between levels; None is a failed level, and where it never does."""
    for index, (position, loss) in enumerate(zip(positions, losses, strict=True)):
        if loss is None:
            return position
        if loss >= limit:
            if index == 0:
                return position
            before = losses[index - 1]
            assert before is not None
            share = (limit - before) / (loss - before)
            return positions[index - 1] + share * (position - positions[index - 1])
    return None


def limits(results: Results, axis: Axis, method: str) -> tuple[float | None, ...]:
    """Positions on an axis at which scenes lose LOST_DB of their environment; None for one that does not within it."""
    found = []
    for scene in results.scenes:
        levels = results.along(axis, method, scene)
        if axis.position(None) not in levels or len(levels) < 2:
            continue
        decibels = [mean(each.environment_db for each in level) for level in levels.values()]
        if decibels[0] is not None:
            drops = [None if value is None else decibels[0] - value for value in decibels]
            found.append(crossing(list(levels), drops, LOST_DB))
    return tuple(found)


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of what is known; None where nothing is."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


@dataclass(frozen=True)
class Judged:
    """A fit that said how far it is to be trusted, and whether it lost its environment."""

    outcome: Outcome
    lost: bool


def judged(results: Results, split: str) -> Iterator[Judged]:
    """Fits of a split with a verdict, against the clean fit of the same scene, method and seed.

    Where that one is refused by its own verdict there is nothing to lose, so such a scene and method is left out.
    """

    def key(cell: Cell) -> tuple[str, str, int]:
        return cell.scene, cell.method, cell.seed

    clean = {
        key(each.cell): each.environment_db
        for each in results.outcomes
        if each.cell.axis is None and each.verdict != REFUSED
    }
    for each in results.outcomes:
        reference = clean.get(key(each.cell))
        known = None not in (each.verdict, each.risk, each.environment_db, reference)
        if known and each.cell.split == split:
            assert reference is not None
            assert each.environment_db is not None
            yield Judged(each, reference - each.environment_db >= LOST_DB)


def verdict_auroc(fits: Sequence[Judged]) -> float | None:
    """Chance that a lost fit has the higher risk than one that is not; None without both."""
    if not fits:
        return None
    confidence = np.array([-(each.outcome.risk or 0.0) for each in fits])
    return auroc(confidence, np.array([each.lost for each in fits]), np.ones(len(fits)))
