"""Snapshots lie on the path of the fit: the last one is its result, and a kill neither loses nor doubles any."""

from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.views import load_views
from panoless.cli import main
from panoless.export.prediction import export_prediction, export_snapshots
from panoless.reconstruct import recorder as recorder_module
from panoless.reconstruct.final_map import complete
from panoless.reconstruct.fit import fit
from panoless.reconstruct.recorder import Recorder
from panoless.reconstruct.snapshots import (
    SnapshotSchedule,
    read_snapshot,
    snapshot_folders,
    snapshot_schedule,
)
from panoless.reconstruct.state import FitState, load_state
from panoless.selection.candidates import Selection
from panoless.splats import train
from panoless.splats.mirror import SurfelMirror
from panoless.splats.objective import LossTerms
from panoless.splats.train import SurfelTrainer
from panoless.splats.training import Training
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset
from shinypartial.prediction.format import SNAPSHOTS, prediction_folders, read_info
from shinypartial.prediction.format import snapshot_folders as exported_snapshots
from tests.support.mirror_sphere import sphere_surfels, tiny_config

pytestmark = [pytest.mark.splats, pytest.mark.usefixtures("often")]
CONFIG = tiny_config(iterations=24, count=120)
MARKS = snapshot_schedule(4, (), CONFIG.splats.iterations)


class Killed(BaseException):
    """What `kill -9` does, as far as one process can do it to itself."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, sphere_dataset: Dataset) -> Path:
    """A fit with four snapshots."""
    folder = tmp_path_factory.mktemp("runs") / "sphere"
    fit(sphere_dataset, CONFIG, folder, MARKS)
    return folder


@pytest.fixture(scope="module")
def prediction(tmp_path_factory: pytest.TempPathFactory, run: Path, sphere_dataset: Dataset) -> Path:
    """Its prediction, with snapshots."""
    folder = tmp_path_factory.mktemp("predictions") / "sphere"
    state = load_state(run)
    assert state is not None
    export_prediction(sphere_dataset, state, CONFIG, folder)
    export_snapshots(sphere_dataset, run, CONFIG, folder)
    return folder


def moments(run: Path) -> list[int]:
    return [int(folder.name) for folder in snapshot_folders(run)]


@pytest.mark.parametrize(("count", "iterations"), [(0, 5), (1, 1), (3, 1000), (6, 45_000), (9, 7)])
def test_marks_halve_down_from_the_end(count: int, iterations: int) -> None:
    marks = sorted(snapshot_schedule(count, (), iterations).iterations, reverse=True)
    assert marks[:1] == [iterations][:count]
    assert all(2 * later - earlier in (0, 1) for earlier, later in pairwise(marks))
    assert len(marks) == min(count, len(marks)) == len(set(marks))
    assert all(mark >= 1 for mark in marks)


@pytest.mark.parametrize(("count", "seconds"), [(-1, ()), (0, (0.0,)), (2, (5.0, float("nan"))), (0, (float("inf"),))])
def test_impossible_marks_are_refused(count: int, seconds: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="--snapshots"):
        snapshot_schedule(count, seconds, 100)


def test_each_mark_leaves_one_snapshot(run: Path) -> None:
    assert moments(run) == sorted(MARKS.iterations)
    for folder in snapshot_folders(run):
        state = read_snapshot(folder)
        assert state.iteration == int(folder.name)
        assert state.environment is None
        assert len(state.curves["iteration"]) == (state.iteration + 9) // 10


def test_time_only_grows_and_ends_before_the_final_solve(run: Path) -> None:
    final = load_state(run)
    assert final is not None
    optimizing = [read_snapshot(folder).seconds["optimize"] for folder in snapshot_folders(run)]
    assert optimizing == sorted(set(optimizing))
    assert optimizing[-1] == final.seconds["optimize"]
    assert "solve environment" not in read_snapshot(snapshot_folders(run)[-1]).seconds


def test_a_snapshot_is_small(run: Path) -> None:
    """It leaves out the moments of Adam, two numbers for each parameter."""
    size = (snapshot_folders(run)[-1] / "checkpoint.pt").stat().st_size
    assert size < 0.6 * (run / "checkpoint.pt").stat().st_size


def test_the_last_snapshot_is_the_result(prediction: Path) -> None:
    last = exported_snapshots(prediction)[-1]
    assert int(last.name) == CONFIG.splats.iterations
    for name in ("environment.exr", "visibility.exr", "surfels.ply", "test/r_000.exr", "test/r_000.png"):
        assert (last / name).read_bytes() == (prediction / name).read_bytes(), name
    first = exported_snapshots(prediction)[0]
    assert (first / "environment.exr").read_bytes() != (prediction / "environment.exr").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_completing_the_last_snapshot_completes_the_fit(
    preset: str, tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the environment is what gradient descent left, and visibility what all iterations saw."""
    monkeypatch.setattr(train, "OBSERVED_ALPHA", 0.0)
    config = tiny_config(preset, iterations=6, count=120)
    final = fit(sphere_dataset, config, tmp_path, snapshot_schedule(2, (), 6))
    views = load_views(sphere_dataset, config.crop_margin_px)
    early, late = (read_snapshot(folder) for folder in snapshot_folders(tmp_path))
    for state in (early, late):
        complete(state, views, config)
    for name in ("environment", "visibility"):
        assert torch.equal(getattr(late, name), getattr(final, name)), name
        assert not torch.equal(getattr(early, name), getattr(final, name)), name


