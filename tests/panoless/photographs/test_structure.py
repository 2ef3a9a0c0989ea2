"""Structure from motion runs as a program of its own: its steps are shown, its crash is a message, Ctrl-C ends it."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from panoless.photographs.frames import Frames, Photograph
from panoless.photographs.posed import Poses
from panoless.photographs.structure import poses_from_structure
from shinypartial.core.errors import InputError
from tests.support.interrupts import heed_interrupts

FRAMES = Frames(
    tuple(Photograph(f"p_{i}", Path(f"p_{i}.png"), 80, 60, 1, 80, 60, blur=0.0, brightness=0.5) for i in range(8))
)


def run(tmp_path: Path, program: str) -> Poses:
    command = (sys.executable, "-c", program)
    return poses_from_structure(FRAMES, tmp_path, {}, tmp_path / "work", command)


@pytest.mark.parametrize(
    ("program", "found"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "SIGSEGV"),
        ("import os; os.abort()", "SIGABRT"),
        ("raise MemoryError('no more')", "exit code 1: MemoryError: no more"),
    ],
)
def test_a_crash_is_a_message(tmp_path: Path, program: str, found: str) -> None:
    with pytest.raises(InputError, match=found):
        run(tmp_path, program)


def test_a_program_that_finds_nothing_is_told_from_one_that_crashes(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no two of 8 frames"):
        run(tmp_path, "pass")


def test_each_stage_shows_its_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As COLMAP 4 writes them; the last stage ends where no more cameras are placed."""
    said = [f"feature_extraction.cc:270] Processed file [{i}/8]" for i in range(1, 9)]
    said += [f"pairing.cc:214] Processing block [{i}/2, {j}/2]" for i in (1, 2) for j in (1, 2)]
    said += [f"incremental_pipeline.cc:550] Registering image #{i} (num_reg_frames={i})" for i in range(3, 7)]
    with pytest.raises(InputError, match="no two"):
        run(tmp_path, f"import sys; sys.stderr.write({chr(10).join(said)!r})")
    shown = capsys.readouterr().err
    for stage, end in (("finding features", "8/8"), ("matching frames", "4/4"), ("placing cameras", "8/8")):
        assert any(line.startswith(stage) and end in line for line in shown.splitlines())


def test_an_interruption_ends_the_program(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    before = signal.getsignal(signal.SIGINT)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    heed_interrupts()
    note = tmp_path / "pid"
    program = f"import os, pathlib, time; pathlib.Path({str(note)!r}).write_text(str(os.getpid())); time.sleep(100)"

    def interrupt() -> None:
        while not note.exists() or not note.read_text():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, program)
    thread.join()
    with pytest.raises(ProcessLookupError):
        os.kill(int(note.read_text()), 0)
