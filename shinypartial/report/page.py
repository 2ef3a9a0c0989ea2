"""One self-contained page about a prediction: numbers, pictures, curves, cost and configuration.

Reads only the prediction folder, after an evaluation; everything is inlined, so the page needs no network and no files.
"""

import base64
import html
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from shinypartial.core.errors import InputError
from shinypartial.evaluation.pictures import (
    ENVIRONMENT_ERROR,
    ENVIRONMENT_ERROR_MAP,
    ENVIRONMENT_EXPOSED,
    ENVIRONMENT_PREDICTION,
    ENVIRONMENT_TRUTH,
    EVALUATION,
    NORMAL_ERROR,
    OBSERVED_MAP,
    RENDER_ERROR,
    VISIBILITY,
    VISIBILITY_MAP,
    Scale,
    ViewPictures,
)
from shinypartial.evaluation.scores import ScoreRow, Scores, ViewScores, read_oracle_baseline, read_scores, score_rows
from shinypartial.io.files import write_text
from shinypartial.io.progress import format_seconds
from shinypartial.metrics.registry import Direction
from shinypartial.prediction.format import DECOMPOSITION, PredictionInfo, read_info
from shinypartial.report.line_chart import Series, is_logarithmic, legend, line_chart
from shinypartial.report.style import STYLE
from shinypartial.report.tables import Bounds, beside, bounds_by_path, metrics_section, paper_section

REPORT = "report.html"
#: Pictures that the method itself exports, shown under the names of their files.
METHOD_PICTURES = "pictures"
CURVE_ABSCISSA = "iteration"
#: Longest side of inlined pictures; many method pictures get the smaller one, which keeps the page below 3 MB.
SHEET_PX, LARGE_PX, SMALL_PX = 1020, 512, 320
FEW_PICTURES = 16
JPEG_QUALITY = 88
#: A PNG of up to this size is inlined losslessly.
LOSSLESS_BYTES = 24_000

HEADLINES = (
    ("environment.as_predicted.full.psnr_srgb", "environment PSNR, all directions"),
    ("environment.as_predicted.resolved.psnr_srgb", "environment PSNR, directions that training views resolve"),
    ("environment.as_predicted.full.ssim_srgb", "environment SSIM, all directions"),
    ("normals.mean_angular_error_deg", "mean normal error, test views"),
    ("render.psnr", "PSNR of rendered test views"),
    ("calibration.visibility_error_auroc", "AUROC: low visibility announces error"),
    ("resolved_coverage", "of the sphere is resolved by training views"),
)
SUMMARY_OF_ENVIRONMENT = ("psnr_srgb", "ssim_srgb", "psnr_linear", "log_rmse_stops")


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
    write_text(page, report_html(prediction, info, scores))
    return page


def summary_lines(prediction: Path) -> list[str]:
    """The scores in a few lines for a terminal."""
    info, scores = read_info(prediction), read_scores(prediction)
    rows = {row.path: row for row in score_rows(scores)}
    bounds = bounds_by_path(read_oracle_baseline(prediction, scores))
    lines = [f"{info.method} on {scores.dataset}, protocol {scores.protocol}"]
    if not scores.dataset_hash_matches:
        lines.append("  warning       the prediction was made from another version of this dataset")
    groups = (
        ("environment", "environment.as_predicted.full", SUMMARY_OF_ENVIRONMENT),
        (
            "  resolved",
            "environment.as_predicted.resolved",
            SUMMARY_OF_ENVIRONMENT,
        ),
        ("normals", "normals", ("mean_angular_error_deg", "median_angular_error_deg", "normal_coverage")),
        ("renders", "render", ("psnr", "ssim", "alpha_iou")),
        ("visibility", "calibration", ("visibility_error_auroc", "visibility_error_spearman")),
    )
    for title, group, names in groups:
        found = [rows[path] for name in names if (path := f"{group}.{name}") in rows]
        if found:
            parts = [
                f"{row.metric.name} {row.metric.text(row.value)} {row.metric.direction.value}{beside(row, bounds)}"
                for row in found
            ]
            lines.append(f"  {title:13s} {'   '.join(parts)}")
    if scores.coverage is not None:
        shares = [rows[name].metric.text(rows[name].value) for name in ("coverage", "resolved_coverage")]
        lines.append(f"  {'coverage':13s} training views see {shares[0]} of the sphere and resolve {shares[1]}")
    if scores.environment is not None and not bounds and info.method != "oracle":
        lines.append(f"  {'bound':13s} unknown: run `shinypartial oracle` to see how good a map these views allow")
    if scores.left_out:
        lines.append(f"  {'left out':13s} {', '.join(entry.name for entry in scores.left_out)}")
    return lines


