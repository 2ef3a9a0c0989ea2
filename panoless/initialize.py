"""First surfels: on the first surface of `hull`, or at random as the paper's code starts."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.config import SurfelConfig
from panoless.hull import carve_hull, completed_surface, hull_surface
from panoless.lathe import Lathe
from panoless.plane import Plane
from panoless.surfels import Surfels
from panoless.views import Views

OVERLAP = 0.8
INITIAL_OPACITY_LOGIT = 2.2
INITIAL_ROUGHNESS_LOGIT = -2.2
RANDOM_OPACITY = 0.1


def hull_surfels(views: Views, config: SurfelConfig, seed: int) -> Surfels:
    """Surfels evenly over the part of the first surface that faces some camera, curved as it is.

    `thin-plate` takes the completed hull, `hull` the hull itself.
    """
    hull = carve_hull(views, config.hull_resolution, config.hull_votes)
    surface = completed_surface(hull, views) if config.initial == "thin-plate" else hull_surface(hull)
    vertex_normals = surface.vertex_normals()
    corners = surface.vertices[surface.triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = _faces_some_camera(corners.mean(1), vertex_normals[surface.triangles].sum(1), views)
    areas = np.where(facing, np.linalg.norm(cross, axis=1) / 2, 0)
    rng = np.random.default_rng(seed)
    # Stratified over the cumulative area: as even as possible without a relaxation.
    picks = np.searchsorted(
        np.cumsum(areas), (np.arange(config.count) + rng.random(config.count)) * areas.sum() / config.count
    )
    faces = surface.triangles[np.minimum(picks, len(corners) - 1)]
    shares = rng.dirichlet([1.0, 1.0, 1.0], config.count)
    points, normals, tensors = (
        np.einsum("kv,kv...->k...", shares, values[faces])
        for values in (surface.vertices, vertex_normals, surface.shape_tensors())
    )
    frames = _tangent_frames(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))
    curvatures = _shape_operators(tensors, frames)
    scale = OVERLAP * math.sqrt(areas.sum() / config.count)
    return _surfels(points, frames, np.full((config.count, 2), scale), curvatures, INITIAL_OPACITY_LOGIT)


def surfels_on_plane(plane: Plane, count: int, seed: int) -> Surfels:
    """Flat surfels evenly within the outline of a plane: about `count`, on a hexagonal grid shifted by the seed."""
    from skimage.measure import points_in_poly

    low, extent = plane.outline.min(0), np.ptp(plane.outline, 0)
    x, y = plane.outline.T
    area = abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2
    across = math.sqrt(area / count / math.sin(math.pi / 3))
    up = across * math.sin(math.pi / 3)
    shift = np.random.default_rng(seed).random(2) - 1
    row, column = np.indices((math.ceil(extent[1] / up) + 2, math.ceil(extent[0] / across) + 2)).reshape(2, -1)
    grid = low + np.stack([(column + row % 2 / 2 + shift[0]) * across, (row + shift[1]) * up], 1)
    points = plane.points(grid[points_in_poly(grid, plane.outline)])
    frame = np.stack([plane.tangent_u, plane.tangent_v, plane.normal], 1)
    frames = np.broadcast_to(frame, (len(points), 3, 3))
    scales = np.full((len(points), 2), OVERLAP * math.sqrt(area / count))
    return _surfels(points, frames, scales, np.zeros((len(points), 3)), INITIAL_OPACITY_LOGIT)


def surfels_on_lathe(lathe: Lathe, count: int) -> Surfels:
    """About `count` surfels in rings around a lathe, curved as it is: half as long along the profile as around."""
    profile, ends = lathe.profile, lathe.angles
    steps = np.diff(lathe.arc_lengths)
    areas = math.pi * steps * (profile[:-1, 0] + profile[1:, 0])
    # A ring of radius ρ and width w holds 2πρ/2w surfels.
    width = math.sqrt(areas.sum() / count / 2)
    rings = max(round(lathe.arc_lengths[-1] / width), 1)
    place = (np.arange(rings) + 0.5) * lathe.arc_lengths[-1] / rings
    side = np.clip(np.searchsorted(lathe.arc_lengths, place) - 1, 0, len(steps) - 1)
    along = (place - lathe.arc_lengths[side]) / np.maximum(steps[side], 1e-12)
    radius, height = (profile[side] + along[:, None] * (profile[side + 1] - profile[side])).T
    angle = ends[side, 0] + along * (ends[side, 1] - ends[side, 0])
    bend = (ends[side, 1] - ends[side, 0]) / np.maximum(steps[side], 1e-12)
    around = np.maximum(np.round(math.pi * radius / width), 3).astype(np.int64)
    ring = np.repeat(np.arange(rings), around)
    first = np.cumsum(around) - around
    turn = 2 * math.pi * (np.arange(len(ring)) - first[ring] + ring % 2 / 2) / around[ring]
    cos, sin, zero = np.cos(turn), np.sin(turn), np.zeros(len(ring))
    along_radius, along_axis = np.cos(angle[ring]), np.sin(angle[ring])
    local = np.stack([radius[ring] * cos, radius[ring] * sin, height[ring]], 1)
    meridian = np.stack([along_radius * cos, along_radius * sin, along_axis], 1)
    azimuth = np.stack([-sin, cos, zero], 1)
    frames = np.stack([azimuth, meridian, np.cross(azimuth, meridian)], 2)
    frames = np.einsum("ji,kjl->kil", lathe.frame, frames)
    # n = n₀ − S·(x − x₀): the normal turns with the profile, and by n_ρ/ρ around the axis.
    curvatures = np.stack([-along_axis / np.maximum(radius[ring], width / 2), zero, -bend[ring]], 1)
    spacing = np.stack([2 * math.pi * radius[ring] / around[ring], np.full(len(ring), width)], 1)
    scales = OVERLAP * np.maximum(spacing, 1e-6)
    return _surfels(lathe.origin + local @ lathe.frame, frames, scales, curvatures, INITIAL_OPACITY_LOGIT)


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
    """The surfels that a fit starts from, on the device of the views."""
    surfels = random_surfels(config, seed) if config.initial == "random" else hull_surfels(views, config, seed)
    return surfels.to(views.train[0].mask.device)


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


def _faces_some_camera(points: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"], views: Views) -> np.ndarray:
    facing = np.zeros(len(points), dtype=bool)
    for view in views.train:
        facing |= ((view.position - points) * normals).sum(1) > 0
    return facing


def _tangent_frames(normals: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3 3"]:
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 1.0, 0]])
    tangent_u = np.cross(helper, normals)
    tangent_u /= np.linalg.norm(tangent_u, axis=1, keepdims=True)
    return np.stack([tangent_u, np.cross(normals, tangent_u), normals], 2)


def _shape_operators(
    tensors: Float[np.ndarray, "K 3 3"], frames: Float[np.ndarray, "K 3 3"]
) -> Float[np.ndarray, "K 3"]:
    """(a, b, c) in the tangent frame of S, dn = S dx: the normal field is n₀ − …, hence a = −t_uᵀ S t_u."""
    tangents = frames[:, :, :2]
    shape = -np.einsum("kiu,kij,kjv->kuv", tangents, tensors, tangents)
    return np.stack([shape[:, 0, 0], (shape[:, 0, 1] + shape[:, 1, 0]) / 2, shape[:, 1, 1]], 1)
