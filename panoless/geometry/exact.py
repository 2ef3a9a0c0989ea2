"""What kinds in closed form share: exact rays, one map, no steps of optimization."""

from collections.abc import Collection
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.corrections import NO_CORRECTIONS, Corrections
from panoless.capture.encoding import encoding_of
from panoless.capture.poses import Poses
from panoless.capture.rays import pixel_rays, reflect, unit_rays_camera
from panoless.capture.views import TrainView, Views, at_most_pixels
from panoless.config import FitConfig
from panoless.deadline import improving
from panoless.environment.direct import direct_rays
from panoless.environment.footprints import Footprints, PixelFootprints
from panoless.environment.rays import Rays, normalize_confidence
from panoless.environment.reflectance import Reflectance
from panoless.environment.resolution import RESOLUTIONS, densest_resolution
from panoless.environment.sharpening import sharpest_map
from panoless.environment.solve import merged, solve_environment
from panoless.environment.surroundings import Surroundings
from panoless.geometry.base import (
    ClosedForm,
    Family,
    Geometry,
    Proposal,
    Propose,
    SurfaceBuffers,
    buffers_by_hits,
    from_plain,
    observe_views,
    placed,
    to_plain,
)
from panoless.kernels.camera import RasterCamera, reflection_directions_world
from panoless.kernels.constants import SUB_PIXELS
from panoless.kernels.cubemap import sample_cubemap
from panoless.problem.blocks import Block
from panoless.problem.corrected import Corrected
from panoless.problem.evidence import Decision
from panoless.problem.nuisance import nuisance_of
from panoless.problem.parametric import ParametricSurface
from panoless.problem.solve import FINISH, LEAST_VIEWS, MOST_VIEWS, after_round, by_silhouettes, solve
from shinypartial.core.camera import Similarity

PROPOSALS = 3
"""Most by corrected silhouettes."""
NEAR_PX = 0.2
"""Distance of a proposal from the masks that is left as it is."""
LARGEST_SHARE_LEFT = 0.8
"""Of that distance, by which cameras are turned. From true cameras it is 0.98 and 1.01 on vase and mirror, with turns
of 0.1° 0.44 and 0.34. Of a wrong kind, true cameras leave 0.82 to 0.95."""


