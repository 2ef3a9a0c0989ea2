"""Surfels as a kind of geometry: what fits when nothing simpler does, in steps of gradient descent."""

from typing import Any, ClassVar, cast

import torch

from panoless.capture.lens import LensChange
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.cubemap import initial_environment, resample
from panoless.environment.solve import solve_environment
from panoless.geometry.base import Geometry, Proposal, ToldPoses, Training, TrainingObserver, observe_views
from panoless.geometry.surfels.mirror import SurfelMirror
from panoless.geometry.surfels.placement import initial_surfels
from panoless.geometry.surfels.shading.geometry import ShadedMirror
from panoless.geometry.surfels.train import train_surfels


class SurfelFamily:
    """Free surfels."""

    kind: ClassVar[str] = "surfels"
    geometry: ClassVar[type[Geometry]] = SurfelMirror
    label: ClassVar[str] = "surfels"
    finds_poses: ClassVar[bool] = True
    refines: ClassVar[str | None] = None
    needs_depth: ClassVar[bool] = True
    told_by_outlines: ClassVar[bool] = False

    def propose(self, views: Views, config: FitConfig, *, asked: bool) -> Proposal | None:
        """Surfels explain any silhouettes."""
        return Proposal(None, 0.0, 1.0)

    def as_proposed(self, proposal: Proposal, config: FitConfig) -> Geometry | None:
        """None: they begin on another geometry, or on the first surface."""
        return None

    def before_steps(self, views: Views, proposal: Proposal, config: FitConfig) -> Geometry | None:
        """None: they know only a far world."""
        return None

    def fit(self, views: Views, proposal: Proposal, config: FitConfig) -> Geometry:
        """Those that the steps begin with: on a geometry that was proposed, else on the first surface."""
        if proposal.shape is not None:
            start = cast(SurfelMirror, proposal.shape.to_surfels(config).with_poses(proposal.shape.poses))
            return ShadedMirror.begun(start, config).to(views.train[0].mask.device)
        surfels = initial_surfels(views, config.surfels, config.seed)
        return ShadedMirror.begun(SurfelMirror.of(surfels, config), config)

    def poses_by_outlines(self, views: Views, proposal: Proposal, config: FitConfig) -> ToldPoses | None:
        """None: cameras are where the geometry has them that surfels start on."""
        return None

    def with_lens(
        self, views: Views, fitted: Any, unknown: LensChange, config: FitConfig
    ) -> tuple[Geometry, LensChange] | None:
        """None: what surfels are trained on is believed."""
        return None

    def after_as_many_steps(self, views: Views, fitted: Any, config: FitConfig) -> Geometry:
        """The same: none are taken."""
        return cast(Geometry, fitted)

    def begin(self, views: Views, geometry: Geometry, config: FitConfig) -> Training:
        """The map that fits the first surfels best; the configured one where maps are not solved."""
        device = views.train[0].mask.device
        environment = initial_environment(config.environment, torch.Generator().manual_seed(config.seed)).to(device)
        length = environment.shape[-1]
        if config.environment.solve and config.environment.activation == "clamp":
            with torch.no_grad():
                rays = list(observe_views(views, geometry, config.surfels.tuned.initial_rays))
                environment = resample(solve_environment(rays, length // 2), length)
        return Training(environment, environment.new_zeros(6, length, length))

    def train(
        self, views: Views, geometry: Geometry, training: Training, config: FitConfig, observer: TrainingObserver
    ) -> tuple[Geometry, Training]:
        """The remaining steps."""
        return train_surfels(views, cast(SurfelMirror, geometry), training, config, observer)
