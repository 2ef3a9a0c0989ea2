"""First surfels: on the visual hull of the masks, or at random as the paper's code starts."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.config import SurfelConfig
from panoless.surfels import Surfels
from panoless.views import Views
from shinypartial.errors import InputError

HULL_HALF_SIDE = 1.1
SURFACE_SMOOTHING_VOXELS = 1.5
CURVATURE_SMOOTHING_VOXELS = 3.0
OVERLAP = 0.8
INITIAL_OPACITY_LOGIT = 2.2
INITIAL_ROUGHNESS_LOGIT = -2.2
RANDOM_OPACITY = 0.1


@dataclass(frozen=True)
class Hull:
    """Signed distance (normalized units, negative inside) on a cubic grid of voxel centers, axes x, y, z."""

    distance: Float[np.ndarray, "N N N"]
    voxel: float

    def to_index(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Grid coordinates of points."""
        return (points + HULL_HALF_SIDE) / self.voxel


def carve_hull(views: Views, resolution: int, votes: float) -> Hull:
    """Visual hull: a voxel stays if at least `votes` of the views have it inside their mask.

    Raises InputError when nothing stays, which means masks and poses contradict each other.
    """
    from scipy.ndimage import distance_transform_edt

    line = torch.linspace(-HULL_HALF_SIDE, HULL_HALF_SIDE, resolution)
    points = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).view(-1, 3)
    allowed = math.floor((1 - votes) * len(views.train))
    misses = torch.zeros(len(points), dtype=torch.int32)
    alive = torch.arange(len(points))
    for view in views.train:
        camera, mask = view.camera, view.mask
        seen = points[alive] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        depth = seen[:, 2].clamp(min=1e-6)
        column = (seen[:, 0] / depth * camera.fx + camera.cx).floor().long()
        row = (seen[:, 1] / depth * camera.fy + camera.cy).floor().long()
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (seen[:, 2] > 0)
        index = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
        misses[alive] += (~(inside & (mask.flatten()[index] >= 0.5))).int()
        alive = alive[misses[alive] <= allowed]
    if len(alive) < 8:
        raise InputError(
            expected="masks and poses that agree on an object",
            found=f"no point in space that {votes:.0%} of the masks contain",
            remedy="Check the axes of transform_matrix (OpenGL) and that masks mark the object, not the background.",
        )
    occupied = np.zeros(resolution**3, dtype=bool)
    occupied[alive.numpy()] = True
    occupied = np.pad(occupied.reshape(resolution, resolution, resolution)[1:-1, 1:-1, 1:-1], 1)
    voxel = 2 * HULL_HALF_SIDE / (resolution - 1)
    distance = distance_transform_edt(~occupied) - distance_transform_edt(occupied)
    return Hull(distance.astype(np.float32) * voxel, voxel)