@dataclass(frozen=True)
class ExactGeometry:
    """A surface that rays meet exactly: one primitive, whose map is solved from all rays at once."""

    poses: Poses | None = field(default=None, kw_only=True)
    """Of the training views, where these were unknowns."""

    @property
    def shape(self) -> Any:
        """The surface: the first field of the kind."""
        return getattr(self, fields(self)[1].name)

    @property
    def reflectance(self) -> Reflectance | None:
        """That with which the shape was solved; None: as a perfect mirror's."""
        return None

    @property
    def num_parameters(self) -> int:
        """Number of unknowns of the surface."""
        return int(self.shape.num_parameters)

    @property
    def surroundings(self) -> Surroundings:
        """Surroundings of the surface."""
        return cast(Surroundings, self.shape.surroundings)

    def with_shape(self, shape: Any) -> Any:
        """Another surface."""
        return replace(self, **{fields(self)[1].name: shape})

    def in_surroundings(self, surroundings: Surroundings) -> Any:
        """The same surface in other surroundings."""
        return self.with_shape(placed(self.shape, surroundings))

    def buffers(self, camera: RasterCamera) -> SurfaceBuffers:
        """See `buffers_by_hits`."""
        return buffers_by_hits(self.shape, camera)

    @property
    def num_primitives(self) -> int:
        """One."""
        return 1

    def with_poses(self, poses: Poses | None) -> Any:
        """The same surface with the cameras there."""
        return replace(self, poses=poses)

    def corrected(self, views: Views) -> Views:
        """With their cameras where the fit found them."""
        return views if self.poses is None else self.poses.moved(views)

    def footprints(self, views: Views, max_pixels: int) -> Footprints | None:
        """None: a pixel is its center."""
        return None

    def solve_map(self, views: Views, config: FitConfig) -> tuple[Float[Tensor, "6 3 L L"], list[Rays]]:
        """The map from all rays, and from footprints where the kind has them.

        It starts from nothing, because a coarse start would reject what is finer. Footprints are means of radiance, so
        they take no part where radiance is encoded. What is seen past the object are rays as any others.
        """
        rays = normalize_confidence(merged(observe_views(views, cast(Geometry, self), config.environment.rays)))
        resolution, encoding = config.environment.solve_resolution, encoding_of(config)
        direct = direct_rays(views, self.surroundings, rays)
        rays = [*rays, direct] if len(direct.directions) else rays
        footprints = None if encoding.high_dynamic_range else self.footprints(views, config.environment.rays)
        if footprints is None or not footprints.smooth:
            return solve_environment(rays, resolution or densest_resolution(rays)), rays
        resolutions = (resolution,) if resolution else RESOLUTIONS
        widened = footprints.widened(views.blur_px)
        return sharpest_map(widened, rays, resolutions, encoding.saturation), rays

    def shade(
        self,
        environment: Float[Tensor, "6 3 L L"],
        camera: RasterCamera,
        pixels: Int[Tensor, "P"],
        normals_camera: Float[Tensor, "3 P"],
    ) -> Float[Tensor, "P 3"]:
        """The map where the normals mirror the pixels' centers to."""
        if self.surroundings.is_far:
            return shade_centers(environment, camera, pixels, normals_camera)
        directions = mirrored_directions(camera, pixels, normals_camera)
        depth = self.buffers(camera).depth
        return sample_cubemap(environment, looked_up(self.surroundings, camera, depth, pixels, directions))

    def to(self, device: torch.device) -> Any:
        """Itself: its numbers are arrays in main memory."""
        return self

    def state_dict(self) -> dict[str, Any]:
        """All numbers as lists and plain values."""
        plain: dict[str, Any] = to_plain(self)
        return plain

    @classmethod
    def from_state_dict(cls, content: dict[str, Any]) -> Any:
        """The geometry that `state_dict` was taken from."""
        return from_plain(cls, content)


