"""Renders of surfaces of revolution: a pixel is the mean over its area, however it is computed."""

from dataclasses import replace

import numpy as np
import torch

from panoless.capture.rays import pixel_rays
from panoless.geometry.revolution.model import SurfaceOfRevolution, revolution_buffers, trace_reflections
from panoless.geometry.revolution.render import mean_light
from panoless.kernels.camera import RasterCamera
from panoless.kernels.cubemap import cubemap_directions
from tests.support.mirror_revolution import TILTED, around, bowl
from tests.support.synthetic_dataset import environment_radiance


def environment(resolution: int = 64) -> torch.Tensor:
    directions = cubemap_directions(resolution).double().numpy()
    return torch.from_numpy(environment_radiance(directions).clip(0, 1).transpose(0, 3, 1, 2).copy()).float()


def ball(radius: float = 0.7, sides: int = 800) -> SurfaceOfRevolution:
    angle = np.linspace(-np.pi / 2, np.pi / 2, sides + 1)
    profile = radius * np.stack([np.cos(angle).clip(0), np.sin(angle)], 1)
    return SurfaceOfRevolution(np.array([0.1, -0.2, 0.05]), TILTED, profile, sides)


def covered(surface: SurfaceOfRevolution, camera: RasterCamera) -> torch.Tensor:
    return torch.nonzero(revolution_buffers(surface, camera).alpha.flatten() > 0)[:, 0]


def test_a_pixel_of_a_ball_is_the_mean_of_its_rays() -> None:
    """Against the analytic sphere at 16×16 rays a pixel, inside its silhouette: 1 % of what single rays miss."""
    surface, scene, camera = ball(), environment(), around(3, 40)[2]
    pixels = covered(surface, camera)
    inner = pixels[revolution_buffers(surface, camera).alpha.flatten()[pixels] == 1]
    truth, single = torch.zeros(len(inner), 3), torch.zeros(len(inner), 3)
    for shift in [((i + 0.5) / 16, (j + 0.5) / 16) for i in range(16) for j in range(16)]:
        truth += _sphere_light(surface, 0.7, scene, camera, inner.numpy(), shift) / 256
    single = _sphere_light(surface, 0.7, scene, camera, inner.numpy(), (0.5, 0.5))
    found = mean_light(surface, scene, camera, inner)
    error, before = ((each - truth).square().mean() for each in (found, single))
    assert float(error) < 0.02 * float(before)


def _sphere_light(surface, radius, scene, camera, pixels, shift):
    origins, rays = pixel_rays(camera, pixels, shift)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    b = ((origins - surface.origin) * rays).sum(1)
    under = b**2 - ((origins - surface.origin) ** 2).sum(1) + radius**2
    normals = (origins + (-b - np.sqrt(under.clip(0)))[:, None] * rays - surface.origin) / radius
    directions_local = rays - 2 * (rays * normals).sum(1, keepdims=True) * normals
    from panoless.kernels.cubemap import sample_cubemap

    return sample_cubemap(scene, torch.from_numpy(directions_local).float())


def test_interpolated_directions_are_those_of_traced_rays() -> None:
    """With no interpolation at all, the smooth pixels of a bowl change by less than a thousandth."""
    surface, scene, camera = bowl(), environment(), around(3, 64)[2]
    pixels = covered(surface, camera)
    quick = mean_light(surface, scene, camera, pixels)
    slow = mean_light(surface, scene, camera, pixels, largest_bend=0.0)
    assert float((quick - slow).abs().mean()) < 1e-3
    assert 0 < int(((quick - slow).abs().amax(1) > 0).sum()) < len(pixels)


def test_a_white_world_makes_a_white_mirror() -> None:
    """Each ray that leaves sees one, so a pixel is the share that leaves: one outside, at most one in the mouth."""
    surface, camera = bowl(), around(4, 48)[3]
    pixels = covered(surface, camera)
    light = mean_light(surface, torch.ones(6, 3, 8, 8), camera, pixels)
    assert float(light.max()) <= 1 + 1e-5
    once = trace_reflections(surface, *pixel_rays(camera, pixels.numpy()), max_bounces=16).bounces == 1
    assert float(light[torch.from_numpy(once)].median()) == 1
    assert float((light > 1 - 1e-5).float().mean()) > 0.9


def test_the_frame_of_the_world_does_not_matter() -> None:
    """A pixel's light stays when only the image grows around it."""
    surface, scene, camera = bowl(), environment(), around(3, 48)[1]
    pixels = covered(surface, camera)
    wider = replace(camera, width=camera.width + 10, height=camera.height + 6, cx=camera.cx + 4, cy=camera.cy + 3)
    row, column = np.divmod(pixels.numpy(), camera.width)
    apply_step = torch.from_numpy((row + 3) * wider.width + column + 4)
    first, second = mean_light(surface, scene, camera, pixels), mean_light(surface, scene, wider, apply_step)
    torch.testing.assert_close(first, second, atol=1e-5, rtol=0)
