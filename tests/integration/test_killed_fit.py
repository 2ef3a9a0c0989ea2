"""A fit that the system kills at any moment continues with the same command, and ends as if nothing had happened."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from panoless.cli import main
from panoless.reconstruct.state import load_state
from shinypartial.dataset.schema import Dataset
from shinypartial.prediction.format import read_info

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
    options += ["--config.surfels.hull-resolution", "24", "--config.environment.resolution", "16"]
    options += ["--config.environment.solve-resolution", "16"]
    options += ["--set", "surroundings.mode=off", "material.reflectance=off"]
    return ["fit", str(dataset.root), "--output", output, *options]


def start(dataset: Dataset, place: Path, output: str) -> subprocess.Popen[str]:
    """The command in a process of its own, with frequent checkpoints."""
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *command(dataset, output)],
        cwd=place,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_WAIT_POLICY": "PASSIVE"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(path: Path, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 120
    while not path.exists():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_killed_fit_continues(tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """In another process, as one ends that nobody killed."""
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "killed"
    process = start(sphere_dataset, tmp_path, "killed")
    wait_for(run / "checkpoint.pt", process)
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


def test_two_fits_do_not_write_to_one_folder(
    tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second is refused with one message and harms nothing; the first ends as if it had been alone."""
    monkeypatch.chdir(tmp_path)
    process = start(sphere_dataset, tmp_path, "one")
    wait_for(tmp_path / "runs" / "one" / "checkpoint.pt", process)
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
