"""The steps of a fit of surfels."""

import math
import time

import torch

from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.deadline import is_past_limit
from panoless.environment.visibility import accumulate
from panoless.splats.density import DensityStatistics, grow_and_prune, reset_opacities
from panoless.splats.descent import Rates, first_map, published
from panoless.splats.kernels.adam import UNBOUNDED
from panoless.splats.mirror import SurfelMirror
from panoless.splats.objective import LossTerms, generator_of
from panoless.splats.optimizer import SurfelOptimizer
from panoless.splats.schedule import Schedule
from panoless.splats.training import Training, TrainingObserver
from shinypartial.core.errors import InputError
from shinypartial.io.progress import Progress

CURVE_EVERY = 10
OBSERVED_ALPHA = 0.5
"""τ: only pixels with alpha above it count as observations."""


def train_surfels(
    views: Views, mirror: SurfelMirror, training: Training, config: FitConfig, observer: TrainingObserver
) -> tuple[SurfelMirror, Training]:
    """Take the steps that remain, up to the time limit."""
    trainer = SurfelTrainer(views, mirror, training, config, observer)
    progress = Progress(observer.title, config.splats.iterations, training.iteration)
    while trainer.iteration < config.splats.iterations and not is_past_limit():
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
        self._brightest = max(1.0, *(float(view.radiance.max()) for view in views.train))
        self._unit = 1.0 if config.splats.rates == "ours" else views.camera_extent
        self.optimizer = SurfelOptimizer(mirror.surfels, training.environment, Rates.of(config, self._unit))
        self.statistics = DensityStatistics.empty(mirror.surfels.count, mirror.surfels.means.device)
        if training.optimizer:
            self.optimizer.load_state_dict(training.optimizer["adam"])
            device = mirror.surfels.means.device
            self.statistics = DensityStatistics(*(part.to(device) for part in training.optimizer["gradients"]))
        self._objective = mirror.objective(views, config)
        self._frozen = frozenset(mirror.surfels.named()) - self._objective.learned
        for name in self._frozen:
            getattr(self.optimizer.surfels, name).requires_grad_(False)

    def current(self) -> tuple[SurfelMirror, Training]:
        """Surfels and training after the last step."""
        gradients = [self.statistics.gradient_sum, self.statistics.count]
        optimizer = {"adam": self.optimizer.state_dict(), "gradients": gradients}
        environment = self.optimizer.environment.detach()
        training = Training(environment, self.evidence, self.iteration, optimizer)
        share = self.iteration / self.config.splats.iterations
        return self._mirror.at(self.optimizer.surfels.detached(), share, self._objective), training

    def step(self) -> LossTerms:
        """One step on one view."""
        terms = self._step(self.iteration)
        self.iteration += 1
        return terms

    def _step(self, iteration: int) -> LossTerms:
        self._restart(iteration)
        view = self.views.train[self._view_index(iteration)]
        surfels = self.optimizer.surfels
        offsets = None
        if self.config.splats.density.enabled:
            offsets = torch.zeros_like(surfels.means[:, :2], requires_grad=True)
        step = self._objective.evaluate(view, surfels, self.optimizer.environment, iteration, offsets)
        step.terms.total.backward()  # type: ignore[no-untyped-call]
        total = float(step.terms.total.detach())
        if not math.isfinite(total):
            raise InputError(
                expected="a finite loss",
                found=f"{total} at iteration {iteration}",
                remedy="Check the images for extreme values, or take --preset default.",
            )
        if offsets is not None and offsets.grad is not None:
            self.statistics.observe(offsets.grad, step.in_frustum, view.camera.width)
        self.optimizer.step(
            self.schedule.rate_factor(iteration),
            geometry=self.schedule.geometry_moves(iteration),
            frozen=self._frozen | self.schedule.resting(iteration),
            means_factor=self.schedule.means_factor(iteration),
            environment_bounds=(0, self._brightest) if self.config.environment.activation == "clamp" else UNBOUNDED,
        )
        if step.observed is not None:
            accumulate(self.evidence, step.observed.directions, step.observed.alpha, OBSERVED_ALPHA)
        self._control_density(iteration)
        if iteration % CURVE_EVERY == 0:
            self._record(iteration, step.terms)
        return step.terms

    def _restart(self, iteration: int) -> None:
        """Materials and map begin again where the objective says so; shapes stay."""
        if self._objective.restarts(iteration):
            self.optimizer.set_values(self._objective.restarted(self.optimizer.surfels.detached()))
            generator = generator_of(self.config.seed, iteration, 3)
            self.optimizer.set_environment(first_map(self.config, generator).to(self.optimizer.environment.device))

    def _view_index(self, iteration: int) -> int:
        """Every epoch visits all views once, in an order that depends on seed and epoch only."""
        epoch, position = divmod(iteration, len(self.views.train))
        if self._epoch != epoch:
            self._epoch = epoch
            generator = generator_of(self.config.seed, epoch)
            self._order = torch.randperm(len(self.views.train), generator=generator).tolist()
        return self._order[position]

    def _control_density(self, iteration: int) -> None:
        surfels = self.optimizer.surfels
        if self.schedule.density_round(iteration):
            generator = generator_of(self.config.seed, iteration, 2)
            prune_faint = self.schedule.opacities_recovered(iteration)
            edit = grow_and_prune(
                surfels,
                self.statistics,
                generator,
                max_surfels=self.config.splats.density.max_surfels,
                least_opacity=published(self.config).least_opacity if prune_faint else 0.0,
                unit=self._unit,
            )
            self.optimizer.edit_surfels(edit.surfels, edit.source, edit.unchanged)
            self.statistics = DensityStatistics.empty(self.optimizer.surfels.count, surfels.means.device)
        if self.schedule.opacity_reset(iteration):
            self.optimizer.set_values(self._objective.revived(reset_opacities(self.optimizer.surfels)))
        elif self.schedule.propagation(iteration):
            self.optimizer.set_values(self._objective.propagated(self.optimizer.surfels, iteration))

    def _record(self, iteration: int, terms: LossTerms) -> None:
        point = {
            "iteration": float(iteration),
            "photometric loss": terms.photometric,
            "normal consistency loss": terms.normal_consistency,
            "silhouette loss": terms.silhouette,
            "surfels": float(self.optimizer.surfels.count),
        }
        self.observer.record(point)
