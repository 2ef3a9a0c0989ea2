"""The free-form surface as a kind of geometry."""

from collections.abc import Collection, MutableMapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from panoless.capture.corrections import NO_CORRECTIONS, Corrections
from panoless.capture.encoding import NO_TINT, encoding_of
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.poses import Poses
from panoless.capture.views import TrainView, Views, at_most_pixels
from panoless.config import FitConfig
from panoless.environment.footprints import Footprints, PixelFootprints
from panoless.environment.rays import Rays
from panoless.environment.reflectance import Reflectance
from panoless.geometry.base import (
    Geometry,
    Mesh,
    Proposal,
    Propose,
    SurfaceBuffers,
    from_plain,
    poses_from_plain,
    to_plain,
)
from panoless.geometry.exact import ExactFamily, ExactGeometry
from panoless.geometry.free_form.fit import FitStage, continued_fit, fit_free_form, variances
from panoless.geometry.free_form.material import EVEN, Material
from panoless.geometry.free_form.photometric import BAND_CELLS, ReflectedRays
from panoless.geometry.free_form.rendering import free_form_buffers, free_form_light
from panoless.geometry.free_form.schedule import Schedule
from panoless.geometry.free_form.start import first_surfaces, started
from panoless.geometry.free_form.surface import LevelSet
from panoless.geometry.free_form.trust import Trust, full_trust
from panoless.kernels.camera import RasterCamera
from panoless.problem.blocks import Block
from panoless.problem.corrected import Corrected
from panoless.problem.evidence import Decision, scored
from panoless.problem.nuisance import nuisance_of
from panoless.problem.observations import inner_distance_px
from panoless.problem.rays import PixelRays

LEAST_VIEWS = 5
"""With fewer views none is held out, and model selection leaves the kind out."""
LEAST_MAP_COSINE = 0.03
"""Between the ray and the surface's normal, for a pixel to count for the final map."""
MAP_INNER_PX = 1.0
"""Its pixels lie farther inside their mask."""
FOOTPRINTS = 2_000_000
"""Most pixels whose areas sharpen it, for memory."""
WIDEST_FOOTPRINT_RAD = 0.15
"""Pixels that mirror more in one direction take no part in that…"""
LEAST_FOOTPRINT_TRUST = 0.3
"""…nor do pixels that are trusted less."""


@dataclass(frozen=True)
class _Traces:
    """Where the rays of a view's pixels meet the surface, not a number where none was traced, and whether they see the
    surroundings by way of it.
    """

    camera: RasterCamera
    distance: Float[np.ndarray, "P"]
    clear: Bool[np.ndarray, "P"]

    @classmethod
    def none(cls, camera: RasterCamera) -> "_Traces":
        """Of no pixel."""
        count = camera.width * camera.height
        return cls(camera, np.full(count, np.nan), np.zeros(count, dtype=bool))

    def are_of(self, camera: RasterCamera) -> bool:
        """Whether they are of that camera."""
        pose, other = self.camera.world_to_camera, camera.world_to_camera
        return torch.equal(pose, other) and replace(self.camera, world_to_camera=other) == camera