def report_html(prediction: Path, info: PredictionInfo, scores: Scores) -> str:
    """The page as text."""
    rows, bounds = score_rows(scores), bounds_by_path(read_oracle_baseline(prediction, scores))
    title = f"{info.method} on {scores.dataset}"
    sections = [
        _header(info, scores, title),
        _headlines(info, rows, bounds),
        _environment_section(prediction),
        _views_section(prediction, scores),
        _method_section(prediction),
        metrics_section(rows, bounds, scores.protocol),
        paper_section(rows, bounds, scores),
        _left_out_section(scores),
        _curves_section(info),
        _cost_section(info),
        _provenance_section(info, scores),
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>\n"
        + "\n".join(section for section in sections if section)
        + "\n</body></html>\n"
    )


def _header(info: PredictionInfo, scores: Scores, title: str) -> str:
    counts = scores.counts
    line = (
        f"Protocol {scores.protocol} · {counts.train_views} training views · {counts.test_views} test views · "
        f"{counts.normal_pixels:,} normals compared, {counts.normal_holes:,} holes"
    )
    warning = (
        ""
        if scores.dataset_hash_matches
        else '<p class="warn">The prediction was made from another version of this dataset: the hashes differ.</p>'
    )
    return f'<header><h1>{html.escape(title)}</h1><p class="dim">{html.escape(line)}</p>{warning}</header>'


def _headlines(info: PredictionInfo, rows: Sequence[ScoreRow], bounds: Bounds) -> str:
    by_path = {row.path: row for row in rows}
    cards = [
        _card(_with_arrow(by_path[path]), text + beside(by_path[path], bounds))
        for path, text in HEADLINES
        if path in by_path and by_path[path].value is not None
    ]
    if info.seconds:
        cards.append(_card(format_seconds(sum(info.seconds.values())), "time of the method, all stages"))
    return f'<div class="cards">{"".join(cards)}</div>'


def _card(value: str, text: str) -> str:
    return f'<div class="card"><b>{html.escape(value)}</b><span>{html.escape(text)}</span></div>'


def _with_arrow(row: ScoreRow) -> str:
    arrow = "" if row.metric.direction is Direction.DESCRIPTION else f" {row.metric.direction.value}"
    return row.metric.text(row.value) + arrow


def _environment_section(prediction: Path) -> str:
    folder = prediction / EVALUATION
    figures = [
        _figure(folder / ENVIRONMENT_TRUTH, "Ground truth: sRGB of radiance clipped to [0, 1]."),
        _figure(folder / ENVIRONMENT_PREDICTION, "Prediction, in the same encoding."),
        _figure(folder / ENVIRONMENT_EXPOSED, "Prediction after the best global exposure."),
        _figure(
            folder / ENVIRONMENT_ERROR_MAP,
            "Error of the prediction as it is: mean over channels of the absolute sRGB difference; dark is good.",
            ENVIRONMENT_ERROR,
        ),
        _figure(
            folder / VISIBILITY_MAP,
            "Visibility as the method states it: how well each direction was observed; bright is well seen.",
            VISIBILITY,
        ),
        _figure(
            folder / OBSERVED_MAP,
            "Directions in training views, by ground-truth normals: white resolved (0.7° or finer), gray seen.",
        ),
    ]
    if not any(figures):
        return ""
    note = "Lat-long maps: top is +Z, the center looks along +X, azimuth falls to the right."
    return f'<h2>Environment</h2><p class="dim">{note}</p><div class="maps">{"".join(figures)}</div>'


