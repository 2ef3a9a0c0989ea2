"""One self-contained page about a prediction: numbers, pictures, curves, cost and configuration.

Reads only the prediction folder, after an evaluation; everything is inlined, so the page needs no network and no files.
"""

import base64
import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shinypartial.core.errors import InputError
from shinypartial.evaluation.key_metrics import key_metrics
from shinypartial.evaluation.pictures import (
    ENVIRONMENT_ERROR,
    ENVIRONMENT_ERROR_MAP,
    ENVIRONMENT_EXPOSED,
    ENVIRONMENT_PREDICTION,
    ENVIRONMENT_TRUTH,
    NORMAL_ERROR,
    OBSERVED_MAP,
    RENDER_ERROR,
    VISIBILITY,
    VISIBILITY_MAP,
    Scale,
    ViewPictures,
)
from shinypartial.evaluation.scores import (
    ScoreRow,
    Scores,
    ViewScores,
    read_oracle_baseline,
    read_scores,
    score_rows,
)
from shinypartial.evaluation.turning import SURFACE_ERROR, TURNING
from shinypartial.io.images import read_png
from shinypartial.io.progress import format_seconds
from shinypartial.metrics.registry import Direction
from shinypartial.prediction.format import DECOMPOSITION, EVALUATION, REPORT, PredictionInfo, read_info
from shinypartial.report.html import write_page
from shinypartial.report.line_chart import ColorBar, LineChart, Series, color_bar, line_chart
from shinypartial.report.tables import OracleRows, metric_tables, oracle_note, oracle_rows, paper_tables

#: Pictures that the method itself exports, shown under the names of their files.
METHOD_PICTURES = "pictures"
CURVE_ABSCISSA = "iteration"
#: Longest side of inlined pictures; many method pictures get the smaller one, which keeps the page below 3 MB.
SHEET_PX, LARGE_PX, SMALL_PX = 1020, 512, 320
FEW_PICTURES = 16
JPEG_QUALITY = 88
#: A PNG of up to this size is inlined losslessly.
LOSSLESS_BYTES = 24_000

RESOLVED = "environment.as_predicted.resolved"
#: Small photographs resolve less than this share of the sphere, of which a score says nothing.
LEAST_SHOWN = 0.001
#: Lines of the summary: title and the group of scores.
SUMMARY = (
    ("environment", "environment.as_predicted.full"),
    ("  resolved", RESOLVED),
    ("  perceptual", "environment.perceptual"),
    ("  distance", "surroundings"),
    ("normals", "normals"),
    ("renders", "render"),
    ("visibility", "calibration"),
)
MAPS = (
    (ENVIRONMENT_TRUTH, "Ground truth: sRGB of radiance clipped to [0, 1].", None),
    (ENVIRONMENT_PREDICTION, "Prediction, in the same encoding.", None),
    (ENVIRONMENT_EXPOSED, "Prediction after the best global exposure.", None),
    (
        ENVIRONMENT_ERROR_MAP,
        "Error of the prediction as it is: mean over channels of the absolute sRGB difference; dark is good.",
        ENVIRONMENT_ERROR,
    ),
    (
        VISIBILITY_MAP,
        "Visibility as the method states it: how well each direction was observed; bright is well seen.",
        VISIBILITY,
    ),
    (
        OBSERVED_MAP,
        "Directions in training views, by ground-truth normals: white resolved (0.7° or finer), gray seen.",
        None,
    ),
)


@dataclass(frozen=True)
class Figure:
    """A picture as a data URI, with its caption and the colors of its scale."""

    uri: str
    caption: str
    legend: ColorBar | None


@dataclass(frozen=True)
class ViewFigures:
    """One test view: its name, its scores in words, and rows of truth, prediction and error."""

    stem: str
    text: str
    trios: tuple[tuple[Figure, ...], ...]


def write_report(prediction: Path, output: Path | None = None) -> Path:
    """Write the page (default PREDICTION/report.html) and return its path.

    Raises InputError when the prediction or its scores are missing or broken.
    """
    info, scores = read_info(prediction), read_scores(prediction)
    page = output or prediction / REPORT
    if page.is_dir():
        raise InputError(
            expected=f"a file name for the report, at {page}",
            found="a folder",
            remedy=f"Name a file, such as {page / REPORT}.",
        )
    rows, oracle = score_rows(scores), oracle_rows(read_oracle_baseline(prediction, scores))
    pictures = sorted((prediction / METHOD_PICTURES).glob("*.png"))
    size = LARGE_PX if len(pictures) <= FEW_PICTURES else SMALL_PX
    return write_page(
        page,
        "report.html.j2",
        generator="report",
        title=f"{info.method} on {scores.dataset}",
        info=info,
        scores=scores,
        cards=_cards(info, {row.path: row for row in rows}, oracle),
        surface=_surface(prediction / EVALUATION / TURNING),
        maps=_figures((prediction / EVALUATION / name, text, scale) for name, text, scale in MAPS),
        views=_views(prediction / EVALUATION, scores),
        view_charts=_line_charts(_view_series(scores)),
        sheet=next(iter(_figures([(prediction / DECOMPOSITION, _SHEET_CAPTION, None)], SHEET_PX)), None),
        gallery=_figures(((path, path.stem.replace("_", " "), None) for path in pictures), size),
        with_oracle=bool(oracle),
        tables=metric_tables(rows, oracle),
        paper_tables=paper_tables(rows, oracle),
        left_out=_left_out(scores),
        training_charts=_line_charts(_training_series(info)),
        costs=_costs(info),
        provenance=_provenance(info, scores),
        config=[(name, _plain(value)) for name, value in _flatten(info.config)],
    )


