"""The free-form surface as a kind of geometry."""

from collections.abc import MutableMapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from panoless.capture.contrast import EXPLAINED, Contrast
from panoless.capture.lens import LensChange
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.poses import Poses, StatedCameras, with_pose_covariances
from panoless.capture.views import TrainView, Views, at_most_pixels, split_held_out
from panoless.config import FitConfig
from panoless.environment.footprints import Footprints, PixelFootprints
from panoless.environment.rays import Rays
from panoless.environment.surroundings import Surroundings
from panoless.geometry.base import (
    Geometry,
    Mesh,
    Proposal,
    SurfaceBuffers,
    ToldPoses,
    from_plain,
    poses_from_plain,
    to_plain,
)
from panoless.geometry.exact import ExactFamily, ExactGeometry
from panoless.geometry.free_form.fit import FitStage, fit_free_form, follow_views, held_out_error, poses_by_outlines
from panoless.geometry.free_form.observations import PixelRays, inner_distance_px
from panoless.geometry.free_form.options import DEFAULTS, FreeFormOptions
from panoless.geometry.free_form.photometric import Sights
from panoless.geometry.free_form.rendering import free_form_buffers, free_form_light
from panoless.geometry.free_form.start import FirstSurfaces, first_surfaces, started
from panoless.geometry.free_form.surface import LevelSet
from panoless.geometry.free_form.trust import Trust, full_trust
from panoless.kernels.camera import RasterCamera
from panoless.numeric.factorize import regularize
from shinypartial.io.records import read_record, write_record


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
    options: FreeFormOptions = DEFAULTS
    contrast: Contrast = Contrast()
    """Of the photographs that it was fitted to, and in which a fit goes on; a state does not keep it."""

    @property
    def surroundings(self) -> Surroundings:
        """Those of the surface."""
        return self.surface.surroundings

    def in_surroundings(self, surroundings: Surroundings) -> "FreeFormMirror":
        """The same surface there."""
        return replace(self, surface=replace(self.surface, surroundings=surroundings))

    @property
    def num_parameters(self) -> int:
        """The coefficients whose support meets the surface."""
        return int((np.abs(self.surface.at_nodes()) < self.options.band_cells).sum())

    def usable_pixels(self, view: TrainView) -> Int[Tensor, "P"]:
        """Solid pixels that see the surroundings by way of the surface, but for the outermost ones."""
        _, traces = self._traced(view, view.solid)
        seeing = self._seeing(view, view.solid, traces.clear[view.solid.cpu().numpy()])
        return view.solid[torch.from_numpy(seeing).to(view.solid.device)]

    def observe(self, view: TrainView, pixels: Int[Tensor, "P"]) -> Rays:
        """The rays of those of the pixels that see the surroundings, with the trust of the surface there."""
        sights = self._sights(view, pixels, 1)
        seeing = self._seeing(view, pixels, sights.clear)
        chosen = pixels[torch.from_numpy(seeing).to(pixels.device)]
        trust = self.trust.at(self.surface.points(sights.hits.places[seeing]))
        outgoing, trusted = (torch.from_numpy(each).float() for each in (sights.outgoing[seeing, 0], trust))
        radiance = view.radiance_at(chosen)
        incoming = view.directions_world(chosen)
        return Rays(outgoing.to(radiance.device), radiance, trusted.to(radiance.device), incoming)

    def _seeing(self, view: TrainView, pixels: Int[Tensor, "P"], clear: Bool[np.ndarray, "P"]) -> Bool[np.ndarray, "P"]:
        """Which of the pixels that are `clear` lie well inside the mask."""
        return clear & (inner_distance_px(view.mask)[pixels.cpu().numpy()] > self.options.map_inner_px)

    def _sights(self, view: TrainView, pixels: Int[Tensor, "P"], samples: int) -> Sights:
        """What pixels of a view see."""
        rays, traces = self._traced(view, pixels)
        index = pixels.cpu().numpy()
        hits = self.surface.hits_at(rays.origins, rays.directions, traces.distance[index])
        return Sights.along(self.surface, rays, samples, hits, traces.clear[index])

    def _traced(self, view: TrainView, pixels: Int[Tensor, "P"]) -> "tuple[PixelRays, _Traces]":
        """Rays of pixels of a view, and its traces. Each is traced once, because selection, map and verdict ask for the
        same.
        """
        index, known = pixels.cpu().numpy(), self._traces.get(view.mask)
        if known is None or not known.are_of(view.camera):
            self._traces[view.mask] = known = _Traces.none(view.camera)
        rays, new = PixelRays.centers(view.camera, index), np.isnan(known.distance[index])
        if new.any():
            found = Sights.of(
                self.surface, rays.chosen(new), 1, self.options.least_map_cosine, occlusion_test=self.occlusion_test
            )
            known.distance[index[new]], known.clear[index[new]] = found.hits.distance, found.clear
        return rays, known

    @cached_property
    def _traces(self) -> MutableMapping[Tensor, "_Traces"]:
        """Of the pixels of each view, by its mask."""
        return WeakIdKeyDictionary()

    def footprints(self, views: Views, max_pixels: int) -> Footprints | None:
        """Four directions over each of at most `footprints` pixels that are trusted and turn little."""
        chosen = at_most_pixels(views, min(max_pixels, self.options.footprints))
        return Footprints.of(self._footprints(*each) for each in chosen)

    def _footprints(self, view: TrainView, pixels: Int[Tensor, "P"]) -> PixelFootprints:
        """Those of the pixels of one view."""
        sights = self._sights(view, pixels, 4)
        trusted = self.trust.at(self.surface.points(sights.hits.places)) > self.options.least_footprint_trust
        kept = sights.clear & trusted & (sights.turn < self.options.widest_footprint_rad)
        directions = torch.from_numpy(sights.outgoing[kept]).float().to(view.radiance.device)
        return PixelFootprints(directions, view.radiance_at(pixels[torch.from_numpy(kept).to(pixels.device)]))

    def shade(
        self,
        environment: Float[Tensor, "6 3 L L"],
        camera: RasterCamera,
        pixels: Int[Tensor, "P"],
        normals_camera: Float[Tensor, "3 P"],
    ) -> Float[Tensor, "P 3"]:
        """Means over the pixels' areas; where the object sees itself, along the ray that leaves in the end."""
        return free_form_light(self.surface, environment, camera, pixels, normals_camera, self.options)

    def buffers(self, camera: RasterCamera) -> SurfaceBuffers:
        """By intersection; alpha by a grid of rays at outlines."""
        return free_form_buffers(self.surface, camera, self.options)

    def mesh(self, frame: ObjectFrame) -> Mesh:
        """Marching cubes, with the exact normals of the vertices and the trust there, `confidence` in [0, 1]."""
        mesh, normals = self.surface.mesh()
        smooth = Mesh.smooth(frame.to_world(mesh.vertices), mesh.triangles, normals)
        return replace(smooth, columns={**smooth.columns, "confidence": self.trust.at(mesh.vertices)})

    def state_dict(self) -> dict[str, Any]:
        """All numbers as lists and plain values."""
        options = write_record(self.options)
        surface, trust, poses = to_plain(self.surface), to_plain(self.trust), to_plain(self.poses)
        known = {"occlusion_test": self.occlusion_test, "options": options}
        return {"surface": surface, "trust": trust, "poses": poses, **known}

    @classmethod
    def from_state_dict(cls, content: dict[str, Any]) -> "FreeFormMirror":
        """The geometry that `state_dict` was taken from."""
        options = read_record(
            FreeFormOptions, content["options"], "the options of a free-form surface", allow_unknown=True
        )
        surface, trust = from_plain(LevelSet, content["surface"]), from_plain(Trust, content["trust"])
        return cls(surface, trust, content["occlusion_test"], options, poses=poses_from_plain(content))


