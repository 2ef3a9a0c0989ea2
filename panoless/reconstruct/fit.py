"""The fit: views in, surfels and environment out. It never sees a score."""

import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch

from panoless.capture.encoding import encoding_of
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.views import Views, load_views
from panoless.config import FitConfig, check_config
from panoless.environment.cubemap import initial_environment, resample
from panoless.environment.observation import observed_rays, solve_final_map, without_fill
from panoless.environment.solve import solve_environment
from panoless.environment.visibility import agreement, visibility_from_agreement, visibility_from_evidence
from panoless.geometry.revolution.lip import clear_of_lip
from panoless.geometry.surfels.model import Surfels
from panoless.geometry.surfels.placement import (
    initial_surfels,
    surfels_on_height_field,
    surfels_on_plane,
    surfels_on_revolution,
)
from panoless.geometry.surfels.train import Fitter
from panoless.kernels.backend import gpu_kernels_installed
from panoless.reconstruct.snapshots import NO_SNAPSHOTS, SnapshotSchedule, require_snapshots
from panoless.reconstruct.state import FitState, acquire_run, load_state, save_state
from panoless.selection.choose import choose_rung, without_frame_reflections
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset
from shinypartial.io.files import folder_lock
from shinypartial.io.progress import Progress
from shinypartial.prediction.format import dataset_hash

INITIAL_RAYS = 1_000_000
MAIN_MEMORY = torch.device("cpu")


def _note_peak_memory(state: FitState) -> None:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    state.peak_memory_bytes = max(state.peak_memory_bytes, peak)


@contextmanager
def _timed(state: FitState, stage: str) -> Iterator[None]:
    start = time.monotonic()
    before = state.seconds.get(stage, 0.0)
    try:
        yield
    finally:
        state.seconds[stage] = before + time.monotonic() - start


def complete(state: FitState, views: Views, config: FitConfig) -> None:
    """Solve the environment for the geometry of a state, and say how well each direction was observed."""
    with _timed(state, "solve environment"), torch.no_grad():
        # No steps are taken with what is no set of surfels, so there is no other map of it.
        if config.environment.solve or state.stepless:
            state.final_environment, rays = solve_final_map(views, state.geometry, config)
            if not config.environment.fill:
                state.final_environment = without_fill(rays, state.final_environment)
        else:
            rays = list(observed_rays(views, state.geometry, config, config.environment.rays))
            sigmoid = config.environment.activation == "sigmoid"
            state.final_environment = torch.sigmoid(state.environment) if sigmoid else state.environment
        if config.visibility == "online" and not state.stepless:
            state.visibility = visibility_from_evidence(state.evidence)
        else:
            found = agreement(rays, state.final_environment, encoding_of(config).saturation)
            state.visibility = visibility_from_agreement(found)
        state.final_environment = encoding_of(config).decoded(state.final_environment)


def new_state(views: Views, config: FitConfig, surfels: Surfels | None = None) -> FitState:
    """The state before the first step: initial surfels, unless given, and the environment that fits them best."""
    device = views.train[0].mask.device
    surfels = initial_surfels(views, config.surfels, config.seed) if surfels is None else surfels.to(device)
    environment = initial_environment(config.environment, torch.Generator().manual_seed(config.seed)).to(device)
    if config.environment.solve and config.environment.activation == "clamp":
        with torch.no_grad():
            rays = list(observed_rays(views, surfels, config, INITIAL_RAYS))
            environment = resample(solve_environment(rays, config.environment.resolution // 2), environment.shape[-1])
    length = environment.shape[-1]
    return FitState(
        surfels=surfels,
        environment=environment,
        iteration=0,
        optimizer={},
        gradient_sum=torch.zeros_like(surfels.opacity_logits),
        gradient_count=torch.zeros_like(surfels.opacity_logits),
        evidence=environment.new_zeros(6, length, length),
        center=[float(x) for x in views.object_frame.center],
        radius=views.object_frame.radius,
    )


def fit(
    dataset: Dataset,
    config: FitConfig,
    folder: Path,
    marks: SnapshotSchedule = NO_SNAPSHOTS,
    device: torch.device = MAIN_MEMORY,
) -> FitState:
    """Fit a dataset in a run folder, taking snapshots at the marks; a killed fit continues from its last checkpoint,
    a finished one is returned.

    The views, the surfels and the environment are placed on `device` once and stay there; the state that is returned
    lies in main memory. Raises InputError when another fit is writing to the folder, or marks are given to a finished
    fit without snapshots.
    """
    check_config(config)
    with folder_lock(folder):
        acquire_run(folder, dataset.root, dataset_hash(dataset), config)
        state = load_state(folder)
        if state is not None and state.final_environment is not None:
            if not state.stepless:
                require_snapshots(folder, marks)
            return state
        start = time.monotonic()
        views = load_views(dataset, config.crop_margin_px, config.downscale, encoding_of(config)).to(device)
        loaded = time.monotonic()
        if state is None:
            state = _first_state(views, config)
            state.seconds = {"read views": loaded - start, "initialize": time.monotonic() - loaded}
            print(f"Model: {state.rung}", file=sys.stderr)
        views, state = clear_views(views, state, config), state.to(device)
        if state.stepless:
            complete(state, views, config)
            _note_peak_memory(state)
            save_state(folder, state)
        else:
            Fitter(views, config, folder, state, marks).run()
        return state.to(MAIN_MEMORY)


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


def _first_state(views: Views, config: FitConfig) -> FitState:
    """The state before the first step, on the rung of the ladder that the scene needs."""
    rung = choose_rung(views, config, _trial)
    if rung.height_field is not None:
        start = surfels_on_height_field(
            rung.height_field, 1 if rung.model == "bent" else config.surfels.count, config.seed
        )
        state = new_state(without_frame_reflections(views, rung.height_field), config, start)
    elif rung.surface is not None:
        state = new_state(views, config, surfels_on_revolution(rung.surface, config.surfels.count))
    elif rung.plane is None:
        state = new_state(views, config)
    else:
        start = surfels_on_plane(rung.plane, 1, config.seed)
        state = new_state(without_frame_reflections(views, rung.plane), config, start)
    state.plane, state.flat, state.rung = rung.plane, rung.model == "plane", f"{rung.model} ({rung.reason})"
    state.height_field, state.bent = rung.height_field, rung.model == "bent"
    state.surface, state.turned = rung.surface, rung.model == "revolution"
    return state


def clear_views(views: Views, state: FitState, config: FitConfig) -> Views:
    """The views without pixels that show more than one reflection of a state's geometry: those that mirror the frame of
    a planar outline, if the configuration has it so, and those beside the rim of a wall without thickness.
    """
    if state.turned and state.surface is not None:
        return clear_of_lip(views, state.surface)
    mirror = state.height_field or (state.plane if config.environment.trace else None)
    return views if mirror is None else without_frame_reflections(views, mirror)


def _trial(views: Views, config: FitConfig, start: Surfels) -> Surfels:
    """Surfels after a fifth of the configured steps, in memory only."""
    shortened = replace(config, iterations=max(config.iterations // 5, 1))
    fitter = Fitter(views, shortened, Path(), new_state(views, shortened, start))
    progress = Progress("comparing models", shortened.iterations)
    for iteration in range(shortened.iterations):
        fitter._step(iteration)
        progress.advance()
    return fitter.optimizer.surfels.detached()


def object_frame_of(state: FitState) -> ObjectFrame:
    """The frame in which a state's surfels live."""
    import numpy as np

    return ObjectFrame(np.array(state.center), state.radius)
