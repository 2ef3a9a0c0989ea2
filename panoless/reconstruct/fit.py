"""The fit: views in, geometry and environment out. It never sees a score."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import cast

import torch

from panoless.capture.configured import configured_views
from panoless.capture.views import Views
from panoless.config import FitConfig, check_config
from panoless.deadline import improving, is_past_limit, time_limit
from panoless.geometry.base import usable_views
from panoless.journal import forget, journal_in
from panoless.kernels.backend import gpu_kernels_installed
from panoless.reconstruct.final_map import complete
from panoless.reconstruct.recorder import Recorder, note_peak_memory, timed
from panoless.reconstruct.snapshots import NO_SNAPSHOTS, SnapshotSchedule, require_snapshots
from panoless.reconstruct.state import FitState, acquire_run, load_state, save_state
from panoless.selection.candidates import Candidate, Selection, Verdict
from panoless.selection.choose import along_one_line, choose_geometry
from panoless.selection.material import without_scattered_light
from panoless.splats.mirror import SurfelMirror
from panoless.splats.start import first_mirror, first_training
from panoless.splats.train import train_surfels
from panoless.trust.evidence import gather_evidence
from panoless.trust.verdict import judge
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import photographs_hash, read_ball_evidence
from shinypartial.dataset.schema import BallEvidence, Dataset
from shinypartial.io.events import note, warn
from shinypartial.io.files import folder_lock
from shinypartial.io.progress import format_seconds
from shinypartial.prediction.format import Trust, dataset_hash

MAIN_MEMORY = torch.device("cpu")


def fit(
    dataset: Dataset,
    config: FitConfig,
    folder: Path,
    schedule: SnapshotSchedule = NO_SNAPSHOTS,
    device: torch.device = MAIN_MEMORY,
    time_limit_s: float | None = None,
) -> FitState:
    """Fit a dataset in a run folder; a killed fit continues after its last finished stage or from its last checkpoint,
    a finished one is returned. Past the time limit nothing is improved further: the state is completed as it is, and
    the next fit in that folder goes on from the last checkpoint.

    The views, the surfels and the environment are placed on `device` once and stay there; the state that is returned
    lies in main memory. Raises InputError when another fit is writing to the folder, or snapshots are requested of a
    finished fit that has none.
    """
    check_config(config)
    with folder_lock(folder):
        acquire_run(folder, dataset.root, dataset_hash(dataset), config, photographs_hash(dataset))
        state = load_state(folder)
        if state is not None and state.is_preliminary:
            state = None if state.training is None else replace(state, environment=None, is_preliminary=False)
        if state is None or state.environment is None:
            with journal_in(folder), _noting_what_is_repeated(folder), time_limit(time_limit_s):
                state = _finished(state, dataset, config, schedule, folder, device)
        elif state.training is not None:
            require_snapshots(folder, schedule)
        if not state.is_preliminary:
            forget(folder)
        return state


def _finished(
    state: FitState | None,
    dataset: Dataset,
    config: FitConfig,
    schedule: SnapshotSchedule,
    folder: Path,
    device: torch.device,
) -> FitState:
    """The end of a fit, saved, from the state that was saved before; None: from the beginning."""
    seconds: dict[str, float] = {} if state is None else state.seconds
    before = sum(seconds.values())
    with timed(seconds, "read views"):
        views, config = configured_views(dataset, config)
        views = views.to(device)
    if state is None:
        with timed(seconds, "initialize"):
            _tell_repairs(views)
            state = begin(views, config)
        state.seconds, state.device = seconds, device_name(device)
        note(f"Model: {state.selection.sentence}")
    state = state.to(device)
    photographs = state.selection.corrections.applied(views, config)
    if state.training is not None:
        views = usable_views(photographs, state.geometry)
        mirror, recorder = cast(SurfelMirror, state.geometry), Recorder(folder, schedule, state, before)
        state.geometry, state.training = train_surfels(views, mirror, state.training, config, recorder)
    with timed(state.seconds, "solve environment"):
        photographs, shown = complete(state, photographs, config)
    with timed(state.seconds, "judge"):
        state.verdict = assess(state, photographs, shown, read_ball_evidence(dataset))
    note_peak_memory(state)
    state.is_preliminary = is_past_limit()
    if state.is_preliminary:
        warn("the time limit ended the search: the result is preliminary. Run again with more time to go on from it.")
    save_state(folder, state)
    return state.to(MAIN_MEMORY)


@contextmanager
def _noting_what_is_repeated(folder: Path) -> Iterator[None]:
    """Notes at an interruption how long ago the run folder was written to, in this run."""
    start = time.time()
    try:
        yield
    except KeyboardInterrupt as stop:
        saved = (path.stat().st_mtime for path in folder.rglob("*") if path.is_file())
        stop.add_note(f"It repeats the work of the last {format_seconds(time.time() - max(start, *saved))}.")
        raise


def _tell_repairs(views: Views) -> None:
    """A line on standard error where masks contradicted each other."""
    repairs = views.repairs
    if repairs.views:
        warn(
            f"the masks of {repairs.views} of {len(views.train)} views contradict the others: {repairs.holes} holes "
            f"filled, {repairs.pieces} stray pieces left out."
        )


def begin(views: Views, config: FitConfig) -> FitState:
    """The state before the map: the geometry that the scene needs, or the surfels that steps start from.

    Where that geometry shows that the object scatters light, another is chosen by photographs without it.
    """
    if config.model == SurfelMirror.kind:
        return _begin_surfels(views, config)
    geometry, selection = choose_geometry(views, config)
    if selection.candidates[-1].is_matte:
        return FitState(geometry, views.object_frame, selection)
    corrected = selection.corrections.applied(views, config)
    with improving():
        shown = without_scattered_light(views, corrected, geometry, selection.held_out_error, config)
        if shown is not None:
            geometry, selection = choose_geometry(*shown)
    return FitState(geometry, views.object_frame, selection)


def _begin_surfels(views: Views, config: FitConfig) -> FitState:
    if views.object_frame.depth_is_open:
        raise along_one_line()
    mirror = first_mirror(views, config)
    requested = Candidate(mirror.kind, Verdict.CHOSEN, "requested")
    training = first_training(views, mirror, config)
    return FitState(mirror, views.object_frame, Selection(mirror.kind, (requested,)), training)


def assess(state: FitState, views: Views, config: FitConfig, ball: BallEvidence | None = None) -> Trust:
    """How far a finished state is to be trusted, by the corrected views that it was fitted to, and by what the capture
    of a ball knows of itself.
    """
    assert state.visibility is not None
    corrections = state.selection.corrections
    with torch.no_grad():
        found = gather_evidence(
            views, state.geometry, state.visibility, config, corrections, state.roughness, ball, state.reflectance
        )
    return judge(found)


def find_device(name: str) -> torch.device:
    """The device "cpu" or "cuda"; InputError when it can't be used."""
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            expected="a GPU that torch can use, for --device cuda",
            found=f"torch {torch.__version__}, which sees none",
            remedy="Install torch for your GPU, or leave --device out.",
        )
    if name == "cuda" and not gpu_kernels_installed():
        raise InputError(
            expected="Triton, for --device cuda", found="none", remedy="Install it: pip install 'panoless[gpu]'."
        )
    return torch.device(name)


def device_name(device: torch.device) -> str:
    """What distinguishes one piece of hardware from another: the GPU's name, or the type of the device."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
