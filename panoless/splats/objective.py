"""What one step of a fit of surfels minimizes, and that of a mirror."""

from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from panoless.capture.views import TrainView
from panoless.config import FitConfig
from panoless.environment.cubemap import look_up
from panoless.geometry.exact import mirrored_directions
from panoless.splats.density import propagate_normals
from panoless.splats.kernels.objective import mirror_objective
from panoless.splats.kernels.rasterize import Channels, RasterBuffers
from panoless.splats.losses import photometric_paper
from panoless.splats.model import Surfels
from panoless.splats.rendering import ALPHA_FLOOR, compose, rasterize_surfels
from panoless.splats.schedule import Phase, Schedule, phase_of
from panoless.splats.targets import Target


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


@dataclass(frozen=True)
class Step:
    """What one view says of surfels and map."""

    terms: LossTerms
    in_frustum: Bool[Tensor, " K"]
    observed: Observed | None = None


@runtime_checkable
class StepObjective(Protocol):
    """What the steps of a fit minimize, and what surfels of its kind become between them."""

    learned: frozenset[str]
    """The parameters that steps change."""

    def evaluate(
        self,
        view: TrainView,
        surfels: Surfels,
        environment: Float[Tensor, "6 3 L L"],
        iteration: int,
        offsets: Float[Tensor, "K 2"] | None,
    ) -> Step:
        """The objective of one view; density control reads the gradient of `offsets`."""
        ...

    def propagated(self, surfels: Surfels, iteration: int) -> Surfels:
        """After a round of normal propagation."""
        ...

    def revived(self, surfels: Surfels) -> Surfels:
        """After opacities were reset."""
        ...

    def restarts(self, iteration: int) -> bool:
        """Whether materials and map begin again before this iteration."""
        ...

    def restarted(self, surfels: Surfels) -> Surfels:
        """With materials as at the start."""
        ...


def generator_of(seed: int, *salt: int) -> torch.Generator:
    """Randomness that depends only on the seed and the place in the fit, so a resumed fit repeats it."""
    number = seed
    for part in salt:
        number = (number * 1_000_003 + part + 1) % (1 << 62)
    return torch.Generator().manual_seed(number)


def composited(
    color: Float[Tensor, "3 P"],
    alpha: Float[Tensor, "P"],
    pixels: Tensor,
    view: TrainView,
    background: Float[Tensor, "3 1"],
) -> tuple[Float[Tensor, "3 H W"], Float[Tensor, "3 H W"]]:
    """A picture, premultiplied at the given pixels and empty elsewhere, and the photograph, both over a background."""
    image = background.expand(3, view.mask.numel()).clone()
    image[:, pixels] = color + (1 - alpha) * background
    target = view.radiance + (1 - view.mask) * background[:, :, None]
    return image.view_as(target), target


class MirrorObjective:
    """The objective of the paper, or that of a mirror alone (see `panoless.splats.kernels.objective`)."""

    def __init__(self, config: FitConfig) -> None:
        """As a configuration takes it."""
        self.config, self._schedule = config, Schedule(config)
        self._phases = dict[tuple[bool, float], Phase]()
        self._targets: MutableMapping[TrainView, Target] = WeakIdKeyDictionary()
        switches = {
            "albedo": config.splats.albedo,
            "curvatures": config.splats.surfels.curved,
            "roughness_logits": config.splats.loss.roughness_weighted,
        }
        always = {"means", "quats", "log_scales", "opacity_logits"}
        self.learned = frozenset(always | {name for name, learned in switches.items() if learned})

    def evaluate(
        self,
        view: TrainView,
        surfels: Surfels,
        environment: Float[Tensor, "6 3 L L"],
        iteration: int,
        offsets: Float[Tensor, "K 2"] | None,
    ) -> Step:
        """Eq. 14. While only the environment learns, surfels need no gradient, unless density control counts it."""
        phase, target = self._phase(iteration), self._target(view)
        with torch.set_grad_enabled(phase.geometry_moves or offsets is not None):
            raster = rasterize_surfels(
                surfels,
                view.camera,
                curved=self.config.splats.surfels.curved,
                screen_offsets=offsets,
                channels=phase.channels,
                active_tiles=_active_tiles(target, phase),
            )
        objective = mirror_objective(
            raster.normals_camera,
            raster.alpha,
            raster.accumulated_depth,
            raster.median_depth,
            raster.colors if self.config.splats.albedo else None,
            environment,
            target.mirror,
            phase.terms,
        )
        total, photometric = objective.total, objective.photometric
        pixels = view.solid
        if not phase.terms.photometric:
            pixels = torch.nonzero(raster.alpha.detach().flatten() > ALPHA_FLOOR)[:, 0]
            error = self._composited_error(view, raster, surfels, environment, pixels, iteration)
            total, photometric = total + error, float(error.detach())
        observed = None
        if self.config.splats.visibility == "online":
            with torch.no_grad():
                directions = mirrored_directions(view.camera, pixels, raster.normals_camera.flatten(1)[:, pixels])
                observed = Observed(directions, raster.alpha.flatten()[pixels])
        terms = LossTerms(total, photometric, objective.normal_consistency, objective.silhouette)
        return Step(terms, raster.in_frustum, observed)

    def propagated(self, surfels: Surfels, iteration: int) -> Surfels:
        """Larger and more opaque."""
        return propagate_normals(surfels)

    def revived(self, surfels: Surfels) -> Surfels:
        """As they are."""
        return surfels

    def restarts(self, iteration: int) -> bool:
        """Never."""
        return False

    def restarted(self, surfels: Surfels) -> Surfels:
        """Never called."""
        return surfels

    def _phase(self, iteration: int) -> Phase:
        acts = self._schedule.geometry_moves(iteration), self._schedule.lambda_silhouette(iteration)
        if acts not in self._phases:
            self._phases[acts] = phase_of(self.config, *acts)
        return self._phases[acts]

    def _target(self, view: TrainView) -> Target:
        if view not in self._targets:
            self._targets[view] = Target.of(view)
        return self._targets[view]

    def _composited_error(
        self,
        view: TrainView,
        buffers: RasterBuffers,
        surfels: Surfels,
        environment: Float[Tensor, "6 3 L L"],
        pixels: Tensor,
        iteration: int,
    ) -> Tensor:
        """Eq. 9 over the whole image, to which the given pixels add more than the background, a random color a step."""
        alpha = buffers.alpha.flatten()[pixels]
        directions = mirrored_directions(view.camera, pixels, buffers.normals_camera.flatten(1)[:, pixels])
        specular = look_up(environment, directions, self.config.environment.activation).T
        if self.config.splats.loss.roughness_weighted:
            specular = specular * (1 - self._roughness(view, surfels).flatten()[pixels]).square()
        color = compose(buffers.colors.flatten(1)[:, pixels], specular, alpha, self.config.splats.alpha_applied)
        background = torch.rand(3, 1, generator=generator_of(self.config.seed, iteration, 1)).to(view.radiance)
        return photometric_paper(*composited(color, alpha, pixels, view, background))

    def _roughness(self, view: TrainView, surfels: Surfels) -> Float[Tensor, "H W"]:
        roughness = torch.sigmoid(surfels.roughness_logits)[:, None].expand(-1, 3).contiguous()
        channels = Channels(depth=False, distortion=False)
        return rasterize_surfels(surfels, view.camera, curved=False, attribute=roughness, channels=channels).colors[0]


def _active_tiles(target: Target, phase: Phase) -> Tensor | None:
    """The tiles that some term of a phase reads; None for all."""
    if phase.everywhere:
        return None
    return target.mask_tiles if phase.channels.depth else target.solid_tiles
