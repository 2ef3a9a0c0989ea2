"""The plan of the tables: its commands parse, cells are shared, and published figures are the paper's."""

import shlex
from collections.abc import Iterator
from typing import get_args

import pytest
import tyro

from panoless.cli import Fit
from panoless.presets import PRESETS
from shinypartial.cli import PROGRAM
from shinypartial.core.errors import InputError
from shinypartial.metrics.registry import metric
from shinypartial.suites.jobs import Size
from shinypartial.suites.tables.page import averages, published_lines
from shinypartial.suites.tables.plan import OF_COST, TABLES, TableName, make_plan
from shinypartial.suites.tables.published import DR, MATERIAL, PAPER, REF, SHADER

NAMES: tuple[TableName, ...] = get_args(TableName)


def commands() -> Iterator[list[str]]:
    """One of those that differ by their paths and seeds alone, which all read the same."""
    schedule = "--config.iterations 60 --config.surfels.count 500"
    plan = make_plan(NAMES, (0,), Size(80, 12, 3), schedule=schedule)
    words = [shlex.split(job.command) for job in plan.jobs]
    yield from {tuple(word for word in each if "/" not in word): each for each in words}.values()


def test_every_command_parses() -> None:
    """By the programs' own parsers; presets decide the defaults of `panoless fit`."""
    seen = set()
    for program, *words in commands():
        assert program in ("panoless", "shinypartial")
        if program == "shinypartial":
            PROGRAM.parse(words)
        else:
            preset = words[words.index("--preset") + 1]
            fit = tyro.cli(Fit, args=words[1:], default=Fit(preset=preset, config=PRESETS[preset]))
            seen.add((preset, fit.config.splats.iterations))
    assert ("3dgs-dr", 60) in seen
    # Ours takes its own schedule.
    assert ("default", PRESETS["default"].splats.iterations) in seen


def test_jobs_name_what_has_to_end_before_them_and_are_made_once() -> None:
    plan = make_plan(NAMES, (0, 1))
    names = [job.name for job in plan.jobs]
    assert len(names) == len(set(names))
    for index, job in enumerate(plan.jobs):
        assert set(job.after) <= set(names[:index])
    one = [cell for cell in plan.cells if cell.key == ("vase", PAPER, 0)]
    assert len(one) == 1
    assert sum(cell.method.name == "oracle baseline" and cell.key[0] == "vase" for cell in plan.cells) == 1


def test_copies_are_fitted_and_the_dataset_itself_is_scored_against() -> None:
    jobs = {job.name: job for job in make_plan(["pose-jitter"], [3], methods=["ours"]).jobs}
    name = "vase.cameras-turned-by-0.5.3.ours.3"
    assert "fit datasets/vase.cameras-turned-by-0.5.3 " in jobs[f"fit/{name}"].command
    assert jobs[f"score/{name}"].command.endswith("--dataset datasets/vase")
    assert "--seed 3 --cameras.rotation-deg 0.5" in jobs["perturb/vase.cameras-turned-by-0.5.3"].command


def test_cells_that_have_figures_already_and_what_only_they_need_are_left_out() -> None:
    whole = make_plan(["roughness"], [0])
    known = [cell.key for cell in whole.cells if "0.3" not in cell.key[0]]
    rest = make_plan(["roughness"], [0], without=known)
    assert {cell.key for cell in whole.cells} == {*known, *(cell.key for cell in rest.cells)}
    assert {job.name for job in rest.jobs if job.name.startswith("render")} == {"render/vase.roughness-0.3"}


def test_columns_are_registered_metrics() -> None:
    for table in TABLES.values():
        for column in table.columns:
            if column.path not in OF_COST:
                assert metric(column.path.rpartition(".")[2]).title


def test_published_rows_belong_to_rows_of_their_table() -> None:
    for table in TABLES.values():
        known = {
            (condition.of(scene), method.name)
            for scene in table.scenes
            for condition in table.conditions
            for method in table.methods
        }
        assert set(table.figures) <= known
        assert all(len(values) <= len(table.columns) for values in table.figures.values())


def test_means_of_published_figures_are_those_that_the_paper_prints() -> None:
    """The rows *Avg.* of its main table; means of rounded figures may differ by half a digit."""
    printed = {
        DR: (6.23, 0.249, 0.692, 0.431, 25.61, 25.91, 37.29, 34.03, 46.55, 68.05),
        SHADER: (8.21, 0.128, 0.705, 0.321, 38.05, 32.88, 43.97, 0.10, 9.26, 33.19),
        REF: (8.82, 0.291, 0.647, 0.326, 20.07, 16.08, 24.21, 1.50, 32.14, 74.69),
        MATERIAL: (8.89, 0.356, 0.601, 0.340, 11.64, 9.25, 15.00, 17.31, 71.08, 93.43),
        PAPER: (13.69, 0.471, 0.540, 0.195, 4.95, 3.52, 7.43, 89.36, 93.63, 95.72),
    }
    table = TABLES["main"]
    found = {line.method: line for line in averages(published_lines(table), table.scenes)}
    assert set(found) == set(printed)
    for method, values in printed.items():
        for index, value in enumerate(values):
            digits = 3 if 1 <= index <= 3 else 2
            assert found[method].middle(index) == pytest.approx(value, abs=1.01 * 10**-digits)


def test_unknown_names_are_refused() -> None:
    with pytest.raises(InputError, match="expected scenes"):
        make_plan(["main"], [0], scenes=["cup"])
    with pytest.raises(InputError, match="expected methods"):
        make_plan(["main"], [0], methods=["nerf"])
