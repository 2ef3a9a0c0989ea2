"""Help of both programs fits a screen, and nothing that it leaves out is lost."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, get_type_hints

import pytest

import panoless
import shinypartial
from panoless.cli import PROGRAM as PANOLESS
from shinypartial.cli import PROGRAM as SHINYPARTIAL
from shinypartial.core.program import Program

ROOT = Path(__file__).resolve().parents[3]
SCREEN_LINES, SCREEN_COLUMNS = 50, 80
SHORT_HELP_LISTS = 12
COMMANDS = [
    pytest.param(program, name, kind, id=f"{program.name} {name}")
    for program in (PANOLESS, SHINYPARTIAL)
    for group in program.groups.values()
    for name, kind in group.items()
]


def lines_of_help(program: Program, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> list[str]:
    assert program.main(arguments) == 0
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize(("program", "name", "kind"), COMMANDS)
def test_help_of_a_command_fits_a_screen_and_shows_what_is_used_most(
    program: Program, name: str, kind: type, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(SCREEN_COLUMNS))
    lines = lines_of_help(program, [name, "--help"], capsys)
    assert len(lines) <= SCREEN_LINES
    shown = getattr(kind, "FIRST", "").split()
    assert len(shown) <= SHORT_HELP_LISTS
    everything = lines_of_help(program, [name, "--help-all"], capsys)
    assert len(everything) > len(lines) if shown else everything == lines
    for path in shown:
        assert type_of(kind, path)
        option = path.rpartition(".")[2].replace("_", "-")
        assert any(f"{option} " in line for line in lines) or is_positional(kind, path), path


def type_of(kind: Any, path: str) -> Any:
    """Of a field, by the names that lead there."""
    for name in path.split("."):
        assert name in {each.name for each in dataclasses.fields(kind)}, path
        kind = get_type_hints(kind)[name]
    return kind


def is_positional(kind: Any, path: str) -> bool:
    return "Positional" in str(get_type_hints(kind, include_extras=True).get(path))


@pytest.mark.parametrize("program", [PANOLESS, SHINYPARTIAL], ids=lambda program: program.name)
def test_the_program_names_its_commands_on_a_screen_and_its_version(
    program: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = lines_of_help(program, ["--help"], capsys)
    assert len(lines) <= SCREEN_LINES
    for group in program.groups.values():
        for name in group:
            assert any(line.startswith(f"  {name} ") for line in lines), name
    assert program.main(["--version"]) == 0
    assert capsys.readouterr().out == f"{program.name} {shinypartial.__version__}\n"
    assert panoless.__version__ == shinypartial.__version__


def test_a_terminal_that_knows_ascii_alone_is_no_error() -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "COLUMNS": str(SCREEN_COLUMNS)}
    command = [sys.executable, "-m", "panoless.cli", "fit", "--help"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert len(done.stdout.splitlines()) <= SCREEN_LINES


@pytest.mark.parametrize(("program", "name", "kind"), COMMANDS)
def test_the_example_of_a_command_is_shown_and_understood(
    program: Program, name: str, kind: type, capsys: pytest.CaptureFixture[str]
) -> None:
    words = program.examples[name]
    assert lines_of_help(program, [name, "--help"], capsys)[-1] == f"example: {program.name} {name} {words}"
    assert isinstance(program.parse([name, *words.split()]), kind)
