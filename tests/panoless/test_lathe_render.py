"""Renders of surfaces of revolution: a pixel is the mean over its area, however it is computed."""

from dataclasses import replace

import numpy as np
import torch

from panoless import lathe_render
from panoless.kernels.cubemap import cubemap_directions
from panoless.kernels.rasterize import RasterCamera
from panoless.lathe import Lathe, followed, lathe_buffers, pixel_rays
from panoless.lathe_render import DEEPEST, mean_light
from tests.support.mirror_lathe import TILTED, around, bowl
from tests.support.synthetic_dataset import environment_radiance


def environment(resolution: int = 64) -> torch.Tensor:
    directions = cubemap_directions(resolution).double().numpy()
    return torch.from_numpy(environment_radiance(directions).clip(0, 1).transpose(0, 3, 1, 2).copy()).float()


def ball(radius: float = 0.7, sides: int = 800) -> Lathe:
    angle = np.linspace(-np.pi / 2, np.pi / 2, sides + 1)
    profile = radius * np.stack([np.cos(angle).clip(0), np.sin(angle)], 1)
    return Lathe(np.array([0.1, -0.2, 0.05]), TILTED, profile, sides)


def covered(lathe: Lathe, camera: RasterCamera) -> torch.Tensor:
    return torch.nonzero(lathe_buffers(lathe, camera).alpha.flatten() > 0)[:, 0]


def test_a_pixel_of_a_ball_is_the_mean_of_its_rays() -> None:
    """Against the analytic sphere at 16×16 rays a pixel, inside its outline: a hundredth of what single rays miss."""
    lathe, scene, camera = ball(), environment(), around(3, 40)[2]
    pixels = covered(lathe, camera)
    inner = pixels[lathe_buffers(lathe, camera).alpha.flatten()[pixels] == 1]
    truth, single = torch.zeros(len(inner), 3), torch.zeros(len(inner), 3)
    for shift in [((i + 0.5) / 16, (j + 0.5) / 16) for i in range(16) for j in range(16)]:
        truth += _sphere_light(lathe, 0.7, scene, camera, inner.numpy(), shift) / 256
    single = _sphere_light(lathe, 0.7, scene, camera, inner.numpy(), (0.5, 0.5))
    found = mean_light(lathe, scene, camera, inner)
    error, before = ((each - truth).square().mean() for each in (found, single))
    assert float(error) < 0.02 * float(before)


def _sphere_light(lathe, radius, scene, camera, pixels, shift):
    origins, rays = pixel_rays(camera, pixels, shift)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    b = ((origins - lathe.origin) * rays).sum(1)
    under = b**2 - ((origins - lathe.origin) ** 2).sum(1) + radius**2
    normals = (origins + (-b - np.sqrt(under.clip(0)))[:, None] * rays - lathe.origin) / radius
    ways = rays - 2 * (rays * normals).sum(1, keepdims=True) * normals
    from panoless.kernels.cubemap import sample_cubemap

    return sample_cubemap(scene, torch.from_numpy(ways).float())


def test_interpolated_directions_are_those_of_traced_rays(monkeypatch) -> None:
    """With no interpolation at all, the smooth pixels of a bowl change by less than a thousandth."""
    lathe, scene, camera = bowl(), environment(), around(3, 64)[2]
    pixels = covered(lathe, camera)
    quick = mean_light(lathe, scene, camera, pixels)
    monkeypatch.setattr(lathe_render, "LARGEST_BEND", 0.0)
    slow = mean_light(lathe, scene, camera, pixels)
    assert float((quick - slow).abs().mean()) < 1e-3
    assert 0 < int(((quick - slow).abs().amax(1) > 0).sum()) < len(pixels)


def test_a_white_world_makes_a_white_mirror() -> None:
    """Each ray that leaves sees one, so a pixel is the share that leaves: one outside, at most one in the mouth."""
    lathe, camera = bowl(), around(4, 48)[3]
    pixels = covered(lathe, camera)
    light = mean_light(lathe, torch.ones(6, 3, 8, 8), camera, pixels)
    assert float(light.max()) <= 1 + 1e-5
    once = followed(lathe, *pixel_rays(camera, pixels.numpy()), DEEPEST).bounces == 1
    assert float(light[torch.from_numpy(once)].median()) == 1
    assert float((light > 1 - 1e-5).float().mean()) > 0.9


def test_the_frame_of_the_world_does_not_matter() -> None:
    """A pixel's light stays when only the image grows around it."""
    lathe, scene, camera = bowl(), environment(), around(3, 48)[1]
    pixels = covered(lathe, camera)
    wider = replace(camera, width=camera.width + 10, height=camera.height + 6, cx=camera.cx + 4, cy=camera.cy + 3)
    row, column = np.divmod(pixels.numpy(), camera.width)
    moved = torch.from_numpy((row + 3) * wider.width + column + 4)
    first, second = mean_light(lathe, scene, camera, pixels), mean_light(lathe, scene, wider, moved)
    torch.testing.assert_close(first, second, atol=1e-5, rtol=0)
