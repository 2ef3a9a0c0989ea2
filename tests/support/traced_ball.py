"""Photographs of mirror balls, traced: rays meet spheres by the quadratic, and a painted room lights all.

The ball has radius 1 and its center is the origin; a photographer may go with the camera, and a post carry the ball.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from panoless.photographs.lens import Lens
from shinypartial.core.camera import look_at
from shinypartial.core.color import linear_to_srgb
from shinypartial.core.sphere import latlong_directions

FILM_MM = 33
"""Focal length on 35 mm film that the pictures below have."""
WIDTH, HEIGHT = 480, 360
FOCAL_PX = FILM_MM / float(np.hypot(36, 24)) * float(np.hypot(WIDTH, HEIGHT))
FINE = 4
"""Rays along either side of a pixel at a ball."""
GLASS = 1.5
POST_RADIUS, POST_TOP = 0.75, -0.6
POST_LIGHT = 0.35
PERSON_RADIUS, PERSON_LIGHT = 0.6, 0.06


@dataclass(frozen=True)
class Room:
    """Radiance of a sphere about a place: a dark floor below, pictures all around, smooth noise on all, and lamps."""

    seed: int = 0
    radius: float = 1e4
    """In radii of the ball."""
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pictures: int = 90
    lamps: int = 5
    lamp_radiance: float = 6.0

    @cached_property
    def map(self) -> Float[np.ndarray, "H W 3"]:
        """Lat-long, as `shinypartial.core.sphere` has it."""
        generator, directions = np.random.default_rng(self.seed), latlong_directions(384)
        height = np.clip((directions[..., 2:] + 0.35) / 0.1, 0, 1)
        light = (1 - height) * [0.14, 0.11, 0.08] + height * [0.5, 0.47, 0.42]
        for _ in range(self.pictures):
            toward, up = generator.normal(size=(2, 3))
            axes = np.stack([toward, np.cross(up, toward), np.cross(toward, np.cross(up, toward))])
            ahead, x, y = np.moveaxis(directions @ (axes / np.linalg.norm(axes, axis=1, keepdims=True)).T, -1, 0)
            wide, high = np.tan(generator.uniform(0.05, 0.3, 2))
            light[(ahead > 0.1) & (np.abs(x) < wide * ahead) & (np.abs(y) < high * ahead)] = generator.uniform(
                0.02, 0.9
            ) * generator.uniform(0.6, 1, 3)
        for cells, size in ((2.0, 0.3), (9.0, 0.15), (23.0, 0.1)):
            lattice = generator.normal(size=(24, 24, 24))
            at = np.moveaxis((directions + 2) * cells, -1, 0)
            light *= np.exp(size * map_coordinates(lattice, at, order=1, mode="grid-wrap"))[..., None]
        light = np.clip(light, 0.01, 0.9)
        for toward in generator.normal(size=(self.lamps, 3)):
            angle = np.arccos(np.clip(directions @ (toward / np.linalg.norm(toward)), -1, 1))
            light[angle < 0.09] = self.lamp_radiance
        return light

    def light(self, origins: Float[np.ndarray, "P 3"], ways: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Radiance along unit rays from within."""
        off = origins - np.array(self.place)
        along = (off * ways).sum(-1)
        reach = -along + np.sqrt(along**2 - (off**2).sum(-1) + self.radius**2)
        x, y, z = ((off + reach[:, None] * ways) / self.radius).T
        height, width = self.map.shape[:2]
        column = (0.5 - np.arctan2(y, x) / (2 * np.pi)) * width - 0.5
        row = np.arccos(np.clip(z, -1, 1)) / np.pi * height - 0.5
        at = np.stack([np.clip(row, 0, height - 1), column])
        channels = [map_coordinates(self.map[..., k], at, order=1, mode="grid-wrap") for k in range(3)]
        return np.stack(channels, -1)


