"""The fit: views in, surfels and environment out. It never sees a score."""

import math
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.checkpoint import FitState, claim_run, load_state, save_state
from panoless.config import FitConfig, check_config
from panoless.cubemap import Rays, initial_environment, look_up, resample, solve_environment
from panoless.densify import DensityStatistics, Edit, grow_and_prune, propagate_normals, reset_opacities
from panoless.initialize import initial_surfels
from panoless.losses import normal_consistency, photometric_masked, photometric_paper, silhouette
from panoless.optimizer import SurfelOptimizer
from panoless.schedule import Schedule
from panoless.shading import (
    ALPHA_FLOOR,
    SurfaceBuffers,
    compose,
    reflection_directions_world,
    surface_buffers,
)
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
from shinypartial.prediction import dataset_hash
from shinypartial.progress import Progress

CHECKPOINT_INTERVAL_S = 20.0
CURVE_EVERY = 10
SOLID_SURFACE_ALPHA = 0.9
INITIAL_RAYS = 1_000_000
FINAL_RAYS = 8_000_000


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

    def __init__(self, views: Views, config: FitConfig, folder: Path, state: FitState) -> None:
        """Continue from `state`, which may be new."""
        self.views, self.config, self.folder, self.state = views, config, folder, state
        self.schedule = Schedule(config)
        self.optimizer = SurfelOptimizer(state.surfels, state.environment, config.rates)
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
        progress = Progress("fitting", self.config.iterations, self.state.iteration)
        saved = time.monotonic()
        while self.state.iteration < self.config.iterations:
            with _timed(self.state, "optimize"):
                terms = self._step(self.state.iteration)
            self.state.iteration += 1
            progress.advance(f"loss {terms.photometric:.4f}  {self.optimizer.surfels.count} surfels")
            if time.monotonic() - saved > CHECKPOINT_INTERVAL_S:
                self._save()
                saved = time.monotonic()
        self._complete()
        self._save()

    def _step(self, iteration: int) -> LossTerms:
        view = self.views.train[self._view_index(iteration)]
        surfels = self.optimizer.surfels
        offsets = torch.zeros(surfels.count, 2, requires_grad=True) if self.config.density.enabled else None
        buffers = surface_buffers(
            surfels,
            view.camera,
            curved=self.config.surfels.curved,
            depth_blend=self.config.loss.depth_blend,
            screen_offsets=offsets,
        )
        terms, observed = self._loss(view, buffers, surfels, iteration)
        terms.total.backward()  # type: ignore[no-untyped-call]
        if not torch.isfinite(terms.total):
            raise InputError(
                expected="a finite loss",
                found=f"{float(terms.total.detach())} at iteration {iteration}",
                remedy="Check the images for extreme values, or lower the rates (--config.rates.…).",
            )
        if offsets is not None and offsets.grad is not None:
            self.statistics.observe(offsets.grad, buffers.in_frustum, view.camera.width)
        self.optimizer.step(
            self.schedule.rate_factor(iteration),
            geometry=self.schedule.geometry_moves(iteration),
            frozen=self._frozen,
        )
        if self.config.environment.activation == "clamp":
            self.optimizer.environment.data.clamp_(0, 1)
        if self.config.visibility == "online":
            accumulate(self.state.evidence, observed.directions, observed.alpha, self.config.visibility_alpha)
        self._control_density(iteration)
        if iteration % CURVE_EVERY == 0:
            self._record(iteration, terms)
        return terms

    def _view_index(self, iteration: int) -> int:
        """Every epoch visits all views once, in an order that depends on seed and epoch only."""
        epoch, position = divmod(iteration, len(self.views.train))
        return int(torch.randperm(len(self.views.train), generator=self._generator(epoch))[position])

    def _generator(self, *salt: int) -> torch.Generator:
        """Randomness that depends only on the seed and the place in the fit, so a resumed fit repeats it."""
        number = self.config.seed
        for part in salt:
            number = (number * 1_000_003 + part + 1) % (1 << 62)
        return torch.Generator().manual_seed(number)

    def _loss(
        self, view: TrainView, buffers: SurfaceBuffers, surfels: Surfels, iteration: int
    ) -> tuple[LossTerms, Observed]:
        loss = self.config.loss
        photometric, observed = (
            self._masked(view, buffers)
            if loss.photometric == "masked"
            else self._composited(view, buffers, surfels, iteration)
        )
        total = photometric
        consistency = outline = 0.0
        geometry = self.schedule.geometry_moves(iteration)
        if loss.lambda_normal_consistency > 0 and geometry:
            weight = view.mask if loss.photometric == "masked" else torch.ones_like(view.mask)
            term = normal_consistency(buffers, view.camera, weight)
            total = total + loss.lambda_normal_consistency * term
            consistency = float(term.detach())
        lambda_silhouette = self.schedule.lambda_silhouette(iteration)
        if lambda_silhouette > 0 and geometry:
            term = silhouette(buffers.alpha, view.mask)
            total = total + lambda_silhouette * term
            outline = float(term.detach())
        if loss.lambda_distortion > 0 and geometry:
            total = total + loss.lambda_distortion * buffers.distortion.mean()
        return LossTerms(total, float(photometric.detach()), consistency, outline), observed

    def _masked(self, view: TrainView, buffers: SurfaceBuffers) -> tuple[Tensor, Observed]:
        pixels = view.solid
        alpha = buffers.alpha.flatten()[pixels]
        directions = _reflections(view, buffers, pixels)
        specular = look_up(self.optimizer.environment, directions, self.config.environment.activation)
        albedo = buffers.albedo.flatten(1)[:, pixels]
        color = compose(albedo, specular.T, alpha, self.config.alpha_applied)
        target = view.radiance.flatten(1)[:, pixels]
        term = photometric_masked(color.T, target.T, self.config.loss.robust_scale)
        return term, Observed(directions.detach(), alpha.detach())

    def _composited(
        self, view: TrainView, buffers: SurfaceBuffers, surfels: Surfels, iteration: int
    ) -> tuple[Tensor, Observed]:
        pixels = torch.nonzero(buffers.alpha.detach().flatten() > ALPHA_FLOOR)[:, 0]
        alpha = buffers.alpha.flatten()[pixels]
        directions = _reflections(view, buffers, pixels)
        specular = look_up(self.optimizer.environment, directions, self.config.environment.activation).T
        if self.config.loss.roughness_weighted:
            specular = specular * (1 - self._roughness(view, surfels).flatten()[pixels]).square()
        color = compose(buffers.albedo.flatten(1)[:, pixels], specular, alpha, self.config.alpha_applied)
        if self.config.loss.random_background:
            background = torch.rand(3, 1, generator=self._generator(iteration, 1))
        else:
            background = torch.zeros(3, 1)
        image = background.expand(3, buffers.alpha.numel()).clone()
        image[:, pixels] = color + (1 - alpha) * background
        target = view.radiance + (1 - view.mask) * background[:, :, None]
        term = photometric_paper(image.view_as(target), target, self.config.loss.lambda_ssim)
        return term, Observed(directions.detach(), alpha.detach())

    def _roughness(self, view: TrainView, surfels: Surfels) -> Float[Tensor, "H W"]:
        roughness = torch.sigmoid(surfels.roughness_logits)[:, None].expand(-1, 3).contiguous()
        return surface_buffers(surfels, view.camera, curved=False, depth_blend=0.0, attribute=roughness).albedo[0]

    def _control_density(self, iteration: int) -> None:
        surfels = self.optimizer.surfels
        if self.schedule.density_round(iteration):
            generator = self._generator(iteration, 2)
            prune_faint = self.schedule.opacities_recovered(iteration)
            edit = grow_and_prune(surfels, self.statistics, self.config.density, generator, prune_faint=prune_faint)
            self._apply(edit)
            self.statistics = DensityStatistics.empty(self.optimizer.surfels.count)
        if self.schedule.opacity_reset(iteration):
            self._apply(_whole(reset_opacities(self.optimizer.surfels)))
        elif self.schedule.propagation(iteration):
            self._apply(_whole(propagate_normals(self.optimizer.surfels)))

    def _apply(self, edit: Edit) -> None:
        self.optimizer.edit_surfels(edit.surfels, edit.source, edit.unchanged)
        for name in self._frozen:
            getattr(self.optimizer.surfels, name).requires_grad_(False)

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
        """Solve the environment for the converged geometry, and say how well each direction was observed."""
        config, state = self.config, self.state
        surfels = self.optimizer.surfels.detached()
        with _timed(state, "solve environment"), torch.no_grad():
            rays = list(observed_rays(self.views, surfels, config, FINAL_RAYS))
            if config.environment.solve:
                state.final_environment = solve_environment(rays, config.environment.solve_resolution)
            else:
                parameters = self.optimizer.environment.detach()
                sigmoid = config.environment.activation == "sigmoid"
                state.final_environment = torch.sigmoid(parameters) if sigmoid else parameters
            if config.visibility == "online":
                state.visibility = visibility_from_evidence(state.evidence)
            else:
                state.visibility = visibility_from_agreement(agreement(rays, state.final_environment))

    def _save(self) -> None:
        state = self.state
        state.surfels = self.optimizer.surfels.detached()
        state.environment = self.optimizer.environment.detach()
        state.optimizer = self.optimizer.state_dict()
        state.gradient_sum, state.gradient_count = self.statistics.gradient_sum, self.statistics.count
        state.peak_memory_bytes = max(
            state.peak_memory_bytes, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        )
        save_state(self.folder, state)


