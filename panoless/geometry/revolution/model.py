"""A surface of revolution: an axis and a profile, what a camera sees of it, and the same as surfels.

Like `plane`, it needs no blending: rays are intersected with the surface itself, and may be followed on from there.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.rays import pixel_rays, pose_of, project, reflect
from panoless.capture.views import TrainView
from panoless.environment.rays import Rays
from panoless.geometry.base import SurfaceBuffers
from panoless.kernels.cpu.revolution import first_hits, follow
from panoless.kernels.rasterize import RasterCamera
from shinypartial.core.sphere import pixel_footprint_sr

CREASE_RAD = math.radians(35.0)
"""A turn of the profile above this is an edge: normals are not interpolated across it."""
SUBPIXELS = 4
MAX_BOUNCES = 6
"""What is mirrored more often is not followed in a fit."""
BOX_AROUND = 64
FOOTPRINT_TEXEL_SR = (math.pi / 2 / 128) ** 2
RAY_EPSILON = 1e-4
"""A mirrored ray starts this far from the surface, in scene units."""


@dataclass(frozen=True)
class Hits:
    """Where rays meet a surface of revolution. All is zero for misses, whose `side` is −1."""

    distance: Float[np.ndarray, "P"]
    """In lengths of the ray's direction; infinite for misses."""
    side: Int[np.ndarray, "P"]
    along: Float[np.ndarray, "P"]
    points: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]
    """Unit, in the normalized frame, outward as the profile has it, whichever face is seen."""

    @property
    def met(self) -> Bool[np.ndarray, "P"]:
        """Which rays meet the surface."""
        return self.side >= 0


@dataclass(frozen=True)
class SurfaceOfRevolution:
    """A mirror of revolution: x = o + ρ cos φ e₁ + ρ sin φ e₂ + h e₃ for all φ and all (ρ, h) on the profile.

    e₃ is the unit axis and o a point on it, in the normalized frame. The profile is a polyline of (ρ, h), ρ ≥ 0, that
    begins on the axis at the bottom, goes up the outside to the vertex `lip` and down inside. It ends on the axis, or
    at the lip when the wall has no thickness and mirrors on both faces. Normals (sin θ, −cos θ), θ the direction of the
    profile, are interpolated along it, except over edges of 35° and more.
    """

    origin: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    profile: Float[np.ndarray, "N 2"]
    lip: int

    @cached_property
    def frame(self) -> Float[np.ndarray, "3 3"]:
        """Rows e₁, e₂, e₃: rotates the normalized frame into that of the axis."""
        helper = np.eye(3)[np.abs(self.axis).argmin()]
        first = np.cross(helper, self.axis)
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.axis, first), self.axis])

    @cached_property
    def angles(self) -> Float[np.ndarray, "S 2"]:
        """Direction of the profile (rad) at both ends of every side."""
        steps = np.diff(self.profile, axis=0)
        own = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        lengths = np.linalg.norm(steps, axis=1)
        turn = np.diff(own)
        # The tangent of the circle through three points leans toward that of the shorter side.
        shared = own[:-1] + turn * lengths[:-1] / np.maximum(lengths[:-1] + lengths[1:], 1e-12)
        smooth = np.abs(turn) < CREASE_RAD
        ends = np.stack([own, own], 1)
        ends[1:, 0] = np.where(smooth, shared, own[1:])
        ends[:-1, 1] = np.where(smooth, shared, own[:-1])
        # A smooth profile meets the axis at a right angle.
        for end, index in ((0, (0, 0)), (-1, (-1, 1))):
            level = np.pi * np.round(own[end] / np.pi)
            if self.profile[end, 0] < 1e-9 and abs(own[end] - level) < CREASE_RAD:
                ends[index] = level
        return ends

    @cached_property
    def arc_lengths(self) -> Float[np.ndarray, "N"]:
        """Length of the profile up to each vertex."""
        return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(self.profile, axis=0), axis=1)))

    @property
    def is_open(self) -> bool:
        """Whether it is a wall without thickness, which ends at the lip."""
        return self.lip == len(self.profile) - 1

    @property
    def num_parameters(self) -> int:
        """How many numbers it is made of: axis and origin across it, height of the frame, and the profile."""
        return 5 + self.profile.size

    def rings(self, around: int) -> Float[np.ndarray, "N A 3"]:
        """Points of the surface at equal steps of azimuth."""
        turn = 2 * np.pi * np.arange(around) / around
        radius, height = (
            self.profile[:, 0, None],
            np.broadcast_to(self.profile[:, 1, None], (len(self.profile), around)),
        )
        return self.origin + np.stack([radius * np.cos(turn), radius * np.sin(turn), height], -1) @ self.frame

    def hits(self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]) -> Hits:
        """The first hit of every ray."""
        starts, along_rays = (origins - self.origin) @ self.frame.T, directions @ self.frame.T
        distance, side, along = first_hits(starts, along_rays, self.profile)
        met = side >= 0
        points = starts + np.where(met, distance, 0.0)[:, None] * along_rays
        ends = self.angles[side]
        angle = ends[:, 0] + along * (ends[:, 1] - ends[:, 0])
        rho = np.hypot(points[:, 0], points[:, 1])
        radial = points[:, :2] / np.maximum(rho, 1e-12)[:, None]
        normals = np.concatenate([np.sin(angle)[:, None] * radial, -np.cos(angle)[:, None]], 1) @ self.frame
        return Hits(
            distance=distance,
            side=side,
            along=along,
            points=np.where(met[:, None], points @ self.frame + self.origin, 0.0),
            normals=np.where(met[:, None], normals, 0.0),
        )


