"""What the user causes becomes one message and exit code 2; our own mistakes stay loud."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from shinypartial.cli import main
from shinypartial.core.errors import EXIT_BAD_INPUT, EXIT_INTERRUPTED, InputError, from_os_error, run_command


def raising(error: BaseException):
    """A command that fails in this way."""

    def command() -> None:
        raise error

    return command


def test_success_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(lambda: None) == 0
    assert capsys.readouterr() == ("", "")


def test_bad_input_is_one_message_on_stderr(capsys: pytest.CaptureFixture[str]) -> None:
    error = InputError(expected="a folder", found="a file", remedy="Choose another.")
    assert run_command(raising(error)) == EXIT_BAD_INPUT == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [
        "error: expected a folder",
        "       found    a file",
        "       remedy   Choose another.",
    ]


@pytest.mark.parametrize(
    ("number", "advice"),
    [
        (errno.ENOSPC, "Free some space"),
        (errno.EDQUOT, "Free some space"),
        (errno.EACCES, "permissions"),
        (errno.EROFS, "permissions"),
        (errno.EISDIR, "permissions"),
        (errno.ENOENT, "Check the path"),
    ],
)
def test_failed_file_operations_have_a_remedy(capsys: pytest.CaptureFixture[str], number: int, advice: str) -> None:
    assert run_command(raising(OSError(number, "the reason", "out/r_000.exr"))) == EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert "out/r_000.exr" in err
    assert advice in err
    assert "Traceback" not in err


def test_an_os_error_without_a_name_still_reads_well() -> None:
    error = from_os_error(OSError(errno.ENOSPC, "No space left on device"))
    assert error.expected == "enough free space to write the output folder"


def test_an_interrupt_says_how_to_go_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(raising(KeyboardInterrupt())) == EXIT_INTERRUPTED == 130
    assert "Run the same command again" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments", [["validate", "missing"], ["evaluate", "missing"], ["paint"], ["evaluate", "--no"]]
)
def test_the_command_line_ends_with_code_2_and_no_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == EXIT_BAD_INPUT
    out, err = capsys.readouterr()
    assert err or out
    assert "Traceback" not in out + err


def test_our_own_mistakes_are_not_hidden() -> None:
    with pytest.raises(ZeroDivisionError):
        run_command(raising(ZeroDivisionError()))


@pytest.mark.parametrize(
    "command",
    ["shinypartial.cli --help", "shinypartial.cli report --help", "panoless.cli --help", "panoless.cli fit --help"],
)
def test_help_that_is_cut_off_by_a_pipe_is_no_error(command: str) -> None:
    """As in `panoless fit --help | head -1`: nobody reads the pipe by the time that help is written, or flushed."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as closed:
        done = subprocess.run(
            [sys.executable, "-m", *command.split()], stdout=closed, stderr=subprocess.PIPE, text=True
        )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("[enforce fail at alloc_cpu.cpp:121] data. DefaultCPUAllocator: can't allocate memory"),
        RuntimeError("CUDA out of memory. Tried to allocate 20.00 GiB"),
    ],
)
def test_too_little_memory_is_one_message(capsys: pytest.CaptureFixture[str], error: BaseException) -> None:
    assert run_command(raising(error)) == EXIT_BAD_INPUT
    assert "enough memory" in capsys.readouterr().err


def test_another_runtime_error_stays_loud() -> None:
    with pytest.raises(RuntimeError, match="ours"):
        run_command(raising(RuntimeError("a mistake of ours")))
