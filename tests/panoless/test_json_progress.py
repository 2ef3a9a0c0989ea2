"""What other programs read while a command runs: every line by its schema, the last one by how it ended."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from panoless.cli import main
from shinypartial.cli import main as benchmark
from shinypartial.dataset.schema import Dataset
from shinypartial.io.events import schema
from shinypartial.prediction.format import read_info
from tests.support.interrupts import heed_interrupts

ROOT = Path(__file__).resolve().parents[2]
SCHEMA = ROOT / "docs" / "reference" / "json-progress.schema.json"
SHORT = ["--model", "surfels", "--config.iterations", "30", "--config.surfels.count", "100"]
SHORT += ["--config.environment.resolution", "16", "--config.environment.solve-resolution", "16", "--set"]
SHORT += ["surroundings.mode=off", "material.reflectance=off", "corrections.masks=off"]
SHORT += ["corrections.exposure=off", "corrections.lens=off", "first_surface.hull_resolution=24"]


def checked(lines: Iterator[str] | list[str]) -> list[dict[str, Any]]:
    """The events, every one by the schema that is documented."""
    validator = jsonschema.Draft202012Validator(json.loads(SCHEMA.read_text(encoding="utf-8")))
    events = [json.loads(line) for line in lines]
    for event in events:
        validator.validate(event)
    assert events[0] | {"version": ""} == {
        "event": "start",
        "command": events[0]["command"],
        "version": "",
        "format": "panoless-progress",
        "format_version": 1,
    }
    return events


def command(dataset: Dataset) -> list[str]:
    return ["fit", str(dataset.root), "--output", "p", "--json-progress", *SHORT]


def start(dataset: Dataset, place: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "panoless.cli", *command(dataset)],
        cwd=place,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_WAIT_POLICY": "PASSIVE"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heed_interrupts,
    )


def test_the_documented_schema_is_that_of_the_code() -> None:
    assert json.loads(SCHEMA.read_text(encoding="utf-8")) == schema()


@pytest.mark.parametrize(
    "wrong",
    [
        {"event": "progress", "stage": "a", "done": 1, "total": 2, "note": ""},
        {"event": "stage", "stage": "", "found_before": False},
        {"event": "of the future"},
        {"event": "result", "paths": {}, "lines": [], "next": [], "verdict": {"verdict": "sure", "reason": "a"}},
    ],
)
def test_the_schema_refuses_other_lines(wrong: dict[str, Any]) -> None:
    assert not jsonschema.Draft202012Validator(schema()).is_valid(wrong)


def test_a_whole_fit_in_lines(
    tmp_path: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(command(sphere_dataset)) == 0
    *events, last = checked(capsys.readouterr().out.splitlines())
    assert (last["event"], last["paths"]["prediction"]) == ("result", str(tmp_path / "p"))
    assert last["paths"]["run"] == str(tmp_path / "runs" / "p")
    verdict = read_info(tmp_path / "p").verdict
    assert verdict is not None
    assert last["verdict"] == {"verdict": verdict.verdict, "reason": verdict.reason, "remedy": verdict.remedy}
    steps = [each for each in events if each["event"] == "progress" and each["total"] == 30]
    assert [each["done"] for each in steps] == sorted({each["done"] for each in steps})
    assert steps[-1]["done"] == 30
    assert steps[-1]["seconds_left"] == 0
    assert any(each["event"] == "note" and each["text"].startswith("Model: ") for each in events)

    assert benchmark(["evaluate", "p", "--json-progress"]) == 0
    last = checked(capsys.readouterr().out.splitlines())[-1]
    assert Path(last["paths"]["scores"]).is_file()
    assert last["lines"]


@pytest.mark.slow
def test_a_whole_light_in_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the photographs that come with the package."""
    monkeypatch.chdir(tmp_path)
    assert main(["light", "lobby-ball", "--output", "light", "--json-progress"]) == 0
    *events, last = checked(capsys.readouterr().out.splitlines())
    assert (events[0]["command"], last["event"]) == ("light", "result")
    assert all(Path(path).exists() for path in last["paths"].values())
    assert {"folder", "dataset", "prediction", "light.hdr", "light.exr"} <= last["paths"].keys()
    assert last["verdict"] is not None


@pytest.mark.parametrize("name", ["fit", "capture", "light"])
def test_bad_input_in_lines(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, str(tmp_path / "nothing"), "--json-progress"]) == 2
    captured = capsys.readouterr()
    first, last = checked(captured.out.splitlines())
    assert (first["command"], last["event"]) == (name, "error")
    assert f"expected {last['expected']}" in captured.err


def test_plain_commands_write_no_events(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["fit", str(sphere_dataset.root), "--output", "p", *SHORT]) == 0
    assert "{" not in capsys.readouterr().out


@pytest.mark.parametrize("way", ["interrupt", pytest.param("close the pipe", marks=pytest.mark.slow)])
def test_a_cancelled_fit_continues(
    way: str,
    tmp_path: Path,
    sphere_dataset: Dataset,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    process, lines = start(sphere_dataset, tmp_path), []
    assert process.stdout is not None
    for line in process.stdout:
        lines.append(line)
        if json.loads(line).get("event") == "stage":
            break
    if way == "interrupt":
        process.send_signal(signal.SIGINT)
        lines += process.stdout
        assert checked(lines)[-1]["event"] == "cancelled"
    else:
        process.stdout.close()
        process.stdout = None
    _, log = process.communicate(timeout=120)
    assert (process.returncode, "Traceback" in log) == (130, False), log
    assert not (tmp_path / "p" / "prediction.json").exists()

    monkeypatch.chdir(tmp_path)
    assert main(command(sphere_dataset)) == 0
    assert checked(capsys.readouterr().out.splitlines())[-1]["event"] == "result"