def revolution_buffers(surface: SurfaceOfRevolution, camera: RasterCamera) -> SurfaceBuffers:
    """The surface as surfels would be seen: depth and normal of the rays through pixel centers, alpha by 4×4 rays where
    neighbors disagree. Where only the center misses, depth and normal are those of a neighbor.
    """
    shape, everything = (camera.height, camera.width), np.arange(camera.height * camera.width)
    hits = _hits_within(surface, camera, everything)
    rays = pixel_rays(camera, everything)[1]
    met = hits.met.reshape(shape)
    alpha = met.astype(np.float64)
    padded = np.pad(met, 1, mode="edge")
    around = sum(padded[1 + i : 1 + i + shape[0], 1 + j : 1 + j + shape[1]].astype(int) for i, j in _NEIGHBORS)
    mixed = np.flatnonzero((around > 0) & (around < len(_NEIGHBORS)))
    share, normal, depth = np.zeros(len(mixed)), np.zeros((len(mixed), 3)), np.zeros(len(mixed))
    for i in range(SUBPIXELS):
        for j in range(SUBPIXELS):
            fine = surface.hits(*pixel_rays(camera, mixed, ((i + 0.5) / SUBPIXELS, (j + 0.5) / SUBPIXELS)))
            facing = _facing(fine.normals, rays[mixed])
            share, normal = share + fine.met, normal + facing
            depth += np.where(fine.met, fine.distance, 0.0)
    alpha.ravel()[mixed] = share / SUBPIXELS**2
    z = np.where(hits.met, hits.distance, 0.0)
    normals = _facing(hits.normals, rays)
    missed = ~hits.met[mixed] & (share > 0)
    z[mixed[missed]] = (depth / np.maximum(share, 1))[missed]
    normals[mixed[missed]] = (normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))[missed]
    rotation, _ = pose_of(camera)
    device = camera.world_to_camera.device
    covered, distance = (
        torch.from_numpy(image.reshape(shape)).float().to(device) for image in (alpha, z * (alpha.ravel() > 0))
    )
    normals_camera = torch.from_numpy((normals @ rotation.T).T.reshape(3, *shape)).float().to(device) * covered
    return SurfaceBuffers(covered, normals_camera, distance, covered.new_zeros(3, *covered.shape))


