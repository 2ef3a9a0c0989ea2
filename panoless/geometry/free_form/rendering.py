"""What a camera sees of a free-form surface."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.rays import pose_of, reflect
from panoless.geometry.base import SurfaceBuffers, buffers_from_arrays
from panoless.geometry.exact import shade_centers
from panoless.geometry.free_form.observations import PixelRays
from panoless.geometry.free_form.photometric import Sights
from panoless.geometry.free_form.surface import LevelSet
from panoless.kernels.cubemap import sample_cubemap
from panoless.kernels.rasterize import RasterCamera

SAMPLES = 4
"""Rays along a side of a pixel at an outline."""
AREA_SAMPLES = 4
"""Mirrored rays over a pixel."""
BOUNCES = 8
"""A ray that has not left after so many reflections shows where it goes then."""


def free_form_buffers(surface: LevelSet, camera: RasterCamera) -> SurfaceBuffers:
    """Depth and normals of rays through pixel centers; alpha the share of 4×4 rays that hit, where neighbors disagree.

    Where only the center misses, depth and normal are those of where its ray comes nearest.
    """
    shape, (rotation, _) = (camera.height, camera.width), pose_of(camera)
    everything = np.arange(camera.height * camera.width)
    rays = PixelRays.centers(camera, everything)
    hits = surface.hits(rays.origins, rays.directions)
    distance, normals = np.where(hits.met, hits.distance, 0.0), hits.normals
    alpha = hits.met.astype(np.float64)
    mixed = np.flatnonzero(_beside_outline(hits.met.reshape(shape)))
    alpha[mixed] = coverage(surface, camera, mixed)
    missed = mixed[(alpha[mixed] > 0) & ~hits.met[mixed]]
    near = surface.nearest(rays.origins[missed], rays.directions[missed])
    distance[missed], normals[missed] = np.where(near.met, near.distance, 0.0), near.normals
    depth = distance * (rays.directions @ rotation[2]) * (alpha > 0)
    normals = np.where((alpha > 0)[:, None], normals, 0.0) @ rotation.T
    return buffers_from_arrays(alpha.reshape(shape), depth.reshape(shape), normals.T.reshape(3, *shape), camera)


def coverage(surface: LevelSet, camera: RasterCamera, pixels: Int[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """The share of 4×4 rays through each pixel that hit."""
    row, column = np.divmod(pixels, camera.width)
    share = np.zeros(len(pixels))
    for i in range(SAMPLES):
        for j in range(SAMPLES):
            rays = PixelRays.through(camera, column + (j + 0.5) / SAMPLES, row + (i + 0.5) / SAMPLES)
            share += surface.hits(rays.origins, rays.directions).met
    return share / SAMPLES**2


def _beside_outline(met: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels among whose eight neighbors and themselves some hit and some miss."""
    from scipy.ndimage import maximum_filter, minimum_filter

    found: np.ndarray = maximum_filter(met, 3, mode="nearest") & ~minimum_filter(met, 3, mode="nearest")
    return found


def free_form_light(
    surface: LevelSet,
    environment: Float[Tensor, "6 3 L L"],
    camera: RasterCamera,
    pixels: Int[Tensor, "P"],
    normals_camera: Float[Tensor, "3 P"],
) -> Float[Tensor, "P 3"]:
    """Radiance of pixels (flat indices): the mean over four rays of each that sees the surroundings at once, else that
    of the ray through its center, followed through its reflections.

    Pixels whose centers miss are shaded by the given normals.
    """
    rays = PixelRays.centers(camera, pixels.cpu().numpy())
    sights = Sights.of(surface, rays, AREA_SAMPLES, 0.0)
    light = shade_centers(environment, camera, pixels, normals_camera)
    for index, directions in (
        (np.flatnonzero(sights.clear), sights.outgoing),
        (np.flatnonzero(sights.hits.met & ~sights.clear), _followed(surface, sights, rays)[:, None]),
    ):
        looked_up = torch.from_numpy(directions[index].reshape(-1, 3)).to(environment)
        mean = sample_cubemap(environment, looked_up).view(len(index), directions.shape[1], 3).mean(1)
        light[torch.from_numpy(index).to(light.device)] = mean
    return light


def _followed(surface: LevelSet, sights: Sights, rays: PixelRays) -> Float[np.ndarray, "P 3"]:
    """Where in the map the rays of pixels that see the object again look in the end; the others' mean nothing."""
    directions = rays.directions.copy()
    going = np.flatnonzero(sights.hits.met & ~sights.clear)
    normals, points = sights.hits.normals[going], surface.points(sights.hits.places[going])
    last = np.zeros_like(directions)
    for _ in range(BOUNCES):
        directions[going], last[going] = reflect(directions[going], normals), points
        hits = surface.hits(points, directions[going], leaving=True)
        going, normals = going[hits.met], hits.normals[hits.met]
        points = surface.points(hits.places[hits.met])
        if not len(going):
            break
    return surface.surroundings.looked_up(last, directions)
