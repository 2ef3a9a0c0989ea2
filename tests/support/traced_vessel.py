"""Vessels as triangle meshes, traced by Embree: photographs that share no code with the model that is fitted."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.views import TrainView, Views
from panoless.kernels.camera import RasterCamera
from shinypartial.core.camera import look_at
from shinypartial.core.conventions import SOLID_ALPHA

AROUND = 256
SAMPLES = 4
"""Rays along either side of a pixel."""
MAX_BOUNCES = 8
UPRIGHT = np.eye(3)
DISTANCE = 3.5
WAVES = np.array([[7.0, 2.0, 1.0], [-2.0, 6.0, 3.0], [1.0, -4.0, 7.0]])


def stripes(directions: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Radiance of unit directions: in each channel waves some fifty degrees long across another axis."""
    return 0.5 + 0.35 * np.sin(directions @ WAVES.T + [0.0, 1.0, 2.0])


@dataclass(frozen=True)
class Vessel:
    """Smooth pieces of a profile (radius, height), outside from the floor to the lip and, if it has one, inside down to
    the axis; the axis is z.
    """

    outside: list[Float[np.ndarray, "_ 2"]]
    inside: list[Float[np.ndarray, "_ 2"]]

    @cached_property
    def mesh(self) -> tuple[EmbreeScene, Float[np.ndarray, "F 3 3"], Float[np.ndarray, "F 3 3"]]:
        """The mesh as Embree has it; corners and their normals, a triangle each."""
        corners, normals = [], []
        turn = 2 * np.pi * np.arange(AROUND) / AROUND
        for piece in self.outside + self.inside:
            tangent = np.gradient(piece, axis=0, edge_order=2)
            tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
            for target, (radial, axial) in ((corners, piece.T), (normals, (tangent[:, 1], -tangent[:, 0]))):
                rings = np.stack(
                    [
                        radial[:, None] * np.cos(turn),
                        radial[:, None] * np.sin(turn),
                        np.repeat(axial[:, None], AROUND, 1),
                    ],
                    -1,
                )
                a, b = rings[:-1], rings[1:]
                c, d = np.roll(b, -1, 1), np.roll(a, -1, 1)
                target.append(np.stack([a, b, c], 2).reshape(-1, 3, 3))
                target.append(np.stack([a, c, d], 2).reshape(-1, 3, 3))
        scene, triangles = EmbreeScene(), np.concatenate(corners)
        TriangleMesh(scene, triangles.astype(np.float32))
        return scene, triangles, np.concatenate(normals)


def cut_bowl() -> Vessel:
    """An open wall without thickness on a flat floor, bulging and flaring to its lip at (0.5, 0.62)."""
    height = np.linspace(-0.7, 0.62, 160)
    radius = 0.42 + 0.12 * np.sin(3.2 * (height + 0.55)) + 0.1 * (height + 0.7) ** 2
    floor = np.linspace([0.0, -0.7], [radius[0], -0.7], 3)
    return Vessel([floor, np.stack([radius, height], 1)], [])


def deep_cup() -> Vessel:
    """An open wall without thickness, as deep as it is wide: cameras see the sky in it by way of its walls only."""
    height = np.linspace(-0.6, 0.6, 160)
    radius = 0.5 + 0.06 * height + 0.04 * np.sin(4 * height)
    floor = np.linspace([0.0, -0.6], [radius[0], -0.6], 3)
    return Vessel([floor, np.stack([radius, height], 1)], [])


def dished_jar() -> Vessel:
    """A closed jar whose top is a shallow dish below its lip."""
    height = np.linspace(-0.7, 0.6, 160)
    radius = 0.45 + 0.08 * np.cos(3.5 * height + 0.4)
    floor = np.linspace([0.0, -0.7], [radius[0], -0.7], 3)
    x = np.linspace(1.0, 0.0, 60)
    dish = np.stack([radius[-1] * x, 0.6 - 0.12 * np.cos(np.pi * x / 2) ** 2], 1)
    return Vessel([floor, np.stack([radius, height], 1)], [dish])


def plate() -> Vessel:
    """A plate with a wide brim and a flat middle, without a wall that silhouettes show: its inside slopes by 30°."""
    outer = np.stack([np.linspace(0.5, 0.9, 80), 0.22 * np.linspace(0, 1, 80) ** 2 - 0.2], 1)
    floor = np.linspace([0.0, -0.2], [0.5, -0.2], 3)
    x = np.linspace(1.0, 0.0, 120)
    inner = np.stack([0.9 * x, 0.02 - 0.14 / (1 + np.exp((0.9 * x - 0.55) / 0.05))], 1)
    inner[0, 1] = outer[-1, 1]
    return Vessel([floor, outer], [inner])


