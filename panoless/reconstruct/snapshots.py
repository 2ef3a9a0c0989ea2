"""Snapshots: what an export needs, kept at chosen moments of a fit, so that quality against time is scored afterwards.

A snapshot is a state without what only the optimizer needs, in RUN/snapshots/ITERATION. Solving its environment is left
to the export; writing it counts as no time of the fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from panoless.reconstruct.state import CHECKPOINT, FitState, load_state
from shinypartial.core.errors import InputError
from shinypartial.prediction.format import SNAPSHOTS


@dataclass(frozen=True)
class SnapshotSchedule:
    """When to take snapshots: after these numbers of finished steps, and at the first step that ends at or after these
    seconds of fitting (reading views, initialization and steps, over all resumed parts).
    """

    iterations: frozenset[int] = frozenset()
    seconds: tuple[float, ...] = ()

    def is_due(self, iteration: int, before: float, now: float) -> bool:
        """Whether a snapshot is due after that many steps, whose last one went from `before` to `now` seconds."""
        return iteration in self.iterations or any(before < mark <= now for mark in self.seconds)

    def __bool__(self) -> bool:
        """Whether there is any mark."""
        return bool(self.iterations or self.seconds)


NO_SNAPSHOTS = SnapshotSchedule()


def snapshot_schedule(count: int, seconds: Sequence[float], iterations: int) -> SnapshotSchedule:
    """`count` marks at I, ⌈I/2⌉, ⌈I/4⌉, … of I iterations (fewer where they coincide), and marks at given seconds.

    Raises InputError for a negative count, and for seconds that are not positive.
    """
    if count < 0 or not all(0 < moment < float("inf") for moment in seconds):
        raise InputError(
            expected="--snapshots of at least 0, and --snapshot-seconds above 0",
            found=f"{count}, and {list(seconds)}",
            remedy="Give a number of snapshots, such as `--snapshots 6`, or moments: `--snapshot-seconds 5 10 20`.",
        )
    return SnapshotSchedule(frozenset(-(-iterations // 2**halvings) for halvings in range(count)), tuple(seconds))


def snapshot_folders(run: Path) -> list[Path]:
    """Folders of all snapshots of a run, earliest first; each is named after the number of finished steps."""
    found = [path.parent for path in (run / SNAPSHOTS).glob(f"*/{CHECKPOINT}") if path.parent.name.isdecimal()]
    return sorted(found, key=lambda folder: int(folder.name))


def require_snapshots(run: Path, schedule: SnapshotSchedule) -> None:
    """InputError when a finished run has none of the snapshots that are requested: it can't take them any more."""
    if schedule and not snapshot_folders(run):
        raise InputError(
            expected=f"snapshots of the finished run {run}",
            found="none: it ran without them",
            remedy="Choose another --output, or delete that folder and fit again.",
        )


def read_snapshot(folder: Path) -> FitState:
    """The state that was kept; its environment is still as the optimizer held it."""
    state = load_state(folder)
    if state is None:
        raise InputError(
            expected=f"a snapshot at {folder}", found=f"no {CHECKPOINT}", remedy="Fit again with --snapshots."
        )
    return state
