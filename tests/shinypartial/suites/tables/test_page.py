"""The page: marks, means, what an earlier run left, and figures as they were scored."""

from dataclasses import replace
from pathlib import Path

import pytest

from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.io.files import write_json
from shinypartial.suites.jobs import Size
from shinypartial.suites.tables.collect import Outcome, Results, collect, read_results
from shinypartial.suites.tables.page import Line, marked, page_lines, published_lines, write_tables_page
from shinypartial.suites.tables.plan import ORACLE, OURS, SIZE, TABLES, Column, make_plan
from shinypartial.suites.tables.published import DR, MATERIAL, PAPER, REF, SHADER
from tests.support.truth_prediction import write_truth_prediction

PSNR = Column("paper.environment.psnr_reinhard", "PSNR")
ERROR = Column("paper.normals.mean_angular_error_deg", "Normals")
PARAMETERS = Column("parameters", "Parameters", 0)


def line(method: str, *values: float) -> Line:
    return Line("vase", method, tuple((value,) for value in values))


def test_best_and_second_best_by_the_direction_of_the_metric() -> None:
    lines = [line("a", 10, 3, 1), line("b", 12, 1, 2), line("c", 11, 2, 3), line(ORACLE, 99, 0, 4)]
    cells = marked((PSNR, ERROR, PARAMETERS), lines)
    assert cells["a"] == ["10.00", "3.00", "1"]
    assert cells["b"] == ["**12.00**", "**1.00**", "2"]
    assert cells["c"] == ["*11.00*", "*2.00*", "3"]
    assert cells[ORACLE] == ["99.00", "0.00", "4"]


def test_what_prints_alike_is_marked_alike_and_one_row_is_not_marked() -> None:
    cells = marked((PSNR,), [line("a", 10.001), line("b", 10.002), line("c", 9)])
    assert [cells[name] for name in "abc"] == [["**10.00**"], ["**10.00**"], ["*9.00*"]]
    assert marked((PSNR,), [line("a", 10)]) == {"a": ["10.00"]}
    seeds = Line("vase", "a", ((1.0, 3.0, 2.0),))
    assert marked((PSNR,), [seeds]) == {"a": ["2.00 (1.00–3.00)"]}
    alike = Line("vase", "a", ((2.001, 2.002, 2.0),))
    assert marked((PSNR,), [alike]) == {"a": ["2.00"]}


def outcome(scene: str, method: str, psnr: float) -> Outcome:
    return Outcome(scene, method, 0, {PSNR.path: psnr})


def test_the_page_has_published_and_measured_rows_and_keeps_earlier_ones(tmp_path: Path) -> None:
    page, size = tmp_path / "tables.md", Size(80, 12, 3)
    first = Results(
        size, "--fast", tuple(outcome(scene, OURS, 20.0 + i) for i, scene in enumerate(TABLES["main"].scenes))
    )
    write_tables_page(page, first)
    write_tables_page(
        page, Results(size, "--fast", (outcome("vase", PAPER, 10.0), Outcome("cola", PAPER, 0, failure="no|")))
    )
    text = page.read_text()
    assert "| Environment PSNR ↑: vase | cola | mirror | mean | Normals mean ° ↓: vase |" in text
    assert "| PanoLess (paper), as published | **18.51** | **9.26** | **13.31** | **13.69** | **3.97** |" in text
    assert "| PanoLess (paper) | *10.00* | – | – | – |" in text
    assert "| ours | **20.00** | 21.00 | 22.00 | 21.00 |" in text
    assert "| cola | PanoLess (paper) | 0 | no\\| |" in text
    assert len(read_results(page.with_suffix(".json")).outcomes) == 5
    with pytest.raises(InputError, match="Choose another --page"):
        write_tables_page(page, replace(first, size=SIZE))


@pytest.mark.parametrize(
    ("schedule", "said"),
    [
        ("", "in all of their steps."),
        ("--x 3", "in all of their steps, with `--x 3`."),
        ("--config.iterations 60 --x 3", "in fewer steps than published, with `--config.iterations 60 --x 3`."),
    ],
)
def test_the_page_says_whether_schedules_are_whole(schedule: str, said: str) -> None:
    assert said in page_lines(Results(Size(80, 12, 3), schedule, ()), "tables.json")


def test_text_around_the_marks_stays_and_seconds_are_means_over_scenes(tmp_path: Path) -> None:
    page = tmp_path / "tables.md"
    page.write_text("# Head\n<!-- tables:begin -->\nold\n<!-- tables:end -->\nTail\n")
    pairs = (("vase", 30.0), ("cola", 60.0))
    outcomes = tuple(Outcome(scene, OURS, 0, {PSNR.path: 20.0, "seconds": each}) for scene, each in pairs)
    write_tables_page(page, Results(SIZE, "", outcomes))
    lines = page.read_text().splitlines()
    assert (lines[0], lines[-1]) == ("# Head", "Tail")
    assert "old" not in lines
    assert "| ours | 20.00 | 20.00 | – | – | 45 |" in lines


def test_figures_are_those_of_the_scores(tmp_path: Path, sphere_dataset: Dataset) -> None:
    """The truth as a prediction: normals without error but for rounding, by both protocols."""
    plan = make_plan(["self-reflection"], [0], scenes=["vase"], methods=["ours"])
    (cell,) = plan.cells
    folder = write_truth_prediction(tmp_path / "predictions" / cell.name, sphere_dataset)
    evaluate(folder)
    for kind in ("fit", "score"):
        record = {"command": "", "code": 0, "seconds": 9.0, "cpu_seconds": 7.0}
        write_json(tmp_path / f"records/{kind}/{cell.name}.json", record)
    (found,) = collect(tmp_path, plan).outcomes
    assert found.key == ("vase", OURS, 0)
    assert found.figures["seconds"] == 7.0
    assert found.figures["parameters"] == 14000
    assert found.figures[ERROR.path] < 0.3  # 8 bits in the paper's protocol.
    assert found.figures["environment.as_predicted.observed.psnr_linear"] > 60


def test_published_figures_have_the_marks_that_the_paper_prints() -> None:
    """Of *Vase* in its main table."""
    lines = [each for each in published_lines(TABLES["main"]) if each.scene == "vase"]
    cells = marked(TABLES["main"].columns, lines)
    bold = {name: [i for i, text in enumerate(row) if text.startswith("**")] for name, row in cells.items()}
    italic = {
        name: [i for i, text in enumerate(row) if text.startswith("*") and i not in bold[name]]
        for name, row in cells.items()
    }
    assert bold == {DR: [], SHADER: [], REF: [], MATERIAL: [2], PAPER: [0, 1, 3, 4, 5, 6, 7, 8, 9]}
    assert italic == {DR: [5, 7], SHADER: [], REF: [3], MATERIAL: [0, 1, 4, 6, 8, 9], PAPER: [2]}
