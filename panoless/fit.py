"""The fit: views in, surfels and environment out. It never sees a score."""

import math
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.checkpoint import FitState, claim_run, load_state, save_state
from panoless.config import FitConfig, check_config
from panoless.cubemap import initial_environment, look_up, resample, solve_environment
from panoless.densify import DensityStatistics, grow_and_prune, propagate_normals, reset_opacities
from panoless.initialize import initial_surfels, surfels_on_lathe, surfels_on_plane, surfels_on_sheet
from panoless.kernels.adam import UNBOUNDED
from panoless.kernels.backend import gpu_kernels_installed
from panoless.kernels.objective import mirror_objective
from panoless.kernels.rasterize import Channels, RasterBuffers
from panoless.ladder import choose_rung, without_mirrored_frame
from panoless.lathe_rim import clear_of_rim
from panoless.light import light_of
from panoless.losses import photometric_paper
from panoless.observation import observed_rays, reflections, solved_environment, without_fill
from panoless.optimizer import SurfelOptimizer
from panoless.schedule import Phase, Schedule, phase_of
from panoless.shading import ALPHA_FLOOR, compose, rasterize_surfels
from panoless.snapshots import Marks, SnapshotKeeper, require_snapshots
from panoless.surfels import Surfels
from panoless.views import Normalization, TrainView, Views, load_views
from panoless.visibility import (
    accumulate,
    agreement,
    visibility_from_agreement,
    visibility_from_evidence,
)
from shinypartial.dataset.schema import Dataset
from shinypartial.errors import InputError
from shinypartial.files import only_writer
from shinypartial.prediction import dataset_hash
from shinypartial.progress import Progress

CHECKPOINT_INTERVAL_S = 20.0
CURVE_EVERY = 10
INITIAL_RAYS = 1_000_000
NO_MARKS = Marks()
MAIN_MEMORY = torch.device("cpu")


@dataclass(frozen=True)
class LossTerms:
    """One step's objective (Eq. 14) and its parts."""

    total: Tensor
    photometric: float
    normal_consistency: float
    silhouette: float


@dataclass(frozen=True)
class Observed:
    """Reflection directions and alpha of the pixels that a step looked up, for online visibility."""

    directions: Float[Tensor, "P 3"]
    alpha: Float[Tensor, "P"]