_SURFACE_CAPTION = (
    "The surface, turning about +Z: its normals as (n + 1)/2; their errors, as far as test views see it, gray "
    "elsewhere; and its confidence, where the method states one (violet: none, yellow: full)."
)
_SHEET_CAPTION = "A photograph, and what the method recovered."


def summary_lines(prediction: Path) -> list[str]:
    """The scores in a few lines for a terminal."""
    info, scores = read_info(prediction), read_scores(prediction)
    rows = {row.path: row for row in score_rows(scores)}
    oracle = oracle_rows(read_oracle_baseline(prediction, scores))
    lines = [f"{info.method} on {scores.dataset}, protocol {scores.protocol}"]
    if not scores.dataset_hash_matches:
        lines.append("  warning       the prediction was made from another version of this dataset")
    if info.verdict:
        lines.append(f"  {'verdict':13s} {info.verdict.sentence()}")
    for title, group in SUMMARY:
        shown = [rows[key.path] for key in key_metrics("summary") if key.group == group and key.path in rows]
        parts = [
            f"{row.metric.name} {row.metric.text(row.value)} {row.metric.direction.value}{oracle_note(row, oracle)}"
            for row in shown
            if row.value is not None
        ]
        if parts and not (group == RESOLVED and (scores.resolved_coverage or 0) < LEAST_SHOWN):
            lines.append(f"  {title:13s} {'   '.join(parts)}")
    if scores.coverage is not None:
        shares = [rows[name].metric.text(rows[name].value) for name in ("coverage", "resolved_coverage")]
        lines.append(f"  {'coverage':13s} training views see {shares[0]} of the sphere and resolve {shares[1]}")
    if scores.environment is not None and not oracle and info.method != "oracle":
        lines.append(f"  {'oracle':13s} unknown: `shinypartial oracle` makes the map that ground-truth normals give")
    lines += [f"  {'left out':13s} {names}: {reason}" for names, reason in _left_out(scores)]
    return lines


def _left_out(scores: Scores) -> list[tuple[str, str]]:
    """Names that were left out for the same reason, and that reason."""
    by_reason: dict[str, list[str]] = {}
    for one in scores.left_out:
        by_reason.setdefault(one.reason, []).append(one.name)
    return [(", ".join(names), reason) for reason, names in by_reason.items()]


def _cards(info: PredictionInfo, rows: dict[str, ScoreRow], oracle: OracleRows) -> list[tuple[str, str]]:
    """The headlines: a value and what it is."""
    cards = []
    for key in key_metrics("report"):
        row = rows.get(key.path)
        if row is not None and row.value is not None:
            arrow = "" if row.metric.direction is Direction.DESCRIPTION else f" {row.metric.direction.value}"
            cards.append((row.metric.text(row.value) + arrow, key.title + oracle_note(row, oracle)))
    if info.seconds:
        cards.append((format_seconds(sum(info.seconds.values())), "Time of the method, all stages"))
    return cards


def _views(folder: Path, scores: Scores) -> list[ViewFigures]:
    suffix = ViewPictures(folder, "", "render").truth.name
    texts = {view.name.rpartition("/")[2]: _view_text(view) for view in scores.views}
    stems = [path.name.removesuffix(suffix) for path in sorted(folder.glob(f"*{suffix}"))]
    return [ViewFigures(stem, texts.get(stem, ""), _trios(folder, stem)) for stem in stems]


def _view_text(view: ViewScores) -> str:
    error = view.mean_angular_error_deg
    normals = "" if error is None else f", mean normal error {error:.2f}°"
    return f"PSNR {view.psnr:.2f} dB, SSIM {view.ssim:.4f}{normals}"


