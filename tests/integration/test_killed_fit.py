"""A fit that the system kills at any moment continues with the same command, and ends as if nothing had happened."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from panoless.cli import main
from panoless.config import FitConfig, with_overrides
from panoless.geometry.registry import FAMILIES
from panoless.journal import FOLDER as JOURNAL
from panoless.reconstruct import recorder
from panoless.reconstruct.fit import fit
from panoless.reconstruct.state import FitState, load_state
from shinypartial.cli import main as benchmark
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import Dataset
from shinypartial.prediction.format import read_info
from tests.support.mirror_sphere import tiny_config

ROOT = Path(__file__).resolve().parents[2]
ITERATIONS = 150
PROGRAM = """
import sys
from panoless.cli import main
from panoless.reconstruct import recorder
recorder.CHECKPOINT_INTERVAL_S = 0.05
sys.exit(main(sys.argv[1:]))
"""


def command(dataset: Dataset, output: str) -> list[str]:
    """A fit of many short steps, and little beside them."""
    options = ["--model", "surfels", "--config.iterations", str(ITERATIONS), "--config.surfels.count", "100"]
    options += ["--config.environment.resolution", "16"]
    options += ["--config.environment.solve-resolution", "16"]
    options += [
        "--set",
        "first_surface.hull_resolution=24",
        "surroundings.mode=off",
        "material.reflectance=off",
    ]
    options += ["corrections.masks=off", "corrections.exposure=off", "corrections.lens=off"]
    return ["fit", str(dataset.root), "--output", output, *options]


def start(dataset: Dataset, place: Path, output: str, *options: str) -> subprocess.Popen[str]:
    """The command in a process of its own, with frequent checkpoints."""
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *command(dataset, output), *options],
        cwd=place,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_WAIT_POLICY": "PASSIVE"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(folder: Path, pattern: str, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 120
    while not list(folder.glob(pattern)):
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_killed_fit_continues(tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """In another process, as one ends that nobody killed."""
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "killed"
    process = start(sphere_dataset, tmp_path, "killed")
    wait_for(run, "checkpoint.pt", process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    state = load_state(run)
    assert state is not None
    assert 0 < state.iteration < ITERATIONS
    assert not (tmp_path / "killed" / "prediction.json").exists()

    for output in ("killed", "whole"):
        assert main(command(sphere_dataset, output)) == 0
    first, second = (tmp_path / name for name in ("killed", "whole"))
    assert read_info(first).curves == read_info(second).curves
    for name in ("environment.exr", "visibility.exr", "surfels.ply", "test/r_001.png"):
        assert (first / name).read_bytes() == (second / name).read_bytes(), name
    assert not list(tmp_path.rglob(".partial-*"))


@pytest.mark.slow
def test_kinds_that_were_examined_before_a_kill_are_not_fitted_again(
    tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The model is chosen before there is a checkpoint; what is found then is as if nothing had happened."""
    monkeypatch.chdir(tmp_path)
    run, auto = tmp_path / "runs" / "killed", ("--model", "auto")
    process = start(sphere_dataset, tmp_path, "killed", *auto)
    wait_for(run, f"{JOURNAL}/_examine-*.pt", process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert not (run / "checkpoint.pt").exists()

    for output in ("killed", "whole"):
        assert main([*command(sphere_dataset, output), *auto]) == 0
        found_before = "Stage 1 of at most 6: a sphere: found before" in capsys.readouterr().err
        assert found_before == (output == "killed")
        assert not (tmp_path / "runs" / output / JOURNAL).exists()
    first, second = (tmp_path / name for name in ("killed", "whole"))
    for name in ("environment.exr", "visibility.exr", "sphere.ply", "test/r_001.png"):
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


SHORT = {"free_form": ("free_form.concavities=false", "free_form.starts=false", "free_form.finest_cells=20")}
BELIEVED = "corrections.masks=off", "corrections.exposure=off", "corrections.lens=off", "corrections.poses=off"


def short_config(kind: str) -> FitConfig:
    """A fit of few steps; of spheres with all that is required of photographs."""
    weighted = () if kind == "sphere" else BELIEVED
    return with_overrides(tiny_config(), (f"model={kind}", *SHORT.get(kind, ()), *weighted))


def numbers(state: FitState) -> list[object]:
    """All that a fit found, to the last bit."""
    assert state.environment is not None
    assert state.visibility is not None
    found = torch.utils._pytree.tree_leaves([state.geometry.state_dict(), state.environment, state.visibility])
    plain = [each.tolist() if isinstance(each, torch.Tensor) else each for each in found]
    return [*plain, state.selection.sentence, state.verdict]


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="the system has no timers of processor time")
@pytest.mark.slow
@pytest.mark.parametrize("kind", [*FAMILIES, "surfels", "auto"])
@pytest.mark.timeout(3600)
# Python ignores an interruption within the callback of a weak reference; that part goes on to its end.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_fit_ends_in_parts_that_are_each_too_short_for_it(
    tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Interrupted after 0.4 to 0.7 of its processor time again and again, a fit that began again would never end. This
    one ends, as if it had not been interrupted, on one thread: two have other last digits.
    """
    monkeypatch.setattr(recorder, "CHECKPOINT_INTERVAL_S", 0.2)
    config, threads, dataset = short_config(kind), torch.get_num_threads(), sphere_dataset
    if kind in ("revolution", "auto"):  # A sphere has no axis, and is taken before anything else is tried.
        assert benchmark(["perturb", "tiny-vase", "--views.keep", "12", "--output", str(tmp_path / "vase")]) == 0
        dataset = open_dataset(tmp_path / "vase")

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    before, chance = signal.signal(signal.SIGPROF, stop), random.Random(kind)
    torch.set_num_threads(1)
    try:
        fit(dataset, config, tmp_path / "compiled")
        begun = time.process_time()
        whole = fit(dataset, config, tmp_path / "whole")
        seconds, notes, ended = time.process_time() - begun, list[str](), None
        while ended is None:
            assert len(notes) < 30
            signal.setitimer(signal.ITIMER_PROF, chance.uniform(0.4, 0.7) * seconds)
            try:
                ended = fit(dataset, config, tmp_path / "parts")
            except KeyboardInterrupt as interruption:
                notes += interruption.__notes__
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
    finally:
        torch.set_num_threads(threads)
        signal.signal(signal.SIGPROF, before)
    assert notes
    assert all("It repeats the work of the last" in each for each in notes)
    assert numbers(ended) == numbers(whole)


def test_two_fits_do_not_write_to_one_folder(
    tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second is refused with one message and harms nothing; the first ends as if it had been alone."""
    monkeypatch.chdir(tmp_path)
    process = start(sphere_dataset, tmp_path, "one")
    wait_for(tmp_path / "runs" / "one", "checkpoint.pt", process)
    process.send_signal(signal.SIGSTOP)
    try:
        # The prediction folder, then the run folder alone: another working folder could name the same prediction.
        assert main(command(sphere_dataset, "one")) == 2
        errors = capsys.readouterr().err
        assert "another run that is writing there" in errors
        assert "Traceback" not in errors
        assert main(command(sphere_dataset, "elsewhere/one")) == 2
        assert f"writes to {Path('runs/one')}" in capsys.readouterr().err
    finally:
        process.send_signal(signal.SIGCONT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert read_info(tmp_path / "one")
