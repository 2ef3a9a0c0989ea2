"""What the training views observed of the environment by way of a geometry: rays, and how far each is to be trusted."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.config import FitConfig
from panoless.cubemap import Rays, robust_weight, solve_environment
from panoless.kernels.cubemap import sample_cubemap, scatter_cubemap
from panoless.kernels.rasterize import Channels, RasterBuffers
from panoless.lathe import Lathe, lathe_rays
from panoless.lathe_map import sharpened_map
from panoless.light import light_of
from panoless.plane import Plane, plane_buffers
from panoless.shading import ALPHA_FLOOR, rasterize_surfels, reflection_directions_world, tiles_of
from panoless.sheet import Sheet, sheet_rays
from panoless.surfels import Surfels
from panoless.views import TrainView, Views, split_held_out
from shinypartial.conventions import SOLID_ALPHA

SOLID_SURFACE_ALPHA = 0.9
#: Share of the rays that is enough to find out whom to trust and how fine a map is worth it.
TRIAL_SHARE = 1 / 8
TRUST_VIEWS = 40
TRIAL_RESOLUTION = 128
RESOLUTIONS = (64, 128, 256)
#: A finer map has to lower the held-out error by this share.
LEAST_GAIN = 0.02
RAYS_A_TEXEL = 8
TRUST_SCALE = 0.15
#: Pixels' worth of an opinion that every surfel starts with, so that one that is hardly seen is hardly believed.
PRIOR_PIXELS, PRIOR_TRUST = 1.0, 0.2
TRUST_POWER = 4
GRAY = 0.5

Geometry = Surfels | Plane | Sheet | Lathe


def observed_rays(views: Views, geometry: Geometry, config: FitConfig, max_rays: int) -> Iterator[Rays]:
    """Reflection directions and radiance of pixels that lie wholly on mask and surface, a batch a view.

    When the views hold more than `max_rays` such pixels, every k-th is taken, beginning elsewhere in each view. On a
    surface of revolution rays are trusted by the solid angle of their pixels, if all are taken.
    """
    for view, pixels in _chosen_pixels(views, max_rays):
        if isinstance(geometry, Plane):
            yield _plane_rays(view, geometry, pixels)
        elif isinstance(geometry, Sheet):
            yield sheet_rays(geometry, view, pixels)
        elif isinstance(geometry, Lathe):
            weighted = len(pixels) == len(view.solid)
            yield lathe_rays(geometry, view, pixels, _mirrored_at_most(config), weighted=weighted)[0]
        else:
            yield _surfel_rays(view, geometry, config, pixels)[0]


def _mirrored_at_most(config: FitConfig) -> int:
    """What `lathe.followed` calls so: pixels that see the object again take part only if nothing is traced."""
    return 1 if config.environment.trace else 0


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


def solved_environment(
    views: Views, geometry: Geometry, config: FitConfig
) -> tuple[Float[Tensor, "6 3 L L"], list[Rays]]:
    """The closed-form map of the training views for a geometry, and the rays that it was solved from.

    A trial map says which surfels to trust, and held-out views how fine the map should be, unless the configuration
    does; then all rays are solved. Exact surfaces need no trial: their map starts from nothing, because a coarse start
    would reject what is finer. That of a surface of revolution is sharpened, unless its radiance is encoded, whose mean
    over a pixel is not that of radiance.
    """
    if not isinstance(geometry, Surfels):
        rays = of_mean_trust_one(list(observed_rays(views, geometry, config, config.environment.rays)))
        resolution = config.environment.solve_resolution or densest_resolution(rays)
        found = solve_environment(rays, resolution)
        light = light_of(config)
        if isinstance(geometry, Lathe) and not light.high_dynamic_range:
            found = sharpened_map(views, geometry, found, light.saturation, _mirrored_at_most(config))
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
    return torch.where(_ray_counts(rays, environment.shape[-1]) > 0, environment, GRAY)


def of_mean_trust_one(rays: Sequence[Rays]) -> list[Rays]:
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


def finest_resolution(rays: Sequence[Rays], start: Float[Tensor, "6 3 L L"]) -> int:
    """Texels along a face side: the first of 64, 128, 256 that held-out views explain as well as the next.

    Every fifth view is held out. Their error is the mean of ‖e‖²/(‖e‖² + s²), s = 0.1, weighted by trust: rays that see
    the object itself count alike for all resolutions.
    """
    solved, held_out = split_held_out(rays)
    if not held_out or not solved:
        return RESOLUTIONS[0]
    best, error = RESOLUTIONS[0], math.inf
    for resolution in RESOLUTIONS:
        found = prediction_error(held_out, solve_environment(solved, resolution, start))
        if found > (1 - LEAST_GAIN) * error:
            break
        best, error = resolution, found
    return best


def densest_resolution(rays: Sequence[Rays]) -> int:
    """Texels along a face side: the finest of 64, 128, 256 with eight rays or more in the median observed texel.

    For geometry whose normals are as exact as their pixels: then no held-out view speaks against detail.
    """
    coarsest = RESOLUTIONS[0]
    count = _ray_counts(rays, coarsest)
    observed = count[count >= 1]
    usual = float(observed.median()) if len(observed) else 0.0
    return max((each for each in RESOLUTIONS if usual * (coarsest / each) ** 2 >= RAYS_A_TEXEL), default=coarsest)


def _ray_counts(rays: Sequence[Rays], resolution: int) -> Float[Tensor, "6 1 L L"]:
    """How many rays fell on each texel."""
    count = torch.zeros(6, 1, resolution, resolution, device=rays[0].directions.device if rays else None)
    for batch in rays:
        count += scatter_cubemap(torch.ones_like(batch.radiance[:, :1]), batch.directions, resolution)
    return count


def prediction_error(rays: Sequence[Rays], environment: Float[Tensor, "6 3 L L"], scale: float = 0.1) -> float:
    """Mean of ‖e‖²/(‖e‖² + s²) over rays, weighted by trust: 0 where a map explains them, 1 where nothing fits
    or there are none.
    """
    summed, weights = 0.0, 0.0
    for batch in rays:
        squared = (sample_cubemap(environment, batch.directions) - batch.radiance).square().sum(1)
        weight = batch.initial_weight()
        summed += float((weight * squared / (squared + scale**2)).sum())
        weights += float(weight.sum())
    return summed / weights if weights > 0 else 1.0


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
