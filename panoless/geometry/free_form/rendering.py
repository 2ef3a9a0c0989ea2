"""What a camera sees of a free-form surface."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.rays import pose_of
from panoless.geometry.base import SurfaceBuffers, beside_silhouette, buffers_from_arrays
from panoless.geometry.exact import shade_centers
from panoless.geometry.free_form.photometric import ReflectedRays
from panoless.geometry.free_form.spread import FinalRays
from panoless.geometry.free_form.surface import LevelSet
from panoless.kernels.camera import RasterCamera
from panoless.kernels.cubemap import sample_cubemap
from panoless.problem.rays import PixelRays

SAMPLES = 4
"""Rays along a side of a pixel at a silhouette, and where mirrored rays turn far or meet the surface again."""
DIRECTIONS = 4
"""Mirrored rays over the other pixels."""
WIDEST_TURN_RAD = 0.15
"""Mirrored rays turn far that turn by more over a pixel."""
BOUNCES = 8
"""A ray that has not left after so many reflections shows where it goes then."""


def free_form_buffers(surface: LevelSet, camera: RasterCamera) -> SurfaceBuffers:
    """Depth and normals of rays through pixel centers; alpha the share of a grid of rays that hit, where neighbors
    disagree.

    Where only the center misses, depth and normal are those of where its ray comes nearest.
    """
    shape, (rotation, _) = (camera.height, camera.width), pose_of(camera)
    everything = np.arange(camera.height * camera.width)
    rays = PixelRays.centers(camera, everything)
    hits = surface.hits(rays.origins, rays.directions)
    distance, normals = np.where(hits.met, hits.distance, 0.0), hits.normals
    alpha = hits.met.astype(np.float64)
    mixed = np.flatnonzero(beside_silhouette(hits.met.reshape(shape)))
    alpha[mixed] = coverage(surface, camera, mixed)
    missed = mixed[(alpha[mixed] > 0) & ~hits.met[mixed]]
    near = surface.nearest(rays.origins[missed], rays.directions[missed])
    distance[missed], normals[missed] = np.where(near.met, near.distance, 0.0), near.normals
    depth = distance * (rays.directions @ rotation[2]) * (alpha > 0)
    normals = np.where((alpha > 0)[:, None], normals, 0.0) @ rotation.T
    return buffers_from_arrays(alpha.reshape(shape), depth.reshape(shape), normals.T.reshape(3, *shape), camera)


def coverage(surface: LevelSet, camera: RasterCamera, pixels: Int[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """The share of a grid of rays through each pixel that hit."""
    row, column = np.divmod(pixels, camera.width)
    share = np.zeros(len(pixels))
    for rays in _grid_of_rays(camera, column, row):
        share += surface.meets(rays.origins, rays.directions)
    return share / SAMPLES**2


def _grid_of_rays(camera: RasterCamera, column: Int[np.ndarray, "P"], row: Int[np.ndarray, "P"]) -> Iterator[PixelRays]:
    """Through the centers of `SAMPLES` parts of pixels a side."""
    for down, across in np.ndindex(SAMPLES, SAMPLES):
        yield PixelRays.through(camera, column + (across + 0.5) / SAMPLES, row + (down + 0.5) / SAMPLES)


def free_form_light(
    surface: LevelSet,
    environment: Float[Tensor, "6 3 L L"],
    camera: RasterCamera,
    pixels: Int[Tensor, "P"],
    normals_camera: Float[Tensor, "3 P"],
) -> Float[Tensor, "P 3"]:
    """Radiance of pixels (flat indices): the mean over a few rays that see the surroundings at once and turn little,
    else over those of a grid of rays that hit, followed through their reflections.

    Pixels that none of these hit are shaded by the given normals.
    """
    index = pixels.cpu().numpy()
    reflected = ReflectedRays.of(surface, PixelRays.centers(camera, index), DIRECTIONS, 0.0)
    light = shade_centers(environment, camera, pixels, normals_camera)
    narrow = reflected.clear & (reflected.turn < WIDEST_TURN_RAD)
    mean = sample_cubemap(environment, torch.from_numpy(reflected.outgoing[narrow]).to(environment))
    light[torch.from_numpy(np.flatnonzero(narrow)).to(light.device)] = mean
    row, column = np.divmod(index[~narrow], camera.width)
    total, count = torch.zeros(len(row), 3).to(light), torch.zeros(len(row)).to(light)
    for rays in _grid_of_rays(camera, column, row):
        final = FinalRays.of(surface, rays, BOUNCES)
        hit = np.flatnonzero(final.met)
        outgoing = surface.surroundings.looked_up(final.last[hit], final.directions[hit])
        found = torch.from_numpy(hit).to(light.device)
        total[found] += sample_cubemap(environment, torch.from_numpy(outgoing).to(environment))
        count[found] += 1
    seen = count > 0
    wide = torch.from_numpy(np.flatnonzero(~narrow)).to(light.device)
    light[wide[seen]] = total[seen] / count[seen, None]
    return light
