"""What a chart of quality against cost shows: runs of one dataset on one machine, seeds joined, the Pareto front.

Reads `prediction.json` and `scores.json` only. What differs in dataset or hardware is refused, what can't be read or
has no score is excluded with the reason.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from shinypartial.comparison.runs import HASH_DIGITS, Entry, Excluded, read_entry
from shinypartial.comparison.significance import Spread, summarize
from shinypartial.core.errors import InputError
from shinypartial.evaluation.key_metrics import key_metrics
from shinypartial.evaluation.scores import read_oracle_baseline, score_rows
from shinypartial.metrics.registry import Direction
from shinypartial.prediction.format import DESCRIPTION, prediction_folders, snapshot_folders

Cost = Literal["seconds", "parameters", "primitives", "bytes"]
Size = Literal["parameters", "primitives", "bytes"]


@dataclass(frozen=True)
class Measure:
    """An axis: its name in the table of points, its title and unit, and where the scores hold it; empty for a cost."""

    name: str
    title: str
    unit: str = ""
    path: str = ""
    higher_is_better: bool = False

    @property
    def label(self) -> str:
        """Title and unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title


COSTS: dict[Cost, Measure] = {
    "seconds": Measure("seconds", "Seconds of fitting"),
    "parameters": Measure("parameters", "Parameters"),
    "primitives": Measure("primitives", "Primitives"),
    "bytes": Measure("bytes", "Bytes of the exported model"),
}
QUALITIES = tuple(
    Measure(key.name, key.title, key.metric.unit, key.path, key.metric.direction is Direction.HIGHER)
    for key in key_metrics("chart")
)
MEASURES = (*COSTS.values(), *QUALITIES)


@dataclass(frozen=True)
class Moment:
    """A scored snapshot: the numbers of finished steps and, by the names of measures, what it cost and reached."""

    folder: str
    iteration: int | None
    values: dict[str, float]


@dataclass(frozen=True)
class Point:
    """One method in one configuration: a value by the name of each measure that it states, over its seeds.

    `curves` are the snapshots of each run, in the order of time, and the run's end where it comes later.
    """

    label: str
    method: str
    folders: tuple[str, ...]
    seeds: tuple[str, ...]
    values: dict[str, Spread]
    curves: tuple[tuple[Moment, ...], ...]


@dataclass(frozen=True)
class Comparable:
    """Points that may share a chart; `oracle` holds the oracle baseline's value by the name of a measure."""

    dataset: str
    dataset_hash: str
    protocol: str
    hardware: str
    points: tuple[Point, ...]
    oracle: dict[str, float]
    excluded: tuple[Excluded, ...]


@dataclass(frozen=True)
class _Run:
    folder: Path
    entry: Entry
    moments: tuple[Moment, ...]


def pareto_front(costs: Sequence[float], values: Sequence[float], *, higher_is_better: bool) -> tuple[bool, ...]:
    """Which points no other dominates: none costs at most as much and is at least as good, one of the two strictly.

    One sweep by rising cost, the best first among equals. Equal points are on the front together.
    """
    sign = -1.0 if higher_is_better else 1.0
    keys = [(cost, sign * value) for cost, value in zip(costs, values, strict=True)]
    front, best = set(), float("inf")
    for cost, value in sorted(set(keys)):
        if value < best:
            front.add((cost, value))
            best = value
    return tuple(key in front for key in keys)