class ExactFamily:
    """A kind that is fitted at once, without steps."""

    geometry: ClassVar[type[Geometry]]
    refines: ClassVar[str | None] = None
    in_few_steps: ClassVar[bool] = True
    needs_depth: ClassVar[bool] = True
    silhouettes_suffice: ClassVar[bool] = False
    by_silhouettes: ClassVar[bool] = False
    """Whether silhouettes determine the shape to the end, so that photographs do not refine it."""

    def proposed_over(
        self, views: Views, proposal: Proposal, config: FitConfig, *, requested: bool = False
    ) -> Proposal | None:
        """The proposal itself."""
        return proposal

    def with_silhouettes(self, views: Views) -> Views:
        """Views with masks whose contours are silhouettes of the kind: themselves."""
        return views

    def as_proposed(self, proposal: Proposal, config: FitConfig) -> Geometry:
        """The geometry of the shape."""
        return cast(Any, self.geometry)(proposal.shape)

    def before_steps(self, views: Views, proposal: Proposal, config: FitConfig) -> Geometry:
        """The proposal itself."""
        return self.as_proposed(proposal, config)

    def refitted(self, views: Views, fitted: Any, config: FitConfig) -> Geometry:
        """By silhouettes once more, or after the last round of the joint solve."""
        if self.by_silhouettes:
            again = cast(Family, self).propose(views, config, requested=False)
            return fitted if again is None else fitted.with_shape(again.shape).in_surroundings(fitted.surroundings)
        with torch.no_grad():
            surface = self.unknowns(views, Proposal(fitted.shape, 0.0, 1.0), config)
            return fitted.with_shape(after_round(views, surface, FINISH, FINISH.resolution).shape)

    def unknowns(self, views: Views, proposal: Proposal, config: FitConfig) -> ParametricSurface:
        """A proposal as a surface of few numbers."""
        raise NotImplementedError

    def begun(self, views: Views, surface: Any, config: FitConfig) -> Any:
        """What photographs start from, after silhouettes of views that are corrected; the surface itself."""
        return surface

    def solve(
        self,
        views: Views,
        proposal: Proposal,
        kinds: Collection[type[Block]],
        required: Collection[str],
        config: FitConfig,
        propose: Propose,
    ) -> tuple[Geometry, Corrections, list[Decision]]:
        """The fit to photographs as they are stated where the scene needs none of the blocks; else that to photographs
        which are corrected by what a surface of few numbers leaves to the blocks.
        """
        views, around = self.with_silhouettes(views), proposal.shape.surroundings
        if not LEAST_VIEWS <= len(views.train) <= MOST_VIEWS:
            kinds = ()
        if (self.by_silhouettes or self.silhouettes_suffice) and not kinds:
            return self.finished(views, self.as_proposed(proposal, config), config), NO_CORRECTIONS, []
        start = proposal
        with torch.no_grad():
            if kinds:
                start = proposal.in_surroundings(around.without_walls)
                start = self._proposed_again(views, start, kinds, config, propose)
            found = solve(
                views,
                self.unknowns(views, start, config),
                kinds,
                required,
                lambda state: self.begun(Corrected.by(state.nuisance).applied(views, config), state.surface, config),
                around=around,
            )
        nuisance = found.state.nuisance
        by = Corrected.by(nuisance, found.variances)
        corrected = by.applied(views, config)
        around = nuisance.around(start.shape.surroundings).scaled(by.scale)
        if self.by_silhouettes:
            again = propose(corrected) if nuisance.blocks else proposal
            geometry = cast(Any, self.as_proposed(again or start, config))
        else:
            scaled = found.state.surface.taken_back(Similarity(1 / by.scale, np.eye(3), np.zeros(3)))
            geometry = cast(Any, self.as_proposed(start, config)).with_shape(scaled.shape)
        geometry = geometry.in_surroundings(around)
        with improving():
            geometry = self.finished(corrected, geometry, config)
        return geometry.with_poses(by.poses), by.corrections, list(found.decisions)

    def finished(self, views: Views, solved: Any, config: FitConfig) -> Any:
        """What steps of the kind alone make of the solved geometry: itself."""
        return solved

    def _proposed_again(
        self, views: Views, proposal: Proposal, kinds: Collection[type[Block]], config: FitConfig, propose: Propose
    ) -> Proposal:
        """A proposal of views that silhouettes corrected by the one before, as long as it comes nearer to the masks."""
        with improving():
            for _ in range(PROPOSALS):
                if proposal.silhouette_px <= NEAR_PX:
                    break
                state = by_silhouettes(views, self.unknowns(views, proposal, config), nuisance_of(views, kinds))
                again = propose(Corrected.by(state.nuisance).applied(views, config))
                if again is None or again.silhouette_px > LARGEST_SHARE_LEFT * proposal.silhouette_px:
                    break
                proposal = again.in_surroundings(proposal.shape.surroundings)
        return proposal

    def poses_by_silhouettes(
        self, views: Views, proposal: Proposal, kinds: Collection[type[Block]], config: FitConfig
    ) -> Poses:
        """See `panoless.problem.solve.by_silhouettes`."""
        views = self.with_silhouettes(views)
        with torch.no_grad():
            state = by_silhouettes(views, self.unknowns(views, proposal, config), nuisance_of(views, kinds))
        found = Corrected.by(state.nuisance).poses
        assert found is not None, "cameras are unknowns"
        return found