class FreeFormFamily(ExactFamily):
    """Closed surfaces, which explain any silhouettes."""

    kind: ClassVar[str] = "free_form"
    geometry: ClassVar[type[Geometry]] = FreeFormMirror
    label: ClassVar[str] = "a free-form surface"
    finds_poses: ClassVar[bool] = True

    def propose(self, views: Views, config: FitConfig, *, asked: bool) -> Proposal | None:
        """First surfaces as level sets; one that is closed explains any silhouettes in the end.

        None where there are too few views to judge it by.
        """
        if len(views.train) < config.free_form.least_views and not asked:
            return None
        return Proposal(first_surfaces(views, config), 0.0, 1.0)

    def as_proposed(self, proposal: Proposal, config: FitConfig) -> Geometry:
        """The first surface, trusted everywhere."""
        surface = proposal.shape.surface
        trust = full_trust(surface, config.free_form.trust_cells)
        return _mirror(surface, trust, None, config)

    def poses_by_outlines(self, views: Views, proposal: Proposal, config: FitConfig) -> ToldPoses | None:
        """Beside a shape, from the plain first surface or the hull."""
        stated, always = (
            with_pose_covariances(views, np.linalg.inv(regularize(_prior(views, config), "the poses"))),
            config.poses.mode == "on",
        )
        first: FirstSurfaces = proposal.shape
        starts, agree = (first.plain, first.hull), first.views_agree
        return poses_by_outlines(stated, starts, config.free_form, views_agree=agree, always=always)

    def with_lens(
        self, views: Views, fitted: Any, unknown: LensChange, config: FitConfig
    ) -> tuple[Geometry, LensChange] | None:
        """On from a fit, in rounds with these unknowns, at the poses that it found."""
        start = replace(_stage(fitted), poses=None, lens=unknown)
        stage = follow_views(fitted.contrast.applied(fitted.corrected(views)), start, config.free_form)
        assert stage.lens is not None, "the lens was unknown"
        factor = float(np.exp(-(stage.lens.focal or 0.0)))
        surface, trust = stage.surface.scaled(factor), stage.trust.scaled(factor)
        return replace(_mirror(surface, trust, fitted.poses, config), contrast=fitted.contrast), stage.lens

    def after_as_many_steps(self, views: Views, fitted: Any, config: FitConfig) -> Geometry:
        """On from a fit, in a round as long as with that unknown."""
        start = replace(_stage(fitted), poses=None)
        stage = follow_views(fitted.contrast.applied(fitted.corrected(views)), start, config.free_form, longer=True)
        return replace(_mirror(stage.surface, stage.trust, fitted.poses, config), contrast=fitted.contrast)

    def fit(self, views: Views, proposal: Proposal, config: FitConfig) -> Geometry:
        """All coefficients by outlines and photographs together; by logarithms of radiance where this leaves what is
        dark unexplained and they explain more of it in held-out views.
        """
        told = proposal.told
        if proposal.fitted is not None:
            posed = views if told is None else with_pose_covariances(views, told.covariances)
            contrast = proposal.fitted.contrast
            found = follow_views(contrast.applied(posed), _stage(proposal.fitted), config.free_form)
            return replace(_mirror(found.surface, found.trust, found.poses, config), contrast=contrast)
        contrast = Contrast.of(views, config.contrast)
        shown = contrast.applied(views)
        fitted = _fitted(views, proposal.shape, told, config)
        if shown is views or (left := _unexplained(shown, fitted, config)) < EXPLAINED:
            return fitted
        first = replace(first_surfaces(shown, config), surroundings=proposal.shape.surroundings)
        again = replace(_fitted(shown, first, told, config), contrast=contrast)
        return again if _unexplained(shown, again, config) < left else fitted


