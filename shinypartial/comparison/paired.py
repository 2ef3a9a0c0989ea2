"""Two groups of scored predictions, several seeds or scenes each: means, spreads and paired differences."""

import csv
import functools
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from shinypartial.comparison.intervals import mean_interval
from shinypartial.core.errors import InputError
from shinypartial.evaluation.scores import Scores, read_scores, score_rows
from shinypartial.io.files import write_json, write_text
from shinypartial.metrics.registry import Direction, Metric, metric
from shinypartial.prediction.format import read_info

FORMAT, FORMAT_VERSION = "shinypartial-comparison", 1
INTERVAL = "bootstrap-t"
JSON, CSV = "comparison.json", "comparison.csv"
CONFIDENCE = 0.95
RESAMPLES = 10_000
#: What the terminal shows; the files hold every metric.
SHOWN = (
    "environment.as_predicted.full.psnr_srgb",
    "environment.as_predicted.full.psnr_linear",
    "environment.as_predicted.full.ssim_srgb",
    "environment.as_predicted.resolved.psnr_srgb",
    "normals.mean_angular_error_deg",
    "normals.median_angular_error_deg",
    "render.psnr",
    "render.ssim",
    "calibration.visibility_error_auroc",
)


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
class Spread:
    """Mean and sample standard deviation (n − 1) of one metric in one group; None with too few runs."""

    number: int
    mean: float | None
    standard_deviation: float | None


@dataclass(frozen=True)
class PairedDifference:
    """Mean of first − second over pairs, and its confidence interval; None with no pair, or fewer than two."""

    pairs: int
    mean: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class ComparedMetric:
    """One metric in both groups; `verdict` says whether the first group is better, worse, or neither for certain."""

    path: str
    first: Spread
    second: Spread
    difference: PairedDifference
    verdict: str

    @property
    def metric(self) -> Metric:
        """Its definition."""
        return metric(self.path.rpartition(".")[2])


@dataclass(frozen=True)
class Comparison:
    """What was compared, how, and every metric that either group has."""

    protocol: str
    first: tuple[str, ...]
    second: tuple[str, ...]
    unpaired: tuple[str, ...]
    confidence: float
    resamples: int
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


def compare(first: Sequence[Path], second: Sequence[Path], seed: int = 0, resamples: int = RESAMPLES) -> Comparison:
    """Compare two groups of scored prediction folders.

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
        resamples=resamples,
        seed=seed,
        metrics=tuple(_compared(path, groups[0], groups[1], keys, seed, resamples) for path in paths),
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


def _compared(
    path: str, first: Mapping[Key, Run], second: Mapping[Key, Run], keys: Sequence[Key], seed: int, resamples: int
) -> ComparedMetric:
    values = [{key: run.values[path] for key, run in group.items() if path in run.values} for group in (first, second)]
    differences = np.array(
        [values[0][key] - values[1][key] if all(key in v for v in values) else np.nan for key in keys]
    )
    found = paired_difference(differences, seed, resamples)
    spreads = [_spread(list(group.values())) for group in values]
    return ComparedMetric(path, spreads[0], spreads[1], found, _verdict(found, metric(path.rpartition(".")[2])))


def _spread(values: Sequence[float]) -> Spread:
    return Spread(
        len(values),
        float(np.mean(values)) if values else None,
        float(np.std(values, ddof=1)) if len(values) > 1 else None,
    )


def paired_difference(
    differences: Float[np.ndarray, "P"], seed: int = 0, resamples: int = RESAMPLES
) -> PairedDifference:
    """Mean of paired differences and its bootstrap-t interval (`mean_interval`); NaN marks a pair without this metric.

    Metrics of equally many pairs share the resamples.
    """
    known = differences[~np.isnan(differences)]
    mean = float(known.mean()) if len(known) else None
    interval = mean_interval(known, CONFIDENCE, resamples, seed)
    if interval is None:
        return PairedDifference(len(known), mean, None, None)
    return PairedDifference(len(known), mean, interval.low, interval.high)


def _verdict(difference: PairedDifference, definition: Metric) -> str:
    if difference.low is None or difference.high is None or definition.direction is Direction.DESCRIPTION:
        return "–"
    if difference.low <= 0 <= difference.high:
        return "undecided"
    return "better" if (difference.low > 0) == (definition.direction is Direction.HIGHER) else "worse"


def comparison_lines(comparison: Comparison) -> list[str]:
    """The most telling metrics as a table for a terminal."""
    lines = [
        f"{len(comparison.first)} runs against {len(comparison.second)}, protocol {comparison.protocol}",
        "difference: first − second over pairs of one dataset and seed, "
        f"and its {comparison.confidence:.0%} {INTERVAL} interval",
    ]
    if comparison.unpaired:
        lines.append(f"without a partner: {', '.join(comparison.unpaired)}")
    rows: list[tuple[str, ...]] = [("metric", "first", "second", "difference", "pairs", "first is")]
    rows += [_text_row(each) for each in comparison.metrics if each.path in SHOWN]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        lines.append("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    pairs = max(each.difference.pairs for each in comparison.metrics)
    if pairs < 2:
        lines.append("  One pair tells nothing about chance: score more seeds or scenes for an interval.")
    return lines


def _text_row(each: ComparedMetric) -> tuple[str, ...]:
    definition, difference = each.metric, each.difference

    def signed(value: float | None) -> str:
        return "–" if value is None else f"{value:+{definition.format_spec.lstrip('+')}}"

    def spread(values: Spread) -> str:
        if values.standard_deviation is None:
            return definition.text(values.mean)
        return f"{definition.text(values.mean)} ± {values.standard_deviation:{definition.format_spec.lstrip('+')}}"

    interval = "" if difference.low is None else f" [{signed(difference.low)}, {signed(difference.high)}]"
    name = f"{each.path} {definition.direction.value}"
    texts = (name, spread(each.first), spread(each.second), signed(difference.mean) + interval)
    return (*texts, str(difference.pairs), each.verdict)


def write_comparison(folder: Path, comparison: Comparison) -> tuple[Path, Path]:
    """Write comparison.json and comparison.csv, every metric with unit and direction; return their paths."""
    rows = [_record(each) for each in comparison.metrics]
    content = asdict(comparison) | {"metrics": rows}
    write_json(folder / JSON, {"format": FORMAT, "format_version": FORMAT_VERSION, "interval": INTERVAL, **content})
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / CSV, stream.getvalue())
    return folder / JSON, folder / CSV


def _record(each: ComparedMetric) -> dict[str, str | float | None]:
    groups = {
        f"{name}_{key}": value
        for name, part in (("first", each.first), ("second", each.second), ("difference", each.difference))
        for key, value in asdict(part).items()
    }
    definition = each.metric
    return {
        "metric": each.path,
        "unit": definition.unit,
        "direction": definition.direction.name.lower(),
        **groups,
        "verdict": each.verdict,
    }