def cameras_around(count: int, elevations_deg: tuple[float, ...]) -> list[Float[np.ndarray, "4 4"]]:
    """Poses on an arc of 200° at elevations in turn."""
    poses = []
    for index, azimuth in enumerate(np.radians(np.linspace(-100, 100, count))):
        elevation = np.radians(elevations_deg[index % len(elevations_deg)])
        across = np.cos(elevation)
        position = np.array([across * np.sin(azimuth), -across * np.cos(azimuth), np.sin(elevation)])
        poses.append(look_at(DISTANCE * position, np.zeros(3)))
    return poses


def trace(
    vessel: Vessel, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], max_bounces: int
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Directions in which unit rays leave, zero for those that never hit or never leave; normals of their first hits,
    zero for misses.
    """
    scene, corners, normals = vessel.mesh
    first, leaving = np.zeros_like(origins), np.zeros_like(origins)
    alive, points, ways = np.arange(len(origins)), origins.copy(), directions.copy()
    for bounce in range(max_bounces + 1):
        found = scene.run(points.astype(np.float32), ways.astype(np.float32), output=True)
        met = found["primID"] >= 0
        if bounce:
            leaving[alive[~met]] = ways[~met]
        alive, points, ways, triangle = alive[met], points[met], ways[met], found["primID"][met]
        if not len(alive):
            break
        # Embree works in single precision: the hit is found again in the plane of its triangle.
        a, b, c = corners[triangle].transpose(1, 0, 2)
        across = np.cross(b - a, c - a)
        distance = ((a - points) * across).sum(1) / (ways * across).sum(1)
        points = points + distance[:, None] * ways
        v = (np.cross(points - a, c - a) * across).sum(1) / (across**2).sum(1)
        w = (np.cross(b - a, points - a) * across).sum(1) / (across**2).sum(1)
        normal = ((1 - v - w)[:, None] * normals[triangle, 0]) + v[:, None] * normals[triangle, 1]
        normal += w[:, None] * normals[triangle, 2]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        if not bounce:
            first[alive] = normal
        ways = ways - 2 * (ways * normal).sum(1, keepdims=True) * normal
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        points = points + 1e-4 * ways
    return leaving, first


@dataclass(frozen=True)
class Photographs:
    """Views, and the true normals where a pixel's center sees the vessel (zero elsewhere), in the turned world."""

    views: Views
    normals: list[Float[np.ndarray, "P 3"]]


def photograph(
    vessel: Vessel,
    count: int,
    size: int,
    turn: Float[np.ndarray, "3 3"] = UPRIGHT,
    elevations_deg: tuple[float, ...] = (-8.0, 15.0, 35.0, 50.0),
) -> Photographs:
    """Views of a vessel under the stripes in a turned world (x ↦ turn·x), each pixel the mean of 4×4 rays."""
    focal = 0.45 * size * DISTANCE
    train, truth = [], []
    for pose in cameras_around(count, elevations_deg):
        place = (np.arange(size * SAMPLES) + 0.5) / SAMPLES
        x, y = np.meshgrid((place - size / 2) / focal, (place - size / 2) / focal)
        rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        leaving, first = trace(vessel, np.tile(pose[:3, 3], (len(rays), 1)), rays, MAX_BOUNCES)
        left = leaving.any(1)
        light = np.where(left[:, None], stripes(leaving), 0.0)

        def mean(values: np.ndarray) -> np.ndarray:
            return values.reshape(size, SAMPLES, size, SAMPLES, -1).mean((1, 3))

        mask = torch.from_numpy(mean(first.any(1))[..., 0]).float()
        x, y = np.meshgrid((np.arange(size) + 0.5 - size / 2) / focal, (np.arange(size) + 0.5 - size / 2) / focal)
        centers = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ pose[:3, :3].T
        centers /= np.linalg.norm(centers, axis=1, keepdims=True)
        truth.append(trace(vessel, np.tile(pose[:3, 3], (len(centers), 1)), centers, 0)[1] @ turn.T)
        world = np.eye(4)
        world[:3, :3] = turn
        camera = RasterCamera(
            torch.from_numpy(np.linalg.inv(world @ pose)).float(),
            focal,
            focal,
            size / 2,
            size / 2,
            size,
            size,
            0.3,
            150.0,
        )
        radiance = torch.from_numpy(np.ascontiguousarray(mean(light).transpose(2, 0, 1))).float()
        train.append(TrainView(camera, radiance, mask, torch.nonzero(mask.flatten() > SOLID_ALPHA)[:, 0]))
    return Photographs(Views(tuple(train), ObjectFrame(np.zeros(3), 1.0), 0.3), truth)