def _hits_within(surface: SurfaceOfRevolution, camera: RasterCamera, pixels: Int[np.ndarray, "P"]) -> Hits:
    """Hits of the rays through pixels, traced only within the box of the projected rings."""
    rotation, center = pose_of(camera)
    corners = (surface.rings(BOX_AROUND).reshape(-1, 3) - center) @ rotation.T
    row, column = np.divmod(pixels, camera.width)
    traced = np.ones(len(pixels), dtype=bool)
    if corners[:, 2].min() > camera.near:
        margin = 2 + (1 / np.cos(np.pi / BOX_AROUND) - 1) * max(camera.width, camera.height)
        for place, seen in zip((column, row), project(camera, corners), strict=True):
            traced &= (place > seen.min() - margin) & (place < seen.max() + margin)
    found = surface.hits(*pixel_rays(camera, pixels[traced]))
    count = len(pixels)
    whole = Hits(
        np.full(count, np.inf), np.full(count, -1), np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3))
    )
    for name, values in vars(whole).items():
        values[traced] = getattr(found, name)
    return whole


_NEIGHBORS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]


def _facing(normals: Float[np.ndarray, "P 3"], rays: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    return np.where(((normals * rays).sum(1) > 0)[:, None], -normals, normals)


@dataclass(frozen=True)
class ReflectionPaths:
    """Where mirrored rays go when they meet nothing more. Directions are unit; zero where they never leave."""

    directions: Float[np.ndarray, "P 3"]
    bounces: Int[np.ndarray, "P"]
    """How often each was mirrored; 0 for rays that miss, and for those that never leave."""
    first: Hits


def trace_reflections(
    surface: SurfaceOfRevolution, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], most: int = 1
) -> ReflectionPaths:
    """Mirror rays at the surface up to `most` times; once, whatever they meet then, if that is 0."""
    first = surface.hits(origins, directions)
    if most == 0:
        once = reflect(directions, first.normals)
        once *= (first.met / np.linalg.norm(once, axis=1))[:, None]
        return ReflectionPaths(once, first.met.astype(np.int64), first)
    met = np.flatnonzero(first.met)
    points = (first.points[met] - surface.origin) @ surface.frame.T
    places = first.side[met], first.along[met]
    directions_local, times = follow(
        points, directions[met] @ surface.frame.T, places, surface.profile, surface.angles, RAY_EPSILON, most
    )
    final, bounces = np.zeros((len(origins), 3)), np.zeros(len(origins), dtype=np.int64)
    final[met], bounces[met] = directions_local @ surface.frame, times
    return ReflectionPaths(final, bounces, first)


def revolution_rays(
    surface: SurfaceOfRevolution, view: TrainView, pixels: Tensor, most: int = 1, *, weighted: bool = False
) -> tuple[Rays, Hits]:
    """What pixels (flat indices) of a view observed of the environment by at most that many reflections (see
    `trace_reflections`), and where they met the surface.

    If `weighted`, rays have the trust 1/(1 + a/t): a is the square of the larger angle to the next of the given pixels
    by row and by column, t the solid angle of a texel of 0.7°. A pixel near the lip sees a long strip, which says
    little about any texel of it. Pixels are in ascending order then.
    """
    origins, directions = pixel_rays(view.camera, pixels.cpu().numpy())
    escapes = trace_reflections(surface, origins, directions, most)
    seen = escapes.bounces > 0
    kept = pixels[torch.from_numpy(seen).to(pixels.device)]
    outgoing = torch.from_numpy(escapes.directions[seen]).float().to(view.radiance.device)
    hits = Hits(**{name: values[seen] for name, values in vars(escapes.first).items()})
    trust = None
    if weighted:
        image, mask = np.zeros((*view.mask.shape, 3)), np.zeros(view.mask.shape, dtype=bool)
        places = kept.cpu().numpy()
        image.reshape(-1, 3)[places], mask.ravel()[places] = escapes.directions[seen], True
        footprint_sr = pixel_footprint_sr(image, mask)[mask]
        trust = torch.from_numpy(1 / (1 + footprint_sr / FOOTPRINT_TEXEL_SR)).to(outgoing)
    return Rays(outgoing, view.radiance.flatten(1)[:, kept].T.contiguous(), trust), hits
