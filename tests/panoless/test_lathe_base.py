"""The bottom of an open vessel is found by way of its walls."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.kernels.cubemap import cubemap_directions
from panoless.lathe import Lathe
from panoless.lathe_base import base_error, base_rays, found_base, with_base
from panoless.lathe_render import mean_light
from panoless.views import Views
from tests.support.mirror_lathe import around, bowl, goblet, lathe_views
from tests.support.synthetic_dataset import environment_radiance

RISE = 0.04


def environment(resolution: int = 64) -> torch.Tensor:
    directions = cubemap_directions(resolution).double().numpy()
    return torch.from_numpy(environment_radiance(directions).clip(0, 1).transpose(0, 3, 1, 2).copy()).float()


def photographs(lathe: Lathe, scene: torch.Tensor) -> Views:
    """Views in which every pixel is the mean over its area, many reflections deep."""
    views = []
    for view in lathe_views(lathe, around(8, 64)).train:
        radiance = torch.zeros(3, view.mask.numel())
        radiance[:, view.solid] = mean_light(lathe, scene, view.camera, view.solid).T
        views.append(replace(view, radiance=radiance.reshape(view.radiance.shape)))
    return replace(lathe_views(lathe, around(1, 16)), train=tuple(views))


@pytest.fixture(scope="module")
def vessel() -> Lathe:
    return with_base(bowl(), RISE)


def test_a_hidden_bottom_is_found_from_a_flat_one(vessel) -> None:
    """Under a known map, to a sixth of its rise; its error is that of the truth, and far below that of a flat one."""
    scene = environment()
    views = photographs(vessel, scene)
    found = found_base(views, bowl(), scene)
    assert found.profile[0, 1] - bowl().profile[0, 1] == pytest.approx(RISE, abs=RISE / 6)
    rays = base_rays(views, bowl())
    assert rays is not None
    flat, best, truth = (base_error(rays, each, scene) for each in (bowl(), found, vessel))
    assert best < 0.6 * flat
    assert best < 1.02 * truth


def test_a_bottom_is_level_at_the_axis_and_leaves_the_wall_alone(vessel) -> None:
    """The wall stays as it was, the middle is as high as asked, and the first side is nearly level."""
    np.testing.assert_array_equal(vessel.profile[-199:], bowl().profile[-199:])
    assert vessel.is_open
    assert vessel.profile[0, 1] == pytest.approx(bowl().profile[0, 1] + RISE)
    steps = np.diff(vessel.profile, axis=0)
    angles = np.arctan2(steps[:, 1], steps[:, 0])
    assert abs(angles[0]) < 0.25 * np.abs(angles[:24]).max()


def test_a_closed_lathe_keeps_its_bottom() -> None:
    """Nothing of it is seen from inside, so nothing is changed."""
    views = lathe_views(goblet(), around(2, 32))
    closed = goblet()
    assert found_base(views, closed, environment(16)) is closed
