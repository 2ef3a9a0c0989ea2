"""What is kept of a fit of surfels while it runs: seconds, curves, checkpoints and snapshots."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from panoless.journal import seconds_before
from panoless.reconstruct.snapshots import SnapshotSchedule, snapshot_folders
from panoless.reconstruct.state import FitState, save_state
from panoless.splats.mirror import SurfelMirror
from panoless.splats.training import Training
from shinypartial.io.system import peak_memory_bytes, release_free_memory
from shinypartial.prediction.format import SNAPSHOTS

CHECKPOINT_INTERVAL_S = 20.0


class Recorder:
    """Observes the steps of one fit, and saves its state at every twentieth second and every snapshot.

    A resumed fit repeats the steps since its checkpoint, so snapshots later than that are deleted and taken again: none
    is lost, none is doubled, and all lie on the path of the fit that is finished in the end.
    """

    title = "fitting"

    def __init__(self, run: Path, schedule: SnapshotSchedule, state: FitState, before: float) -> None:
        """Begin or continue at `state`, whose seconds and curves are kept up to date.

        Marks up to `before`, the seconds of the checkpoint, have been passed; reading and initialization since then may
        have passed others.
        """
        self._run, self._schedule, self._state, self._before = run, schedule, state, before
        self._saved = time.monotonic()
        for folder in snapshot_folders(run):
            if int(folder.name) > state.iteration:
                shutil.rmtree(folder)

    def after_step(self, iteration: int, seconds: float, current: Callable[[], tuple[SurfelMirror, Training]]) -> None:
        """Count the step, and save what is due."""
        stages, before = self._state.seconds, self._before
        stages["optimize"] = stages.get("optimize", 0.0) + seconds
        self._before = sum(stages.values())
        if self._schedule.is_due(iteration, before, self._before):
            geometry, training = current()
            kept = replace(self._state, geometry=geometry, training=replace(training, optimizer={}))
            save_state(self._run / SNAPSHOTS / f"{iteration:06d}", kept)
        if time.monotonic() - self._saved > CHECKPOINT_INTERVAL_S:
            self._state.geometry, self._state.training = current()
            note_peak_memory(self._state)
            save_state(self._run, self._state)
            self._saved = time.monotonic()

    def record(self, point: dict[str, float]) -> None:
        """Append to the curves."""
        for name, value in point.items():
            self._state.curves.setdefault(name, []).append(value)


def note_peak_memory(state: FitState) -> None:
    """Raise the state's peak to that of this process."""
    state.peak_memory_bytes = max(state.peak_memory_bytes, peak_memory_bytes())


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Add the time that a block takes to its stage, with that of what it takes from an earlier run, and give back the
    memory that it no longer needs.
    """
    start = time.monotonic() + seconds_before()
    try:
        yield
    finally:
        release_free_memory()
        seconds[stage] = seconds.get(stage, 0.0) + time.monotonic() + seconds_before() - start
