"""The leaderboard ranks what can be compared, names what can't, and needs nothing but the folders it reads."""

import csv
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from shinypartial.cli import main
from shinypartial.comparison.runs import ORACLE, Group, Line, collect
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.evaluation.key_metrics import KEY_METRICS, key_metrics
from shinypartial.evaluation.scores import read_scores, score_rows
from shinypartial.metrics.registry import Direction
from shinypartial.prediction.format import read_info, write_info
from shinypartial.report.leaderboard import PAGE, TABLE, write_leaderboard
from tests.support.truth_prediction import write_truth_prediction

ENVIRONMENT, NORMALS = "environment.as_predicted.full.psnr_srgb", "normals.mean_angular_error_deg"
VOID = {"meta", "br"}


@pytest.fixture(scope="module")
def scored(sphere_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One evaluated prediction, to be copied and changed."""
    root = write_truth_prediction(tmp_path_factory.mktemp("scored") / "truth", sphere_dataset)
    evaluate(root)
    return root


@pytest.fixture
def submit(scored: Path, tmp_path: Path) -> Callable[..., Path]:
    """Copy the prediction below predictions/ under a name, with other scores (by their place) and another method."""

    def copy(folder: str, method: str | None = None, **scores: Any) -> Path:
        target = tmp_path / "predictions" / folder
        target.mkdir(parents=True)
        for name in ("prediction.json", "scores.json"):
            shutil.copy(scored / name, target)
        write_info(target, replace(read_info(target), method=method or folder))
        content = json.loads((target / "scores.json").read_text())
        for place, value in scores.items():
            *groups, name = place.split("__")
            part = content
            for group in groups:
                part = part[group]
            part[name] = value
        (target / "scores.json").write_text(json.dumps(content))
        return target

    return copy


def place(path: str) -> str:
    """A place in the scores as the name of a keyword."""
    return path.replace(".", "__")


def only_group(root: Path) -> Group:
    """The single group below a folder."""
    (group,) = collect(root).groups
    return group


def methods(group: Group) -> list[str]:
    """Methods in the order of the table."""
    return [line.entry.info.method for line in group.lines]


def cell_of(group: Group, line: Line, path: str) -> tuple[str, bool]:
    """Text and mark of a cell."""
    cell = line.cells[[column.path for column in group.columns].index(path)]
    return cell.text, cell.best


class Page(HTMLParser):
    """Checks nesting, and collects references and the cells of tables."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []
        self.text: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "action")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def test_key_metrics_are_scores_that_the_registry_knows(scored: Path) -> None:
    """The dataset resolves no direction and is infinitely far, so these scores have no such rows."""
    known = {row.path for row in score_rows(read_scores(scored))} | {"surroundings.inverse_distance_error"}
    known |= {path.replace(".full.", ".resolved.") for path in known}
    assert {key.path for key in KEY_METRICS} <= known
    assert len({key.path for key in KEY_METRICS}) == len(KEY_METRICS)
    assert all(key.name for key in key_metrics("chart"))


def test_methods_are_ordered_best_first_and_the_oracle_stands_above(submit: Callable[..., Path]) -> None:
    for name, value in (("low", 10.0), ("high", 30.0), ("middle", 20.0), (ORACLE, 15.0)):
        root = submit(name, **{place(ENVIRONMENT): value}).parent
    assert methods(only_group(root)) == [ORACLE, "high", "middle", "low"]


def test_the_best_is_marked_by_the_direction_of_the_metric(submit: Callable[..., Path]) -> None:
    submit("a", **{place(ENVIRONMENT): 20.0, place(NORMALS): 1.0})
    submit("b", **{place(ENVIRONMENT): 30.0, place(NORMALS): 2.0})
    group = only_group(submit(ORACLE, **{place(ENVIRONMENT): 90.0, place(NORMALS): 0.0}).parent)
    oracle, high, low = group.lines
    assert cell_of(group, high, ENVIRONMENT) == ("30.00 dB", True)
    assert cell_of(group, low, ENVIRONMENT) == ("20.00 dB", False)
    assert cell_of(group, low, NORMALS) == ("1.00°", True)
    assert cell_of(group, high, NORMALS) == ("2.00°", False)
    assert not any(cell.best for cell in oracle.cells)
    assert all(column.metric.direction is not Direction.DESCRIPTION for column in group.columns)


def test_equal_numbers_are_equally_best_and_missing_ones_never(submit: Callable[..., Path]) -> None:
    submit("a", **{place(ENVIRONMENT): 20.001})
    submit("b", **{place(ENVIRONMENT): 20.002})
    group = only_group(submit("c", environment=None).parent)
    assert [cell_of(group, line, ENVIRONMENT)[1] for line in group.lines] == [True, True, False]
    assert methods(group)[-1] == "c"