def test_the_time_of_a_snapshot_includes_its_solve(run: Path, prediction: Path) -> None:
    for source, target in zip(snapshot_folders(run), exported_snapshots(prediction), strict=True):
        info, state = read_info(target), read_snapshot(source)
        assert info.iteration == state.iteration
        assert set(info.seconds) == {*state.seconds, "solve environment"}
        assert info.seconds["solve environment"] > 0
        assert sum(info.seconds.values()) > sum(state.seconds.values()) - 1e-2


def test_a_snapshot_is_solved_like_an_end(run: Path, sphere_dataset: Dataset) -> None:
    """Its environment is the closed-form map of its own geometry, not that of the finished fit."""
    state, views = read_snapshot(snapshot_folders(run)[0]), load_views(sphere_dataset, CONFIG.crop_margin_px)
    with torch.no_grad():
        expected, _ = state.geometry.solve_map(views, CONFIG)
    complete(state, views, CONFIG)
    assert state.environment is not None
    assert torch.equal(state.environment, expected)


def test_the_format_tells_results_from_snapshots(prediction: Path) -> None:
    assert read_info(prediction).iteration is None
    assert prediction_folders(prediction) == [prediction]
    assert prediction_folders(prediction.parent) == [prediction]
    assert len(exported_snapshots(prediction)) == len(MARKS.iterations)


def test_exporting_again_keeps_what_is_there(run: Path, prediction: Path, sphere_dataset: Dataset, monkeypatch) -> None:
    def forbidden(*_) -> None:
        raise AssertionError("nothing is left to solve")

    monkeypatch.setattr("panoless.export.prediction.complete", forbidden)
    assert export_snapshots(sphere_dataset, run, CONFIG, prediction) == exported_snapshots(prediction)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_killed_fit_has_the_same_snapshots(preset: str, tmp_path: Path, sphere_dataset: Dataset, monkeypatch) -> None:
    """The fit is killed right after snapshots that its checkpoint does not know yet."""
    config = tiny_config(preset, iterations=24, count=120)
    marks = SnapshotSchedule(frozenset({5, 9, 10, 24}))
    fit(sphere_dataset, config, tmp_path / "whole", marks)
    step, save = SurfelTrainer._step, recorder_module.save_state

    def save_sometimes(folder: Path, state: FitState) -> None:
        if state.iteration % 4 == 0 or folder.parent.name == SNAPSHOTS:
            save(folder, state)

    for stop in (6, 10, 11):

        def step_until(self: SurfelTrainer, iteration: int, stop: int = stop) -> LossTerms:
            if iteration == stop:
                raise Killed
            return step(self, iteration)

        with monkeypatch.context() as patch:
            patch.setattr(recorder_module, "CHECKPOINT_INTERVAL_S", -1.0)
            patch.setattr(recorder_module, "save_state", save_sometimes)
            patch.setattr(SurfelTrainer, "_step", step_until)
            with pytest.raises(Killed):
                fit(sphere_dataset, config, tmp_path / "pieces", marks)
    fit(sphere_dataset, config, tmp_path / "pieces", marks)
    assert moments(tmp_path / "pieces") == moments(tmp_path / "whole") == [5, 9, 10, 24]
    for first, second in zip(*(snapshot_folders(tmp_path / name) for name in ("pieces", "whole")), strict=True):
        one, other = read_snapshot(first), read_snapshot(second)
        for name, value in one.geometry.state_dict()["surfels"].items():
            assert torch.equal(value, other.geometry.state_dict()["surfels"][name]), name
        assert one.training is not None
        assert other.training is not None
        assert torch.equal(one.training.environment, other.training.environment)
        assert torch.equal(one.training.evidence, other.training.evidence)
        assert one.curves == other.curves


def state_at(iteration: int, seconds: float) -> FitState:
    return FitState(
        SurfelMirror(sphere_surfels(3)),
        ObjectFrame(np.zeros(3), 1.0),
        Selection("surfels", ()),
        Training(torch.zeros(6, 3, 2, 2), torch.zeros(6, 2, 2), iteration),
        seconds={"read views": 0.5, "optimize": seconds - 0.5},
    )


