"""A bent mirror in a frame, as views: its own coverage, and an environment with detail everywhere in its normals."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.kernels.rasterize import RasterCamera
from panoless.lathe import pixel_rays
from panoless.plane import Plane
from panoless.sheet import Sheet, flat_sheet, sheet_buffers, sightings
from panoless.views import Normalization, Views
from tests.support.mirror_plane import train_view


def bumpy(plane: Plane, height: float, seed: int = 1, cells: int = 4) -> Sheet:
    """Random bumps a few cells wide."""
    flat = flat_sheet(plane, cells)
    bumps = np.random.default_rng(seed).normal(size=flat.coefficients.shape)
    return replace(flat, coefficients=height * bumps)


def patterned(directions: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Waves of three lengths, in [0, 1]."""
    waves = np.random.default_rng(6).normal(size=(3, 3)) * 3
    first, second = np.sin(directions @ waves), np.sin(2 * directions @ waves[::-1].T)
    return 0.5 + 0.2 * first + 0.15 * second + 0.1 * np.sin(5 * directions @ waves[:, ::-1])


def sheet_views(sheet: Sheet, cameras: list[RasterCamera]) -> Views:
    """What cameras see of it; the frame, where it is mirrored, is black."""
    train = []
    for camera in cameras:
        view = train_view(camera, sheet_buffers(sheet, camera).alpha.double().numpy())
        radiance = torch.zeros_like(view.radiance)
        seen = sightings(sheet, view, view.solid)
        radiance.flatten(1)[:, seen.pixels] = torch.from_numpy(patterned(seen.outgoing).T).float()
        train.append(replace(view, radiance=radiance))
    return Views(tuple(train), Normalization(np.zeros(3), 1.0), 0.3)


def normal_errors_deg(found: Sheet, truth: Sheet, camera: RasterCamera) -> Float[np.ndarray, "P"]:
    """Angles between the normals that two sheets show to a camera, where both lie within the outline of the truth."""
    pixels = np.flatnonzero(sheet_buffers(truth, camera).alpha.numpy() > 0.99)
    rays = pixel_rays(camera, pixels)
    normals = [sheet.hits(*rays).normals @ sheet.frame for sheet in (found, truth)]
    return np.degrees(2 * np.arcsin(np.linalg.norm(normals[0] - normals[1], axis=1).clip(max=2) / 2))
