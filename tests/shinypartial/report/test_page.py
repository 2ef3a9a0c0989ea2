"""The report is one file that needs nothing else, says what it shows, and names what was left out."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.evaluation.pictures import NEUTRAL_GRAY, NORMAL_ERROR, VISIBILITY, colormap_colors, scalar_picture
from shinypartial.evaluation.scores import read_scores, score_rows, write_scores
from shinypartial.io.images import write_png
from shinypartial.io.picture_sheet import write_picture_sheet
from shinypartial.metrics import perceptual
from shinypartial.prediction.format import (
    DECOMPOSITION,
    Candidate,
    FoundCamera,
    ModelSelection,
    Trust,
    read_info,
    write_info,
)
from shinypartial.report.line_chart import LEFT, Series, color_bar, line_chart
from shinypartial.report.page import summary_lines, write_report
from tests.support.truth_prediction import write_truth_prediction

VOID = {"meta", "img", "br", "line", "polyline"}


class Page(HTMLParser):
    """Checks nesting, and collects references and figures."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []
        self.figures = self.captions = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")]
        self.figures += tag == "figure"
        self.captions += tag == "figcaption"
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag in VOID


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory, sphere_dataset: Dataset) -> Path:
    """A scored prediction with two pictures of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(perceptual.ENVIRONMENT_VARIABLE, raising=False)
        patch.setattr(perceptual, "CACHE", Path("no-cache"))
        prediction = write_truth_prediction(tmp_path_factory.mktemp("report") / "truth", sphere_dataset)
        evaluate(prediction)
    for name in ("r_000_albedo", "r_000_specular"):
        write_png(prediction / "pictures" / f"{name}.png", np.full((20, 30, 3), 99, np.uint8))
    return prediction


@pytest.fixture(scope="module")
def page(evaluated: Path) -> str:
    return write_report(evaluated).read_text(encoding="utf-8")


def test_the_page_is_well_formed_and_needs_no_other_file(page: str) -> None:
    parsed = Page(page)
    assert parsed.open == []
    assert parsed.references
    assert all(reference.startswith("data:image/") for reference in parsed.references)
    assert "http" not in page
    assert "<script" not in page
    assert "url(" not in page


def test_the_page_says_whether_the_scene_was_held_out(evaluated: Path) -> None:
    scores = read_scores(evaluated)
    write_scores(evaluated, replace(scores, split="held-out"))
    page = write_report(evaluated).read_text()
    write_scores(evaluated, scores)
    assert "split of the scene" in page
    assert "held-out" in page


def test_every_figure_has_a_caption(page: str) -> None:
    parsed = Page(page)
    # Environment 6, three test views of 6, two charts over views, two pictures of the method, two curves.
    assert parsed.figures == parsed.captions == 6 + 3 * 6 + 2 + 2 + 2


def test_every_metric_configuration_entry_and_left_out_name_is_on_the_page(page: str, evaluated: Path) -> None:
    scores = read_scores(evaluated)
    text = re.sub(r"<[^>]+>", " ", page)
    for row in score_rows(scores):
        if row.value is not None:
            assert row.metric.text(row.value) in text, row.path
            assert row.metric.name in text
    for entry in scores.left_out:
        assert entry.name in text
    for word in ("nested.rate", "&lt;adam&gt;", "r 000 albedo", scores.dataset_hash, "14,000", "256 MiB", "linear-v1"):
        assert word in text


def test_a_method_cannot_write_into_the_page(evaluated: Path) -> None:
    info = read_info(evaluated)
    write_info(evaluated, replace(info, method="<script>x</script>"))
    assert "<script>" not in write_report(evaluated).read_text(encoding="utf-8")
    write_info(evaluated, info)


def test_the_choice_of_the_model_is_a_table_and_a_sentence(evaluated: Path, page: str) -> None:
    info = read_info(evaluated)
    assert "Model selection" not in page
    candidates = (
        Candidate("plane", 16.2, 0.651, None, "rejected", "16 px away"),
        Candidate("revolution", 0.0534, 0.9992, 0.03111, "chosen", "<better> by 4 σ"),
    )
    write_info(evaluated, replace(info, model_selection=ModelSelection("revolution", candidates)))
    with_table = write_report(evaluated).read_text(encoding="utf-8")
    assert Page(with_table).open == []
    text = re.sub(r"<[^>]+>", " ", with_table)
    assert "revolution was chosen (&lt;better&gt; by 4 σ); plane: rejected (16 px away)." in text
    for word in ("16.2 px", "65.1%", "–", "0.0534 px", "99.9%", "0.0311"):
        assert word in text
    write_info(evaluated, info)


def test_what_was_estimated_of_each_training_view_is_a_table(evaluated: Path, page: str) -> None:
    info = read_info(evaluated)
    assert "Training views" not in page
    cameras = (
        FoundCamera("turned", turn_deg=(0.3, 0.0, 0.4), turn_sigma_deg=(0.01, 0.02, 0.03)),
        FoundCamera("moved", shift=(0.03, 0.04, 0.0), shift_sigma=(0.001, 0.002, 0.001), gain=(0.9, 1.0, 1.1)),
    )
    write_info(evaluated, replace(info, cameras=cameras))
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", write_report(evaluated).read_text(encoding="utf-8")))
    assert "turned 0.500° 0.030° – – – – –" in text
    assert "moved – – 0.05 0.002 0.900 1.000 1.100" in text
    write_info(evaluated, info)


def test_a_verdict_stands_before_everything_else(evaluated: Path) -> None:
    info = read_info(evaluated)
    write_info(evaluated, replace(info, verdict=Trust("do not trust", "cameras <disagree>", "Refine them.", 3.0)))
    text = write_report(evaluated).read_text(encoding="utf-8")
    body = re.sub(r"<[^>]+>", " ", text[text.index("<body") :])
    assert "Do not trust : cameras &lt;disagree&gt;. Refine them." in body
    assert body.index("Do not trust") < body.index("Protocol")
    assert any("do not trust: cameras <disagree>. Refine them." in line for line in summary_lines(evaluated))
    write_info(evaluated, info)


def test_the_report_goes_where_it_is_told_and_is_reproducible(evaluated: Path, tmp_path: Path, page: str) -> None:
    output = tmp_path / "deep" / "page.html"
    assert write_report(evaluated, output) == output
    assert output.read_text(encoding="utf-8") == page


def test_the_sheet_of_the_decomposition_comes_before_single_pictures(evaluated: Path, page: str) -> None:
    assert "<details><summary>2 single" not in page
    write_picture_sheet(evaluated / DECOMPOSITION, {"alpha": np.full((20, 30), 255, np.uint8)})
    info = read_info(evaluated)
    write_info(evaluated, replace(info, primitives=1234567, model_bytes=7654321))
    with_sheet = write_report(evaluated).read_text(encoding="utf-8")
    assert Page(with_sheet).figures == Page(page).figures + 1
    places = [with_sheet.index(text) for text in ("the method recovered.", "2 single pictures", "r 000 albedo")]
    assert places == sorted(places)
    assert "1,234,567" in with_sheet
    assert "7,654,321" in with_sheet
    (evaluated / DECOMPOSITION).unlink()
    write_info(evaluated, info)


def test_a_report_without_scores_says_to_evaluate(tmp_path: Path, sphere_dataset: Dataset) -> None:
    prediction = write_truth_prediction(tmp_path / "new", sphere_dataset)
    with pytest.raises(InputError, match="shinypartial evaluate"):
        write_report(prediction)
    evaluate(prediction)
    with pytest.raises(InputError, match="a folder"):
        write_report(prediction, tmp_path)


def test_the_summary_names_numbers_and_what_was_left_out(evaluated: Path) -> None:
    lines = "\n".join(summary_lines(evaluated))
    assert "truth on sphere, protocol linear-v1" in lines
    assert "mean_angular_error_deg 0.00° ↓" in lines
    assert "left out      lpips_alex, lpips_vgg: no LPIPS weights found: run `shinypartial weights` once" in lines
    assert "warning" not in lines


def test_lpips_is_shown_wherever_its_weights_lie(
    tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With weights in one of their places nothing is requested: `evaluate` scores, summary and report show."""
    monkeypatch.setattr(perceptual, "find_weights", lambda network, folder: tmp_path / network)
    monkeypatch.setattr(perceptual, "has_torch", lambda: True)
    monkeypatch.setattr(perceptual, "load_lpips", lambda network, _: lambda *_: {"alex": 0.125, "vgg": 0.25}[network])
    prediction = write_truth_prediction(tmp_path / "truth", sphere_dataset)
    evaluate(prediction)
    lines = "\n".join(summary_lines(prediction))
    assert "perceptual  lpips_alex 0.1250 ↓" in lines
    assert re.search(r"renders .* lpips_alex 0\.1250 ↓", lines)
    assert "LPIPS weights" not in lines
    page = write_report(prediction).read_text(encoding="utf-8")
    assert "<b>0.1250 ↓</b><span>Environment LPIPS</span>" in page
    assert "0.2500" in page
    assert "LPIPS weights" not in page


