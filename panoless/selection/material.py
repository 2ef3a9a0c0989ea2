"""What share of the light the object mirrors, and what it scatters beside, by what a finished geometry explains: a
metal's color, which pales at grazing angles, evenly scattered light, and places that differ.

It is taken for a perfect mirror until held-out views speak against it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d

from panoless.capture.encoding import NO_TINT, SATURATED, RadianceEncoding, encoding_of
from panoless.capture.rays import project
from panoless.capture.views import TrainView, Views, held_out_parts, split_held_out
from panoless.config import FitConfig
from panoless.environment.material_field import MaterialPixels
from panoless.environment.rays import Rays, joined_rays
from panoless.environment.reflectance import (
    Reflectance,
    cosines_of_incidence,
    find_reflectance,
    grazing,
    lamp_light,
    left_unexplained,
    normals_of,
    unsaturated,
)
from panoless.environment.resolution import ERROR_SCALE, count_rays
from panoless.environment.solve import solve_environment
from panoless.geometry.base import Geometry, SurfaceBuffers, observe_views, usable_views
from panoless.journal import remembered
from panoless.kernels.cubemap import sample_cubemap
from panoless.numeric.robust import bounded_error
from panoless.selection.held_out import is_clearly_lower

RAYS = 100_000
"""About so many pixels of all views determine an even reflectance, and whether places differ."""
RESOLUTION, FIELD_JUDGED = 32, 64
"""Most texels along a face side of the maps under which even reflectances and places are judged. Where few rays fall
into a texel, a scattered share explains noise: it draws what is predicted toward the mean."""
LARGEST_REFLECTANCE = 0.97
"""Of the channel that is mirrored least, above which held-out views do not decide."""
LEAST_GAIN = 0.02
"""Share by which a reflectance has to lower the held-out error."""
LEAST_ALBEDO = 0.02
"""Share of scattered light, in the channel that has most of it, from which held-out views decide."""
LEAST_SCATTERING_GAIN = 0.07
"""Share by which scattered light has to lower the held-out error."""
LEAST_SCATTERING_ERROR = 0.05
"""Held-out error of a fit from which the shape is looked for again without scattered light, where there is some."""
FIELD_RESOLUTION = 128
"""Most texels along a face side of the maps under which places are determined."""
LEAST_FIELD_ERROR = 0.03
"""Held-out error from which places may differ."""
PIXELS = 300_000
"""About so many pixels of all views at most determine how, and maps."""
FIELD_ROUNDS = 3
"""In which places and the map are determined in turn."""
WHOLLY = 0.999
"""Share of the texels around a direction that were seen, from which a map predicts it."""
MANY_RADII = 1e3
"""Distance at which a ray's direction is projected: beyond the near plane."""
PIXELS_A_CELL = 3.0
"""Side of a cell in pixels of the median view."""
LEAST_CELLS, MOST_CELLS = 32, 128
"""Along a side of the lattice."""
LEAST_SHARE = 0.25
"""Mirrored share, in the channel that is mirrored least, below which a pixel shows nothing of the surroundings."""


@remembered()
def earned_reflectance(views: Views, geometry: Geometry, config: FitConfig) -> Reflectance | None:
    """The reflectance of the object, if held-out views are clearly better explained by it; else None. Views are those
    of usable pixels. One that scatters light, too, has to explain them clearly better than one that does not, and one
    that differs from place to place clearly better than either.

    Four fifths of the views determine it and the map by which the others are judged, then all views determine it.
    Nothing is determined where the shape was solved with its material, where a tint is given, or in a high dynamic
    range.
    """
    options, encoding = config.material, encoding_of(config)
    resolution = config.environment.trial_resolution(RESOLUTION)
    if geometry.reflectance is not None:
        return geometry.reflectance
    if options.reflectance == "off" or encoding.high_dynamic_range or config.tint != NO_TINT:
        return None
    with torch.no_grad():
        rays = list(observe_views(views, geometry, RAYS))
        seen = [unsaturated(each, encoding.saturation) for each in rays]
        kept, held_out = split_held_out(seen)
        if not held_out or not any(len(each.radiance) for each in kept):
            return None
        lamps = lamp_light(joined_rays(rays), encoding.saturation, resolution)
        known, perfect = joined_rays(kept), Reflectance(np.ones(3))
        metal = find_reflectance(known, resolution)
        matte = find_reflectance(known, resolution, lamps, metal)
        earned = perfect
        for found, least in ((metal, LEAST_GAIN), (matte, LEAST_SCATTERING_GAIN)):
            if min(found.tint) > LARGEST_REFLECTANCE and found.albedo.max() < LEAST_ALBEDO:
                continue
            other, best = (_errors(kept, held_out, each, resolution) for each in (found, earned))
            if is_clearly_lower(other, best, least):
                earned = found
        even = perfect
        if earned is not perfect:
            even = find_reflectance(joined_rays(seen), resolution, lamps if earned is matte else None)
        if _differs(views, geometry, earned, config):
            finest = config.environment.trial_resolution(FIELD_RESOLUTION)
            seen_surface = SeenSurface.of(views, geometry, encoding.saturation, PIXELS)
            return seen_surface.with_field(even, finest, rounds=FIELD_ROUNDS)
        return None if earned is perfect else even