def _views_section(prediction: Path, scores: Scores) -> str:
    folder = prediction / EVALUATION
    suffix = ViewPictures(folder, "", "render").truth.name
    blocks = []
    for path in sorted(folder.glob(f"*{suffix}")):
        stem = path.name.removesuffix(suffix)
        line = next((_view_line(view) for view in scores.views if view.name.rpartition("/")[2] == stem), "")
        blocks.append(f"<div><h3>{html.escape(stem)}</h3><p class='dim'>{line}</p>{_view_trios(folder, stem)}</div>")
    if not blocks:
        return ""
    note = (
        "Renders are sRGB of premultiplied radiance, so the object stands on black. Normals are world normals as "
        "(n + 1)/2; gray: no object or no normal. Normal errors are shown where the object fills the pixel; a hole "
        "takes the last color."
    )
    charts = _charts(_view_series(scores))
    return f'<h2>Test views</h2><p class="dim">{note}</p><div class="views">{"".join(blocks)}</div>{charts}'


def _view_line(view: ViewScores) -> str:
    error = view.mean_angular_error_deg
    normals = "" if error is None else f", mean normal error {error:.2f}°"
    return f"PSNR {view.psnr:.2f} dB, SSIM {view.ssim:.4f}{normals}"


def _view_trios(folder: Path, stem: str) -> str:
    trios = []
    for kind, scale in (("render", RENDER_ERROR), ("normals", NORMAL_ERROR)):
        pictures = ViewPictures(folder, stem, kind)
        figures = [
            _figure(pictures.truth, f"Ground truth {kind}.", size=SMALL_PX),
            _figure(pictures.prediction, f"Predicted {kind}.", size=SMALL_PX),
            _figure(pictures.error, f"{scale.title[0].upper()}{scale.title[1:]}.", scale, SMALL_PX),
        ]
        if any(figures):
            trios.append(f'<div class="trio">{"".join(figures)}</div>')
    return "".join(trios)


def _view_series(scores: Scores) -> list[Series]:
    index = [float(i) for i in range(len(scores.views))]
    errors = [view.mean_angular_error_deg for view in scores.views]
    series = [Series("PSNR (dB) of every test view", index, [view.psnr for view in scores.views], "test view")]
    known = [(i, error) for i, error in zip(index, errors, strict=True) if error is not None]
    title = "mean normal error (°) of every test view"
    series.append(Series(title, [i for i, _ in known], [error for _, error in known], "test view"))
    return series


def _method_section(prediction: Path) -> str:
    """The sheet of the decomposition, then single pictures, folded away where they would only repeat the sheet."""
    sheet = _figure(prediction / DECOMPOSITION, "What the method makes of one test view.", size=SHEET_PX)
    paths = sorted((prediction / METHOD_PICTURES).glob("*.png"))
    if not paths:
        return f"<h2>Decomposition</h2>{sheet}" if sheet else ""
    size = LARGE_PX if len(paths) <= FEW_PICTURES else SMALL_PX
    figures = "".join(_figure(path, path.stem.replace("_", " "), size=size) for path in paths)
    note = "Pictures that the method itself exported; the captions are the names of its files."
    gallery = f'<p class="dim">{note}</p><div class="gallery">{figures}</div>'
    if sheet:
        gallery = f"{sheet}<details><summary>{len(paths)} single pictures</summary>{gallery}</details>"
    return f"<h2>Decomposition</h2>{gallery}"


def _figure(path: Path, caption: str, scale: Scale | None = None, size: int = LARGE_PX) -> str:
    if not path.is_file():
        return ""
    bar = legend(scale) if scale else ""
    text = html.escape(caption, quote=True)
    return (
        f'<figure><img src="{_inline_picture(path, size)}" alt="{text}">{bar}<figcaption>{text}</figcaption></figure>'
    )