def _trios(folder: Path, stem: str) -> tuple[tuple[Figure, ...], ...]:
    trios = []
    for kind, scale in (("render", RENDER_ERROR), ("normals", NORMAL_ERROR)):
        pictures = ViewPictures(folder, stem, kind)
        trio = (
            (pictures.truth, f"Ground truth {kind}.", None),
            (pictures.prediction, f"Predicted {kind}.", None),
            (pictures.error, f"{scale.title[0].upper()}{scale.title[1:]}.", scale),
        )
        trios.append(tuple(_figures(trio, SMALL_PX)))
    return tuple(trio for trio in trios if trio)


def _surface(path: Path) -> Figure | None:
    """The animated picture as it is; None where there is none."""
    if not path.is_file():
        return None
    uri = "data:image/webp;base64," + base64.b64encode(path.read_bytes()).decode()
    return Figure(uri, _SURFACE_CAPTION, color_bar(SURFACE_ERROR))


def _figures(pictures: Iterable[tuple[Path, str, Scale | None]], longest_px: int = LARGE_PX) -> list[Figure]:
    """Those of the pictures that exist, inlined."""
    return [
        Figure(_inline_picture(path, longest_px), caption, color_bar(scale) if scale else None)
        for path, caption, scale in pictures
        if path.is_file()
    ]


def _inline_picture(path: Path, longest_px: int) -> str:
    """A data URI of the picture, at most `longest_px` on its longer side; lossless when that is small."""
    from PIL import Image

    pixels = read_png(path)
    picture = Image.fromarray(pixels[..., :3] if pixels.shape[2] > 1 else np.repeat(pixels, 3, 2))
    picture.thumbnail((longest_px, longest_px), Image.Resampling.LANCZOS)
    lossless, lossy = io.BytesIO(), io.BytesIO()
    picture.save(lossless, "PNG", optimize=True)
    if lossless.tell() <= LOSSLESS_BYTES:
        return "data:image/png;base64," + base64.b64encode(lossless.getvalue()).decode()
    picture.save(lossy, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(lossy.getvalue()).decode()


def _view_series(scores: Scores) -> list[Series]:
    index = [float(i) for i in range(len(scores.views))]
    errors = [view.mean_angular_error_deg for view in scores.views]
    known = [(i, error) for i, error in zip(index, errors, strict=True) if error is not None]
    title = "mean normal error (°) of every test view"
    return [
        Series("PSNR (dB) of every test view", index, [view.psnr for view in scores.views], "test view"),
        Series(title, [i for i, _ in known], [error for _, error in known], "test view"),
    ]


def _training_series(info: PredictionInfo) -> list[Series]:
    abscissa = info.curves.get(CURVE_ABSCISSA)
    series = []
    for name, values in info.curves.items():
        if name == CURVE_ABSCISSA:
            continue
        matching = abscissa is not None and len(abscissa) == len(values)
        x = abscissa if abscissa is not None and matching else [float(i) for i in range(len(values))]
        series.append(Series(name.replace("_", " "), x, values, CURVE_ABSCISSA if matching else "entry"))
    return series


def _line_charts(series: Iterable[Series]) -> list[LineChart]:
    return [line_chart(one) for one in series if len(one.y) > 1]


def _costs(info: PredictionInfo) -> list[tuple[str, list[tuple[str, str]]]]:
    """Tables of what the prediction cost: title and rows; those without a row are dropped."""
    seconds = [(stage, f"{value:.1f} s") for stage, value in info.seconds.items()]
    memory = [("peak memory", f"{info.peak_memory_bytes / 2**20:,.0f} MiB")] if info.peak_memory_bytes else []
    hardware = [(name, _plain(value)) for name, value in _flatten(info.hardware)]
    sizes = [("primitives", info.primitives), ("bytes of the exported model", info.model_bytes)]
    sizes += list(info.parameter_counts.items())
    size = [(name, f"{count:,}") for name, count in sizes if count is not None]
    tables = [("Time by stage", seconds), ("Hardware", hardware + memory), ("Size", size)]
    return [(title, rows) for title, rows in tables if rows]


def _provenance(info: PredictionInfo, scores: Scores) -> list[tuple[str, str]]:
    return [
        ("dataset", scores.dataset),
        ("split of the scene", scores.split),
        ("dataset hash (evaluated)", scores.dataset_hash),
        ("dataset hash (prediction)", info.dataset_hash),
        ("protocol", scores.protocol),
        ("method", info.method),
        *([("model", info.model)] if info.model else []),
        *([("surroundings", info.surroundings.sentence())] if info.surroundings is not None else []),
        *([("roughness", f"{info.roughness:.2g}")] if info.roughness is not None else []),
        *([("blur of the pictures", f"{info.blur_px:.2g} px")] if info.blur_px is not None else []),
    ]


def _flatten(content: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Nested keys joined by dots, in their order."""
    pairs: list[tuple[str, Any]] = []
    for name, value in content.items():
        if isinstance(value, dict) and value:
            pairs += _flatten(value, f"{prefix}{name}.")
        else:
            pairs.append((f"{prefix}{name}", value))
    return pairs


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
