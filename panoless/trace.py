"""Which reflected rays meet the object again, where, and what they see there.

Rays are followed through a grid of signed distances, made of the depth maps of the training views.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from panoless.kernels.cpu.trace import Picture, Tally, march, tally_view
from panoless.kernels.cpu.workers import run_shared
from panoless.kernels.rasterize import Channels, RasterCamera
from panoless.kernels.reference.objective import reflection_directions_world, surface_depth
from panoless.shading import ALPHA_FLOOR, rasterize_surfels
from panoless.surfels import Surfels
from panoless.views import TrainView, Views

HALF_SIDE = 1.1
RESOLUTION = 128
#: Distances are averaged this far from a surface.
BAND_VOXELS = 4.0
FUSED_VIEWS = 40
SURFACE_ALPHA = 0.5
DEPTH_ONLY = Channels(colors=False, distortion=False)


@dataclass(frozen=True)
class TracedSurface:
    """Signed distance in voxels, positive outside, at voxel centers of a cube around the unit ball; axes x, y, z.

    `normals_world` are means over the views that saw a voxel, zero where none did, and not unit.
    """

    distance: Float[np.ndarray, "N N N"]
    normals_world: Float[np.ndarray, "N N N 3"]
    voxel: float


@dataclass(frozen=True)
class Hits:
    """Where rays meet the surface: points in the normalized frame, unit normals; meaningless where `found` is false."""

    found: Bool[Tensor, "P"]
    points: Float[Tensor, "P 3"]
    normals_world: Float[Tensor, "P 3"]


def fuse_surface(views: Views, surfels: Surfels, curved: bool) -> TracedSurface:
    """The surface that some forty training views see of the surfels, within their masks."""
    chosen = views.train[:: math.ceil(len(views.train) / FUSED_VIEWS)]
    return fuse_pictures([picture_of(view, surfels, curved) for view in chosen])


def fuse_pictures(pictures: Sequence[Picture], resolution: int = RESOLUTION) -> TracedSurface:
    """Signed distances from depth and normals of some cameras.

    Near a surface: the mean over views of the distance from the tangent plane of the pixel that a voxel falls on,
    weighted by the squared cosine of incidence. Hidden from all views: inside. Not inside, though, where more views see
    the voxel empty, or outside their outline, than near a surface.
    """
    voxel = 2 * HALF_SIDE / (resolution - 1)
    shape = (resolution,) * 3
    tally = Tally(
        weight=np.zeros(shape, np.float32),
        distance=np.zeros(shape, np.float32),
        normal=np.zeros((*shape, 3), np.float32),
        empty=np.zeros(shape, np.int32),
        near=np.zeros(shape, np.int32),
    )
    numbers = [np.float32(value) for value in (HALF_SIDE, voxel, BAND_VOXELS * voxel)]
    for picture in pictures:
        run_shared(tally_view, picture, *numbers, tally)
    return TracedSurface(_signed_distance(tally, voxel), tally.normal, voxel)


def first_hits(
    surface: TracedSurface,
    points: Float[Tensor, "P 3"],
    normals_world: Float[Tensor, "P 3"],
    directions: Float[Tensor, "P 3"],
) -> Hits:
    """Follow rays that leave the surface at points of the normalized frame, whose unit normals face away from it.

    A ray starts a voxel above the surface; what is nearer than that to where it starts isn't told from it.
    """
    origins = (_array(points) + np.float32(HALF_SIDE)) / np.float32(surface.voxel)
    lengths = np.empty(len(origins), np.float32)
    run_shared(march, surface.distance, origins, _array(normals_world), _array(directions), lengths)
    found = np.isfinite(lengths)
    ends = origins + np.where(found, lengths, 0)[:, None] * _array(directions)
    normals = np.zeros_like(ends)
    normals[found] = _normals_at(surface, ends[found])
    moved = ends * np.float32(surface.voxel) - np.float32(HALF_SIDE)
    device = points.device
    return Hits(*(torch.from_numpy(each).to(device) for each in (found, moved, normals)))


def leaving_directions(
    surface: TracedSurface,
    points: Float[Tensor, "P 3"],
    normals_world: Float[Tensor, "P 3"],
    directions: Float[Tensor, "P 3"],
    bounces: int = 3,
) -> Float[Tensor, "P 3"]:
    """Directions in which mirrored rays leave the scene, after up to `bounces` further reflections.

    At a hit with normal n a direction d becomes d − 2 (d·n) n, as in Eq. 5. A ray that meets the surface once more
    keeps its last direction.
    """
    directions, pending = directions.clone(), torch.arange(len(points), device=points.device)
    for _ in range(bounces):
        hits = first_hits(surface, points, normals_world, directions[pending])
        pending, points, normals_world = pending[hits.found], hits.points[hits.found], hits.normals_world[hits.found]
        if not len(pending):
            break
        incoming = directions[pending]
        directions[pending] = incoming - 2 * (incoming * normals_world).sum(1, keepdim=True) * normals_world
    return directions


def sees_itself(
    surface: TracedSurface, view: TrainView, surfels: Surfels, curved: bool, margin_px: int = 0
) -> Bool[Tensor, "H W"]:
    """Pixels that lie wholly on the object and whose mirrored ray meets it again, and those within a margin of them."""
    with torch.no_grad():
        raster = rasterize_surfels(surfels, view.camera, curved=curved, channels=DEPTH_ONLY)
        depth = surface_depth(raster.accumulated_depth, raster.median_depth, raster.alpha, 0.5)
        pixels = view.solid[raster.alpha.flatten()[view.solid] > SURFACE_ALPHA]
        rotation, rays = view.camera_to_world_rotation, view.rays_camera.flatten(1)[:, pixels]
        normals_camera = raster.normals_camera.flatten(1)[:, pixels]
        points = surface_points(view.camera, rays, depth.flatten()[pixels])
        normals_world = (rotation @ normalize(normals_camera, dim=0)).T
        hits = first_hits(surface, points, normals_world, reflection_directions_world(normals_camera, rays, rotation))
    seen = torch.zeros_like(view.mask)
    seen.view(-1)[pixels] = hits.found.float()
    if margin_px:
        seen = max_pool2d(seen[None], 2 * margin_px + 1, stride=1, padding=margin_px)[0]
    return seen > 0


def surface_points(
    camera: RasterCamera, rays_camera: Float[Tensor, "3 P"], depth: Float[Tensor, "P"]
) -> Float[Tensor, "P 3"]:
    """Points of the normalized frame at z-depths along camera rays of any length."""
    pose = camera.world_to_camera
    return (rays_camera / rays_camera[2] * depth - pose[:3, 3:]).T @ pose[:3, :3]


def picture_of(view: TrainView, surfels: Surfels, curved: bool) -> Picture:
    """Depth and normals of the surfels within the mask of a view."""
    with torch.no_grad():
        raster = rasterize_surfels(surfels, view.camera, curved=curved, channels=DEPTH_ONLY)
        depth = surface_depth(raster.accumulated_depth, raster.median_depth, raster.alpha, 0.5)
        depth = depth * (raster.alpha > SURFACE_ALPHA) * (view.mask > SURFACE_ALPHA)
        normals = normalize(raster.normals_camera, dim=0).permute(1, 2, 0)
    camera = view.camera
    return Picture(
        depth=_array(depth),
        normals=_array(normals),
        world_to_camera=_array(camera.world_to_camera),
        intrinsics=tuple(np.float32(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)),
    )


def _signed_distance(tally: Tally, voxel: float) -> Float[np.ndarray, "N N N"]:
    """Voxels; beyond the band, the distance to it is added."""
    from scipy.ndimage import distance_transform_edt

    distance = np.full(tally.weight.shape, -BAND_VOXELS, np.float32)
    near = tally.near > 0
    distance[near] = tally.distance[near] / (tally.weight[near] * voxel)
    distance[(distance < 0) & (tally.empty > tally.near)] = BAND_VOXELS
    for axis in range(3):
        for side in (0, -1):
            np.moveaxis(distance, axis, 0)[side] = BAND_VOXELS
    outside = distance >= BAND_VOXELS
    beyond = distance_transform_edt(outside).astype(np.float32) - 1
    return np.where(outside, BAND_VOXELS + np.maximum(beyond, 0), distance)


def _normals_at(surface: TracedSurface, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Unit normals at voxel coordinates: of the views where some saw the place, of the distances elsewhere."""
    from scipy.ndimage import map_coordinates

    def at(volume: Float[np.ndarray, "N N N"]) -> Float[np.ndarray, "P"]:
        return map_coordinates(volume, points.T, order=1, mode="nearest")

    seen = np.stack([at(surface.normals_world[..., axis]) for axis in range(3)], 1)
    slope = np.stack([at(np.gradient(surface.distance, axis=axis)) for axis in range(3)], 1)
    normals = np.where((seen**2).sum(1, keepdims=True) > ALPHA_FLOOR**2, seen, slope)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float32)