def _mirror(surface: LevelSet, trust: Trust, poses: Poses | None, config: FitConfig) -> FreeFormMirror:
    return FreeFormMirror(surface, trust, config.environment.trace, config.free_form, poses=poses)


def _fitted(views: Views, first: FirstSurfaces, told: ToldPoses | None, config: FitConfig) -> FreeFormMirror:
    """From first surfaces on. A start that has descended may have bent a lid until pixels agree a little: then hollows
    are looked for under the plain surface.

    Poses that are free under covariances that outlines `told` leave the world where it is said to be: these say little
    of what all cameras share.
    """
    options, start = config.free_form, started(views, first, config.free_form)
    lids = () if np.array_equal(start.coefficients, first.plain.coefficients) else (first.surface,)
    if told is None:
        return _mirror(*fit_free_form(views, start, options, lids=lids), config)
    surface, trust, poses = fit_free_form(
        with_pose_covariances(views, told.covariances), start, options, lids=lids, free_poses=True
    )
    assert poses is not None, "poses were free"
    common, poses = poses.without_common(StatedCameras.of(views), told.prior)
    return _mirror(surface.taken_back(common), trust, poses, config)


def _prior(views: Views, config: FitConfig) -> Float[np.ndarray, "V 6 6"]:
    """Inverse covariances of turns (rad) and shifts before anything tells more of them."""
    options = config.poses
    return StatedCameras.of(views).prior(np.radians(options.turn_deg), options.shift, options.stated_floor)


def _unexplained(views: Views, fitted: FreeFormMirror, config: FitConfig) -> float:
    """How badly a map of four fifths of the views predicts the others; nothing where there are too few."""
    known, unknown = split_held_out((views if fitted.poses is None else fitted.poses.moved(views)).train)
    if not known or not unknown:
        return 0.0
    stage, (solved, tested) = _stage(fitted), (replace(views, train=tuple(each)) for each in (known, unknown))
    return held_out_error(solved, tested, replace(stage, poses=None), config.free_form)


def _stage(fitted: FreeFormMirror) -> FitStage:
    """What a fit ended with."""
    return FitStage(fitted.surface, fitted.trust, None, fitted.options.damping, poses=fitted.poses)