def test_submitting_is_copying_a_folder(submit: Callable[..., Path], tmp_path: Path) -> None:
    root = submit("first").parent
    write_leaderboard(root, tmp_path / "out")
    assert "second" not in (tmp_path / "out" / PAGE).read_text()
    submit("nested/second")
    write_leaderboard(root, tmp_path / "out")
    assert "second" in (tmp_path / "out" / PAGE).read_text()


def test_datasets_are_never_mixed(submit: Callable[..., Path]) -> None:
    submit("a")
    other = submit("b", dataset="other", dataset_hash="f" * 64)
    write_info(other, replace(read_info(other), dataset_hash="f" * 64))
    assert [len(group.lines) for group in collect(other.parent).groups] == [1, 1]


EXCLUDED: dict[str, tuple[Callable[[Path], object], str]] = {
    "without scores": (lambda root: (root / "scores.json").unlink(), "not scored"),
    "broken scores": (lambda root: (root / "scores.json").write_text("{"), "JSON"),
    "scores of another shape": (lambda root: (root / "scores.json").write_text("[]"), "another format"),
    "another format": (lambda root: (root / "scores.json").write_text("{}"), "another format"),
    "no description": (lambda root: (root / "prediction.json").write_text("{}"), "another format"),
}


@pytest.mark.parametrize(("damage", "words"), EXCLUDED.values(), ids=EXCLUDED.keys())
def test_what_cannot_be_read_is_excluded_with_the_reason(
    submit: Callable[..., Path], damage: Callable[[Path], object], words: str
) -> None:
    submit("good")
    bad = submit("bad")
    damage(bad)
    board = collect(bad.parent)
    (excluded,) = board.excluded
    assert excluded.folder == "bad"
    assert words in excluded.reason
    assert excluded.remedy
    assert methods(board.groups[0]) == ["good"]


UNCOMPARABLE: dict[str, tuple[dict[str, Any], str]] = {
    "another protocol": ({"protocol": "linear-v0"}, "linear-v0"),
    "another version of the dataset": ({"dataset_hash_matches": False}, "hashes differ"),
    "scored on another dataset": ({"dataset_hash": "0" * 64}, "hashes differ"),
    "a text for a number": ({place(ENVIRONMENT): "high"}, "scores.json"),
    "not a number": ({place(ENVIRONMENT): float("nan")}, "found nan"),
}


@pytest.mark.parametrize(("scores", "words"), UNCOMPARABLE.values(), ids=UNCOMPARABLE.keys())
def test_what_cannot_be_compared_is_excluded_with_the_reason(
    submit: Callable[..., Path], scores: dict[str, Any], words: str
) -> None:
    board = collect(submit("odd", **scores).parent)
    assert board.groups == ()
    assert words in board.excluded[0].reason


def test_a_prediction_without_scores_names_the_command(
    submit: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = submit("bad")
    (bad / "scores.json").unlink()
    assert main(["leaderboard", str(bad.parent), "--output", str(tmp_path / "out")]) == 0
    command = f"shinypartial evaluate {bad}"
    assert command in capsys.readouterr().out
    assert command in (tmp_path / "out" / PAGE).read_text()


def test_the_page_needs_no_other_file_and_no_network(submit: Callable[..., Path], tmp_path: Path) -> None:
    root = submit("a", method="<script>alert(1)</script>").parent
    submit("b", protocol="linear-v0")
    write_leaderboard(root, tmp_path / "out")
    text = (tmp_path / "out" / PAGE).read_text()
    page = Page(text)
    assert page.references == []
    assert not re.search(r"https?://|@import|url\(", text)
    assert text.count("<script>") == 1
    assert "<script>alert(1)</script>" in page.text
    assert "prefers-color-scheme: dark" in text
    assert 'name="viewport"' in text


def test_the_table_holds_every_score_at_full_precision(submit: Callable[..., Path], tmp_path: Path) -> None:
    target = submit("a")
    write_leaderboard(target.parent, tmp_path / "out")
    with (tmp_path / "out" / TABLE).open(newline="") as stream:
        (line,) = csv.DictReader(stream)
    assert line["seconds"] == "63.5"
    assert line["parameters"] == "14000"
    for row in score_rows(read_scores(target)):
        assert line[row.path] == ("" if row.value is None else str(row.value))


def test_wrong_folders_are_refused(submit: Callable[..., Path], tmp_path: Path) -> None:
    root = submit("a").parent
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / PAGE).write_text("<p>mine")
    with pytest.raises(InputError, match="something else"):
        write_leaderboard(root, tmp_path / "site")
    with pytest.raises(InputError, match=r"prediction\.json"):
        write_leaderboard(tmp_path / "empty", tmp_path / "out")
    assert (tmp_path / "site" / PAGE).read_text() == "<p>mine"
