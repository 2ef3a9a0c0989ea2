"""The map is sharpened by what pixels are: means over areas."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import max_pool2d, normalize

from panoless.capture.views import Views
from panoless.environment.footprints import PixelFootprints
from panoless.environment.sharpening import deblur_map
from panoless.environment.solve import solve_environment
from panoless.geometry.revolution.deblurred_map import pixel_footprints
from panoless.geometry.revolution.model import revolution_buffers, revolution_rays
from panoless.geometry.revolution.render import mean_light
from panoless.kernels.cubemap import cubemap_directions, sample_cubemap
from tests.support.mirror_revolution import around, bowl, revolution_views

ONE, SMOOTHNESS = torch.ones(3), 0.05


def scene(resolution: int) -> torch.Tensor:
    """Soft stripes of thirty degrees, of which the pixels at the bowl's sides span a good part."""
    directions = cubemap_directions(resolution)
    waves = [0.5 + 0.4 * torch.sin(12 * directions[..., k] + k) for k in range(3)]
    return torch.stack(waves, 1).contiguous()


def lamp(resolution: int) -> torch.Tensor:
    """Where the lamp of `lit_scene` shines: a disk of twelve degrees that faces the cameras' side."""
    toward = normalize(torch.tensor([0.2, -0.9, 0.4]), dim=0)
    return (cubemap_directions(resolution) @ toward).acos() < 0.2


def lit_scene(resolution: int) -> torch.Tensor:
    """The stripes, and a lamp of radiance 3 in front of them."""
    return torch.where(lamp(resolution)[:, None], 3.0, scene(resolution))


def photographed(truth: torch.Tensor) -> Views:
    """A bowl under a map, each pixel the mean over its area, clipped as photographs are."""
    views = revolution_views(bowl(), around(8, 96))
    train = []
    for view in views.train:
        radiance = torch.zeros(3, view.mask.numel())
        radiance[:, view.solid] = mean_light(bowl(), truth, view.camera, view.solid).T.clamp(max=1)
        train.append(replace(view, radiance=radiance.reshape(view.radiance.shape)))
    return replace(views, train=tuple(train))


@pytest.fixture(scope="module")
def photographs() -> Views:
    """The bowl under the stripes."""
    return photographed(scene(64))


@pytest.fixture(scope="module")
def under_a_lamp() -> tuple[torch.Tensor, torch.Tensor]:
    """Maps of centers and sharpened, of the bowl under the lamp."""
    views = photographed(lit_scene(64))
    start = solve_environment([revolution_rays(bowl(), view, view.solid)[0] for view in views.train], 64)
    return start, deblur_map(pixel_footprints(views, bowl()), start, ONE, SMOOTHNESS)


def test_areas_tell_the_map_better_than_centers(photographs) -> None:
    """Where smooth pixels look, the squared error of the map falls to less than 0.6 of what it was."""
    truth, views, surface = scene(64), photographs, bowl()
    rays = [revolution_rays(surface, view, view.solid)[0] for view in views.train]
    start = solve_environment(rays, 64)
    directions = torch.cat([each.directions.flatten(0, 1) for each in pixel_footprints(views, surface).smooth])
    errors = [
        float((sample_cubemap(found, directions) - sample_cubemap(truth, directions)).square().mean())
        for found in (start, deblur_map(pixel_footprints(views, surface), start, ONE, SMOOTHNESS))
    ]
    assert errors[1] < 0.6 * errors[0]


def test_the_true_map_stays(photographs) -> None:
    """Its pixels are what was photographed, but for the difference of 4 and of 16 rays."""
    truth = scene(64)
    found = deblur_map(pixel_footprints(photographs, bowl()), truth, ONE, SMOOTHNESS)
    assert float((found - truth).abs().mean()) < 0.02


def test_seeing_and_spreading_are_adjoint() -> None:
    """⟨A E, w⟩ = ⟨E, Aᵀ w⟩ for any map E and any values w of pixels."""
    generator = torch.Generator().manual_seed(0)
    areas = pixel_footprints(revolution_views(bowl(), around(2, 48)), bowl()).smooth[0]
    image = torch.rand(6, 3, 32, 32, generator=generator)
    values = torch.rand(len(areas.radiance), 3, generator=generator)
    left = (areas.seen(image) * values).double().sum()
    right = (image * areas.spread(values, 32)).double().sum()
    torch.testing.assert_close(left, right, rtol=1e-4, atol=0)


def test_a_lamp_is_told_by_pixels_that_see_it_in_part(under_a_lamp) -> None:
    """Of a radiance of 3, shown as 1, the map of centers has nothing and the sharpened one a third of the excess or
    more where the lamp was seen; more than four degrees from the lamp nothing is brighter than views show.
    """
    start, found = under_a_lamp
    within = lamp(64)[:, None].expand(-1, 3, -1, -1)
    assert float(start.max()) <= 1
    assert 1.67 < float(found[within & (start > 0.99)].mean()) < 3.3
    beside = max_pool2d(within.float(), 7, 1, 3) > 0
    assert float(found[~beside].max()) < 1.02


def test_clipped_renders_need_light_above_one(under_a_lamp) -> None:
    """Where pixels see the lamp by up to a third, from elsewhere: the squared error falls by a tenth or more."""
    _, found = under_a_lamp
    shining = lamp(64)[:, None].expand(-1, 3, -1, -1).float().contiguous()
    errors = torch.zeros(2)
    for camera in around(5, 96):
        pixels = torch.nonzero(revolution_buffers(bowl(), camera).alpha.flatten() == 1)[:, 0]
        share = mean_light(bowl(), shining, camera, pixels)[:, 0]
        pixels = pixels[(share > 0.01) & (share < 1 / 3)]
        truth = mean_light(bowl(), lit_scene(64), camera, pixels).clamp(max=1)
        for index, each in enumerate((found, found.clamp(max=1))):
            errors[index] += (mean_light(bowl(), each, camera, pixels).clamp(max=1) - truth).square().sum()
    assert float(errors[0]) < 0.9 * float(errors[1])


def test_light_above_one_costs_nothing_below(under_a_lamp) -> None:
    """Clipped to [0, 1], the map under the lamp is nearer to the truth than the one of centers."""
    start, found = under_a_lamp
    truth = lit_scene(64).clamp(max=1)
    before, after = ((each.clamp(0, 1) - truth).square().mean() for each in (start, found))
    assert float(after) < float(before)


def test_without_saturated_pixels_saturation_is_nothing(photographs) -> None:
    """Views that end at 1 and views without an end give the same map, where nothing is brighter than 0.9."""
    start = solve_environment([revolution_rays(bowl(), view, view.solid)[0] for view in photographs.train], 64)
    ended, endless = (
        deblur_map(pixel_footprints(photographs, bowl()), start, each * ONE, SMOOTHNESS) for each in (1.0, float("inf"))
    )
    torch.testing.assert_close(ended, endless.clamp(max=1))


def test_a_saturated_pixel_is_a_lower_bound() -> None:
    """It has a vote where a map is darker than it, none where one is brighter; any other pixel has one either way."""
    areas = PixelFootprints(torch.zeros(2, 1, 3), torch.tensor([[1.0, 1.0, 1.0], [0.5, 0.5, 0.5]]))
    votes = areas.weights(torch.tensor([[2.0, 1.0, 0.9], [0.6, 0.5, 0.4]]), ONE, 0.1, 0.998) > 0
    assert votes.tolist() == [[False, False, True], [True, True, True]]
