"""The command line: help, bad usage, exit codes, and the newest folder where none is named."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from shinypartial.cli import main
from shinypartial.dataset.schema import Dataset

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = (
    "generate",
    "film",
    "align",
    "subset",
    "perturb",
    "validate",
    "evaluate",
    "evaluate-direct",
    "report",
    "release",
    "leaderboard",
    "oracle",
    "postprocess",
    "convert",
    "compare",
    "weights",
    "stability",
)


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    assert f"shinypartial {command}" in capsys.readouterr().out


def test_help_lists_all_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(command in out for command in COMMANDS)


def test_help_costs_little_more_than_the_libraries_that_print_it() -> None:
    """A ratio of times that are measured in turn: a slow machine slows both."""

    def taken(*arguments: str) -> float:
        start = time.perf_counter()
        subprocess.run([sys.executable, *arguments], cwd=ROOT, check=True, capture_output=True)
        return time.perf_counter() - start

    # Measured 2.4 on an idle machine; with scipy loaded it is 4.
    pairs = ((taken("-m", "shinypartial.cli", "--help"), taken("-c", "import numpy, tyro")) for _ in range(4))
    assert min(help_s / libraries_s for help_s, libraries_s in pairs) < 3


@pytest.mark.parametrize("arguments", [["--help"], ["generate", "--help"]], ids=" ".join)
def test_a_reader_that_stops_early_is_no_error(arguments: list[str]) -> None:
    """As in `shinypartial --help | head -1`: the pipe has no reader when the help is written."""
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, "-m", "shinypartial.cli", *arguments]
    done = subprocess.run(command, cwd=ROOT, stdout=write_end, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (0, "")


BAD_USAGE = {
    "no command": [],
    "unknown command": ["paint"],
    "no scene": ["generate"],
    "unknown option": ["generate", "--scene", "vase", "--lens", "50"],
    "not a number": ["generate", "--scene", "vase", "--resolution", "big"],
    "not whole": ["generate", "--scene", "vase", "--train", "1.5"],
}


@pytest.mark.parametrize("arguments", BAD_USAGE.values(), ids=BAD_USAGE.keys())
def test_bad_usage_exits_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    assert out + err


BAD_INPUT = {
    "unknown scene": (["generate", "--scene", "no-such-scene"], "vase"),
    "too small": (["generate", "--scene", "vase", "--resolution", "0"], "render.resolution"),
    "no views": (["generate", "--scene", "vase", "--train", "0"], "camera.train"),
    "no recipe": (["generate", "--scene", "none/scene.toml"], "Check the path"),
    "no dataset": (["validate", "none"], "nothing there"),
}


@pytest.mark.parametrize(("arguments", "advice"), BAD_INPUT.values(), ids=BAD_INPUT.keys())
def test_bad_input_exits_with_2_and_advice(
    arguments: list[str], advice: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert advice in err
    assert "Traceback" not in err


@pytest.mark.parametrize("command", ["validate", "evaluate", "report", "oracle"])
def test_nothing_to_work_on_says_how_to_make_it(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([command]) == 2
    assert re.search("shinypartial generate|panoless fit", capsys.readouterr().err)


def test_validate_passes_a_sound_dataset(sphere_dataset: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", str(sphere_dataset.root)]) == 0
    assert "keeps every promise" in capsys.readouterr().out


def test_validate_lists_breaks_and_exits_with_2(damaged_dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (damaged_dataset / "train/r_000.png").unlink()
    assert main(["validate", str(damaged_dataset)]) == 2
    out, err = capsys.readouterr()
    assert "train/r_000.png" in out
    assert "2 broken promises" in err, "The frame and the checksum list both miss the file."


def test_validate_takes_the_newest_dataset_and_says_so(
    sphere_dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "datasets").mkdir()
    (tmp_path / "datasets" / "sphere").symlink_to(sphere_dataset.root)
    monkeypatch.chdir(tmp_path)
    assert main(["validate"]) == 0
    assert "Newest dataset: datasets/sphere" in capsys.readouterr().out
