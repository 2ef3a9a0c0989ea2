"""The steps of a fit of surfels."""

import math
import time
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from panoless.environment.cubemap import look_up
from panoless.environment.visibility import accumulate
from panoless.geometry.base import Training, TrainingObserver
from panoless.geometry.exact import mirrored_directions
from panoless.geometry.surfels.density import DensityStatistics, grow_and_prune, propagate_normals, reset_opacities
from panoless.geometry.surfels.losses import photometric_paper
from panoless.geometry.surfels.mirror import SurfelMirror
from panoless.geometry.surfels.model import Surfels
from panoless.geometry.surfels.optimizer import SurfelOptimizer
from panoless.geometry.surfels.rendering import ALPHA_FLOOR, compose, rasterize_surfels
from panoless.geometry.surfels.schedule import Phase, Schedule, phase_of
from panoless.kernels.adam import UNBOUNDED
from panoless.kernels.objective import mirror_objective
from panoless.kernels.rasterize import Channels, RasterBuffers
from shinypartial.core.errors import InputError
from shinypartial.io.progress import Progress

CURVE_EVERY = 10


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


def train_surfels(
    views: Views, mirror: SurfelMirror, training: Training, config: FitConfig, observer: TrainingObserver
) -> tuple[SurfelMirror, Training]:
    """Take the steps that remain."""
    trainer = SurfelTrainer(views, mirror, training, config, observer)
    progress = Progress(observer.title, config.iterations, training.iteration)
    while trainer.iteration < config.iterations:
        start = time.monotonic()
        terms = trainer.step()
        observer.after_step(trainer.iteration, time.monotonic() - start, trainer.current)
        progress.advance(f"loss {terms.photometric:.4f}  {trainer.optimizer.surfels.count} surfels")
    return trainer.current()


class SurfelTrainer:
    """The optimization of surfels and map from a state on."""

    def __init__(
        self, views: Views, mirror: SurfelMirror, training: Training, config: FitConfig, observer: TrainingObserver
    ) -> None:
        """Continue from `mirror` and `training`, which may be new."""
        self.views, self.config, self.observer, self._mirror = views, config, observer, mirror
        self.iteration, self.evidence = training.iteration, training.evidence
        self.schedule = Schedule(config)
        self._epoch, self._order = -1, list[int]()
        self._phases = dict[tuple[bool, float], Phase]()
        self._brightest = max(1.0, *(float(view.radiance.max()) for view in views.train))
        unit = views.camera_extent if config.scene_radius == "cameras" else 1.0
        rates = replace(config.rates, means=config.rates.means * unit)
        shares = config.density.dense_share * unit, config.density.prune_share * unit
        self._density = replace(config.density, dense_share=shares[0], prune_share=shares[1])
        self.optimizer = SurfelOptimizer(mirror.surfels, training.environment, rates)
        self.statistics = DensityStatistics.empty(mirror.surfels.count, mirror.surfels.means.device)
        if training.optimizer:
            self.optimizer.load_state_dict(training.optimizer["adam"])
            device = mirror.surfels.means.device
            self.statistics = DensityStatistics(*(part.to(device) for part in training.optimizer["gradients"]))
        frozen = {
            "albedo": config.albedo,
            "curvatures": config.surfels.curved,
            "roughness_logits": config.loss.roughness_weighted,
        }
        self._frozen = frozenset(name for name, learned in frozen.items() if not learned)
        for name in self._frozen:
            getattr(self.optimizer.surfels, name).requires_grad_(False)

    def current(self) -> tuple[SurfelMirror, Training]:
        """Surfels and training after the last step."""
        gradients = [self.statistics.gradient_sum, self.statistics.count]
        optimizer = {"adam": self.optimizer.state_dict(), "gradients": gradients}
        environment = self.optimizer.environment.detach()
        training = Training(environment, self.evidence, self.iteration, optimizer)
        return replace(self._mirror, surfels=self.optimizer.surfels.detached()), training

    def step(self) -> LossTerms:
        """One step on one view."""
        terms = self._step(self.iteration)
        self.iteration += 1
        return terms

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
            accumulate(self.evidence, observed.directions, observed.alpha, self.config.visibility_alpha)
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
                directions = mirrored_directions(view.camera, pixels, raster.normals_camera.flatten(1)[:, pixels])
                observed = Observed(directions, raster.alpha.flatten()[pixels])
        return LossTerms(total, photometric, objective.normal_consistency, objective.silhouette), observed

    def _composited(
        self, view: TrainView, buffers: RasterBuffers, surfels: Surfels, pixels: Tensor, iteration: int
    ) -> Tensor:
        """Eq. 9 over the whole image, to which the given pixels add more than the background."""
        alpha = buffers.alpha.flatten()[pixels]
        directions = mirrored_directions(view.camera, pixels, buffers.normals_camera.flatten(1)[:, pixels])
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
        self.observer.record(point)