class SeenByCenters(ExactGeometry):
    """A surface that is traced through pixel centers. Over its area, a pixel sees what centers do in pictures that are
    shifted by parts of a pixel.
    """

    def usable_pixels(self, view: TrainView) -> Int[Tensor, "P"]:
        """Solid pixels that see the surroundings."""
        return self.seen(view, view.solid)[0]

    def seen(self, view: TrainView, pixels: Int[Tensor, "P"]) -> tuple[Int[Tensor, "Q"], Float[Tensor, "Q 3"]]:
        """Which of the pixels see the surroundings, in order, and where these look in the map: after one reflection."""
        outgoing, met = reflected(self.shape, *pixel_rays(view.camera, pixels.cpu().numpy()))
        return pixels[torch.from_numpy(met).to(pixels.device)], torch.from_numpy(outgoing[met]).to(view.radiance)

    def observe(self, view: TrainView, pixels: Int[Tensor, "P"]) -> Rays:
        """The rays of those of the pixels that see the surroundings."""
        chosen, directions = self.seen(view, pixels)
        return Rays(directions, view.radiance_at(chosen), incoming=view.directions_world(chosen))

    def footprints(self, views: Views, max_pixels: int) -> Footprints | None:
        """Four directions over each of about so many pixels at most; None where no pixel has all of them."""
        found = []
        for view, pixels in at_most_pixels(views, max_pixels):
            parts = [self.seen(_shifted(view, *place), pixels) for place in SUB_PIXELS[4]]
            count = torch.bincount(torch.cat([each for each, _ in parts]), minlength=view.mask.numel())
            whole = count == len(parts)
            directions = torch.stack([looks[whole[each]] for each, looks in parts], 1)
            found.append(PixelFootprints(directions, view.radiance_at(pixels[whole[pixels]])))
        return Footprints.of(found)


def _shifted(view: TrainView, right: float, down: float) -> TrainView:
    """A view whose rays through pixel centers are those through other places within the pixels."""
    camera = view.camera
    return replace(view, camera=replace(camera, cx=camera.cx - right, cy=camera.cy - down))


def reflected(
    surface: ClosedForm, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]
) -> tuple[Float[np.ndarray, "P 3"], Bool[np.ndarray, "P"]]:
    """Directions in the map of rays after one reflection by a surface, and which rays meet it."""
    hits = surface.hits(origins, directions)
    outgoing = reflect(directions / np.linalg.norm(directions, axis=1, keepdims=True), hits.normals)
    return surface.surroundings.looked_up(hits.points, outgoing), hits.met


def shade_centers(
    environment: Float[Tensor, "6 3 L L"],
    camera: RasterCamera,
    pixels: Int[Tensor, "P"],
    normals_camera: Float[Tensor, "3 P"],
) -> Float[Tensor, "P 3"]:
    """E(ω) of the rays through pixel centers, reflected at the given normals (of any length)."""
    return sample_cubemap(environment, mirrored_directions(camera, pixels, normals_camera))


def mirrored_directions(
    camera: RasterCamera, pixels: Int[Tensor, "P"], normals_camera: Float[Tensor, "3 P"]
) -> Float[Tensor, "P 3"]:
    """World directions of the rays through pixel centers (flat indices), reflected at normals of any length."""
    rays = unit_rays_camera(camera, normals_camera.device).flatten(1)[:, pixels]
    return reflection_directions_world(normals_camera, rays, camera.world_to_camera[:3, :3].T)


def looked_up(
    surroundings: Surroundings,
    camera: RasterCamera,
    depth: Float[Tensor, "H W"],
    pixels: Int[Tensor, "P"],
    directions: Float[Tensor, "P 3"],
) -> Float[Tensor, "P 3"]:
    """Where in the map the mirrored directions of pixels (flat indices) look, by the depth of the surface there."""
    if surroundings.is_far:
        return directions
    origins, rays = pixel_rays(camera, pixels.cpu().numpy())
    points = origins + depth.flatten()[pixels].cpu().numpy().astype(np.float64)[:, None] * rays
    unit = directions.cpu().numpy().astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return torch.from_numpy(surroundings.looked_up(points, unit)).to(directions)