def collect_points(paths: Iterable[Path], dataset: str | None = None, hardware: str | None = None) -> Comparable:
    """Read every prediction at or below the paths; `dataset` (a name) and `hardware` (some words) choose among them.

    Raises InputError when there is none, or when more than one dataset, version of it or hardware is left.
    """
    entries, excluded = _read(paths)
    oracles = [entry for _, entry in entries if entry.is_oracle]
    methods = [(folder, entry) for folder, entry in entries if not entry.is_oracle]
    if dataset is not None:
        methods = [(folder, entry) for folder, entry in methods if entry.scores.dataset == dataset]
    if hardware is not None:
        words = hardware.casefold()
        methods = [(folder, entry) for folder, entry in methods if words in entry.info.hardware_text.casefold()]
    if not methods:
        reasons = "; ".join(f"{one.folder}: {one.reason}" for one in excluded[:3])
        raise InputError(
            expected="at least one scored prediction" + _wish(dataset, hardware),
            found=reasons or "none",
            remedy=excluded[0].remedy if excluded else "Name other folders, --dataset or --hardware.",
        )
    _require_one_dataset([entry for _, entry in methods])
    _require_one_hardware([entry for _, entry in methods])
    runs = []
    for folder, entry in methods:
        moments, rest = _moments(folder, entry)
        runs.append(_Run(folder, entry, moments))
        excluded += rest
    scores = methods[0][1].scores
    excluded += [
        Excluded(
            entry.folder, "states no seconds, so it is in no chart of time", f"Add `seconds` to its {DESCRIPTION}."
        )
        for _, entry in methods
        if not entry.seconds
    ]
    return Comparable(
        dataset=scores.dataset,
        dataset_hash=scores.dataset_hash,
        protocol=scores.protocol,
        hardware=methods[0][1].info.hardware_text,
        points=_points(runs),
        oracle=_oracle_values(oracles, runs),
        excluded=tuple(excluded),
    )


def _read(paths: Iterable[Path]) -> tuple[list[tuple[Path, Entry]], list[Excluded]]:
    paths = tuple(paths)
    folders = list(dict.fromkeys(folder for path in paths for folder in prediction_folders(path)))
    if not folders:
        raise InputError(
            expected=f"prediction folders at or below {', '.join(map(str, paths))}",
            found=f"none (no folder holds {DESCRIPTION})",
            remedy="Name prediction folders, or the folder that holds them.",
        )
    entries: list[tuple[Path, Entry]] = []
    excluded: list[Excluded] = []
    for folder in folders:
        found = read_entry(folder, folder.as_posix())
        if isinstance(found, Entry):
            entries.append((folder, found))
        else:
            excluded.append(found)
    return entries, excluded


def _wish(dataset: str | None, hardware: str | None) -> str:
    on = f" of {dataset}" if dataset else ""
    return on + (f" on hardware that mentions {hardware!r}" if hardware else "")


def _require_one_dataset(entries: Sequence[Entry]) -> None:
    names = sorted({entry.scores.dataset for entry in entries})
    if len(names) > 1:
        raise InputError(
            expected="predictions of one dataset, for scores on different ones don't compare",
            found=", ".join(names),
            remedy=f"Choose one, such as `--dataset {names[0]}`, and make a chart for each.",
        )
    versions = sorted({entry.scores.dataset_hash for entry in entries})
    if len(versions) > 1:
        listed = "; ".join(
            f"{version[:HASH_DIGITS]}… ({', '.join(e.folder for e in entries if e.scores.dataset_hash == version)})"
            for version in versions
        )
        raise InputError(
            expected=f"predictions of one version of {names[0]}",
            found=f"{len(versions)} versions, by their hashes: {listed}",
            remedy="Name the folders of one version.",
        )


def _require_one_hardware(entries: Sequence[Entry]) -> None:
    kinds = sorted({entry.info.hardware_text for entry in entries})
    if len(kinds) > 1:
        raise InputError(
            expected="predictions made on one hardware, for seconds on different ones don't compare",
            found="; ".join(kinds),
            remedy="Choose with words that only one of them has, such as `--hardware 'device cpu'`.",
        )


def _values(entry: Entry) -> dict[str, float]:
    info = entry.info
    costs = {
        "seconds": entry.seconds,
        "parameters": entry.parameters,
        "primitives": info.primitives,
        "bytes": info.model_bytes,
    }
    values = {name: float(value) for name, value in costs.items() if value}
    for quality in QUALITIES:
        value = entry.value(quality.path)
        if value is not None:
            values[quality.name] = value
    return values