def _whole(surfels: Surfels) -> Edit:
    """An edit that changes values in place: all rows stay, all moments restart."""
    everything = torch.arange(surfels.count)
    return Edit(surfels, everything, torch.zeros(surfels.count, dtype=torch.bool))


@contextmanager
def _timed(state: FitState, stage: str) -> Iterator[None]:
    start = time.monotonic()
    before = state.seconds.get(stage, 0.0)
    try:
        yield
    finally:
        state.seconds[stage] = before + time.monotonic() - start


def _reflections(view: TrainView, buffers: SurfaceBuffers, pixels: Tensor) -> Float[Tensor, "P 3"]:
    """World directions that the given pixels (flat indices) of a view mirror."""
    return reflection_directions_world(
        buffers.raster_normals_camera.flatten(1)[:, pixels],
        view.rays_camera.flatten(1)[:, pixels],
        view.camera_to_world_rotation,
    )


def observed_rays(views: Views, surfels: Surfels, config: FitConfig, max_rays: int) -> Iterator[Rays]:
    """Reflection directions and radiance of pixels that lie wholly on mask and surface, a batch a view.

    When the views hold more than `max_rays` such pixels, every k-th is taken, beginning elsewhere in each view.
    """
    stride = math.ceil(sum(len(view.solid) for view in views.train) / max_rays)
    for index, view in enumerate(views.train):
        buffers = surface_buffers(surfels, view.camera, curved=config.surfels.curved, depth_blend=0.0)
        pixels = view.solid[index % stride :: stride]
        pixels = pixels[buffers.alpha.flatten()[pixels] > SOLID_SURFACE_ALPHA]
        directions = _reflections(view, buffers, pixels)
        diffuse = buffers.albedo.flatten(1)[:, pixels]
        yield Rays(directions, (view.radiance.flatten(1)[:, pixels] - diffuse).T.contiguous())


