"""Two groups of scored predictions, several seeds or scenes each: means, spreads and tests of paired differences."""

import csv
import functools
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float

from shinypartial.comparison.significance import (
    MOST_ENUMERATED,
    Spread,
    mean_interval,
    sign_flip_test,
    summarize,
)
from shinypartial.core.errors import InputError
from shinypartial.evaluation.key_metrics import key_metrics, path_metric
from shinypartial.evaluation.scores import Scores, read_scores, score_rows
from shinypartial.io.files import write_json, write_text
from shinypartial.metrics.registry import Direction, Metric
from shinypartial.prediction.format import read_info

FORMAT, FORMAT_VERSION = "shinypartial-comparison", 2
INTERVAL, TEST = "Student t", "sign-flip test"
JSON, CSV = "comparison.json", "comparison.csv"
CONFIDENCE = 0.95
#: A first group is called better or worse from this p-value down.
SIGNIFICANCE = 0.05
#: The fewest pairs whose smallest p-value, 2¹⁻ⁿ, is below that.
FEWEST_PAIRS = 6


@dataclass(frozen=True)
class Run:
    """A scored prediction; runs of two groups are a pair when dataset version and seed agree."""

    folder: Path
    method: str
    dataset_hash: str
    seed: str
    scores: Scores

    @functools.cached_property
    def values(self) -> dict[str, float]:
        """Every number that was scored, by its path."""
        return {row.path: row.value for row in score_rows(self.scores) if row.value is not None}


@dataclass(frozen=True)
class PairedDifference:
    """Mean of first − second over pairs, its confidence interval and the p-value of the sign-flip test.

    What needs more pairs than there are is None.
    """

    pairs: int
    mean: float | None
    low: float | None
    high: float | None
    p_value: float | None


@dataclass(frozen=True)
class ComparedMetric:
    """One metric in both groups; `verdict` says whether the first group is better, worse, or neither for certain."""

    path: str
    first: Spread | None
    second: Spread | None
    difference: PairedDifference
    verdict: str

    @property
    def metric(self) -> Metric:
        """Its definition."""
        return path_metric(self.path)


@dataclass(frozen=True)
class Comparison:
    """What was compared, how, and every metric that either group has."""

    protocol: str
    first: tuple[str, ...]
    second: tuple[str, ...]
    unpaired: tuple[str, ...]
    confidence: float
    seed: int
    metrics: tuple[ComparedMetric, ...]


def read_run(folder: Path) -> Run:
    """Read a scored prediction; its seed is `seed` of the configuration, empty when the method states none."""
    info, scores = read_info(folder), read_scores(folder)
    if not scores.dataset_hash_matches:
        raise InputError(
            expected=f"{folder} to be made from the dataset that it was scored on",
            found="different dataset hashes",
            remedy="Make the prediction again from that dataset, or evaluate it on its own.",
        )
    return Run(folder, info.method, scores.dataset_hash, str(info.config.get("seed", "")), scores)


def compare(first: Sequence[Path], second: Sequence[Path], seed: int = 0) -> Comparison:
    """Compare two groups of scored prediction folders; `seed` draws sign flips where there are too many to enumerate.

    Raises InputError when a group is empty, holds two runs of one dataset and seed, when protocols differ, or when no
    two runs form a pair.
    """
    groups = [_group(folders, name) for folders, name in ((first, "first"), (second, "second"))]
    protocols = {run.scores.protocol for group in groups for run in group.values()}
    if len(protocols) != 1:
        raise InputError(
            expected="scores of one protocol",
            found=", ".join(sorted(protocols)),
            remedy="Evaluate all predictions again with this version.",
        )
    keys = [key for key in groups[0] if key in groups[1]]
    if not keys:
        raise InputError(
            expected="at least one pair: runs of both groups with the same dataset version and seed",
            found="none",
            remedy="Score both methods on the same datasets with the same seeds (`seed` in prediction.json's config).",
        )
    paths = list(dict.fromkeys(path for group in groups for run in group.values() for path in run.values))
    return Comparison(
        protocol=protocols.pop(),
        first=tuple(str(run.folder) for run in groups[0].values()),
        second=tuple(str(run.folder) for run in groups[1].values()),
        unpaired=tuple(str(run.folder) for group in groups for key, run in group.items() if key not in keys),
        confidence=CONFIDENCE,
        seed=seed,
        metrics=tuple(_compare_metric(path, groups[0], groups[1], keys, seed) for path in paths),
    )


Key = tuple[str, str]


def _group(folders: Sequence[Path], name: str) -> dict[Key, Run]:
    if not folders:
        raise InputError(
            expected=f"at least one prediction folder in the {name} group",
            found="none",
            remedy="Name them: `shinypartial compare A1 A2 --against B1 B2`.",
        )
    group: dict[Key, Run] = {}
    for run in map(read_run, folders):
        key = (run.dataset_hash, run.seed)
        if key in group:
            raise InputError(
                expected=f"one run for each dataset and seed in the {name} group",
                found=f"{group[key].folder} and {run.folder}, both of {run.scores.dataset} with seed {run.seed!r}",
                remedy="Leave one out.",
            )
        group[key] = run
    return group