@dataclass(frozen=True)
class FreeFormMirror(ExactGeometry):
    """A closed surface, and how far each part of it is trusted."""

    kind: ClassVar[str] = "free_form"
    surface: LevelSet
    trust: Trust
    occlusion_test: bool = True
    """Whether pixels that see the object again are left out."""
    material: Material | None = None
    """What places mirror and scatter, where the shape was solved with it. A saved state has it as its reflectance."""

    @property
    def reflectance(self) -> Reflectance | None:
        """Of that material."""
        return None if self.material is None else Reflectance(np.ones(3), field=self.material.field)

    @property
    def num_parameters(self) -> int:
        """The coefficients whose support meets the surface."""
        return int((np.abs(self.surface.at_nodes()) < BAND_CELLS).sum())

    def usable_pixels(self, view: TrainView) -> Int[Tensor, "P"]:
        """Solid pixels that see the surroundings by way of the surface, but for the outermost ones."""
        _, traces = self._traced(view, view.solid)
        seeing = self._seeing(view, view.solid, traces.clear[view.solid.cpu().numpy()])
        return view.solid[torch.from_numpy(seeing).to(view.solid.device)]

    def observe(self, view: TrainView, pixels: Int[Tensor, "P"]) -> Rays:
        """The rays of those of the pixels that see the surroundings, with the trust of the surface there."""
        reflected = self._reflected(view, pixels, 1)
        seeing = self._seeing(view, pixels, reflected.clear)
        chosen = pixels[torch.from_numpy(seeing).to(pixels.device)]
        trust = self.trust.at(self.surface.points(reflected.hits.places[seeing]))
        outgoing, trusted = (torch.from_numpy(each).float() for each in (reflected.outgoing[seeing, 0], trust))
        radiance = view.radiance_at(chosen)
        incoming = view.directions_world(chosen)
        return Rays(outgoing.to(radiance.device), radiance, trusted.to(radiance.device), incoming)

    def _seeing(self, view: TrainView, pixels: Int[Tensor, "P"], clear: Bool[np.ndarray, "P"]) -> Bool[np.ndarray, "P"]:
        """Which of the pixels that are `clear` lie well inside the mask."""
        return clear & (inner_distance_px(view.mask)[pixels.cpu().numpy()] > MAP_INNER_PX)

    def _reflected(self, view: TrainView, pixels: Int[Tensor, "P"], samples: int) -> ReflectedRays:
        """What pixels of a view see."""
        rays, traces = self._traced(view, pixels)
        index = pixels.cpu().numpy()
        hits = self.surface.hits_at(rays.origins, rays.directions, traces.distance[index])
        return ReflectedRays.along(self.surface, rays, samples, hits, traces.clear[index])

    def _traced(self, view: TrainView, pixels: Int[Tensor, "P"]) -> "tuple[PixelRays, _Traces]":
        """Rays of pixels of a view, and its traces, once for selection, map and verdict."""
        index, known = pixels.cpu().numpy(), self._traces.get(view.mask)
        if known is None or not known.are_of(view.camera):
            self._traces[view.mask] = known = _Traces.none(view.camera)
        rays, new = PixelRays.centers(view.camera, index), np.isnan(known.distance[index])
        if new.any():
            found = ReflectedRays.of(
                self.surface, rays.chosen(new), 1, LEAST_MAP_COSINE, occlusion_test=self.occlusion_test
            )
            known.distance[index[new]], known.clear[index[new]] = found.hits.distance, found.clear
        return rays, known

    @cached_property
    def _traces(self) -> MutableMapping[Tensor, "_Traces"]:
        """Of the pixels of each view, by its mask."""
        return WeakIdKeyDictionary()

    def footprints(self, views: Views, max_pixels: int) -> Footprints | None:
        """Four directions over each of at most `FOOTPRINTS` pixels that are trusted and turn little."""
        chosen = at_most_pixels(views, min(max_pixels, FOOTPRINTS))
        return Footprints.of(self._footprints(*each) for each in chosen)

    def _footprints(self, view: TrainView, pixels: Int[Tensor, "P"]) -> PixelFootprints:
        """Those of the pixels of one view."""
        reflected = self._reflected(view, pixels, 4)
        trusted = self.trust.at(self.surface.points(reflected.hits.places)) > LEAST_FOOTPRINT_TRUST
        kept = reflected.clear & trusted & (reflected.turn < WIDEST_FOOTPRINT_RAD)
        directions = torch.from_numpy(reflected.outgoing[kept]).float().to(view.radiance.device)
        return PixelFootprints(directions, view.radiance_at(pixels[torch.from_numpy(kept).to(pixels.device)]))

    def shade(
        self,
        environment: Float[Tensor, "6 3 L L"],
        camera: RasterCamera,
        pixels: Int[Tensor, "P"],
        normals_camera: Float[Tensor, "3 P"],
    ) -> Float[Tensor, "P 3"]:
        """Means over the pixels' areas; where the object sees itself, along the ray that leaves in the end."""
        return free_form_light(self.surface, environment, camera, pixels, normals_camera)

    def buffers(self, camera: RasterCamera) -> SurfaceBuffers:
        """By intersection; alpha by a grid of rays at silhouettes."""
        return free_form_buffers(self.surface, camera)

    def mesh(self, frame: ObjectFrame) -> Mesh:
        """Marching cubes, with the exact normals of the vertices and the trust there, `confidence` in [0, 1]."""
        mesh, normals = self.surface.mesh()
        smooth = Mesh.smooth(frame.to_world(mesh.vertices), mesh.triangles, normals)
        return replace(smooth, columns={**smooth.columns, "confidence": self.trust.at(mesh.vertices)})

    def state_dict(self) -> dict[str, Any]:
        """All numbers as lists and plain values."""
        surface, trust, poses = to_plain(self.surface), to_plain(self.trust), to_plain(self.poses)
        return {"surface": surface, "trust": trust, "poses": poses, "occlusion_test": self.occlusion_test}

    @classmethod
    def from_state_dict(cls, content: dict[str, Any]) -> "FreeFormMirror":
        """The geometry that `state_dict` was taken from."""
        surface, trust = from_plain(LevelSet, content["surface"]), from_plain(Trust, content["trust"])
        return cls(surface, trust, content["occlusion_test"], poses=poses_from_plain(content))