def test_a_dataset_of_another_version_is_a_warning(tmp_path: Path, sphere_dataset: Dataset) -> None:
    prediction = write_truth_prediction(tmp_path / "old", sphere_dataset)
    write_info(prediction, replace(read_info(prediction), dataset_hash="0" * 64, curves={}))
    evaluate(prediction)
    assert "another version" in "\n".join(summary_lines(prediction))
    assert "the hashes differ" in write_report(prediction).read_text(encoding="utf-8")


def test_charts_use_a_logarithm_only_for_wide_positive_ranges() -> None:
    x = [float(i) for i in range(1000)]
    narrow, wide = Series("a", x, [1 + i for i in x], "i"), Series("b", x, [1 + i % 2 for i in x], "i")
    assert line_chart(narrow).logarithmic
    assert not line_chart(wide).logarithmic
    assert not line_chart(Series("c", x, [i - 1 for i in x], "i")).logarithmic
    points = line_chart(narrow).points
    assert len(points.split()) == 300
    assert points.startswith(f"{LEFT}.0,")
    line_chart(Series("constant", [0.0, 1.0], [2.0, 2.0], "i"))


def test_colors_follow_the_scale_and_holes_take_its_end() -> None:
    colors = colormap_colors(NORMAL_ERROR.colormap)
    values = np.array([[0.0, 30.0, 90.0, np.nan, 5.0]])
    picture = scalar_picture(values, NORMAL_ERROR, np.array([[True, True, True, True, False]]))
    np.testing.assert_array_equal(picture[0, 0], colors[0])
    for column in (1, 2, 3):
        np.testing.assert_array_equal(picture[0, column], colors[255])
    assert (picture[0, 4] == NEUTRAL_GRAY).all()
    assert color_bar(NORMAL_ERROR).high == "≥ 30°"
    assert color_bar(VISIBILITY).high == "1"


@pytest.mark.parametrize("name", ["magma", "viridis"])
def test_colormaps_grow_brighter_evenly(name: str) -> None:
    """Luminance rises along the map, so that errors can be ranked in print and by color-blind readers."""
    luminance = colormap_colors(name) @ np.array([0.2126, 0.7152, 0.0722])
    assert (np.diff(luminance[::8]) > 0).all()