class Fitter:
    """Runs the steps of a fit from a state to completion, saving as it goes."""

    def __init__(self, views: Views, config: FitConfig, folder: Path, state: FitState, marks: Marks = NO_MARKS) -> None:
        """Continue from `state`, which may be new."""
        self.views, self.config, self.folder, self.state, self.marks = views, config, folder, state, marks
        self.schedule = Schedule(config)
        self._epoch, self._order = -1, list[int]()
        self._phases = dict[tuple[bool, float], Phase]()
        self._brightest = max(1.0, *(float(view.radiance.max()) for view in views.train))
        unit = views.camera_extent if config.scene_radius == "cameras" else 1.0
        rates = replace(config.rates, means=config.rates.means * unit)
        shares = config.density.dense_share * unit, config.density.prune_share * unit
        self._density = replace(config.density, dense_share=shares[0], prune_share=shares[1])
        self.optimizer = SurfelOptimizer(state.surfels, state.environment, rates)
        if state.optimizer:
            self.optimizer.load_state_dict(state.optimizer)
        self.statistics = DensityStatistics(state.gradient_sum, state.gradient_count)
        frozen = {
            "albedo": config.albedo,
            "curvatures": config.surfels.curved,
            "roughness_logits": config.loss.roughness_weighted,
        }
        self._frozen = frozenset(name for name, learned in frozen.items() if not learned)
        for name in self._frozen:
            getattr(self.optimizer.surfels, name).requires_grad_(False)

    def run(self) -> None:
        """Optimize to the last iteration and complete the state."""
        snapshots = SnapshotKeeper(self.folder, self.marks, self.state)
        progress = Progress("fitting", self.config.iterations, self.state.iteration)
        saved = time.monotonic()
        while self.state.iteration < self.config.iterations:
            with _timed(self.state, "optimize"):
                terms = self._step(self.state.iteration)
            self.state.iteration += 1
            snapshots.observe(self.state, self.optimizer.surfels, self.optimizer.environment)
            progress.advance(f"loss {terms.photometric:.4f}  {self.optimizer.surfels.count} surfels")
            if time.monotonic() - saved > CHECKPOINT_INTERVAL_S:
                self._save()
                saved = time.monotonic()
        self._complete()
        self._save()

    def _step(self, iteration: int) -> LossTerms:
        view = self.views.train[self._view_index(iteration)]
        surfels = self.optimizer.surfels
        offsets = None
        if self.config.density.enabled:
            offsets = torch.zeros_like(surfels.means[:, :2], requires_grad=True)
        phase = self._phase(iteration)
        # While only the environment learns, surfels need no gradient, unless density control counts it.
        with torch.set_grad_enabled(phase.geometry_moves or offsets is not None):
            raster = rasterize_surfels(
                surfels,
                view.camera,
                curved=self.config.surfels.curved,
                screen_offsets=offsets,
                channels=phase.channels,
                active_tiles=self._active_tiles(view, iteration),
            )
        terms, observed = self._loss(view, raster, surfels, iteration)
        terms.total.backward()  # type: ignore[no-untyped-call]
        total = float(terms.total.detach())
        if not math.isfinite(total):
            raise InputError(
                expected="a finite loss",
                found=f"{total} at iteration {iteration}",
                remedy="Check the images for extreme values, or lower the rates (--config.rates.…).",
            )
        if offsets is not None and offsets.grad is not None:
            self.statistics.observe(offsets.grad, raster.in_frustum, view.camera.width)
        self.optimizer.step(
            self.schedule.rate_factor(iteration),
            geometry=phase.geometry_moves,
            frozen=self._frozen,
            means_factor=self.schedule.means_factor(iteration),
            environment_bounds=(0, self._brightest) if self.config.environment.activation == "clamp" else UNBOUNDED,
        )
        if observed is not None:
            accumulate(self.state.evidence, observed.directions, observed.alpha, self.config.visibility_alpha)
        self._control_density(iteration)
        if iteration % CURVE_EVERY == 0:
            self._record(iteration, terms)
        return terms

    def _view_index(self, iteration: int) -> int:
        """Every epoch visits all views once, in an order that depends on seed and epoch only."""
        epoch, position = divmod(iteration, len(self.views.train))
        if self._epoch != epoch:
            self._epoch = epoch
            self._order = torch.randperm(len(self.views.train), generator=self._generator(epoch)).tolist()
        return self._order[position]

    def _generator(self, *salt: int) -> torch.Generator:
        """Randomness that depends only on the seed and the place in the fit, so a resumed fit repeats it."""
        number = self.config.seed
        for part in salt:
            number = (number * 1_000_003 + part + 1) % (1 << 62)
        return torch.Generator().manual_seed(number)

    def _phase(self, iteration: int) -> Phase:
        acts = self.schedule.geometry_moves(iteration), self.schedule.lambda_silhouette(iteration)
        if acts not in self._phases:
            self._phases[acts] = phase_of(self.config, *acts)
        return self._phases[acts]

    def _active_tiles(self, view: TrainView, iteration: int) -> Tensor | None:
        """The tiles that some term of this iteration reads; None for all."""
        phase = self._phase(iteration)
        if phase.everywhere:
            return None
        return view.mask_tiles if phase.channels.depth else view.solid_tiles

    def _loss(
        self, view: TrainView, raster: RasterBuffers, surfels: Surfels, iteration: int
    ) -> tuple[LossTerms, Observed | None]:
        phase = self._phase(iteration)
        objective = mirror_objective(
            raster.normals_camera,
            raster.alpha,
            raster.accumulated_depth,
            raster.median_depth,
            raster.colors if self.config.albedo else None,
            self.optimizer.environment,
            view.mirror,
            phase.terms,
        )
        total, photometric = objective.total, objective.photometric
        pixels = view.solid
        if not phase.terms.photometric:
            pixels = torch.nonzero(raster.alpha.detach().flatten() > ALPHA_FLOOR)[:, 0]
            composited = self._composited(view, raster, surfels, pixels, iteration)
            total, photometric = total + composited, float(composited.detach())
        if phase.channels.distortion:
            total = total + self.config.loss.lambda_distortion * raster.distortion.mean()
        observed = None
        if self.config.visibility == "online":
            with torch.no_grad():
                observed = Observed(reflections(view, raster.normals_camera, pixels), raster.alpha.flatten()[pixels])
        return LossTerms(total, photometric, objective.normal_consistency, objective.silhouette), observed

    def _composited(
        self, view: TrainView, buffers: RasterBuffers, surfels: Surfels, pixels: Tensor, iteration: int
    ) -> Tensor:
        """Eq. 9 over the whole image, to which the given pixels add more than the background."""
        alpha = buffers.alpha.flatten()[pixels]
        directions = reflections(view, buffers.normals_camera, pixels)
        specular = look_up(self.optimizer.environment, directions, self.config.environment.activation).T
        if self.config.loss.roughness_weighted:
            specular = specular * (1 - self._roughness(view, surfels).flatten()[pixels]).square()
        color = compose(buffers.colors.flatten(1)[:, pixels], specular, alpha, self.config.alpha_applied)
        if self.config.loss.random_background:
            background = torch.rand(3, 1, generator=self._generator(iteration, 1)).to(view.radiance)
        else:
            background = view.radiance.new_zeros(3, 1)
        image = background.expand(3, buffers.alpha.numel()).clone()
        image[:, pixels] = color + (1 - alpha) * background
        target = view.radiance + (1 - view.mask) * background[:, :, None]
        return photometric_paper(image.view_as(target), target, self.config.loss.lambda_ssim)

    def _roughness(self, view: TrainView, surfels: Surfels) -> Float[Tensor, "H W"]:
        roughness = torch.sigmoid(surfels.roughness_logits)[:, None].expand(-1, 3).contiguous()
        channels = Channels(depth=False, distortion=False)
        return rasterize_surfels(surfels, view.camera, curved=False, attribute=roughness, channels=channels).colors[0]

    def _control_density(self, iteration: int) -> None:
        surfels = self.optimizer.surfels
        if self.schedule.density_round(iteration):
            generator = self._generator(iteration, 2)
            prune_faint = self.schedule.opacities_recovered(iteration)
            edit = grow_and_prune(surfels, self.statistics, self._density, generator, prune_faint=prune_faint)
            self.optimizer.edit_surfels(edit.surfels, edit.source, edit.unchanged)
            self.statistics = DensityStatistics.empty(self.optimizer.surfels.count, surfels.means.device)
        if self.schedule.opacity_reset(iteration):
            self.optimizer.set_values(reset_opacities(self.optimizer.surfels))
        elif self.schedule.propagation(iteration):
            self.optimizer.set_values(propagate_normals(self.optimizer.surfels))

    def _record(self, iteration: int, terms: LossTerms) -> None:
        point = {
            "iteration": float(iteration),
            "photometric loss": terms.photometric,
            "normal consistency loss": terms.normal_consistency,
            "silhouette loss": terms.silhouette,
            "surfels": float(self.optimizer.surfels.count),
        }
        for name, value in point.items():
            self.state.curves.setdefault(name, []).append(value)

    def _complete(self) -> None:
        self.state.surfels = self.optimizer.surfels.detached()
        self.state.environment = self.optimizer.environment.detach()
        complete(self.state, self.views, self.config)

    def _save(self) -> None:
        state = self.state
        state.surfels = self.optimizer.surfels.detached()
        state.environment = self.optimizer.environment.detach()
        state.optimizer = self.optimizer.state_dict()
        state.gradient_sum, state.gradient_count = self.statistics.gradient_sum, self.statistics.count
        _note_peak_memory(state)
        save_state(self.folder, state)


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
            state.final_environment, rays = solved_environment(views, state.geometry, config)
            if not config.environment.fill:
                state.final_environment = without_fill(rays, state.final_environment)
        else:
            rays = list(observed_rays(views, state.geometry, config, config.environment.rays))
            sigmoid = config.environment.activation == "sigmoid"
            state.final_environment = torch.sigmoid(state.environment) if sigmoid else state.environment
        if config.visibility == "online" and not state.stepless:
            state.visibility = visibility_from_evidence(state.evidence)
        else:
            found = agreement(rays, state.final_environment, light_of(config).saturation)
            state.visibility = visibility_from_agreement(found)
        state.final_environment = light_of(config).decoded(state.final_environment)


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
        center=[float(x) for x in views.normalization.center],
        radius=views.normalization.radius,
    )