@dataclass(frozen=True)
class Scene:
    """Balls in a room."""

    room: Room = Room()
    balls: tuple[tuple[float, float, float, float], ...] = ((0.0, 0.0, 0.0, 1.0),)
    """Centers and radii."""
    post: bool = False
    """A cylinder about the axis −z, which hides the lowest part of the ball."""
    person: bool = False
    """A dark sphere at the camera, which only mirrors show."""
    glass: bool = False
    mirrored: float = 0.65
    """Reflectance F of light that falls in straight; Schlick's F + (1 − F)(1 − cos θ)⁵ of other light: chrome."""

    def radiance(self, pose: Float[np.ndarray, "4 4"], lens: Lens) -> Float[np.ndarray, "H W 3"]:
        """What a camera sees, pixels near balls from FINE × FINE rays, others from one."""
        light = self._traced(pose, lens, 0, 0, lens.width, lens.height, 1)
        for *center, radius in self.balls:
            x, y, z = (np.array(center) - pose[:3, 3]) @ pose[:3, :3]
            if z <= radius:
                continue
            reach = 1.15 * lens.fx * radius / z + 3
            column, row = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
            left, right = (int(np.clip(column + sign * reach, 0, lens.width)) for sign in (-1, 1))
            top, bottom = (int(np.clip(row + sign * reach, 0, lens.height)) for sign in (-1, 1))
            light[top:bottom, left:right] = self._traced(pose, lens, left, top, right, bottom, FINE)
        return light

    def covers(self, pose: Float[np.ndarray, "4 4"], lens: Lens) -> Float[np.ndarray, "H W"]:
        """Share of each pixel that the first ball covers, whatever hides it."""
        origins, ways = _rays(pose, lens, 0, 0, lens.width, lens.height, FINE)
        met = np.isfinite(_meets(origins, ways, np.array(self.balls[0])))
        return met.reshape(lens.height, FINE, lens.width, FINE).mean((1, 3))

    def normals(self, pose: Float[np.ndarray, "4 4"], lens: Lens) -> Float[np.ndarray, "H W 3"]:
        """World normals of the first ball at pixels' centers; zero beside it."""
        origins, ways = _rays(pose, lens, 0, 0, lens.width, lens.height, 1)
        *center, radius = self.balls[0]
        reach = _meets(origins, ways, np.array(self.balls[0]))
        met = np.isfinite(reach)
        found = np.zeros_like(ways)
        found[met] = (origins[met] + reach[met, None] * ways[met] - center) / radius
        return found.reshape(lens.height, lens.width, 3)

    def _traced(
        self, pose: Float[np.ndarray, "4 4"], lens: Lens, left: int, top: int, right: int, bottom: int, side: int
    ) -> Float[np.ndarray, "H W 3"]:
        origins, ways = _rays(pose, lens, left, top, right, bottom, side)
        reaches = np.stack([_meets(origins, ways, np.array(ball)) for ball in self.balls])
        nearest, reach = reaches.argmin(0), reaches.min(0)
        met = np.isfinite(reach)
        hidden = self._at_post(origins, ways) < reach
        eye = pose[:3, 3]
        light = np.empty_like(ways)
        light[~met] = self._lit(origins[~met], ways[~met], None)
        balls = np.array(self.balls)[nearest[met]]
        points = origins[met] + reach[met, None] * ways[met]
        normals = (points - balls[:, :3]) / balls[:, 3:]
        if self.glass:
            points, leaving = _through_glass(points, ways[met], normals, balls)
        else:
            leaving = ways[met] - 2 * (ways[met] * normals).sum(-1, keepdims=True) * normals
        light[met] = self._lit(points, leaving, eye)
        if not self.glass:
            cosines = -(ways[met] * normals).sum(-1, keepdims=True)
            light[met] *= self.mirrored + (1 - self.mirrored) * (1 - cosines) ** 5
        light[hidden] = POST_LIGHT
        return light.reshape(bottom - top, side, right - left, side, 3).mean((1, 3))

    def _lit(
        self, origins: Float[np.ndarray, "P 3"], ways: Float[np.ndarray, "P 3"], eye: Float[np.ndarray, "3"] | None
    ) -> Float[np.ndarray, "P 3"]:
        light = self.room.light(origins, ways)
        light[np.isfinite(self._at_post(origins, ways))] = POST_LIGHT
        if self.person and eye is not None:
            light[np.isfinite(_meets(origins, ways, np.array([*eye, PERSON_RADIUS])))] = PERSON_LIGHT
        return light

    def _at_post(self, origins: Float[np.ndarray, "P 3"], ways: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """Distance to the post's side; infinite for a miss."""
        if not self.post:
            return np.full(len(origins), np.inf)
        square = np.maximum((ways[:, :2] ** 2).sum(-1), 1e-12)
        along = (origins[:, :2] * ways[:, :2]).sum(-1)
        inside = along**2 - square * ((origins[:, :2] ** 2).sum(-1) - POST_RADIUS**2)
        reach = (-along - np.sqrt(np.maximum(inside, 0))) / square
        low = origins[:, 2] + reach * ways[:, 2] < POST_TOP
        return np.where((inside > 0) & (reach > 1e-6) & low, reach, np.inf)


def _rays(
    pose: Float[np.ndarray, "4 4"], lens: Lens, left: int, top: int, right: int, bottom: int, side: int
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    across, down = ((np.arange(a * side, b * side) + 0.5) / side for a, b in ((left, right), (top, bottom)))
    x, y = np.meshgrid((across - lens.cx) / lens.fx, (down - lens.cy) / lens.fy)
    ways = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ pose[:3, :3].T
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    return np.tile(pose[:3, 3], (len(ways), 1)), ways


def _meets(
    origins: Float[np.ndarray, "P 3"], ways: Float[np.ndarray, "P 3"], ball: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "P"]:
    """Distance along unit rays to a ball: the lesser root of t² + 2 b t + c = 0; infinite for a miss."""
    off = origins - ball[:3]
    b, c = (off * ways).sum(-1), (off**2).sum(-1) - ball[3] ** 2
    root = b**2 - c
    reach = -b - np.sqrt(np.maximum(root, 0))
    return np.where((root > 0) & (reach > 1e-6), reach, np.inf)


def _through_glass(
    points: Float[np.ndarray, "P 3"],
    ways: Float[np.ndarray, "P 3"],
    normals: Float[np.ndarray, "P 3"],
    balls: Float[np.ndarray, "P 4"],
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Where rays leave glass and along which way, by Snell's law at both surfaces."""
    inside = _refracted(ways, normals, 1 / GLASS)
    chord = -2 * ((points - balls[:, :3]) * inside).sum(-1, keepdims=True)
    leaving = points + chord * inside
    return leaving, _refracted(inside, -(leaving - balls[:, :3]) / balls[:, 3:], GLASS)


def _refracted(
    ways: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"], ratio: float
) -> Float[np.ndarray, "P 3"]:
    cosine = -(ways * normals).sum(-1, keepdims=True)
    other = np.sqrt(np.maximum(1 - ratio**2 * (1 - cosine**2), 0))
    return ratio * ways + (ratio * cosine - other) * normals


def lens_of(focal_px: float = FOCAL_PX) -> Lens:
    """A centered pinhole."""
    return Lens(focal_px, focal_px, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def camera_at(
    azimuth_deg: float,
    elevation_deg: float = 12.0,
    distance: float = 6.0,
    beside: tuple[float, float, float] = (0.25, 0.1, -0.1),
) -> Float[np.ndarray, "4 4"]:
    """Pose of a camera, azimuth from −y, that looks a little past the ball."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    level = np.cos(elevation)
    away = np.array([level * np.sin(azimuth), -level * np.cos(azimuth), np.sin(elevation)])
    return look_at(distance * away, np.array(beside))


def developed(
    radiance: Float[np.ndarray, "H W 3"], exposure: float = 1.0, noise: float = 0.0, seed: int = 0
) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit sRGB codes of exposed light, with noise of that standard deviation in codes of 1."""
    codes = linear_to_srgb(np.clip(exposure * radiance, 0, 1))
    if noise:
        codes = codes + noise * np.random.default_rng(seed).normal(size=codes.shape)
    return np.rint(np.clip(codes, 0, 1) * 255).astype(np.uint8)


def exif(film_mm: int | None = FILM_MM, seconds: float | None = None) -> dict[str, Any]:
    """Tags by OpenImageIO's names."""
    tags: dict[str, Any] = {} if film_mm is None else {"Exif:FocalLengthIn35mmFilm": film_mm}
    return (
        tags
        if seconds is None
        else tags | {"ExposureTime": seconds, "FNumber": 1.0, "Exif:PhotographicSensitivity": 100}
    )


def aligned_turns(found: Float[np.ndarray, "V 3 3"], truth: Float[np.ndarray, "V 3 3"]) -> Float[np.ndarray, "V 3"]:
    """Rotation vectors (rad, camera axes) from true world-to-camera rotations to those found, after the turn of the
    world that fits best.
    """
    left, _, right = np.linalg.svd(np.einsum("vji,vjk->ik", found, truth))
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return Rotation.from_matrix(found @ turn @ truth.transpose(0, 2, 1)).as_rotvec()


def turns_between(found: Float[np.ndarray, "V 3 3"], truth: Float[np.ndarray, "V 3 3"]) -> Float[np.ndarray, "V"]:
    """Their angles (deg)."""
    return np.degrees(np.linalg.norm(aligned_turns(found, truth), axis=1))
