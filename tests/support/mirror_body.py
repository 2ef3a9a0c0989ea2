"""Mirrors that are no surface of ours: bodies given by a function, traced in numpy under a pattern of waves."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.views import Photograph, Views, views_of
from shinypartial.core.camera import Camera, look_at
from shinypartial.core.color import linear_to_srgb
from shinypartial.dataset.write import make_frames
from shinypartial.io.files import write_json
from shinypartial.io.images import write_png
from tests.support.synthetic_dataset import entries_of

Points = Float[np.ndarray, "P 3"]
MARCH_STEPS, ROOT_STEPS = 160, 50
DIFFERENCE = 1e-6


@dataclass(frozen=True)
class Body:
    """f(x) < 0 inside, with |∇f| at most about 1, within a ball of that reach around the origin."""

    value: Callable[[Points], Float[np.ndarray, "P"]]
    reach: float = 1.2

    def normals(self, points: Points) -> Points:
        """Unit, by central differences."""
        shifts = DIFFERENCE * np.eye(3)
        slopes = np.stack([self.value(points + shift) - self.value(points - shift) for shift in shifts], 1)
        return slopes / np.linalg.norm(slopes, axis=1, keepdims=True)

    def hits(self, origins: Points, directions: Points) -> Float[np.ndarray, "P"]:
        """Distance along rays of unit direction, infinite for a miss: marched, then halved."""
        middle = -(origins * directions).sum(1)
        half = np.sqrt(np.maximum(self.reach**2 - (origins**2).sum(1) + middle**2, 0))
        t, found = np.maximum(middle - half, 0.0), np.full(len(origins), np.inf)
        going = np.flatnonzero((half > 0) & (middle + half > 0))
        before = t.copy()
        for _ in range(MARCH_STEPS):
            if not len(going):
                break
            value = self.value(origins[going] + t[going, None] * directions[going])
            inside = value <= 0
            found[going[inside]] = t[going[inside]]
            going, value = going[~inside], value[~inside]
            before[going] = t[going]
            t[going] += np.maximum(0.7 * value, 2e-3)
            going = going[t[going] < (middle + half)[going]]
        met = np.flatnonzero(np.isfinite(found))
        low, high = before[met], found[met]
        for _ in range(ROOT_STEPS):
            center = (low + high) / 2
            outside = self.value(origins[met] + center[:, None] * directions[met]) > 0
            low, high = np.where(outside, center, low), np.where(outside, high, center)
        found[met] = (low + high) / 2
        return found


def sphere(radius: float = 1.0) -> Body:
    """A ball."""
    return Body(lambda x: np.linalg.norm(x, axis=1) - radius)


def ellipsoid(axes: tuple[float, float, float] = (1.0, 0.8, 0.65)) -> Body:
    """By its implicit function, scaled to slope 1 or less."""
    return Body(lambda x: (np.linalg.norm(x / axes, axis=1) - 1) * min(axes))


def block(half: tuple[float, float, float] = (0.7, 0.8, 0.62), exponent: float = 6.0) -> Body:
    """With flat faces and rounded edges, turned so that a corner faces the cameras at +X."""
    turn = look_at(np.array([1.0, 0.7, 0.5]), np.zeros(3))[:3, :3]
    return Body(lambda x: (np.linalg.norm(x @ turn / half, exponent, axis=1) - 1) * min(half))


def torus(ring: float = 0.7, tube: float = 0.3) -> Body:
    """About the x axis, so that cameras there look through its hole."""
    return Body(lambda x: np.hypot(np.hypot(x[:, 1], x[:, 2]) - ring, x[:, 0]) - tube)


def wavy_ball(depth: float = 0.05, waves: float = 3.0) -> Body:
    """A ball with bumps."""

    def value(x: Points) -> Float[np.ndarray, "P"]:
        bumps = np.sin(waves * x[:, 0] + 1) * np.sin(waves * x[:, 1]) * np.cos(waves * x[:, 2] + 0.5)
        return 0.8 * (np.linalg.norm(x, axis=1) - 0.95 - 2 * depth * bumps)

    return Body(value)


def dented(
    axes: tuple[float, float, float],
    middle: tuple[float, float, float],
    hollow: tuple[float, float, float],
    rounding: float = 0.1,
) -> Body:
    """An ellipsoid without another one, whose middle is given, with a rounded rim."""
    outer, inner = ellipsoid(axes).value, ellipsoid(hollow).value

    def value(x: Points) -> Float[np.ndarray, "P"]:
        one, other = outer(x), -inner(x - np.array(middle))
        return np.maximum(one, other) + np.maximum(rounding - np.abs(one - other), 0) ** 2 / (4 * rounding)

    return Body(value)


def rods_and_speck(radius: float) -> Body:
    """Two thin rods with round ends that do not touch, and a ball of a rod's radius beside them."""
    rods = [((0.0, -0.7, -0.6), (0.0, -0.5, 0.7)), ((0.1, 0.1, -0.7), (-0.1, 0.7, 0.5)), ((0.3, 0.2, 0.75),) * 2]

    def value(x: Points) -> Float[np.ndarray, "P"]:
        distances = []
        for start, end in np.array(rods):
            along = end - start
            share = np.clip((x - start) @ along / max(along @ along, DIFFERENCE), 0, 1)
            distances.append(np.linalg.norm(x - start - share[:, None] * along, axis=1))
        return np.min(distances, axis=0) - radius

    return Body(value)


