"""Pairs by dataset and seed; equal groups differ by nothing, a known shift is found, few pairs decide nothing."""

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shinypartial.cli import main
from shinypartial.comparison.paired import (
    ComparedMetric,
    Comparison,
    PairedDifference,
    compare,
    comparison_lines,
    write_comparison,
)
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.evaluation.scores import read_scores, write_scores
from shinypartial.metrics import perceptual
from shinypartial.prediction.format import read_info, write_info
from tests.support.truth_prediction import write_truth_prediction

PSNR = "render.psnr"


@pytest.fixture(scope="module")
def scored(sphere_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(perceptual.ENVIRONMENT_VARIABLE, raising=False)
        patch.setattr(perceptual, "CACHE", Path("no-cache"))
        prediction = write_truth_prediction(tmp_path_factory.mktemp("scored") / "truth", sphere_dataset)
        evaluate(prediction)
    return prediction


def make_run(scored: Path, folder: Path, seed: int, psnr: float, dataset_hash: str = "a") -> Path:
    """A scored prediction with that seed and render PSNR."""
    folder.mkdir(parents=True)
    for name in ("prediction.json", "scores.json"):
        shutil.copy(scored / name, folder / name)
    info, scores = read_info(folder), read_scores(folder)
    assert scores.render is not None
    write_info(folder, replace(info, config={"seed": seed}, dataset_hash=dataset_hash))
    write_scores(folder, replace(scores, render=replace(scores.render, psnr=psnr), dataset_hash=dataset_hash))
    return folder


def make_group(scored: Path, parent: Path, values: list[float]) -> list[Path]:
    return [make_run(scored, parent / f"seed{i}", i, value) for i, value in enumerate(values)]


def of(comparison: Comparison, path: str) -> ComparedMetric:
    return next(each for each in comparison.metrics if each.path == path)


VALUES = [20.0, 22.0, 19.5, 24.0, 21.0, 23.0]


def test_equal_groups_differ_by_nothing(scored: Path, tmp_path: Path) -> None:
    comparison = compare(make_group(scored, tmp_path / "a", VALUES), make_group(scored, tmp_path / "b", VALUES))
    for each in comparison.metrics:
        assert each.difference == PairedDifference(len(VALUES), 0.0, 0.0, 0.0, 1.0)
        assert each.verdict in ("undecided", "–")
    psnr = of(comparison, PSNR)
    assert psnr.first is not None
    assert psnr.first.mean == pytest.approx(21.583333)
    assert psnr.first.standard_deviation == pytest.approx(np.std(VALUES, ddof=1))


def test_a_known_shift_is_recovered_and_its_sign_judged(scored: Path, tmp_path: Path) -> None:
    """The spread between seeds is large, but pairs cancel it; six of one sign have p = 2⁻⁵."""
    noise = [0.1, -0.1, 0.05, -0.05, 0.0, 0.0]
    better = [value + 0.5 + extra for value, extra in zip(VALUES, noise, strict=True)]
    groups = make_group(scored, tmp_path / "a", better), make_group(scored, tmp_path / "b", VALUES)
    found = of(compare(*groups), PSNR)
    assert found.difference.mean == pytest.approx(0.5)
    assert found.difference.low is not None
    assert found.difference.high is not None
    assert 0.4 < found.difference.low < 0.5 < found.difference.high < 0.6
    assert found.difference.p_value == 2**-5
    assert found.verdict == "better"
    assert of(compare(*reversed(groups)), PSNR).verdict == "worse"


def test_five_pairs_are_never_called_better_and_the_table_says_why(scored: Path, tmp_path: Path) -> None:
    """However large the difference: one of 2⁵ flips, and its opposite, are as extreme, p = 1/16."""
    first = make_group(scored, tmp_path / "a", [value + 9 for value in VALUES[:5]])
    comparison = compare(first, make_group(scored, tmp_path / "b", VALUES[:5]))
    assert (of(comparison, PSNR).difference.p_value, of(comparison, PSNR).verdict) == (0.0625, "undecided")
    lines = comparison_lines(comparison)
    assert "p = 0.0625, n = 5" in "\n".join(lines)
    assert "exact sign-flip test" in lines[2]
    assert "5 pairs have p ≥ 0.0625: score 6 seeds or scenes or more" in lines[-1]


def test_runs_are_paired_by_dataset_and_seed_not_by_order(scored: Path, tmp_path: Path) -> None:
    first = make_group(scored, tmp_path / "a", [1.0, 2.0, 3.0])
    second = make_group(scored, tmp_path / "b", [1.0, 2.0, 3.0])
    first.append(make_run(scored, tmp_path / "a" / "other", 0, 50.0, dataset_hash="b"))
    second.append(make_run(scored, tmp_path / "b" / "seed9", 9, 70.0))
    comparison = compare(first, second[::-1])
    found = of(comparison, PSNR)
    assert (found.difference.pairs, found.difference.mean) == (3, 0.0)
    assert found.first is not None
    assert found.second is not None
    assert (found.first.number, found.second.number) == (4, 4)
    assert set(comparison.unpaired) == {str(first[-1]), str(second[-1])}
    assert "without a partner" in "\n".join(comparison_lines(comparison))


def test_what_cannot_be_compared_is_refused(scored: Path, tmp_path: Path) -> None:
    a, b = make_group(scored, tmp_path / "a", [1.0]), make_group(scored, tmp_path / "b", [2.0])
    with pytest.raises(InputError, match="one run for each dataset and seed"):
        compare([*a, *b], b)
    with pytest.raises(InputError, match="in the second group"):
        compare(a, [])
    with pytest.raises(InputError, match="at least one pair"):
        compare(a, [make_run(scored, tmp_path / "c", 5, 1.0)])
    write_scores(b[0], replace(read_scores(b[0]), protocol="linear-v0"))
    with pytest.raises(InputError, match="one protocol"):
        compare(a, b)
    write_scores(b[0], replace(read_scores(b[0]), dataset_hash_matches=False))
    with pytest.raises(InputError, match="different dataset hashes"):
        compare(a, b)


def test_one_pair_has_a_difference_but_no_interval(scored: Path, tmp_path: Path) -> None:
    comparison = compare(make_group(scored, tmp_path / "a", [2.0]), make_group(scored, tmp_path / "b", [1.0]))
    assert of(comparison, PSNR).difference == PairedDifference(1, 1.0, None, None, 1.0)
    assert "1 pair has p ≥ 1" in comparison_lines(comparison)[-1]


def test_a_metric_that_some_runs_lack_is_compared_on_the_others(scored: Path, tmp_path: Path) -> None:
    first, second = (make_group(scored, tmp_path / name, [2.0, 3.0, 4.0]) for name in "ab")
    write_scores(first[1], replace(read_scores(first[1]), render=None))
    found = of(compare(first, second), PSNR)
    assert found.first is not None
    assert (found.first.number, found.difference.pairs, found.difference.mean) == (2, 2, 0.0)
    for folder in first:
        write_scores(folder, replace(read_scores(folder), render=None))
    found = of(compare(first, second), PSNR)
    assert (found.first, found.difference) == (None, PairedDifference(0, None, None, None, None))
    assert found.verdict == "–"


def test_the_command_prints_a_table_and_writes_every_metric(
    scored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = make_group(scored, tmp_path / "a", VALUES)
    second = make_group(scored, tmp_path / "b", [value - 1 for value in VALUES])
    output = tmp_path / "out"
    assert main(["compare", *map(str, first), "--against", *map(str, second), "--output", str(output)]) == 0
    out = capsys.readouterr().out
    assert "render.psnr ↑" in out
    assert re.search(r"\+1\.00 \[\+1\.00, \+1\.00\] +p = 0\.0312, n = 6 +better", out)
    content = json.loads((output / "comparison.json").read_text())
    with (output / "comparison.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["metric"] for row in rows] == [row["metric"] for row in content["metrics"]]
    psnr = next(row for row in rows if row["metric"] == PSNR)
    assert (psnr["unit"], psnr["direction"], psnr["verdict"]) == ("dB", "higher", "better")
    assert float(psnr["difference_mean"]) == pytest.approx(1.0)
    assert float(psnr["difference_p_value"]) == 2**-5
    assert (content["test"], content["interval"]) == ("sign-flip test", "Student t")
    assert write_comparison(output, compare(first, second))[0] == output / "comparison.json"
