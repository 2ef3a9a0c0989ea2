"""Surfels on a surface of revolution."""

import math

import numpy as np

from panoless.config import SurfelConfig
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.splats.model import Surfels
from panoless.splats.placement import surfels_at


def surfels_on_revolution(surface: SurfaceOfRevolution, config: SurfelConfig) -> Surfels:
    """About as many surfels as configured in rings around a surface of revolution, curved as it is: half as long along
    the profile as around.
    """
    profile, ends = surface.profile, surface.angles
    steps = np.diff(surface.arc_lengths)
    areas = math.pi * steps * (profile[:-1, 0] + profile[1:, 0])
    # A ring of radius ρ and width w holds 2πρ/2w surfels.
    width = math.sqrt(areas.sum() / config.count / 2)
    rings = max(round(surface.arc_lengths[-1] / width), 1)
    place = (np.arange(rings) + 0.5) * surface.arc_lengths[-1] / rings
    side = np.clip(np.searchsorted(surface.arc_lengths, place) - 1, 0, len(steps) - 1)
    along = (place - surface.arc_lengths[side]) / np.maximum(steps[side], 1e-12)
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
    frames = np.einsum("ji,kjl->kil", surface.frame, frames)
    # n = n₀ − S·(x − x₀): the normal turns with the profile, and by n_ρ/ρ around the axis.
    curvatures = np.stack([-along_axis / np.maximum(radius[ring], width / 2), zero, -bend[ring]], 1)
    spacing = np.stack([2 * math.pi * radius[ring] / around[ring], np.full(len(ring), width)], 1)
    scales = config.tuned.overlap * np.maximum(spacing, 1e-6)
    return surfels_at(surface.origin + local @ surface.frame, frames, scales, curvatures)
