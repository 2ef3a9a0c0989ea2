"""The map is sharpened by what pixels are: means over areas."""

from dataclasses import replace

import pytest
import torch

from panoless.cubemap import solve_environment
from panoless.kernels.cubemap import cubemap_directions, sample_cubemap
from panoless.lathe import lathe_rays
from panoless.lathe_map import _areas, sharpened_map
from panoless.lathe_render import mean_light
from panoless.views import Views
from tests.support.mirror_lathe import around, bowl, lathe_views


def scene(resolution: int) -> torch.Tensor:
    """Soft stripes of thirty degrees, of which the pixels at the bowl's sides span a good part."""
    directions = cubemap_directions(resolution)
    waves = [0.5 + 0.4 * torch.sin(12 * directions[..., k] + k) for k in range(3)]
    return torch.stack(waves, 1).contiguous()


@pytest.fixture(scope="module")
def photographs() -> Views:
    """A bowl under the stripes, each pixel the mean over its area."""
    truth = scene(64)
    views = lathe_views(bowl(), around(8, 96))
    train = []
    for view in views.train:
        radiance = torch.zeros(3, view.mask.numel())
        radiance[:, view.solid] = mean_light(bowl(), truth, view.camera, view.solid).T
        train.append(replace(view, radiance=radiance.reshape(view.radiance.shape)))
    return replace(views, train=tuple(train))


def test_areas_tell_the_map_better_than_centers(photographs) -> None:
    """Where smooth pixels look, the squared error of the map falls to less than 0.6 of what it was."""
    truth, views, lathe = scene(64), photographs, bowl()
    rays = [lathe_rays(lathe, view, view.solid)[0] for view in views.train]
    start = solve_environment(rays, 64)
    directions = torch.cat([each.directions.flatten(0, 1) for each in _areas(views, lathe)])
    errors = [
        float((sample_cubemap(found, directions) - sample_cubemap(truth, directions)).square().mean())
        for found in (start, sharpened_map(views, lathe, start))
    ]
    assert errors[1] < 0.6 * errors[0]


def test_the_true_map_stays(photographs) -> None:
    """Its pixels are what was photographed, but for the difference of 4 and of 16 rays."""
    truth = scene(64)
    found = sharpened_map(photographs, bowl(), truth)
    assert float((found - truth).abs().mean()) < 0.02


def test_seeing_and_spreading_are_adjoint() -> None:
    """⟨A E, w⟩ = ⟨E, Aᵀ w⟩ for any map E and any values w of pixels."""
    generator = torch.Generator().manual_seed(0)
    areas = _areas(lathe_views(bowl(), around(2, 48)), bowl())[0]
    image = torch.rand(6, 3, 32, 32, generator=generator)
    values = torch.rand(len(areas.radiance), 3, generator=generator)
    left = (areas.seen(image) * values).double().sum()
    right = (image * areas.spread(values, 32)).double().sum()
    torch.testing.assert_close(left, right, rtol=1e-4, atol=0)
