"""A surface of revolution: an axis and a profile, and what a camera sees of it.

Like a plane, it needs no blending: rays are intersected with the surface itself, and may be followed on from there.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.rays import pixel_rays, pose_of, project, reflect
from panoless.capture.views import TrainView
from panoless.environment.rays import Rays
from panoless.environment.surroundings import FAR, Surroundings
from panoless.geometry.base import SurfaceBuffers, buffers_from_arrays
from panoless.kernels.camera import RasterCamera
from panoless.kernels.revolution import first_hits, follow
from shinypartial.core.sphere import pixel_footprint_sr

CONFIDENCE_TEXEL_RAD = math.pi / 2 / 128
"""A pixel that spans a wider angle says little about any texel: confidence 1/(1 + a/t) with t its square."""
MAX_BOUNCES = 16
FITTED_BOUNCES = 6
"""Reflections of a ray in a fit; more bounces only count in pictures."""
"""Reflections after which a ray is black: as many as the renderer of the data sets follows."""

CREASE_RAD = math.radians(35.0)
"""A turn of the profile above this is an edge: normals are not interpolated across it."""
BOX_AROUND = 64
RAY_EPSILON = 1e-4
"""A mirrored ray starts this far from the surface, in radii of the object frame."""


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

    def of(self, chosen: Int[np.ndarray, "Q"] | Bool[np.ndarray, "P"]) -> "Hits":
        """Those of the chosen rays."""
        return Hits(**{name: values[chosen] for name, values in vars(self).items()})


@dataclass(frozen=True)
class Rings:
    """Circles of a surface of revolution, one for each vertex of the profile and two for a crease.

    Points and unit normals are in the normalized frame; `sides` names the circles at both ends of each side.
    """

    points: Float[np.ndarray, "R A 3"]
    normals: Float[np.ndarray, "R A 3"]
    sides: Int[np.ndarray, "S 2"]


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
    surroundings: Surroundings = FAR
    """What it stands in."""

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

    def turned_over(self) -> "SurfaceOfRevolution":
        """The same outside with the axis the other way round, closed flat at both ends."""
        outer = self.profile[1 : self.lip + 1][::-1] * [1.0, -1.0]
        profile = closed_profile(outer)
        return replace(self, axis=-self.axis, profile=profile, lip=len(outer))

    @cached_property
    def arc_lengths(self) -> Float[np.ndarray, "N"]:
        """Length of the profile up to each vertex."""
        return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(self.profile, axis=0), axis=1)))

    def arc_length_at(self, side: Int[np.ndarray, "P"], along: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
        """Length of the profile up to places on its sides."""
        length = self.arc_lengths
        return length[side] + along * (length[side + 1] - length[side])

    @property
    def is_open(self) -> bool:
        """Whether it is a wall without thickness, which ends at the lip."""
        return self.lip == len(self.profile) - 1

    @property
    def num_parameters(self) -> int:
        """How many numbers it is made of: axis and origin across it, height of the frame, and the profile."""
        return 5 + self.profile.size

    def rings(self, around: int) -> Rings:
        """The surface at equal steps of azimuth."""
        ends, angle = np.stack([np.arange(len(self.angles)), np.arange(len(self.angles)) + 1], 1), self.angles
        own = np.ones(angle.shape, bool)
        own[1:, 0] = angle[1:, 0] != angle[:-1, 1]
        turn = 2 * np.pi * np.arange(around) / around
        radius, height = self.profile[ends[own]].T[..., None]
        across, along = np.sin(angle[own])[:, None], -np.cos(angle[own])[:, None]
        wide = np.ones(around)
        points = np.stack([radius * np.cos(turn), radius * np.sin(turn), height * wide], -1)
        normals = np.stack([across * np.cos(turn), across * np.sin(turn), along * wide], -1)
        rows = np.cumsum(own.ravel()).reshape(own.shape) - 1
        return Rings(self.origin + points @ self.frame, normals @ self.frame, rows)

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


def revolution_buffers(surface: SurfaceOfRevolution, camera: RasterCamera, samples: int = 4) -> SurfaceBuffers:
    """What is seen of the surface: depth and normal of the rays through pixel centers, alpha by `samples`²
    rays where neighbors disagree. Where only the center misses, depth and normal are those of a neighbor. The three
    depths agree.
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
    for i in range(samples):
        for j in range(samples):
            fine = surface.hits(*pixel_rays(camera, mixed, ((i + 0.5) / samples, (j + 0.5) / samples)))
            facing = _facing(fine.normals, rays[mixed])
            share, normal = share + fine.met, normal + facing
            depth += np.where(fine.met, fine.distance, 0.0)
    alpha.ravel()[mixed] = share / samples**2
    z = np.where(hits.met, hits.distance, 0.0)
    normals = _facing(hits.normals, rays)
    missed = ~hits.met[mixed] & (share > 0)
    z[mixed[missed]] = (depth / np.maximum(share, 1))[missed]
    normals[mixed[missed]] = (normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))[missed]
    rotation, _ = pose_of(camera)
    return buffers_from_arrays(
        alpha, (z * (alpha.ravel() > 0)).reshape(shape), (normals @ rotation.T).T.reshape(3, *shape), camera
    )


