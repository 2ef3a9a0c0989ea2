"""First surfels: on the first surface of `hull`, or at random as the paper's code starts."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.views import Views
from panoless.first_surface.completion import complete_surface, hull_surface
from panoless.first_surface.mesh import TriangleMesh, unit
from panoless.first_surface.options import FirstSurfaceOptions
from panoless.first_surface.visual_hull import Hull, carve_hull
from panoless.splats.model import Surfels
from panoless.splats.options import SurfelConfig

TIE_TOLERANCE = 1e-6
INITIAL_OPACITY_LOGIT = 2.2
INITIAL_ROUGHNESS_LOGIT = -2.2
RANDOM_OPACITY = 0.1
OVERLAP = 0.8
"""Radius of a surfel over the side of its share of the area, a square."""
SAG_PX = 1.0
"""A surfel's disk may leave the first surface, or the hull, by so much at twice its radius."""
LEAST_RADIUS_PX = 1.5
"""Strong curvature makes no smaller surfels than these."""
SHRINKING_STEPS = 6
"""Times that a surfel which sticks out of the hull is shrunk at most…"""
SHRINKAGE = 0.75
"""…and the factor each time."""
CANDIDATES = 8
"""Points drawn for each surfel, to be spread."""
RELAXATION_ROUNDS = 3
"""Rounds of Lloyd's relaxation by which surfels spread."""


def hull_surfels(views: Views, config: SurfelConfig, seed: int, options: FirstSurfaceOptions) -> Surfels:
    """Surfels over the part of the first surface that faces some camera, curved as it is, within the outlines.

    `thin-plate` takes the completed hull, `hull` the hull itself. Axes follow the principal directions; a radius is
    at most that of `_reach`, so that strong curvature gets smaller surfels, and more of them.
    """
    hull = carve_hull(views, options.hull_resolution, options.hull_votes)
    surface = complete_surface(hull, views) if config.initial == "thin-plate" else hull_surface(hull)
    facing = _faces_some_camera(surface, views)
    return surfels_on_mesh(surface, config, seed, facing, hull)


def surfels_on_mesh(
    surface: TriangleMesh,
    config: SurfelConfig,
    seed: int,
    facing: Bool[np.ndarray, "T"],
    hull: Hull,
) -> Surfels:
    """Surfels over the triangles of a mesh that are `facing`, curved as it is, and within a hull."""
    vertex_normals, tensors = surface.vertex_normals(), surface.shape_tensors()
    areas = np.linalg.norm(surface.area_vectors(), axis=1) / 2 * facing
    face_normals = unit(vertex_normals[surface.triangles].sum(1))
    bends, _ = _principal(tensors[surface.triangles].mean(1), _tangent_frames(face_normals))
    radii, largest = _radii(areas, bends, hull.pixel, config.count)
    rng = np.random.default_rng(seed)
    expected = np.cumsum(areas / radii.prod(1))
    # Stratified over the cumulative number, and more than are needed, so that they can be spread.
    candidates = CANDIDATES * config.count
    picks = np.searchsorted(expected, (np.arange(candidates) + rng.random(candidates)) * expected[-1] / candidates)
    faces = surface.triangles[np.minimum(picks, len(surface.triangles) - 1)]
    shares = rng.dirichlet([1.0, 1.0, 1.0], candidates)
    points = np.einsum("kv,kvi->ki", shares, surface.vertices[faces])
    chosen = _spread(points, config.count)
    points, faces, shares = points[chosen], faces[chosen], shares[chosen]
    normals, tensors = (np.einsum("kv,kv...->k...", shares, values[faces]) for values in (vertex_normals, tensors))
    bends, frames = _principal(tensors, _tangent_frames(unit(normals)))
    scales = _within_hull(hull, points, frames, np.minimum(_reach(bends, hull.pixel), largest))
    return surfels_at(points, frames, scales, _shape_operators(tensors, frames))


def _radii(
    areas: Float[np.ndarray, "T"], bends: Float[np.ndarray, "T 2"], pixel: float, count: int
) -> tuple[Float[np.ndarray, "T 2"], float]:
    """Radii of so many overlapping surfels on faces of these principal curvatures, and the largest.

    The largest radius r solves Σ A/(min(r, l_u) min(r, l_v)) = n/`OVERLAP`², l the limit by curvature.
    """
    limits = _reach(bends, pixel)
    low, high = 1e-6, OVERLAP * math.sqrt(areas.sum() / count) * 100
    for _ in range(60):
        middle = math.sqrt(low * high)
        needed = (areas / np.minimum(limits, middle).prod(1)).sum() * OVERLAP**2
        low, high = (middle, high) if needed > count else (low, middle)
    return np.minimum(limits, high), high


def _reach(bends: Float[np.ndarray, "K 2"], pixel: float) -> Float[np.ndarray, "K 2"]:
    """The radius s at which a disk leaves a surface of curvature κ by `SAG_PX` at 2 s, at least `LEAST_RADIUS_PX`."""
    limit = np.sqrt(SAG_PX * pixel / 2 / np.maximum(np.abs(bends), 1e-9))
    return np.maximum(limit, LEAST_RADIUS_PX * pixel)


