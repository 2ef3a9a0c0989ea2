"""The progress line, with and without a terminal."""

import io

import pytest

from shinypartial.io import progress
from shinypartial.io.progress import Progress, format_seconds

START_S = 1000.0


class Terminal(io.StringIO):
    """A stream that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A clock that the test moves: `clock[0]` in seconds."""
    now = [START_S]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 00 s"), (185, "3 min 05 s"), (7322, "122 min 02 s")],
)
def test_seconds(seconds: float, text: str) -> None:
    assert format_seconds(seconds) == text


def test_without_a_terminal_lines_are_plain_and_rare(clock: list[float]) -> None:
    stream = io.StringIO()
    bar = Progress("render", 100, stream=stream, _start_s=START_S)
    for _ in range(100):
        clock[0] += 1
        bar.advance()
    lines = stream.getvalue().splitlines()
    assert "\r" not in stream.getvalue()
    assert "\x1b" not in stream.getvalue()
    assert len(lines) == 11, "One line at once, one every 10 s, one at the end."
    assert lines[-1].endswith("100/100  took 1 min 40 s")


def test_on_a_terminal_one_line_is_rewritten(clock: list[float]) -> None:
    stream = Terminal()
    bar = Progress("render", 3, stream=stream, _start_s=START_S)
    for _ in range(3):
        clock[0] += 1
        bar.advance()
    assert stream.getvalue().count("\r\x1b[2K") == 3
    assert stream.getvalue().count("\n") == 1
    assert stream.getvalue().endswith("\n")


def test_the_time_left_is_the_mean_step_times_the_steps_left(clock: list[float]) -> None:
    bar = Progress("fit", 10, stream=io.StringIO(), _start_s=START_S)
    clock[0] += 8
    bar.advance(steps=4)
    assert "4/10  12 s left" in bar.line(clock[0])


def test_work_of_an_earlier_run_does_not_count_as_speed(clock: list[float]) -> None:
    bar = Progress("render", 100, done=90, stream=io.StringIO(), _start_s=START_S)
    assert "estimating" in bar.line(clock[0])
    clock[0] += 3
    bar.advance()
    assert "91/100  27 s left" in bar.line(clock[0])


def test_the_note_is_shown(clock: list[float]) -> None:
    stream = io.StringIO()
    Progress("fit", 1, stream=stream, _start_s=START_S).advance("loss 0.1")
    assert stream.getvalue().endswith("took 0 s  loss 0.1\n")