class FreeFormFamily(ExactFamily):
    """Closed surfaces, which explain any silhouettes."""

    kind: ClassVar[str] = "free_form"
    geometry: ClassVar[type[Geometry]] = FreeFormMirror
    label: ClassVar[str] = "a free-form surface"

    def propose(self, views: Views, config: FitConfig, *, requested: bool) -> Proposal | None:
        """First surfaces as level sets; one that is closed explains any silhouettes in the end.

        None where there are too few views to judge it by.
        """
        if len(views.train) < LEAST_VIEWS and not requested:
            return None
        return Proposal(first_surfaces(views, config), 0.0, 1.0)

    def as_proposed(self, proposal: Proposal, config: FitConfig) -> Geometry:
        """The first surface, trusted everywhere."""
        surface = proposal.shape.surface
        return _mirror(surface, full_trust(surface), None, config)

    def refitted(self, views: Views, fitted: FreeFormMirror, config: FitConfig) -> Geometry:
        """After its last round once more."""
        begun = FitStage(fitted.surface, fitted.trust, material=fitted.material)
        found = continued_fit(views, begun, Schedule.of(config.free_form))
        return replace(_mirror(found.surface, found.trust, None, config), material=found.material)

    def solve(
        self,
        views: Views,
        proposal: Proposal,
        kinds: Collection[type[Block]],
        required: Collection[str],
        config: FitConfig,
        propose: Propose,
    ) -> tuple[Geometry, Corrections, list[Decision]]:
        """All coefficients by silhouettes and photographs, with nuisance blocks of those kinds.

        A start that has descended may have bent a cap until pixels agree a little: then concavities are searched under
        the plain surface.
        """
        schedule, first = Schedule.of(config.free_form), proposal.shape
        start, nuisance = started(views, first, schedule, nuisance_of(views, kinds, first.surroundings))
        caps = () if np.array_equal(start.coefficients, first.plain.coefficients) else (first.surface,)
        mixed = config.material.scattering != "off" and config.tint == NO_TINT
        mixed = mixed and not encoding_of(config).high_dynamic_range
        stage, decisions = fit_free_form(
            views,
            start,
            schedule,
            hull=first.hull,
            caps=caps,
            nuisance=nuisance,
            required=required,
            materials=(None, EVEN) if mixed else (None,),
        )
        if stage.settings is None:  # The time limit came before the first round.
            return _mirror(stage.surface, stage.trust, None, config), NO_CORRECTIONS, []
        with torch.no_grad():
            known = variances(views, stage)
        found = Corrected.by(stage.nuisance, known)
        surface, trust = stage.surface.scaled(found.scale), stage.trust.scaled(found.scale)
        gone = [each for each in decisions if not each.kept]
        kept = [scored(each, known[each.name]) for each in stage.nuisance.blocks]
        mirror = replace(_mirror(surface, trust, found.poses, config), material=stage.material)
        return mirror, found.corrections, [*gone, *kept]


def _mirror(surface: LevelSet, trust: Trust, poses: Poses | None, config: FitConfig) -> FreeFormMirror:
    return FreeFormMirror(surface, trust, config.environment.trace, poses=poses)