def _differs(views: Views, geometry: Geometry, even: Reflectance, config: FitConfig) -> bool:
    """Whether places that differ explain held-out views clearly better than an even reflectance."""
    parts, resolution = held_out_parts(views), config.environment.trial_resolution(FIELD_JUDGED)
    if parts is None:
        return False
    known, tested = (SeenSurface.of(part, geometry, encoding_of(config).saturation, RAYS) for part in parts)
    errors = tested.errors(even, known, resolution)
    if errors.mean() < LEAST_FIELD_ERROR:
        return False
    return is_clearly_lower(tested.errors(known.with_field(even, resolution, rounds=1), known, resolution), errors)


def _errors(
    known: Sequence[Rays], held_out: Sequence[Rays], reflectance: Reflectance, resolution: int
) -> Float[np.ndarray, "V"]:
    """Mean of ‖e‖²/(‖e‖² + s²) of each held-out view under the map of the others."""
    unknown = [replace(rays, trust=torch.zeros_like(rays.radiance[:, 0])) for rays in held_out]
    residual = left_unexplained(joined_rays([*known, *unknown]), reflectance, resolution)
    ends = np.cumsum([len(rays.radiance) for rays in (*known, *unknown)])
    parts = np.split(bounded_error(residual, ERROR_SCALE), ends[:-1])[len(known) :]
    return np.array([np.average(part) if len(part) else 0.0 for part in parts])


@dataclass(frozen=True)
class SeenSurface:
    """Pixels that see the surroundings, where they see a surface, and how. Arrays hold one row a pixel of all views."""

    views: Views
    geometry: Geometry
    parts: tuple[Rays, ...]
    """Of each view."""
    saturation: Float[Tensor, "3"]

    @classmethod
    def of(cls, views: Views, geometry: Geometry, saturation: Float[Tensor, "3"], count: int) -> "SeenSurface":
        """Of about so many usable pixels at most."""
        seen = observe_views(views, geometry, count)
        parts = tuple(replace(each, radiance=each.radiance.to(each.directions)) for each in seen)
        return cls(views, geometry, parts, saturation.to(parts[0].directions))

    @cached_property
    def rays(self) -> Rays:
        """Of all views."""
        return joined_rays(self.parts)

    @cached_property
    def points(self) -> Float[Tensor, "P 3"]:
        """Where they meet the surface, in the normalized frame: only places that differ need them."""
        pairs = zip(self.views.train, self.parts, strict=True)
        return torch.cat(
            [self.geometry.buffers(view.camera).points(view.camera, _pixels_of(view, rays)) for view, rays in pairs]
        )

    def map_under(self, reflectance: Reflectance, resolution: int) -> Float[Tensor, "6 3 L L"]:
        """The map of what a perfect mirror would have shown: (c − D)/F, weighted by F²."""
        share, scattered = self._shown(reflectance)
        seen = self.rays.radiance
        saturated = self.rays.reaches(SATURATED * self.saturation)[:, None]
        mirrored = torch.where(saturated, seen, (seen - scattered).clamp(min=0)) / share.clamp(min=LEAST_SHARE)
        trust = self.rays.initial_weight() * share.amin(1) ** 2
        return solve_environment([Rays(self.rays.directions, mirrored, trust)], resolution)

    def errors(self, reflectance: Reflectance, known: "SeenSurface", resolution: int) -> Float[np.ndarray, "V"]:
        """Mean of ‖e‖²/(‖e‖² + s²) of each view under the map of others, over directions that those saw."""
        share, scattered = self._shown(reflectance)
        light = sample_cubemap(known.map_under(reflectance, resolution), self.rays.directions)
        error = (share * light + scattered).minimum(self.saturation) - self.rays.radiance
        bounded = bounded_error(error, ERROR_SCALE).double().cpu().numpy()
        observed = (count_rays([known.rays], resolution) > 0).to(light)
        counted = (sample_cubemap(observed, self.rays.directions)[:, 0] > WHOLLY).cpu().numpy()
        view = np.repeat(np.arange(len(self.parts)), [len(each.radiance) for each in self.parts])
        found: np.ndarray = np.bincount(view, bounded * counted) / np.maximum(np.bincount(view, counted), 1)
        return found

    def with_field(self, even: Reflectance, resolution: int, *, rounds: int) -> Reflectance:
        """The reflectance with places that differ from it: these and the map are determined in turn."""
        size_px = np.median([_size_px(view) for view in self.views.train])
        cells = int(np.clip(size_px / PIXELS_A_CELL, LEAST_CELLS, MOST_CELLS))
        found, pixels = even, MaterialPixels.of(self.points.double().cpu().numpy(), cells)
        share, scattered = self._shown(even)
        pale = 1 - grazing(cosines_of_incidence(self.rays))[:, None]
        for _ in range(rounds):
            light = sample_cubemap(self.map_under(found, resolution), self.rays.directions)
            left = self.rays.radiance - share * light - scattered
            slopes, residual = (each.double().cpu().numpy() for each in (light * pale, left))
            field = pixels.field(slopes, residual)
            found = replace(even, field=field)
        return found

    def _shown(self, reflectance: Reflectance) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
        points = None if reflectance.field is None else self.points
        return reflectance.shown(cosines_of_incidence(self.rays), normals_of(self.rays), points)