def _hits_within(surface: SurfaceOfRevolution, camera: RasterCamera, pixels: Int[np.ndarray, "P"]) -> Hits:
    """Hits of the rays through pixels, traced only within the box of the projected rings."""
    rotation, center = pose_of(camera)
    corners = (surface.rings(BOX_AROUND).points.reshape(-1, 3) - center) @ rotation.T
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


def closed_profile(outer: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "M 2"]:
    """(ρ, h) of an outside from the bottom up, closed flat at both ends."""
    return np.concatenate([[[0.0, outer[0, 1]]], outer, [[0.0, outer[-1, 1]]]])


_NEIGHBORS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]


def _facing(normals: Float[np.ndarray, "P 3"], rays: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    return np.where(((normals * rays).sum(1) > 0)[:, None], -normals, normals)


@dataclass(frozen=True)
class ReflectionPaths:
    """Where in the map mirrored rays look that meet nothing more. Directions are unit; zero where they never leave."""

    directions: Float[np.ndarray, "P 3"]
    bounces: Int[np.ndarray, "P"]
    """How often each was mirrored; 0 for rays that miss, and for those that never leave."""
    first: Hits


def trace_reflections(
    surface: SurfaceOfRevolution,
    origins: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    *,
    max_bounces: int = 1,
    occlusion_test: bool = True,
) -> ReflectionPaths:
    """Mirror rays at the surface up to `max_bounces` times.

    A ray that meets the surface once more after the last reflection never leaves; without `occlusion_test` that is not
    looked for, and such a ray leaves as it was mirrored last.
    """
    first = surface.hits(origins, directions)
    met = np.flatnonzero(first.met)
    final, bounces = np.zeros((len(origins), 3)), np.zeros(len(origins), dtype=np.int64)
    if occlusion_test:
        points = (first.points[met] - surface.origin) @ surface.frame.T
        places = first.side[met], first.along[met]
        last, leaving, times = follow(
            points, directions[met] @ surface.frame.T, places, surface.profile, surface.angles, RAY_EPSILON, max_bounces
        )
        looked_up = surface.surroundings.looked_up(last @ surface.frame + surface.origin, leaving @ surface.frame)
        final[met], bounces[met] = np.where(times[:, None] > 0, looked_up, 0.0), times
        return ReflectionPaths(final, bounces, first)
    hits, incoming = first.of(met), directions[met]
    for _ in range(max_bounces):
        outgoing = reflect(incoming, hits.normals)
        outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
        final[met] = surface.surroundings.looked_up(hits.points, outgoing)
        bounces[met] += 1
        hits = surface.hits(hits.points + RAY_EPSILON * outgoing, outgoing)
        met, incoming, hits = met[hits.met], outgoing[hits.met], hits.of(hits.met)
    return ReflectionPaths(final, bounces, first)


def revolution_rays(
    surface: SurfaceOfRevolution,
    view: TrainView,
    pixels: Tensor,
    *,
    max_bounces: int = 1,
    occlusion_test: bool = True,
    weighted: bool = False,
) -> tuple[Rays, Hits]:
    """What pixels (flat indices) of a view observed of the environment (see `trace_reflections`), and where they met
    the surface.

    If `weighted`, rays have the confidence 1/(1 + a/t): a is the square of the larger angle to the next of the given
    pixels by row and by column, t that of a texel. A pixel near the lip sees a long strip, which says little about any
    texel of it. Pixels are in ascending order then.
    """
    origins, directions = pixel_rays(view.camera, pixels.cpu().numpy())
    paths = trace_reflections(surface, origins, directions, max_bounces=max_bounces, occlusion_test=occlusion_test)
    left = paths.bounces > 0
    kept = pixels[torch.from_numpy(left).to(pixels.device)]
    outgoing = torch.from_numpy(paths.directions[left]).float().to(view.radiance.device)
    trust = None
    if weighted:
        image, mask = np.zeros((*view.mask.shape, 3)), np.zeros(view.mask.shape, dtype=bool)
        places = kept.cpu().numpy()
        image.reshape(-1, 3)[places], mask.ravel()[places] = paths.directions[left], True
        footprint_sr = pixel_footprint_sr(image, mask)[mask]
        trust = torch.from_numpy(1 / (1 + footprint_sr / CONFIDENCE_TEXEL_RAD**2)).to(outgoing)
    radiance, incoming = view.radiance_at(kept), view.directions_world(kept)
    return Rays(outgoing, radiance, trust, incoming), paths.first.of(left)