def _within_hull(
    hull: Hull,
    points: Float[np.ndarray, "K 3"],
    frames: Float[np.ndarray, "K 3 3"],
    radii: Float[np.ndarray, "K 2"],
) -> Float[np.ndarray, "K 2"]:
    """Radii, shrunk until the disk at twice the radius leaves the hull by no more than `SAG_PX`, along either axis.

    What lies outside the hull is seen outside the masks, where it would be a halo.
    """
    radii = radii.copy()
    for _ in range(SHRINKING_STEPS):
        tips = 2 * radii[:, :, None] * frames[:, :, :2].transpose(0, 2, 1)
        excess = np.maximum(hull.at(points[:, None] + tips), hull.at(points[:, None] - tips))
        shrunk = np.maximum(SHRINKAGE * radii, LEAST_RADIUS_PX * hull.pixel)
        radii = np.where(excess > SAG_PX * hull.pixel, shrunk, radii)
    return radii


def _spread(points: Float[np.ndarray, "C 3"], count: int) -> Int[np.ndarray, "K"]:
    """Indices of so many points, spread evenly among all: Lloyd's relaxation of a regular choice."""
    from scipy.spatial import cKDTree

    centers = points[:: max(len(points) // count, 1)][:count]
    for _ in range(RELAXATION_ROUNDS):
        _, owner = cKDTree(centers).query(points)
        total = np.bincount(owner, minlength=count)
        sums = np.stack([np.bincount(owner, column, minlength=count) for column in points.T], 1)
        centers = np.where(total[:, None] > 0, sums / np.maximum(total, 1)[:, None], centers)
    distances, nearest = cKDTree(points).query(centers, k=2)
    # The middle of two points is as near to one as to the other: not rounding decides then, but their order.
    tied = distances[:, 1] <= (1 + TIE_TOLERANCE) * distances[:, 0]
    return np.where(tied, nearest.min(1), nearest[:, 0])


def _principal(
    tensors: Float[np.ndarray, "K 3 3"], frames: Float[np.ndarray, "K 3 3"]
) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, "K 3 3"]]:
    """Principal curvatures of shape tensors, and the frames turned about their normals to the principal directions."""
    tangents = frames[:, :, :2]
    shape = _within_tangents(tensors, frames)
    bends, directions = np.linalg.eigh((shape + shape.transpose(0, 2, 1)) / 2)
    tangent_u = np.einsum("kiu,ku->ki", tangents, directions[:, :, 0])
    return bends, np.stack([tangent_u, np.cross(frames[:, :, 2], tangent_u), frames[:, :, 2]], 2)


def random_surfels(config: SurfelConfig, seed: int) -> Surfels:
    """Surfels uniformly in the normalized cube with random orientation, sized by their mean distance."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (config.count, 3))
    frames = Rotation.random(config.count, random_state=rng).as_matrix()
    scale = 0.55 * 2 / config.count ** (1 / 3)
    logit = math.log(RANDOM_OPACITY / (1 - RANDOM_OPACITY))
    return surfels_at(points, frames, np.full((config.count, 2), scale), np.zeros((config.count, 3)), logit)


def initial_surfels(
    views: Views, config: SurfelConfig, seed: int, options: FirstSurfaceOptions = FirstSurfaceOptions()
) -> Surfels:
    """The surfels that a fit starts from, on the device of the views."""
    surfels = random_surfels(config, seed) if config.initial == "random" else hull_surfels(views, config, seed, options)
    return surfels.to(views.train[0].mask.device)


def surfels_at(
    points: Float[np.ndarray, "K 3"],
    frames: Float[np.ndarray, "K 3 3"],
    scales: Float[np.ndarray, "K 2"],
    curvatures: Float[np.ndarray, "K 3"],
    opacity_logit: float = INITIAL_OPACITY_LOGIT,
) -> Surfels:
    """Surfels with centers, tangent frames (columns), radii and shape operators."""
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


def _faces_some_camera(surface: TriangleMesh, views: Views) -> Bool[np.ndarray, "T"]:
    points = surface.vertices[surface.triangles].mean(1)
    normals = surface.vertex_normals()[surface.triangles].sum(1)
    facing = np.zeros(len(points), dtype=bool)
    for view in views.train:
        facing |= ((view.position - points) * normals).sum(1) > 0
    return facing


def _tangent_frames(normals: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3 3"]:
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 1.0, 0]])
    tangent_u = np.cross(helper, normals)
    tangent_u /= np.linalg.norm(tangent_u, axis=1, keepdims=True)
    return np.stack([tangent_u, np.cross(normals, tangent_u), normals], 2)


def _within_tangents(
    tensors: Float[np.ndarray, "K 3 3"], frames: Float[np.ndarray, "K 3 3"]
) -> Float[np.ndarray, "K 2 2"]:
    """Tᵀ S T with T the first two columns of a frame."""
    tangents = frames[:, :, :2]
    return np.einsum("kiu,kij,kjv->kuv", tangents, tensors, tangents)


def _shape_operators(
    tensors: Float[np.ndarray, "K 3 3"], frames: Float[np.ndarray, "K 3 3"]
) -> Float[np.ndarray, "K 3"]:
    """(a, b, c) in the tangent frame of S, dn = S dx: the normal field is n₀ − …, hence a = −t_uᵀ S t_u."""
    shape = -_within_tangents(tensors, frames)
    return np.stack([shape[:, 0, 0], (shape[:, 0, 1] + shape[:, 1, 0]) / 2, shape[:, 1, 1]], 1)