def _size_px(view: TrainView) -> float:
    """Of the cube around the object, seen from the front."""
    return 2 * view.camera.fx / float(np.linalg.norm(view.position))


def _pixels_of(view: TrainView, rays: Rays) -> Int[Tensor, "P"]:
    """Flat indices of the pixels through whose centers rays came."""
    assert rays.incoming is not None
    camera = view.camera
    x, y = (each.floor().long() for each in project(camera, MANY_RADII * rays.incoming @ view.camera_to_world_rotation))
    return y.clamp(0, camera.height - 1) * camera.width + x.clamp(0, camera.width - 1)


def _without(
    view: TrainView,
    posed: TrainView,
    surface: SurfaceBuffers,
    reflectance: Reflectance,
    encoding: RadianceEncoding,
) -> TrainView:
    """(c − D)/F, at most the saturation over F₀, which what is saturated becomes: it may be any brighter. Pixels that
    mirror too little, and those within a cell beside them, which mix two materials, are not solid.
    """
    pixels = torch.nonzero(surface.alpha.flatten() > 0)[:, 0].to(view.radiance.device)
    share, scattered = surface.shown(reflectance, posed.camera, pixels)
    radiance, at_normal = view.radiance_at(pixels), torch.tensor(reflectance.tint).to(view.radiance)
    mirrored = torch.where(
        radiance >= SATURATED * encoding.saturation.to(radiance), radiance, (radiance - scattered).clamp(min=0)
    )
    shown = replace(encoding, tint=reflectance.tint).without_gain((mirrored / at_normal).T, (share / at_normal).T)
    changed = view.radiance.clone()
    changed.flatten(1)[:, pixels] = shown
    dim = torch.zeros_like(view.mask)
    dim.flatten()[pixels] = (share.amin(1) < LEAST_SHARE * at_normal.amin()).to(dim)
    if reflectance.field is not None:
        beside = max(1, round(_size_px(posed) / reflectance.field.cells))
        dim = max_pool2d(dim[None], 2 * beside + 1, 1, beside)[0]
    return replace(view, radiance=changed, solid=view.solid[dim.flatten()[view.solid] == 0])


def usable_as_perfect_mirror(views: Views, geometry: Geometry, config: FitConfig) -> Views:
    """Usable pixels of views, as a perfect mirror would have shown them where the shape was solved with a material."""
    usable = usable_views(views, geometry)
    if geometry.reflectance is None:
        return usable
    return usable_views(as_perfect_mirror(views, usable, geometry, geometry.reflectance, encoding_of(config)), geometry)


def as_perfect_mirror(
    views: Views, posed: Views, geometry: Geometry, reflectance: Reflectance, encoding: RadianceEncoding
) -> Views:
    """The views as a perfect mirror would have shown them. `posed` are the same with their cameras as the geometry has
    them.
    """
    parts = zip(views.train, posed.train, strict=True)
    shown = (_without(*each, geometry.buffers(each[1].camera), reflectance, encoding) for each in parts)
    return replace(views, train=tuple(shown))


def without_scattered_light(
    views: Views, corrected: Views, geometry: Geometry, error: float, config: FitConfig
) -> tuple[Views, FitConfig] | None:
    """The views as a perfect mirror would have shown them, if an object of that geometry is found to scatter light, and
    held-out views are left with an `error` that this may have made; else None. The configuration says at which radiance
    they are saturated.

    `corrected` are the same views as the geometry was fitted to. They determine the light and where the cameras stand;
    what their exposures and their lens differ by is small beside what is scattered, and is left to the next choice.
    """
    if geometry.reflectance is not None or config.material.scattering == "off" or error < LEAST_SCATTERING_ERROR:
        return None
    usable = usable_views(corrected, geometry)
    found = earned_reflectance(usable, geometry, config)
    if found is None or not found.is_scattering:
        return None
    mirror = as_perfect_mirror(views, usable, geometry, found, encoding_of(config))
    return mirror, replace(config, tint=found.tint)
