"""The plan is data: cells, jobs and commands as written by hand."""

from pathlib import Path

import pytest
import tyro

from shinypartial.cli.datasets import Perturb
from shinypartial.cli.scenes import Generate
from shinypartial.core.errors import InputError
from shinypartial.suites.jobs import PLAN, read_jobs, write_jobs
from shinypartial.suites.stability.axes import AXES, BY_NAME, Axis
from shinypartial.suites.stability.plan import METHODS, Plan, conditions, make_plan, parse_methods

COPY = {"copy": "cp -r {dataset} {prediction} # {seed}"}


def commands(plan: Plan) -> dict[str, str]:
    return {job.name: job.command for job in plan.jobs}


def test_a_plan_of_clean_data_holds_a_fit_a_seed() -> None:
    cells = make_plan("clean", COPY, [1, 2], scenes=["vase", "mirror"]).cells
    assert [cell.name for cell in cells] == ["vase.1.copy", "vase.2.copy", "mirror.1.copy", "mirror.2.copy"]


def test_tiny_plan() -> None:
    plan = make_plan("tiny", COPY, [7])
    assert [cell.name for cell in plan.cells] == [
        "tiny-vase.7.copy",
        "tiny-vase.rotation-0.5.7.copy",
        "tiny-vase.rotation-2.7.copy",
    ]
    assert commands(plan) == {
        "perturb/tiny-vase": "shinypartial perturb tiny-vase --output datasets/tiny-vase",
        "fit/tiny-vase.7.copy": "cp -r datasets/tiny-vase predictions/tiny-vase.7.copy # 7",
        "score/tiny-vase.7.copy": "shinypartial evaluate predictions/tiny-vase.7.copy --dataset datasets/tiny-vase",
    } | {
        line: command
        for level in ("0.5", "2")
        for line, command in {
            f"perturb/tiny-vase.rotation-{level}.7": "shinypartial perturb datasets/tiny-vase "
            f"--output datasets/tiny-vase.rotation-{level}.7 --link --seed 7 --cameras.rotation-deg {level}",
            f"fit/tiny-vase.rotation-{level}.7.copy": f"cp -r datasets/tiny-vase.rotation-{level}.7 "
            f"predictions/tiny-vase.rotation-{level}.7.copy # 7",
            f"score/tiny-vase.rotation-{level}.7.copy": "shinypartial evaluate "
            f"predictions/tiny-vase.rotation-{level}.7.copy --dataset datasets/tiny-vase",
        }.items()
    }


def test_rendered_levels_are_scored_on_themselves_and_made_once() -> None:
    plan = make_plan("core", COPY, [0, 1], scenes=["vase"], axes=["room"])
    rendered = [name for name in commands(plan) if name.startswith("render/")]
    assert rendered == ["render/vase", *(f"render/vase.room-{each}" for each in (20, 10, 5, 2)), "render/vase.matte-1"]
    assert commands(plan)["render/vase.room-5"] == (
        "shinypartial generate --scene vase --resolution 160 --train 50 --test 8 "
        "--surroundings-radii 5 --output datasets/vase.room-5"
    )
    assert commands(plan)["score/vase.room-5.1.copy"].endswith("--dataset datasets/vase.room-5")


def test_errors_in_a_room_are_scored_on_that_room() -> None:
    plan = commands(make_plan("core", COPY, [0], scenes=["vase"], axes=["capture-room"]))
    assert plan["render/vase.capture-room"].endswith(
        "--surroundings-radii 8 --surroundings-room box --output datasets/vase.capture-room"
    )
    assert plan["perturb/vase.capture-room-1.0"].startswith("shinypartial perturb datasets/vase.capture-room --output ")
    assert plan["score/vase.capture-room-1.0.copy"].endswith("--dataset datasets/vase.capture-room")
    assert plan["score/vase.0.copy"].endswith("--dataset datasets/vase")