def _compare_metric(
    path: str, first: Mapping[Key, Run], second: Mapping[Key, Run], keys: Sequence[Key], seed: int
) -> ComparedMetric:
    values = [{key: run.values[path] for key, run in group.items() if path in run.values} for group in (first, second)]
    known = [key for key in keys if all(key in group for group in values)]
    difference = paired_difference(np.array([values[0][key] - values[1][key] for key in known]), seed)
    spreads = [summarize(list(group.values())) if group else None for group in values]
    return ComparedMetric(path, spreads[0], spreads[1], difference, _verdict(difference, path_metric(path)))


def paired_difference(differences: Float[np.ndarray, "P"], seed: int = 0) -> PairedDifference:
    """Mean, Student's interval and sign-flip test of paired differences."""
    mean = float(differences.mean()) if len(differences) else None
    interval = mean_interval(differences, CONFIDENCE)
    low, high = (interval.low, interval.high) if interval else (None, None)
    return PairedDifference(len(differences), mean, low, high, sign_flip_test(differences, seed))


def _verdict(difference: PairedDifference, definition: Metric) -> str:
    if difference.mean is None or difference.p_value is None or definition.direction is Direction.DESCRIPTION:
        return "–"
    if difference.p_value > SIGNIFICANCE:
        return "undecided"
    return "better" if (difference.mean > 0) == (definition.direction is Direction.HIGHER) else "worse"


def comparison_lines(comparison: Comparison) -> list[str]:
    """The most important metrics as a table for a terminal."""
    pairs = max(one.difference.pairs for one in comparison.metrics)
    kind = "exact" if pairs <= MOST_ENUMERATED else "randomized"
    lines = [
        f"{len(comparison.first)} runs against {len(comparison.second)}, protocol {comparison.protocol}",
        "difference: first − second over pairs of one dataset and seed, "
        f"and its {comparison.confidence:.0%} {INTERVAL} interval",
        f"p: {kind} {TEST} of the paired differences, two-sided, n pairs",
    ]
    if comparison.unpaired:
        lines.append(f"without a partner: {', '.join(comparison.unpaired)}")
    rows: list[tuple[str, ...]] = [("metric", "first", "second", "difference", "test", "first is")]
    by_path = {one.path: one for one in comparison.metrics}
    rows += [_text_row(by_path[key.path]) for key in key_metrics("comparison") if key.path in by_path]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        lines.append("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    if pairs < FEWEST_PAIRS:
        least = f"{pairs} {'pair has' if pairs == 1 else 'pairs have'} p ≥ {2.0 ** (1 - pairs):.3g}"
        lines.append(
            f"  {least}: score {FEWEST_PAIRS} seeds or scenes or more to distinguish a difference from chance."
        )
    return lines


def _text_row(compared: ComparedMetric) -> tuple[str, ...]:
    definition, difference = compared.metric, compared.difference

    def signed(value: float | None) -> str:
        return "–" if value is None else f"{value:+{definition.format_spec.lstrip('+')}}"

    def text(values: Spread | None) -> str:
        if values is None or values.standard_deviation is None:
            return definition.text(values.mean if values else None)
        return f"{definition.text(values.mean)} ± {values.standard_deviation:{definition.format_spec.lstrip('+')}}"

    interval = "" if difference.low is None else f" [{signed(difference.low)}, {signed(difference.high)}]"
    test = "–" if difference.p_value is None else f"p = {difference.p_value:.3g}, n = {difference.pairs}"
    name = f"{compared.path} {definition.direction.value}"
    texts = (name, text(compared.first), text(compared.second), signed(difference.mean) + interval)
    return (*texts, test, compared.verdict)


def write_comparison(folder: Path, comparison: Comparison) -> tuple[Path, Path]:
    """Write comparison.json and comparison.csv, every metric with unit and direction; return their paths."""
    rows = [_record(one) for one in comparison.metrics]
    content = asdict(comparison) | {"interval": INTERVAL, "test": TEST, "metrics": rows}
    write_json(folder / JSON, {"format": FORMAT, "format_version": FORMAT_VERSION, **content})
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / CSV, stream.getvalue())
    return folder / JSON, folder / CSV


def _record(compared: ComparedMetric) -> dict[str, str | float | None]:
    groups: dict[str, float | None] = {}
    for name, spread in (("first", compared.first), ("second", compared.second)):
        values = asdict(spread) if spread else {"number": 0}
        groups |= {f"{name}_{field.name}": values.get(field.name) for field in fields(Spread)}
    groups |= {f"difference_{key}": value for key, value in asdict(compared.difference).items()}
    definition = compared.metric
    return {
        "metric": compared.path,
        "unit": definition.unit,
        "direction": definition.direction.name.lower(),
        **groups,
        "verdict": compared.verdict,
    }
