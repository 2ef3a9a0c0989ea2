"""What the training views observed of the environment by way of a geometry: rays, and how far each is to be trusted."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.encoding import encoding_of
from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from panoless.environment.rays import Rays
from panoless.environment.resolution import count_rays, densest_resolution, finest_resolution
from panoless.environment.solve import solve_environment
from panoless.geometry.height_field.model import HeightField, height_field_rays
from panoless.geometry.plane.model import Plane, plane_buffers
from panoless.geometry.revolution.deblurred_map import deblur_map
from panoless.geometry.revolution.model import SurfaceOfRevolution, revolution_rays
from panoless.geometry.surfels.model import Surfels
from panoless.geometry.surfels.rendering import ALPHA_FLOOR, rasterize_surfels, reflection_directions_world, tiles_of
from panoless.kernels.cubemap import sample_cubemap
from panoless.kernels.rasterize import Channels, RasterBuffers
from panoless.numeric.robust import robust_weight
from shinypartial.core.conventions import SOLID_ALPHA

SOLID_SURFACE_ALPHA = 0.9
#: Share of the rays that is enough to find out whom to trust and how fine a map is worth it.
TRIAL_SHARE = 1 / 8
TRUST_VIEWS = 40
TRIAL_RESOLUTION = 128
TRUST_SCALE = 0.15
#: Pixels' worth of an opinion that every surfel starts with, so that one that is hardly seen is hardly believed.
PRIOR_PIXELS, PRIOR_TRUST = 1.0, 0.2
TRUST_POWER = 4
GRAY = 0.5

Geometry = Surfels | Plane | HeightField | SurfaceOfRevolution


def observed_rays(views: Views, geometry: Geometry, config: FitConfig, max_rays: int) -> Iterator[Rays]:
    """Reflection directions and radiance of pixels that lie wholly on mask and surface, a batch a view.

    When the views hold more than `max_rays` such pixels, every k-th is taken, beginning elsewhere in each view. On a
    surface of revolution rays are trusted by the solid angle of their pixels, if all are taken.
    """
    for view, pixels in _chosen_pixels(views, max_rays):
        if isinstance(geometry, Plane):
            yield _plane_rays(view, geometry, pixels)
        elif isinstance(geometry, HeightField):
            yield height_field_rays(geometry, view, pixels)
        elif isinstance(geometry, SurfaceOfRevolution):
            weighted = len(pixels) == len(view.solid)
            occluded = config.environment.trace
            yield revolution_rays(geometry, view, pixels, occlusion_test=occluded, weighted=weighted)[0]
        else:
            yield _surfel_rays(view, geometry, config, pixels)[0]


def _chosen_pixels(views: Views, most: int) -> Iterator[tuple[TrainView, Tensor]]:
    stride = max(1, math.ceil(sum(len(view.solid) for view in views.train) / most))
    for index, view in enumerate(views.train):
        yield view, view.solid[index % stride :: stride]


def reflections(view: TrainView, normals_camera: Float[Tensor, "3 H W"], pixels: Tensor) -> Float[Tensor, "P 3"]:
    """World directions that the given pixels (flat indices) of a view mirror."""
    return reflection_directions_world(
        normals_camera.flatten(1)[:, pixels],
        view.rays_camera.flatten(1)[:, pixels],
        view.camera_to_world_rotation,
    )


def solve_final_map(views: Views, geometry: Geometry, config: FitConfig) -> tuple[Float[Tensor, "6 3 L L"], list[Rays]]:
    """The closed-form map of the training views for a geometry, and the rays that it was solved from.

    A trial map says which surfels to trust, and held-out views how fine the map should be, unless the configuration
    does; then all rays are solved. Exact surfaces need no trial: their map starts from nothing, because a coarse start
    would reject what is finer. That of a surface of revolution is sharpened, unless its radiance is encoded, whose mean
    over a pixel is not that of radiance.
    """
    if not isinstance(geometry, Surfels):
        rays = normalize_confidence(list(observed_rays(views, geometry, config, config.environment.rays)))
        resolution = config.environment.solve_resolution or densest_resolution(rays)
        found = solve_environment(rays, resolution)
        light = encoding_of(config)
        if isinstance(geometry, SurfaceOfRevolution) and not light.high_dynamic_range:
            found = deblur_map(views, geometry, found, light.saturation, occlusion_test=config.environment.trace)
        return found, rays
    seen = [
        (view, *_surfel_rays(view, geometry, config, pixels))
        for view, pixels in _chosen_pixels(views, config.environment.rays)
    ]
    resolution = config.environment.solve_resolution
    few = config.environment.rays * TRIAL_SHARE
    coarse = solve_environment(_thinned([rays for _, rays, _ in seen], few), resolution or TRIAL_RESOLUTION)
    trust = surfel_trust(views, geometry, config, coarse)
    rays = [replace(rays, trust=_trust_of(view, geometry, trust, pixels)) for view, rays, pixels in seen]
    trial = _thinned(rays, few)
    coarse = solve_environment(trial, resolution or TRIAL_RESOLUTION)
    return solve_environment(rays, resolution or finest_resolution(trial, coarse), coarse), rays


def _thinned(rays: Sequence[Rays], most: float) -> list[Rays]:
    """About `most` of the rays at most: every k-th, beginning elsewhere in each batch."""
    stride = max(1, math.ceil(sum(len(batch.directions) for batch in rays) / most))
    return [batch.every(stride, index % stride) for index, batch in enumerate(rays)]


def without_fill(rays: Sequence[Rays], environment: Float[Tensor, "6 3 L L"]) -> Float[Tensor, "6 3 L L"]:
    """A map that is gray where none of the rays fell."""
    return torch.where(count_rays(rays, environment.shape[-1]) > 0, environment, GRAY)


def normalize_confidence(rays: Sequence[Rays]) -> list[Rays]:
    """The same rays with their trust in units of its mean.

    The map's fill of gaps and its pull toward a start count in rays: if all are hardly trusted, these would outvote
    them where only the least trusted see.
    """
    total = sum(float(batch.initial_weight().sum()) for batch in rays)
    mean = total / max(sum(len(batch.directions) for batch in rays), 1)
    if mean <= 0:
        return list(rays)
    return [replace(batch, trust=batch.initial_weight() / mean) for batch in rays]


def surfel_trust(
    views: Views, surfels: Surfels, config: FitConfig, environment: Float[Tensor, "6 3 L L"]
) -> Float[Tensor, "K"]:
    """Share of the pixels that a surfel makes up, over some forty views, whose radiance agrees with a map; in [0, 1].

    A surfel whose normal is wrong disagrees in most views although its rays agree with each other in one; a pixel alone
    cannot tell. Agreement is the Geman–McClure weight of the residual; a pixel counts for a surfel by its share in the
    blend, which is the derivative of the blended image.
    """
    agreeing, total = torch.zeros_like(surfels.means[:, 0]), torch.zeros_like(surfels.means[:, 0])
    for view in views.train[:: math.ceil(len(views.train) / TRUST_VIEWS)]:
        rays, pixels = _surfel_rays(view, surfels, config, view.solid)
        error = sample_cubemap(environment, rays.directions) - rays.radiance
        shares = torch.zeros(surfels.count, 3, device=surfels.means.device, requires_grad=True)
        with torch.enable_grad():
            buffers = _rasterize_attribute(view, surfels.detached(), shares)
            votes = torch.zeros_like(buffers.colors).flatten(1)
            votes[0, pixels], votes[1, pixels] = robust_weight(error, TRUST_SCALE), 1.0
            # A scalar, because torch loads much code to check the shapes of other cotangents.
            voted = (buffers.colors * votes.view_as(buffers.colors)).sum()
        (gradient,) = torch.autograd.grad(voted, shares)
        agreeing += gradient[:, 0]
        total += gradient[:, 1]
    return (agreeing + PRIOR_TRUST * PRIOR_PIXELS) / (total + PRIOR_PIXELS)


def _surfel_rays(view: TrainView, surfels: Surfels, config: FitConfig, pixels: Tensor) -> tuple[Rays, Tensor]:
    """Rays of those of the given pixels that surfels cover, and which pixels these are."""
    buffers = rasterize_surfels(
        surfels,
        view.camera,
        curved=config.surfels.curved,
        channels=Channels(colors=config.albedo, depth=False, distortion=False),
        active_tiles=tiles_of(view.mask > SOLID_ALPHA),
    )
    pixels = pixels[buffers.alpha.flatten()[pixels] > SOLID_SURFACE_ALPHA]
    diffuse = buffers.colors.flatten(1)[:, pixels]
    radiance = (view.radiance.flatten(1)[:, pixels] - diffuse).T.contiguous()
    return Rays(reflections(view, buffers.normals_camera, pixels), radiance), pixels


def _plane_rays(view: TrainView, plane: Plane, pixels: Tensor) -> Rays:
    buffers = plane_buffers(plane, view.camera)
    pixels = pixels[buffers.alpha.flatten()[pixels] > SOLID_SURFACE_ALPHA]
    directions = reflections(view, buffers.raster_normals_camera, pixels)
    return Rays(directions, view.radiance.flatten(1)[:, pixels].T.contiguous())


def _trust_of(
    view: TrainView, surfels: Surfels, trust: Float[Tensor, "K"], pixels: Int[Tensor, "P"]
) -> Float[Tensor, "P"]:
    """The trust of the surfels that pixels see, blended, to the fourth power."""
    buffers = _rasterize_attribute(view, surfels, trust[:, None].expand(-1, 3).contiguous())
    blended = buffers.colors[0].flatten()[pixels] / buffers.alpha.flatten()[pixels].clamp(min=ALPHA_FLOOR)
    return blended.clamp(0, 1) ** TRUST_POWER


def _rasterize_attribute(view: TrainView, surfels: Surfels, attribute: Float[Tensor, "K 3"]) -> RasterBuffers:
    return rasterize_surfels(
        surfels,
        view.camera,
        curved=False,
        attribute=attribute,
        channels=Channels(depth=False, distortion=False),
        active_tiles=tiles_of(view.mask > SOLID_ALPHA),
    )