def _inline_picture(path: Path, longest_px: int) -> str:
    """A data URI of the picture, at most `longest_px` on its longer side; lossless when that is small."""
    from PIL import Image

    try:
        with Image.open(path) as opened:
            picture = opened.convert("RGB")
    except OSError as error:
        raise InputError(
            expected=f"a complete picture at {path}", found=str(error), remedy="Delete it, then evaluate again."
        ) from None
    picture.thumbnail((longest_px, longest_px), Image.Resampling.LANCZOS)
    lossless, lossy = io.BytesIO(), io.BytesIO()
    picture.save(lossless, "PNG", optimize=True)
    if lossless.tell() <= LOSSLESS_BYTES:
        return "data:image/png;base64," + base64.b64encode(lossless.getvalue()).decode()
    picture.save(lossy, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(lossy.getvalue()).decode()


def _left_out_section(scores: Scores) -> str:
    if not scores.left_out:
        return ""
    return "<h2>Left out</h2>" + _table((entry.name, entry.reason) for entry in scores.left_out)


def _curves_section(info: PredictionInfo) -> str:
    abscissa = info.curves.get(CURVE_ABSCISSA)
    series = []
    for name, values in info.curves.items():
        if name == CURVE_ABSCISSA:
            continue
        matching = abscissa is not None and len(abscissa) == len(values)
        x = abscissa if abscissa is not None and matching else [float(i) for i in range(len(values))]
        series.append(Series(name.replace("_", " "), x, values, CURVE_ABSCISSA if matching else "entry"))
    charts = _charts(series)
    return f"<h2>Training</h2>{charts}" if charts else ""


def _charts(series: Iterable[Series]) -> str:
    figures = [
        f"<figure>{line_chart(one)}<figcaption>{html.escape(one.title)}"
        f"{', logarithmic axis' if is_logarithmic(one) else ''}</figcaption></figure>"
        for one in series
        if len(one.y) > 1
    ]
    return f'<div class="charts">{"".join(figures)}</div>' if figures else ""


def _cost_section(info: PredictionInfo) -> str:
    seconds = [(stage, f"{value:.1f} s") for stage, value in info.seconds.items()]
    memory = [("peak memory", f"{info.peak_memory_bytes / 2**20:,.0f} MiB")] if info.peak_memory_bytes else []
    hardware = [(name, _plain(value)) for name, value in _flatten(info.hardware)]
    sizes = [("primitives", info.primitives), ("bytes of the exported model", info.model_bytes)]
    sizes += list(info.parameter_counts.items())
    size = [(name, f"{count:,}") for name, count in sizes if count is not None]
    parts = [("Time by stage", seconds), ("Hardware", hardware + memory), ("Size", size)]
    blocks = "".join(f"<div><h3>{title}</h3>{_table(lines)}</div>" for title, lines in parts if lines)
    return f'<h2>Cost</h2><div class="maps">{blocks}</div>' if blocks else ""


def _provenance_section(info: PredictionInfo, scores: Scores) -> str:
    lines = [
        ("dataset", scores.dataset),
        ("dataset hash (evaluated)", scores.dataset_hash),
        ("dataset hash (prediction)", info.dataset_hash),
        ("protocol", scores.protocol),
        ("method", info.method),
        *([("model", info.model)] if info.model else []),
    ]
    config = [(name, _plain(value)) for name, value in _flatten(info.config)]
    details = f"<details><summary>Configuration, {len(config)} entries</summary>{_table(config)}</details>"
    return f"<h2>Provenance</h2>{_table(lines)}{details if config else ''}"


def _table(lines: Iterable[tuple[str, str]]) -> str:
    body = "".join(
        f"<tr><th>{html.escape(name)}</th><td class='text'>{html.escape(value)}</td></tr>" for name, value in lines
    )
    return f'<div class="scroll"><table>{body}</table></div>'


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
