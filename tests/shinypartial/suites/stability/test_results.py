"""What is made of finished cells, against numbers worked out by hand."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from shinypartial.core.errors import InputError
from shinypartial.io.files import write_json
from shinypartial.prediction.format import DESCRIPTION
from shinypartial.suites.stability.axes import BY_NAME
from shinypartial.suites.stability.collect import (
    Outcome,
    Results,
    crossing,
    join_results,
    judged,
    limits,
    read_results,
    verdict_auroc,
    write_results,
)
from shinypartial.suites.stability.figures import write_pictures
from shinypartial.suites.stability.page import page_lines, write_stability_page
from shinypartial.suites.stability.plan import SIZE, Cell

ROTATION = BY_NAME["rotation"]


def outcome(level: float | None, decibels: float | None, risk: float | None = None, scene: str = "vase") -> Outcome:
    cell = Cell(scene, "development", "fast", None if level is None else "rotation", level, 0)
    if decibels is None:
        return Outcome(cell, failure="error: <none> | nothing")
    word = None if risk is None else "trust" if risk < 1 else "do not trust"
    return Outcome(cell, decibels, decibels - 5, 40 / decibels, 1.0, word, risk, {"views": 50.0}, 12.0)


#: Falls of 0, 1, 5 and 10 dB.
VASE = [outcome(None, 20, 0.2), outcome(0.5, 19, 0.6), outcome(1.0, 15, 0.5), outcome(2.0, 10, 2.0)]
RESULTS = Results(SIZE, tuple(VASE))


@pytest.mark.parametrize(
    ("losses", "expected"),
    [
        ([0, 1, 5, 10], 0.75),
        ([0, 3, 3, 3], 0.5),
        ([0, 1, 2, 2.9], None),
        ([0, 1, None, 10], 1),
        ([0, -1, 7, 0], 0.75),
    ],
)
def test_a_limit_is_reached_between_levels(losses: list[float | None], expected: float | None) -> None:
    assert crossing([0, 0.5, 1, 2], losses, 3) == expected


def test_limits_of_scenes() -> None:
    assert limits(RESULTS, ROTATION, "fast") == (0.75,)
    assert limits(Results(SIZE, (*VASE[:2], outcome(1.0, None))), ROTATION, "fast") == (1.0,)
    assert limits(Results(SIZE, tuple(VASE[1:])), ROTATION, "fast") == ()


def test_auroc_of_verdicts() -> None:
    """Lost fits have the risks 0.5 and 2, the others 0.2 and 0.6: three of four pairs are in order."""
    fits = list(judged(RESULTS, "development"))
    assert [each.lost for each in fits] == [False, False, True, True]
    assert verdict_auroc(fits) == 0.75
    assert verdict_auroc(list(judged(RESULTS, "held-out"))) is None
    unknown = Results(SIZE, (*VASE, outcome(0.1, None), outcome(0.25, 10)))
    assert len(list(judged(unknown, "development"))) == 4


def test_results_are_written_whole(tmp_path: Path) -> None:
    outcomes = (*VASE, outcome(0.1, None))
    write_results(tmp_path / "results.json", Results(SIZE, outcomes))
    cells = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["cells"]
    found = [Outcome(Cell(**{key: each.pop(key) for key in Cell.__dataclass_fields__}), **each) for each in cells]
    assert tuple(found) == outcomes
    assert read_results(tmp_path / "results.json") == Results(SIZE, outcomes)


def test_joined_results_prefer_the_own_ones() -> None:
    mirror = outcome(None, 30, 0.1, "mirror")
    joined = join_results(RESULTS, [Results(SIZE, (outcome(0.5, 1), mirror)), Results(SIZE, (outcome(None, 2),))])
    assert joined.outcomes == (*VASE, mirror)


def test_results_of_another_size_or_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one size"):
        join_results(RESULTS, [Results(replace(SIZE, resolution=32), ())])
    path = tmp_path / "scores.json"
    path.write_text('{"format": "scores"}', encoding="utf-8")
    with pytest.raises(InputError, match=r"stability\.json"):
        read_results(path)


def test_the_page_is_the_same_for_the_same_results(tmp_path: Path) -> None:
    results = Results(SIZE, (*VASE, outcome(0.1, None), outcome(None, 21, 0.1, "mirror")))
    for name in ("a", "b"):
        write_stability_page(tmp_path / name / "stability.md", tmp_path, results)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert list(map(str, files)) == ["assets/stability-rotation.svg", "results/stability.json", "stability.md"]
    assert all((tmp_path / "a" / each).read_bytes() == (tmp_path / "b" / each).read_bytes() for each in files)
    page = (tmp_path / "a" / "stability.md").read_text()
    assert "| development | fast | 5 | 2 | 0.833 |" in page
    assert "| Clean | 20.00 | 21.00 |" in page
    assert "| Camera rotation: 0.5° | 1.0 | – |" in page
    assert "| Camera rotation: 1° | **5.0** | – |" in page
    assert "error: &lt;none> \\| nothing" in page


def test_a_fit_without_a_map_has_no_picture(tmp_path: Path) -> None:
    unknown = [replace(each, environment_db=None) for each in VASE]
    for each in unknown:
        write_json(tmp_path / "predictions" / each.cell.name / DESCRIPTION, {})
    assert write_pictures(tmp_path, tmp_path, Results(SIZE, tuple(unknown)), "fast") == []


def test_verdicts_are_counted_by_method() -> None:
    """The same fits by an earlier version have a row of their own, and those of the first method alone are listed."""
    earlier = [replace(each, cell=replace(each.cell, method="before")) for each in VASE]
    page = "\n".join(page_lines(Results(SIZE, (*VASE, *earlier)), []))
    alone = "\n".join(page_lines(Results(SIZE, tuple(VASE)), []))
    row = next(line for line in alone.splitlines() if line.startswith("| development | fast |"))
    assert row in page
    assert row.replace("| fast |", "| before |") in page
    for line in alone[alone.index("| Verdict of fast |") :].splitlines()[:5]:
        assert line in page


def test_the_spread_over_seeds_is_stated() -> None:
    """Of 20, 21 and 22 dB the deviation is 1 dB; a failed fit and worse data don't count."""
    fits = [(None, 20.0), (None, 21.0), (None, 22.0), (0.5, 5.0), (None, None)]
    outcomes = [outcome(level, decibels) for level, decibels in fits]
    seeded = [replace(each, cell=replace(each.cell, seed=seed)) for seed, each in enumerate(outcomes)]
    page = "\n".join(page_lines(Results(SIZE, tuple(seeded)), []))
    assert "| vase | fast | 3 | 1.000 dB |" in page


def test_the_page_names_the_scenes_of_a_method_that_was_not_fitted_to_all(tmp_path: Path) -> None:
    other = outcome(None, 30, 0.1, "mirror")
    slow = replace(other, cell=replace(other.cell, method="slow"))
    write_stability_page(tmp_path / "page.md", tmp_path, Results(SIZE, (*VASE, other, slow)))
    assert f"- Methods: {other.cell.method}, slow (mirror only)" in (tmp_path / "page.md").read_text(encoding="utf-8")