def _moments(folder: Path, whole: Entry) -> tuple[tuple[Moment, ...], list[Excluded]]:
    """The scored snapshots of a prediction and its end, by time; and the snapshots that are not of this fit."""
    moments: list[Moment] = []
    excluded: list[Excluded] = []
    for snapshot in snapshot_folders(folder):
        entry = read_entry(snapshot, snapshot.as_posix())
        if isinstance(entry, Entry):
            differing = _difference(entry, whole)
            if not differing and entry.seconds:
                moments.append(Moment(entry.folder, entry.info.iteration, _values(entry)))
                continue
            reason = f"a snapshot of another {differing} than {whole.folder}" if differing else "states no seconds"
            entry = Excluded(snapshot.as_posix(), reason, "Export the snapshots again, or delete that folder.")
        excluded.append(entry)
    moments.sort(key=lambda moment: moment.values["seconds"])
    end = Moment(whole.folder, None, _values(whole))
    if moments and end.values.get("seconds", 0.0) > moments[-1].values["seconds"]:
        moments.append(end)
    return tuple(moments), excluded


def _difference(snapshot: Entry, whole: Entry) -> str:
    """What keeps a snapshot from being a moment of this fit; empty when nothing does."""
    if snapshot.scores.dataset_hash != whole.scores.dataset_hash:
        return "dataset"
    if (snapshot.info.method, snapshot.info.config) != (whole.info.method, whole.info.config):
        return "configuration"
    return "" if snapshot.info.hardware_text == whole.info.hardware_text else "hardware"


def _points(runs: Sequence[_Run]) -> tuple[Point, ...]:
    """Runs of one method that differ in nothing but the seed are one point; points by rising time."""
    groups: dict[str, list[_Run]] = {}
    for run in runs:
        groups.setdefault(_key(run), []).append(run)
    points = [_point(group) for group in groups.values()]
    methods = [point.method for point in points]
    points = [
        replace(point, label=f"{point.method}, {point.folders[0]}") if methods.count(point.method) > 1 else point
        for point in points
    ]
    return tuple(sorted(points, key=lambda p: (p.values["seconds"].median if "seconds" in p.values else 0.0, p.label)))


def _key(run: _Run) -> str:
    """What repetitions have in common; a run that states no seed is no repetition of another."""
    info = run.entry.info
    config = {name: value for name, value in info.config.items() if name != "seed"}
    alone = "" if "seed" in info.config else run.entry.folder
    return json.dumps([info.method, config, alone], sort_keys=True)


def _point(group: Sequence[_Run]) -> Point:
    runs = [_values(run.entry) for run in group]
    spreads = {}
    for measure in MEASURES:
        known = [values[measure.name] for values in runs if measure.name in values]
        if known:
            spreads[measure.name] = summarize(known)
    method = group[0].entry.info.method
    return Point(
        label=method,
        method=method,
        folders=tuple(run.entry.folder for run in group),
        seeds=tuple(str(run.entry.info.config.get("seed", "")) for run in group),
        values=spreads,
        curves=tuple(run.moments for run in group if run.moments),
    )


def _oracle_values(oracles: Sequence[Entry], runs: Sequence[_Run]) -> dict[str, float]:
    """The oracle baseline's environment, from the predictions named or from beside them; its normals are the truth."""
    wanted = runs[0].entry.scores.dataset_hash
    found = [entry.scores for entry in oracles if entry.scores.dataset_hash == wanted]
    found += [scores for run in runs if (scores := read_oracle_baseline(run.folder, run.entry.scores)) is not None]
    if not found:
        return {}
    rows = {row.path: row.value for row in score_rows(found[0])}
    values = {one.name: rows.get(one.path) for one in QUALITIES if one.path.startswith("environment.")}
    return {name: value for name, value in values.items() if value is not None}
