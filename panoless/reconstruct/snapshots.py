"""Snapshots: what an export needs, kept at chosen moments of a fit, so that quality against time is scored afterwards.

A snapshot is a state without what only the optimizer needs, in RUN/snapshots/ITERATION. Solving its environment is left
to the export; writing it counts as no time of the fit.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from panoless.geometry.surfels.model import Surfels
from panoless.reconstruct.state import CHECKPOINT, FitState, load_state, save_state
from shinypartial.core.errors import InputError
from shinypartial.prediction.format import SNAPSHOTS


@dataclass(frozen=True)
class SnapshotSchedule:
    """When to take snapshots: after these numbers of finished steps, and at the first step that ends at or after these
    seconds of fitting (reading views, initialization and steps, over all resumed parts).
    """

    iterations: frozenset[int] = frozenset()
    seconds: tuple[float, ...] = ()

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


class SnapshotKeeper:
    """Takes the snapshots of one fit.

    A resumed fit repeats the steps since its checkpoint, so snapshots later than that are deleted and taken again: none
    is lost, none is doubled, and all lie on the path of the fit that is finished in the end.
    """

    def __init__(self, run: Path, marks: SnapshotSchedule, state: FitState) -> None:
        """Begin or continue at `state`."""
        self._folder, self._marks = run / SNAPSHOTS, marks
        self._seconds = _fitting_seconds(state)
        for folder in snapshot_folders(run):
            if int(folder.name) > state.iteration:
                shutil.rmtree(folder)

    def observe(self, state: FitState, surfels: Surfels, environment: Tensor) -> None:
        """Call after each step, with the optimizer's surfels and environment: saves them when a mark has come."""
        before, self._seconds = self._seconds, _fitting_seconds(state)
        passed = any(before < mark <= self._seconds for mark in self._marks.seconds)
        if not passed and state.iteration not in self._marks.iterations:
            return
        nothing = torch.zeros(0)
        kept = replace(
            state,
            surfels=surfels.detached(),
            environment=environment.detach(),
            optimizer={},
            gradient_sum=nothing,
            gradient_count=nothing,
        )
        save_state(self._folder / f"{state.iteration:06d}", kept)


def snapshot_folders(run: Path) -> list[Path]:
    """Folders of all snapshots of a run, earliest first; each is named after the number of finished steps."""
    found = [path.parent for path in (run / SNAPSHOTS).glob(f"*/{CHECKPOINT}") if path.parent.name.isdecimal()]
    return sorted(found, key=lambda folder: int(folder.name))


def require_snapshots(run: Path, marks: SnapshotSchedule) -> None:
    """InputError when a finished run has none of the snapshots that are asked for: it can't take them any more."""
    if marks and not snapshot_folders(run):
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


def _fitting_seconds(state: FitState) -> float:
    return sum(state.seconds.values())
