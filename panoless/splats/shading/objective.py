"""What the steps of other methods minimize: their image beside the photograph, and what a method adds to that."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from panoless.kernels.camera import RasterCamera
from panoless.splats.kernels.reference.objective import silhouette
from panoless.splats.losses import photometric_paper
from panoless.splats.model import ShadedSurfels, Surfels
from panoless.splats.objective import LossTerms, Step, composited, generator_of
from panoless.splats.schedule import Schedule
from panoless.splats.shading.base import Shading, blend_surfels, consistency_with_depth
from panoless.splats.shading.occlusion import BEGINS, EVERY, MOST_VIEWS, DepthMap, Occluder

SHAPES = frozenset({"means", "quats", "log_scales", "opacity_logits"})


def learned_by(shading: Shading) -> frozenset[str]:
    """The parameters that steps of a method change."""
    return SHAPES | shading.learned


class ShadedObjective:
    """(1 − λ_s) L1 + λ_s (1 − SSIM) + λ_nd · consistency + λ_α · silhouette + the method's own penalty."""

    def __init__(self, shading: Shading, views: Views, config: FitConfig, occluder: Occluder | None = None) -> None:
        """Of one method, with the weights of a configuration, and what is known already of what hides its map."""
        self._neighbors, self._cameras = nearest_views(views), [view.camera for view in views.train]
        self.occluder = occluder
        """What hides the map, of the surface as it was when it was last requested."""
        self._shading, self._config, self._schedule = shading, config, Schedule(config)
        self.learned = learned_by(shading)

    def evaluate(
        self,
        view: TrainView,
        surfels: Surfels,
        environment: Float[Tensor, "6 3 L L"],
        iteration: int,
        offsets: Float[Tensor, "K 2"] | None,
    ) -> Step:
        """The objective over all pixels of the picture."""
        primitives, loss = cast(ShadedSurfels, surfels), self._config.splats.loss
        share = iteration / self._config.splats.iterations
        sigmoid = self._config.environment.activation == "sigmoid"
        light = torch.sigmoid(environment) if sigmoid else environment
        self._renew_occluder(primitives, iteration)
        seen = self._shading.seen(primitives, view.camera, light, share, offsets, self.occluder)
        surface = seen.surface
        everywhere = torch.arange(view.mask.numel(), device=view.mask.device)
        color = (seen.diffuse + seen.specular).flatten(1)
        image, target = composited(color, surface.alpha.flatten(), everywhere, view, view.radiance.new_ones(3, 1))
        total = photometric = photometric_paper(image, target)
        consistency = outline = photometric.new_zeros(())
        if loss.lambda_normal_consistency > 0:
            consistency = consistency_with_depth(surface, view.camera, torch.ones_like(view.mask))
            total = total + loss.lambda_normal_consistency * consistency
        weight_of_outline = self._schedule.lambda_silhouette(iteration)
        if weight_of_outline > 0:
            outline = silhouette(surface.alpha, view.mask)
            total = total + weight_of_outline * outline
        penalty = self._shading.penalty(seen, primitives, view, self._neighbors[id(view)], share)
        if penalty is not None:
            total = total + penalty
        parts = (float(part.detach()) for part in (photometric, consistency, outline))
        return Step(LossTerms(total, *parts), surface.in_frustum)

    def propagated(self, surfels: Surfels, iteration: int) -> Surfels:
        """As the method has it."""
        generator = generator_of(self._config.seed, iteration, 4)
        share = iteration / self._config.splats.iterations
        return self._shading.propagated(cast(ShadedSurfels, surfels), share, generator)

    def restarts(self, iteration: int) -> bool:
        """At the method's share of the steps."""
        return self._schedule.reached(iteration, self._shading.restarts_at)

    def restarted(self, surfels: Surfels) -> Surfels:
        """With the method's first materials; shapes stay."""
        fresh = self._shading.begun(surfels, random=False).named()
        return replace(surfels, **{name: fresh[name] for name in self._shading.learned})

    def _renew_occluder(self, primitives: ShadedSurfels, iteration: int) -> None:
        if not self._shading.traces or not self._schedule.begun(iteration, BEGINS):
            return
        if self.occluder is None or self._schedule.due(iteration, EVERY):
            self.occluder = occluder_of(primitives.detached(), self._cameras)

    def revived(self, surfels: Surfels) -> Surfels:
        """After opacities were reset."""
        return self._shading.revived(cast(ShadedSurfels, surfels))


@torch.no_grad()
def occluder_of(surfels: ShadedSurfels, cameras: Sequence[RasterCamera]) -> Occluder:
    """Distances to the surface that cameras see of surfels."""
    chosen = cameras[:: math.ceil(len(cameras) / MOST_VIEWS)]
    seen = ((camera, blend_surfels(surfels, camera, surfels.base_color_logits, None)) for camera in chosen)
    maps = (DepthMap(camera, each.depth, each.alpha) for camera, each in seen)
    return Occluder.fused(maps, surfels.means.device)


def nearest_views(views: Views) -> dict[int, RasterCamera]:
    """The camera of the view nearest to each, by the view's identity; its own where there is no other."""
    places = torch.from_numpy(np.stack([view.position for view in views.train]))
    apart = torch.cdist(places, places).fill_diagonal_(torch.inf)
    nearest = apart.argmin(1).tolist()
    return {id(view): views.train[other].camera for view, other in zip(views.train, nearest, strict=True)}