def test_marks_in_seconds_come_once_however_often_the_fit_is_killed(tmp_path: Path) -> None:
    """A step may pass several marks, and a resumed fit passes them again, at other iterations. What reading again
    passes is taken at the first step.
    """
    marks = SnapshotSchedule(seconds=(0.4, 2.0, 4.0, 4.5, 20.0))

    def go(begin: tuple[int, float], steps: list[tuple[int, float]], before: float) -> None:
        state = state_at(*begin)
        recorder = Recorder(tmp_path, marks, state, before)
        for iteration, seconds in steps:
            after = state_at(iteration, seconds)
            took = seconds - sum(state.seconds.values())
            recorder.after_step(iteration, took, lambda after=after: (after.geometry, after.training))

    go((0, 0.6), [(1, 1.5), (2, 2.0), (3, 3.8), (4, 5.0), (5, 6.0)], before=0.0)
    assert moments(tmp_path) == [1, 2, 4]
    # The checkpoint was at the third step, and the fourth is faster this time.
    go((3, 3.9), [(4, 3.95), (5, 4.7), (6, 5.0)], before=3.8)
    assert moments(tmp_path) == [1, 2, 5]
    # A checkpoint after the last snapshot leaves all of them.
    go((6, 5.1), [(7, 6.0)], before=5.0)
    assert moments(tmp_path) == [1, 2, 5]
    # Reading took from 3.8 to 4.2 seconds.
    go((3, 4.2), [(4, 4.3)], before=3.8)
    assert moments(tmp_path) == [1, 2, 4]


def test_a_resumed_fit_counts_reading_each_time(tmp_path: Path, sphere_dataset: Dataset, monkeypatch) -> None:
    config, step = tiny_config(iterations=4, count=40), SurfelTrainer._step

    def step_until(self: SurfelTrainer, iteration: int) -> LossTerms:
        if iteration == 2:
            raise Killed
        return step(self, iteration)

    with monkeypatch.context() as patch:
        patch.setattr(recorder_module, "CHECKPOINT_INTERVAL_S", -1.0)
        patch.setattr(SurfelTrainer, "_step", step_until)
        with pytest.raises(Killed):
            fit(sphere_dataset, config, tmp_path / "run")
    killed = load_state(tmp_path / "run")
    assert killed is not None
    assert fit(sphere_dataset, config, tmp_path / "run").seconds["read views"] > killed.seconds["read views"]


def test_a_finished_run_without_snapshots_says_so(tmp_path: Path, sphere_dataset: Dataset) -> None:
    config = tiny_config(iterations=4, count=40)
    fit(sphere_dataset, config, tmp_path / "run")
    with pytest.raises(InputError, match="ran without"):
        fit(sphere_dataset, config, tmp_path / "run", snapshot_schedule(2, (), config.splats.iterations))
    with pytest.raises(InputError, match="--snapshots"):
        export_snapshots(sphere_dataset, tmp_path / "run", config, tmp_path / "prediction")


def test_the_commands_take_and_export_snapshots(
    tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    options = ["--config.iterations", "4", "--config.surfels.count", "40"]
    options += ["--config.environment.resolution", "16", "--config.environment.solve-resolution", "16"]
    options += ["--model", "surfels", "--set", "first_surface.hull_resolution=24", "surroundings.mode=off"]
    assert main(["fit", str(sphere_dataset.root), "--output", "p", "--snapshots", "2", *options]) == 0
    assert "panoless export runs/p --output p --snapshots" in capsys.readouterr().out
    assert main(["export", "runs/p", "--output", "p", "--snapshots"]) == 0
    assert [folder.name for folder in exported_snapshots(tmp_path / "p")] == ["000002", "000004"]
    assert read_info(tmp_path / "p").config == read_info(exported_snapshots(tmp_path / "p")[0]).config
    assert "snapshots" not in asdict(CONFIG)


@pytest.mark.parametrize(
    ("model", "name"),
    [("plane", "a plane"), pytest.param("revolution", "a surface of revolution", marks=pytest.mark.slow)],
)
def test_what_takes_no_steps_has_no_snapshots_and_the_command_says_why(
    model: str,
    name: str,
    tmp_path: Path,
    many_views_dataset: Dataset,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    options = [
        "--model",
        model,
        "--config.environment.solve-resolution",
        "16",
        "--set",
        "corrections.poses=off",
        "corrections.masks=off",
        "corrections.exposure=off",
        "corrections.lens=off",
        "surroundings.mode=off",
        "material.reflectance=off",
        "material.roughness=off",
        "material.blur=off",
    ]
    assert main(["fit", str(many_views_dataset.root), "--output", "p", "--snapshots", "2", *options]) == 0
    assert f"No snapshots: this run took {name}" in capsys.readouterr().out
    assert main(["export", "runs/p", "--output", "p", "--snapshots"]) == 2
    assert f"took {name}, which is fitted without steps" in capsys.readouterr().err