def fit(
    dataset: Dataset, config: FitConfig, folder: Path, marks: Marks = NO_MARKS, device: torch.device = MAIN_MEMORY
) -> FitState:
    """Fit a dataset in a run folder, taking snapshots at the marks; a killed fit continues from its last checkpoint,
    a finished one is returned.

    The views, the surfels and the environment are placed on `device` once and stay there; the state that is returned
    lies in main memory. Raises InputError when another fit is writing to the folder, or marks are given to a finished
    fit without snapshots.
    """
    check_config(config)
    with only_writer(folder):
        claim_run(folder, dataset.root, dataset_hash(dataset), config)
        state = load_state(folder)
        if state is not None and state.final_environment is not None:
            if not state.stepless:
                require_snapshots(folder, marks)
            return state
        start = time.monotonic()
        views = load_views(dataset, config.crop_margin_px, config.downscale, light_of(config)).to(device)
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
    if rung.sheet is not None:
        start = surfels_on_sheet(rung.sheet, 1 if rung.model == "bent" else config.surfels.count, config.seed)
        state = new_state(without_mirrored_frame(views, rung.sheet), config, start)
    elif rung.lathe is not None:
        state = new_state(views, config, surfels_on_lathe(rung.lathe, config.surfels.count))
    elif rung.plane is None:
        state = new_state(views, config)
    else:
        start = surfels_on_plane(rung.plane, 1, config.seed)
        state = new_state(without_mirrored_frame(views, rung.plane), config, start)
    state.plane, state.flat, state.rung = rung.plane, rung.model == "plane", f"{rung.model} ({rung.reason})"
    state.sheet, state.bent = rung.sheet, rung.model == "bent"
    state.lathe, state.turned = rung.lathe, rung.model == "revolution"
    return state


def clear_views(views: Views, state: FitState, config: FitConfig) -> Views:
    """The views without pixels that show more than one reflection of a state's geometry: those that mirror the frame of
    a planar outline, if the configuration has it so, and those beside the rim of a wall without thickness.
    """
    if state.turned and state.lathe is not None:
        return clear_of_rim(views, state.lathe)
    mirror = state.sheet or (state.plane if config.environment.trace else None)
    return views if mirror is None else without_mirrored_frame(views, mirror)


def _trial(views: Views, config: FitConfig, start: Surfels) -> Surfels:
    """Surfels after a fifth of the configured steps, in memory only."""
    shortened = replace(config, iterations=max(config.iterations // 5, 1))
    fitter = Fitter(views, shortened, Path(), new_state(views, shortened, start))
    progress = Progress("comparing models", shortened.iterations)
    for iteration in range(shortened.iterations):
        fitter._step(iteration)
        progress.advance()
    return fitter.optimizer.surfels.detached()


def normalization_of(state: FitState) -> Normalization:
    """The frame in which a state's surfels live."""
    import numpy as np

    return Normalization(np.array(state.center), state.radius)