def test_core_has_the_levels_of_the_table_and_the_anchors_once() -> None:
    core = list(conditions("core"))
    assert len(core) == len(set(core)) == 1 + sum(len(axis.levels) for axis in AXES if axis.kind == "core") + 1
    assert ("matte", 1.0) in core
    assert len(list(conditions("all"))) > len(core)
    assert set(conditions("core", ["focal"])) == {
        (None, None),
        *(("focal", level) for level in (0.5, 1.0, 2.0, 4.0)),
        ("rotation", 2.0),
        ("matte", 1.0),
    }


def test_levels_become_options_and_positions() -> None:
    assert BY_NAME["focal"].arguments(4) == ["--cameras.focal-factor", "1.04"]
    assert BY_NAME["capture"].arguments(2)[:4] == ["--cameras.rotation-deg", "0.6", "--cameras.focal-factor", "1.02"]
    assert [BY_NAME["views"].position(level) for level in (None, 10)] == [0, 40]
    assert BY_NAME["views"].text(40) == "10 views"
    assert [BY_NAME["room"].position(level) for level in (None, 5)] == [0, 0.2]
    assert BY_NAME["room"].text(0.2) == "5 radii"
    assert all(axis.text(axis.position(level)).startswith(f"{level:g}") for axis in AXES for level in axis.levels)


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: axis.name)
def test_options_of_every_axis_are_those_of_its_command(axis: Axis) -> None:
    """Each level parses, and changes something that no other level does."""
    command, words = (Generate, ["--scene", "vase"]) if axis.rendered else (Perturb, ["tiny-vase", "--output", "copy"])
    parsed = [tyro.cli(command, args=[*words, *options]) for options in ([], *map(axis.arguments, axis.levels))]
    assert len(set(map(repr, parsed))) == 1 + len(axis.levels)


def test_methods() -> None:
    assert parse_methods(["fast"], ["mine=run {dataset} a=b"]) == {"fast": METHODS["fast"], "mine": "run {dataset} a=b"}
    with pytest.raises(InputError, match="fast, default, paper"):
        parse_methods(["slow"], [])


@pytest.mark.parametrize("methods", [{"a": "run"}, {"a/b": "run {dataset}"}, {"a": "run {dataset} {rest}"}, {}])
def test_methods_that_cannot_run_are_refused(methods: dict[str, str]) -> None:
    with pytest.raises(InputError):
        make_plan("tiny", methods, [0])


def test_unknown_names_are_refused() -> None:
    for wrong in ({"scenes": ["cup"]}, {"axes": ["color"]}):
        with pytest.raises(InputError, match=r"expected (scenes|axes): "):
            make_plan("core", COPY, [0], **wrong)


def test_any_scene_that_declares_a_split_can_be_asked_for() -> None:
    """Also one that is not among those of a plan by default."""
    cells = make_plan("core", COPY, [0], scenes=["rounded-block", "dish"], axes=["masks-eroded"]).cells
    assert {(cell.scene, cell.split) for cell in cells} == {("rounded-block", "held-out"), ("dish", "development")}


def test_a_folder_takes_more_cells_but_no_other_command(tmp_path: Path) -> None:
    write_jobs(tmp_path, make_plan("tiny", COPY, [0]))
    more = make_plan("tiny", COPY, [0, 1])
    write_jobs(tmp_path, more)
    assert read_jobs(tmp_path) == more.jobs
    with pytest.raises(InputError, match="another name for the method"):
        write_jobs(tmp_path, make_plan("tiny", {"copy": "false {dataset}"}, [0]))


@pytest.mark.parametrize("content", ["{}", "[]", '{"jobs": {"fit/a": {"after": []}}}'])
def test_a_plan_that_is_none_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / PLAN).write_text(content)
    with pytest.raises(InputError, match=r"plan\.json"):
        write_jobs(tmp_path, make_plan("tiny", COPY, [0]))