def new_state(views: Views, config: FitConfig) -> FitState:
    """The state before the first step: initial surfels, and the environment that fits them best."""
    surfels = initial_surfels(views, config.surfels, config.seed)
    environment = initial_environment(config.environment, torch.Generator().manual_seed(config.seed))
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
        gradient_sum=torch.zeros(surfels.count),
        gradient_count=torch.zeros(surfels.count),
        evidence=torch.zeros(6, length, length),
        center=[float(x) for x in views.normalization.center],
        radius=views.normalization.radius,
    )


def fit(dataset: Dataset, config: FitConfig, folder: Path) -> FitState:
    """Fit a dataset in a run folder; a killed fit continues from its last checkpoint, a finished one is returned."""
    check_config(config)
    claim_run(folder, dataset.root, dataset_hash(dataset), config)
    state = load_state(folder)
    if state is not None and state.final_environment is not None:
        return state
    start = time.monotonic()
    views = load_views(dataset, config.crop_margin_px)
    loaded = time.monotonic()
    if state is None:
        state = new_state(views, config)
        state.seconds = {"read views": loaded - start, "initialize": time.monotonic() - loaded}
    Fitter(views, config, folder, state).run()
    return state


def normalization_of(state: FitState) -> Normalization:
    """The frame in which a state's surfels live."""
    import numpy as np

    return Normalization(np.array(state.center), state.radius)
