"""Charts show exactly what compares: the Pareto front by definition, places in order, nothing mixed, nothing lost."""

import csv
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shinypartial.cli import main
from shinypartial.comparison.pareto import Comparable, Point, collect_points, pareto_front
from shinypartial.comparison.runs import collect
from shinypartial.comparison.significance import summarize
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.prediction.format import ORACLE_SUFFIX, read_info, write_info
from shinypartial.report.chart import PAGE, TABLE, Chart, make_charts, write_chart
from shinypartial.report.chart_svg import CARD, Curve, Mark, Plot, draw, follow_page_colors, make_figure
from shinypartial.report.leaderboard import write_leaderboard
from tests.support.truth_prediction import write_truth_prediction

SVG = "{http://www.w3.org/2000/svg}"
numbers = st.integers(0, 6)


@pytest.fixture(scope="module")
def scored(sphere_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One evaluated prediction, to be copied and changed."""
    root = write_truth_prediction(tmp_path_factory.mktemp("scored") / "truth", sphere_dataset)
    evaluate(root)
    return root


@pytest.fixture
def submit(scored: Path, tmp_path: Path) -> Callable[..., Path]:
    """Copy the prediction below predictions/ with other facts, seconds, PSNR and mean normal error."""

    def copy(
        folder: str, seconds: float = 60.0, psnr: float = 20.0, error: float = 1.0, dataset: str = "", **facts: Any
    ) -> Path:
        target = tmp_path / "predictions" / folder
        target.mkdir(parents=True)
        info = replace(read_info(scored), method=folder, seconds={"fit": seconds} if seconds else {})
        write_info(target, replace(info, **facts))
        content = json.loads((scored / "scores.json").read_text())
        content["environment"]["as_predicted"]["full"]["psnr_srgb"] = psnr
        content["normals"]["mean_angular_error_deg"] = content["normals"]["median_angular_error_deg"] = error
        content["dataset"] = dataset or content["dataset"]
        (target / "scores.json").write_text(json.dumps(content))
        return target

    return copy


def chart(comparable: Comparable, name: str) -> Chart:
    """The chart with a file name."""
    return next(each for each in make_charts(comparable, "parameters") if each.file_name == name)


def point(comparable: Comparable, method: str) -> Point:
    """The point of a method."""
    return next(each for each in comparable.points if each.method == method)


@given(st.lists(st.tuples(numbers, numbers), max_size=12), st.booleans())
def test_the_front_is_what_no_point_dominates(points: list[tuple[int, int]], higher: bool) -> None:
    """Against the definition, with many ties."""

    def dominates(a: tuple[int, int], b: tuple[int, int]) -> bool:
        as_good = a[1] >= b[1] if higher else a[1] <= b[1]
        return a[0] <= b[0] and as_good and a != b

    expected = tuple(not any(dominates(other, one) for other in points) for one in points)
    costs, values = [float(p[0]) for p in points], [float(p[1]) for p in points]
    assert pareto_front(costs, values, higher_is_better=higher) == expected


def test_better_means_the_right_thing_for_each_quality(submit: Callable[..., Path], tmp_path: Path) -> None:
    submit("fast", seconds=10, psnr=20, error=2.0)
    submit("slow-better-map", seconds=20, psnr=25, error=3.0)
    submit("slower-better-normals", seconds=30, psnr=22, error=1.0)
    comparable = collect_points([tmp_path / "predictions"])
    assert [p.method for p in comparable.points] == ["fast", "slow-better-map", "slower-better-normals"]
    assert chart(comparable, "environment_psnr_by_seconds.svg").front == {1: True, 2: True, 3: False}
    assert chart(comparable, "mean_normal_error_by_seconds.svg").front == {1: True, 2: False, 3: True}


def test_seeds_are_joined_by_their_median(submit: Callable[..., Path], tmp_path: Path) -> None:
    for seed, (seconds, psnr) in enumerate([(50.0, 21.0), (40.0, 30.0), (90.0, 22.0)]):
        submit(f"seed-{seed}", seconds, psnr, method="ours", config={"seed": seed, "rate": 1.0})
    submit("other", method="ours", config={"seed": 0, "rate": 2.0})
    submit("no-seed", method="theirs", config={})
    submit("no-seed-again", method="theirs", config={})
    comparable = collect_points([tmp_path / "predictions"])
    assert sorted(len(p.folders) for p in comparable.points) == [1, 1, 1, 3]
    joined = next(p for p in comparable.points if len(p.folders) == 3)
    assert joined.seeds == ("0", "1", "2")
    assert joined.values["seconds"] == summarize([50.0, 40.0, 90.0])
    assert joined.values["environment_psnr"] == summarize([21.0, 30.0, 22.0])
    assert len({p.label for p in comparable.points}) == 4


def test_several_datasets_are_refused_until_one_is_chosen(submit: Callable[..., Path], tmp_path: Path) -> None:
    submit("first", dataset="vase")
    submit("second", dataset="can")
    with pytest.raises(InputError, match="can, vase") as caught:
        collect_points([tmp_path / "predictions"])
    assert "--dataset can" in caught.value.remedy
    assert [p.method for p in collect_points([tmp_path / "predictions"], dataset="vase").points] == ["first"]
    with pytest.raises(InputError, match="of cup"):
        collect_points([tmp_path / "predictions"], dataset="cup")


def test_versions_of_a_dataset_are_refused(submit: Callable[..., Path], tmp_path: Path) -> None:
    submit("first")
    folder = submit("second", dataset_hash="f" * 64)
    content = json.loads((folder / "scores.json").read_text())
    (folder / "scores.json").write_text(json.dumps({**content, "dataset_hash": "f" * 64}))
    with pytest.raises(InputError, match=r"2 versions.*ffff.*second"):
        collect_points([tmp_path / "predictions"])


def test_several_hardwares_are_refused_until_one_is_chosen(submit: Callable[..., Path], tmp_path: Path) -> None:
    submit("desk", hardware={"processor": "Desk 9", "threads": 8})
    submit("lap", hardware={"processor": "Lap 1", "threads": 8})
    submit("nowhere", hardware={})
    with pytest.raises(InputError, match="not stated; processor Desk 9, threads 8; processor Lap 1") as caught:
        collect_points([tmp_path / "predictions"])
    assert "--hardware" in caught.value.remedy
    chosen = collect_points([tmp_path / "predictions"], hardware="lap")
    assert [p.method for p in chosen.points] == ["lap"]
    assert "processor Lap 1" in draw(make_charts(chosen, "parameters")[0].plot)


def test_a_run_on_a_gpu_and_one_on_the_cpu_are_different_hardware(submit: Callable[..., Path], tmp_path: Path) -> None:
    machine = {"processor": "Desk 9 CPU", "threads": 8}
    submit("slow", hardware={**machine, "device": "cpu"})
    submit("quick", hardware={"device": "Some GPU", **machine})
    with pytest.raises(InputError, match="device Some GPU, processor Desk 9 CPU, threads 8; device cpu, processor"):
        collect_points([tmp_path / "predictions"])
    for words, method in (("device cpu", "slow"), ("some gpu", "quick")):
        (drawn,) = collect_points([tmp_path / "predictions"], hardware=words).points
        assert drawn.method == method
    write_leaderboard(tmp_path / "predictions", tmp_path / "board")
    assert "device Some GPU, processor Desk 9 CPU" in (tmp_path / "board" / "index.html").read_text()


def test_what_cannot_be_drawn_is_named(submit: Callable[..., Path], tmp_path: Path) -> None:
    submit("good")
    (submit("unscored") / "scores.json").unlink()
    folder = submit("old-protocol")
    content = json.loads((folder / "scores.json").read_text())
    (folder / "scores.json").write_text(json.dumps({**content, "protocol": "linear-v0"}))
    submit("timeless", seconds=0.0)
    (submit("wrong") / "prediction.json").write_text("[]")
    folder = submit("lying")
    content = json.loads((folder / "prediction.json").read_text())
    (folder / "prediction.json").write_text(json.dumps({**content, "primitives": "many"}))
    drawn = write_chart([tmp_path / "predictions"], tmp_path / "chart")
    excluded = {Path(one.folder).name: one.reason for one in drawn.excluded}
    assert set(excluded) == {"unscored", "old-protocol", "timeless", "wrong", "lying"}
    assert "linear-v0" in excluded["old-protocol"]
    page = (tmp_path / "chart" / PAGE).read_text()
    assert all(f"/{name}</th>" in page for name in excluded)
    assert {p.method for p in drawn.points} == {"good", "timeless"}
    assert len(chart(drawn, "environment_psnr_by_seconds.svg").plot.marks) == 1
    assert len(chart(drawn, "environment_psnr_by_parameters.svg").plot.marks) == 2


def test_nothing_scored_is_an_error_that_says_what_to_do(submit: Callable[..., Path], tmp_path: Path, capsys) -> None:
    with pytest.raises(InputError, match="none"):
        collect_points([tmp_path])
    (submit("unscored") / "scores.json").unlink()
    assert main(["chart", str(tmp_path / "predictions"), "--output", str(tmp_path / "chart")]) == 2
    assert "shinypartial evaluate" in capsys.readouterr().err
    assert not (tmp_path / "chart").exists()


def test_the_oracle_is_a_line_and_no_point(
    submit: Callable[..., Path], sphere_dataset: Dataset, tmp_path: Path
) -> None:
    folder = submit("ours", psnr=20)
    assert collect_points([folder]).oracle == {}
    oracle = submit(sphere_dataset.name + ORACLE_SUFFIX, psnr=36, method="oracle", hardware={"another": "machine"})
    for paths in ([tmp_path / "predictions"], [folder], [folder, oracle]):
        comparable = collect_points(paths)
        assert [p.method for p in comparable.points] == ["ours"]
        assert comparable.oracle == {"environment_psnr": 36}
    with_line = [each.file_name for each in make_charts(comparable, "parameters") if each.plot.oracle is not None]
    assert with_line == ["environment_psnr_by_seconds.svg", "environment_psnr_by_parameters.svg"]
    assert ">oracle baseline 36</text>" in draw(chart(comparable, with_line[0]).plot)
    write_chart([folder], tmp_path / "chart")
    rows = csv.DictReader((tmp_path / "chart" / TABLE).read_text().splitlines())
    assert [(row["kind"], row["environment_psnr"]) for row in rows] == [("oracle baseline", "36.0"), ("result", "20.0")]


def snapshot(submit: Callable[..., Path], name: str, iteration: int, **facts: Any) -> Path:
    """A scored snapshot of a prediction."""
    facts = {"method": name, "iteration": iteration, **facts}
    return submit(f"{name}/snapshots/{iteration:06d}", **facts)


def test_snapshots_are_a_curve_by_time_and_no_methods(submit: Callable[..., Path], tmp_path: Path) -> None:
    submit("ours", seconds=60, psnr=30)
    for iteration, seconds, psnr in ((100, 20.0, 22.0), (50, 10.0, 18.0), (200, 59.0, 30.0)):
        snapshot(submit, "ours", iteration, seconds=seconds, psnr=psnr)
    comparable = collect_points([tmp_path / "predictions"])
    assert [p.method for p in comparable.points] == ["ours"]
    (curve,) = point(comparable, "ours").curves
    assert [moment.iteration for moment in curve] == [50, 100, 200, None]
    (drawn,) = chart(comparable, "environment_psnr_by_seconds.svg").plot.curves
    assert (drawn.x, drawn.y) == ([10.0, 20.0, 59.0, 60.0], [18.0, 22.0, 30.0, 30])
    assert not chart(comparable, "environment_psnr_by_parameters.svg").plot.curves
    (group,) = collect(tmp_path / "predictions").groups
    assert [line.entry.info.method for line in group.lines] == ["ours"]


def test_snapshots_of_another_fit_are_no_part_of_the_curve(submit: Callable[..., Path], tmp_path: Path) -> None:
    submit("ours", seconds=60)
    snapshot(submit, "ours", 50, seconds=10)
    snapshot(submit, "ours", 100, seconds=20, config={"seed": 1})
    snapshot(submit, "ours", 200, seconds=40, hardware={"device": "faster"})
    (snapshot(submit, "ours", 400) / "scores.json").unlink()
    comparable = collect_points([tmp_path / "predictions"])
    (curve,) = point(comparable, "ours").curves
    assert [moment.iteration for moment in curve] == [50, None]
    reasons = [one.reason for one in comparable.excluded]
    assert [word in reason for word, reason in zip(("configuration", "hardware", "not scored"), reasons, strict=True)]


def test_the_table_holds_every_point_and_snapshot(submit: Callable[..., Path], tmp_path: Path) -> None:
    submit("ours", seconds=60, psnr=30, primitives=7, model_bytes=99)
    submit("worse", seconds=70, psnr=10)
    snapshot(submit, "ours", 50, seconds=10, psnr=18)
    write_chart([tmp_path / "predictions"], tmp_path / "chart")
    rows = list(csv.DictReader((tmp_path / "chart" / TABLE).read_text().splitlines()))
    assert [(row["kind"], row["label"], row["iteration"]) for row in rows] == [
        ("result", "ours", ""),
        ("snapshot", "ours", "50"),
        ("result", "worse", ""),
    ]
    assert [float(row["environment_psnr"]) for row in rows] == [30, 18, 10]
    assert [row["front_environment_psnr_by_seconds"] for row in rows] == ["1", "", "0"]
    assert (rows[0]["primitives"], rows[0]["bytes"], rows[2]["primitives"]) == ("7.0", "99.0", "")
    assert all(row["hardware"] and row["dataset_hash"] and row["protocol"] for row in rows)


def test_the_page_needs_nothing_else_and_pictures_are_small(submit: Callable[..., Path], tmp_path: Path) -> None:
    submit("a<b>&c", seconds=60)
    submit("other", seconds=30)
    snapshot(submit, "other", 5, seconds=3)
    assert main(["chart", str(tmp_path / "predictions"), "--output", str(tmp_path / "chart")]) == 0
    page = (tmp_path / "chart" / PAGE).read_text()
    assert not [word for word in ("<script", "src=", "@import", "a<b>") if word in page]
    assert all(reference.startswith("#") for reference in re.findall(r'href="([^"]*)"', page))
    assert re.findall(r"url\(([^#])", page) == []
    pictures = sorted((tmp_path / "chart").glob("*.svg"))
    assert len(pictures) == page.count("<svg") == 6
    for picture in pictures:
        root = ElementTree.parse(picture).getroot()
        assert picture.stat().st_size < 300_000
        assert any("Hardware:" in (text.text or "") for text in root.iter(f"{SVG}text"))
    write_chart([tmp_path / "predictions"], tmp_path / "chart")
    (tmp_path / "chart" / PAGE).write_text("mine")
    with pytest.raises(InputError, match="something else"):
        write_chart([tmp_path / "predictions"], tmp_path / "chart")


three_values = st.tuples(st.floats(1e-3, 1e6), st.floats(1, 3), st.floats(1, 3)).map(
    lambda s: [s[0] / s[1], s[0], s[0] * s[2]]
)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(three_values, three_values), min_size=1, max_size=9), st.none() | st.floats(0.1, 1e3))
def test_everything_lies_in_the_plot_and_the_front_is_filled(
    runs: list[tuple[list[float], list[float]]], oracle: float | None
) -> None:
    """Bars, curves and the oracle baseline lie within the axes, which have two to twelve short ticks each."""
    places = [(summarize(x), summarize(y)) for x, y in runs]
    marks = [Mark(index, "a", x, y, index % 2 == 0) for index, (x, y) in enumerate(places, 1)]
    curve = Curve(1, [places[0][0].low, places[0][0].high], [places[0][1].low, places[0][1].high])
    figure = make_figure(Plot("title", "cost", "quality", marks, [curve], oracle, ["fact"]))
    (axes,) = figure.axes
    for (low, high), ends in zip((axes.get_xlim(), axes.get_ylim()), zip(*places, strict=True), strict=True):
        assert low < min(spread.low for spread in ends)
        assert max(spread.high for spread in ends) < high
    assert oracle is None or axes.get_ylim()[0] < oracle < axes.get_ylim()[1]
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        ticks = [tick for tick in axis.get_majorticklocs() if low <= tick <= high]
        assert 2 <= len(ticks) <= 12
        assert all(len(axis.get_major_formatter()(tick, 0)) <= 9 for tick in ticks)
    drawn = {line.get_gid(): line for line in axes.lines}
    for mark in marks:
        line = drawn[f"mark{mark.number}"]
        assert (line.get_xdata()[0], line.get_ydata()[0]) == (mark.x.median, mark.y.median)
        assert (line.get_markerfacecolor() != CARD) == mark.on_front


def test_the_same_plot_is_the_same_text_and_follows_the_page() -> None:
    mark = Mark(1, "<one>", summarize([1.0, 2.0]), summarize([3.0]), True)
    plot = Plot("a & b", "cost", "quality", [mark], [], None, ["fact"])
    text = draw(plot)
    assert draw(plot) == text
    assert ">a &amp; b</text>" in text
    assert ">&lt;one&gt;</text>" in text
    assert "var(" not in text
    assert "var(--dim)" in follow_page_colors(text)


def test_evaluate_scores_the_snapshots_too(scored: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    folder, evaluated = tmp_path / "p", []
    monkeypatch.setattr(
        "shinypartial.evaluation.evaluate.evaluate", lambda prediction, *_, **__: evaluated.append(prediction)
    )
    shutil.copytree(scored, folder)
    assert main(["evaluate", str(folder), "--snapshots"]) == 2
    assert "panoless export --snapshots" in capsys.readouterr().err
    for name in ("000020", "000010"):
        shutil.copytree(scored, folder / "snapshots" / name)
    assert main(["evaluate", str(folder), "--snapshots"]) == 0
    assert evaluated == [folder / "snapshots" / "000010", folder / "snapshots" / "000020", folder]