def hull_surfels(views: Views, config: SurfelConfig, seed: int) -> Surfels:
    """Surfels evenly over the part of the hull's surface that faces some camera, curved as the hull is."""
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    hull = carve_hull(views, config.hull_resolution, config.hull_votes)
    smooth = gaussian_filter(hull.distance, SURFACE_SMOOTHING_VOXELS)
    vertices, triangles, _, _ = marching_cubes(smooth, 0.0)
    corners = (vertices * hull.voxel - HULL_HALF_SIDE)[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = _gradient_at(smooth, hull, corners.mean(1))
    facing = _faces_some_camera(corners.mean(1), normals, views)
    areas = np.where(facing, np.linalg.norm(cross, axis=1) / 2, 0)
    rng = np.random.default_rng(seed)
    # Stratified over the cumulative area: as even as possible without a relaxation.
    picks = np.searchsorted(
        np.cumsum(areas), (np.arange(config.count) + rng.random(config.count)) * areas.sum() / config.count
    )
    barycentric = rng.dirichlet([1.0, 1.0, 1.0], config.count)
    points = (corners[np.minimum(picks, len(corners) - 1)] * barycentric[..., None]).sum(1)
    frames = _tangent_frames(_gradient_at(smooth, hull, points))
    curvatures = _shape_operators(gaussian_filter(hull.distance, CURVATURE_SMOOTHING_VOXELS), hull, points, frames)
    scale = OVERLAP * math.sqrt(areas.sum() / config.count)
    return _surfels(points, frames, np.full((config.count, 2), scale), curvatures, INITIAL_OPACITY_LOGIT)


def random_surfels(config: SurfelConfig, seed: int) -> Surfels:
    """Surfels uniformly in the normalized cube with random orientation, sized by their mean distance."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (config.count, 3))
    frames = Rotation.random(config.count, random_state=rng).as_matrix()
    scale = 0.55 * 2 / config.count ** (1 / 3)
    logit = math.log(RANDOM_OPACITY / (1 - RANDOM_OPACITY))
    return _surfels(points, frames, np.full((config.count, 2), scale), np.zeros((config.count, 3)), logit)


def initial_surfels(views: Views, config: SurfelConfig, seed: int) -> Surfels:
    """The surfels that a fit starts from."""
    return hull_surfels(views, config, seed) if config.initial == "hull" else random_surfels(config, seed)


def _surfels(
    points: Float[np.ndarray, "K 3"],
    frames: Float[np.ndarray, "K 3 3"],
    scales: Float[np.ndarray, "K 2"],
    curvatures: Float[np.ndarray, "K 3"],
    opacity_logit: float,
) -> Surfels:
    from scipy.spatial.transform import Rotation

    quats = Rotation.from_matrix(frames).as_quat()[:, [3, 0, 1, 2]]

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))

    return Surfels(
        means=tensor(points),
        quats=tensor(quats),
        log_scales=tensor(np.log(scales)),
        opacity_logits=torch.full((len(points),), opacity_logit),
        albedo=torch.zeros(len(points), 3),
        curvatures=tensor(curvatures),
        roughness_logits=torch.full((len(points),), INITIAL_ROUGHNESS_LOGIT),
    )


def _gradient_at(
    field: Float[np.ndarray, "N N N"], hull: Hull, points: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "P 3"]:
    """Unit gradient of a signed distance: the outward normal."""
    from scipy.ndimage import map_coordinates

    index = hull.to_index(points).T
    gradient = np.stack([map_coordinates(part, index, order=1) for part in np.gradient(field, hull.voxel)], -1)
    return gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)


def _faces_some_camera(points: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"], views: Views) -> np.ndarray:
    facing = np.zeros(len(points), dtype=bool)
    for view in views.train:
        world_to_camera = view.camera.world_to_camera.numpy()
        center = -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
        facing |= ((center - points) * normals).sum(1) > 0
    return facing


def _tangent_frames(normals: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3 3"]:
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 1.0, 0]])
    tangent_u = np.cross(helper, normals)
    tangent_u /= np.linalg.norm(tangent_u, axis=1, keepdims=True)
    return np.stack([tangent_u, np.cross(normals, tangent_u), normals], 2)


def _shape_operators(
    field: Float[np.ndarray, "N N N"],
    hull: Hull,
    points: Float[np.ndarray, "K 3"],
    frames: Float[np.ndarray, "K 3 3"],
) -> Float[np.ndarray, "K 3"]:
    """(a, b, c) from the Hessian H of the signed distance: the normal changes by H δ along δ, hence a = −t_uᵀ H t_u."""
    from scipy.ndimage import map_coordinates

    index = hull.to_index(points).T
    rows = [
        [map_coordinates(second, index, order=1) for second in np.gradient(first, hull.voxel)]
        for first in np.gradient(field, hull.voxel)
    ]
    hessian = np.moveaxis(np.array(rows), -1, 0)
    tangents = frames[:, :, :2]
    shape = -np.einsum("kiu,kij,kjv->kuv", tangents, hessian, tangents)
    return np.stack([shape[:, 0, 0], (shape[:, 0, 1] + shape[:, 1, 0]) / 2, shape[:, 1, 1]], 1)