def pattern(directions: Points) -> Float[np.ndarray, "P 3"]:
    """Waves of three lengths, and soft edges, in [0, 1]."""
    waves = np.random.default_rng(6).normal(size=(3, 3)) * 3
    first, second = np.sin(directions @ waves), np.sin(2 * directions @ waves[::-1].T)
    edges = np.tanh(8 * np.sin(2 * directions @ waves[:, ::-1]))
    return 0.5 + 0.15 * first + 0.12 * second + 0.12 * np.sin(5 * directions @ waves[:, ::-1]) + 0.1 * edges


def cameras_around(count: int, resolution: int, distance: float = 5.0, spread_deg: float = 75.0) -> list[Camera]:
    """On a spiral over a cap around +X, all of which look at the origin."""
    focal, cameras = 0.5 * resolution * distance / 1.35, []
    for index in range(count):
        away = np.radians(spread_deg) * np.sqrt((index + 0.5) / count)
        turn = index * np.pi * (3 - 5**0.5)
        direction = np.array([np.cos(away), np.sin(away) * np.cos(turn), np.sin(away) * np.sin(turn)])
        pose = look_at(distance * direction, np.zeros(3))
        cameras.append(Camera(pose, focal, focal, resolution / 2, resolution / 2, resolution, resolution))
    return cameras


def light_of(body: Body, origins: Points, directions: Points, bounces: int = 4) -> Float[np.ndarray, "P 4"]:
    """Radiance seen along rays, followed through reflections, and coverage."""
    light = np.zeros((len(origins), 4))
    index, rays = np.arange(len(origins)), (origins, directions)
    for bounce in range(bounces + 1):
        distance = body.hits(*rays)
        missed = ~np.isfinite(distance)
        if bounce:
            light[index[missed], :3] = pattern(rays[1][missed])
        index, points = index[~missed], (rays[0] + np.where(missed, 0, distance)[:, None] * rays[1])[~missed]
        light[index, 3] = 1
        normals, coming = body.normals(points), rays[1][~missed]
        out = coming - 2 * (coming * normals).sum(1)[:, None] * normals
        rays = points + 1e-4 * normals, out
    return light


def camera_rays_world(camera: Camera, per_side: int) -> tuple[Points, Points]:
    """Rays through per_side² places of each pixel, pixel by pixel."""
    shifts = (np.arange(per_side) + 0.5) / per_side
    row, column, down, right = np.meshgrid(
        np.arange(camera.height), np.arange(camera.width), shifts, shifts, indexing="ij"
    )
    x, y = (column + right - camera.cx) / camera.fx, (row + down - camera.cy) / camera.fy
    rotation = camera.camera_to_world[:3, :3]
    directions = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ rotation.T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.tile(camera.camera_to_world[:3, 3], (len(directions), 1)), directions


def photograph(body: Body, camera: Camera, per_side: int = 2) -> Photograph:
    """Means over the pixels' areas."""
    light = light_of(body, *camera_rays_world(camera, per_side))
    image = light.reshape(camera.height, camera.width, -1, 4).mean(2)
    planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).float()
    return Photograph(camera, planes[:3].contiguous(), planes[3].contiguous())


def write_plain_dataset(root: Path, body: Body, count: int, resolution: int, per_side: int = 3) -> Path:
    """What cameras around +X see of it as a plain NeRF-synthetic folder; two of the views are for tests, too."""
    cameras = cameras_around(count, resolution)
    for split, chosen in (("train", cameras), ("test", cameras[:2])):
        frames = make_frames(root, split, chosen)
        for frame in frames:
            light = light_of(body, *camera_rays_world(frame.camera, per_side))
            image = light.reshape(resolution, resolution, -1, 4).mean(2)
            straight = np.clip(image[..., :3] / np.maximum(image[..., 3:], 1e-6), 0, 1)
            rgba = np.concatenate([linear_to_srgb(straight), image[..., 3:]], -1)
            write_png(frame.png, np.rint(255 * rgba).astype(np.uint8))
        angle = 2 * math.atan(resolution / 2 / chosen[0].fx)
        write_json(root / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": entries_of(frames)})
    return root


def body_views(body: Body, count: int, resolution: int, per_side: int = 2) -> Views:
    """What cameras around +X see of it."""
    return views_of([photograph(body, camera, per_side) for camera in cameras_around(count, resolution)])


def true_normals(body: Body, camera: Camera) -> tuple[Points, Bool[np.ndarray, "P"], Bool[np.ndarray, "P"]]:
    """At pixel centers: normals, whether there is a surface, and whether it mirrors the surroundings at once."""
    origins, directions = camera_rays_world(camera, 1)
    distance = body.hits(origins, directions)
    met = np.isfinite(distance)
    points = origins + np.where(met, distance, 0)[:, None] * directions
    normals = body.normals(points)
    out = directions - 2 * (directions * normals).sum(1)[:, None] * normals
    clear = met.copy()
    clear[met] = ~np.isfinite(body.hits(points[met] + 1e-4 * normals[met], out[met]))
    return normals, met, clear


def in_frame(frame: ObjectFrame, points: Points) -> Points:
    """Points of the world in the normalized frame."""
    return (points - frame.center) / frame.radius
