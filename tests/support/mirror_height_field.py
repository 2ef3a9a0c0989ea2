"""A bent mirror in a frame, as views: its own coverage, and an environment with detail everywhere in its normals."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import pixel_rays
from panoless.capture.views import Views
from panoless.geometry.height_field.model import (
    HeightField,
    flat_height_field,
    height_field_buffers,
    visible_reflections,
)
from panoless.geometry.plane.model import Plane
from panoless.kernels.camera import RasterCamera
from tests.support.mirror_plane import train_view


def bumpy(plane: Plane, height: float, seed: int = 1, cells: int = 4) -> HeightField:
    """Random bumps a few cells wide."""
    flat = flat_height_field(plane, cells)
    bumps = np.random.default_rng(seed).normal(size=flat.coefficients.shape)
    return replace(flat, coefficients=height * bumps)


def patterned(directions: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Waves of three lengths, in [0, 1]."""
    waves = np.random.default_rng(6).normal(size=(3, 3)) * 3
    first, second = np.sin(directions @ waves), np.sin(2 * directions @ waves[::-1].T)
    return 0.5 + 0.2 * first + 0.15 * second + 0.1 * np.sin(5 * directions @ waves[:, ::-1])


def height_field_views(height_field: HeightField, cameras: list[RasterCamera]) -> Views:
    """What cameras see of it; the frame, where it is mirrored, is black."""
    train = []
    for camera in cameras:
        view = train_view(camera, height_field_buffers(height_field, camera).alpha.double().numpy())
        radiance = torch.zeros_like(view.radiance)
        seen = visible_reflections(height_field, view, view.solid)
        radiance.flatten(1)[:, seen.pixels] = torch.from_numpy(patterned(seen.outgoing).T).float()
        train.append(replace(view, radiance=radiance))
    return Views(tuple(train), ObjectFrame(np.zeros(3), 1.0), 0.3)


def normal_errors_deg(found: HeightField, truth: HeightField, camera: RasterCamera) -> Float[np.ndarray, "P"]:
    """Angles between the normals that two height fields show to a camera, where both lie within the boundary of the
    truth.
    """
    pixels = np.flatnonzero(height_field_buffers(truth, camera).alpha.numpy() > 0.99)
    rays = pixel_rays(camera, pixels)
    normals = [height_field.hits(*rays).normals @ height_field.frame for height_field in (found, truth)]
    return np.degrees(2 * np.arcsin(np.linalg.norm(normals[0] - normals[1], axis=1).clip(max=2) / 2))
