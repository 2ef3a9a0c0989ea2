"""A ground that is stated: what photographs show of it past the object determines the map before any reflection."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from torch import Tensor

from panoless.capture.poses import StatedCameras
from panoless.capture.views import Views, load_views
from panoless.environment.surroundings import Floor, Surroundings
from panoless.geometry.free_form.photometric import Linearization
from panoless.geometry.free_form.schedule import Round as FreeFormRound
from panoless.geometry.free_form.surface import LevelSet
from panoless.geometry.free_form.task import make_task
from panoless.geometry.free_form.trust import full_trust
from panoless.geometry.sphere.model import Sphere
from panoless.geometry.sphere.unknowns import SphereUnknowns
from panoless.kernels.cubemap import sample_cubemap
from panoless.problem.blocks import CameraPoses, Ground, MaskOffsets
from panoless.problem.equations import Data, Photographs, State, Traced
from panoless.problem.nuisance import NO_NUISANCE, nuisance_of
from panoless.problem.solve import FINISH, ROUNDS, by_silhouettes, take_round
from shinypartial.dataset.read import open_dataset
from tests.support.ball_on_tiles import CENTER, RADIUS, write_ball_on_tiles


def views_of(folder: Path, lacked_px: int = 0) -> Views:
    return load_views(open_dataset(write_ball_on_tiles(folder, lacked_px)), 8)


def above(views: Views) -> Surroundings:
    assert views.ground is not None
    return Surroundings(np.zeros(1), Floor(views.ground.up, views.ground.depth, 8.0))


def off(views: Views, sigma_px: float, around: Surroundings) -> float:
    """Errors of center and radius of a joint solve under masks that are stated as that rough, in radii."""
    frame, views = views.object_frame, replace(views, mask_sigma_px=sigma_px)
    nuisance = nuisance_of(views, [CameraPoses, Ground, MaskOffsets], around)
    state = by_silhouettes(views, SphereUnknowns(Sphere(np.zeros(3), 0.95, around)), nuisance)
    for settings in ROUNDS[:2]:
        state = take_round(views, state, settings, FINISH.resolution)
    found = state.without_common(StatedCameras.of(views)).surface.shape
    center = (frame.to_world(found.center) - CENTER) / RADIUS
    return float(np.linalg.norm([*center, found.radius * frame.radius / RADIUS - 1]))


def test_photographs_find_a_ball_whose_masks_are_stated_as_rough(tmp_path: Path) -> None:
    """They lack 10 of its 56 rows."""
    views = views_of(tmp_path, 10)
    around = above(views)
    views = replace(views, ground=None)
    stated = off(views, 1.0, around)
    assert stated < 0.003
    assert stated < 0.5 * off(views, 0.0, around)


def test_the_ground_finds_a_ball_whose_masks_lack_a_quarter_of_it(tmp_path: Path) -> None:
    """Within 0.003 radii, and less than half as far off as by reflections alone."""
    views = views_of(tmp_path, 14)
    around = above(views)
    found = off(views, 1.0, around)
    assert found < 0.003
    assert found < 0.5 * off(replace(views, ground=None), 1.0, around)


def test_directions_that_nothing_mirrors_have_the_color_of_the_ground(tmp_path: Path) -> None:
    views = views_of(tmp_path)
    assert views.ground is not None
    around, light = above(views), views.ground.light
    data = Data.of(views, ROUNDS[1], FINISH.resolution)
    state = State(SphereUnknowns(Sphere(np.zeros(3), 1.0, around)), NO_NUISANCE)
    traced = Traced.of(data, state)
    assert traced is not None
    photographs = Photographs.at(data, state, traced, estimated=False)
    assert photographs is not None
    assert len(photographs.direct) == len(light.radiance)
    empty = LevelSet(np.full(3, -1.5), 0.125, np.zeros((27, 27, 27)))
    distance = np.linalg.norm(empty.points(empty.nodes().reshape(-1, 3)), axis=1) - 1
    level = replace(empty.interpolating(distance.reshape(empty.shape) / empty.spacing), surroundings=around)
    settings = FreeFormRound(20, 32, 0.3, 1, 8000, 30.0, 1)
    free_form = Linearization.at(make_task(views, settings), level, full_trust(level), None, 2)
    assert free_form.known.sum() == pytest.approx(float(light.weight.sum()))
    plain = replace(views, ground=None)
    without = Linearization.at(make_task(plain, settings), level, full_trust(level), None, 2)
    assert not without.known.any()

    def apart(environment: Tensor) -> float:
        return float((sample_cubemap(environment, light.directions) - light.radiance).abs().median())

    # Texels of this size are means over tiles.
    assert apart(photographs.environment) < 0.4 * float(light.radiance.std())
    assert apart(free_form.environment) < 0.4 * float(light.radiance.std()) < apart(without.environment)


def test_a_far_world_has_no_ground(tmp_path: Path) -> None:
    views = views_of(tmp_path)
    data = Data.of(views, ROUNDS[0], FINISH.resolution)
    state = State(SphereUnknowns(Sphere(np.zeros(3), 1.0)), NO_NUISANCE)
    traced = Traced.of(data, state)
    assert traced is not None
    photographs = Photographs.at(data, state, traced, estimated=False)
    assert photographs is not None
    assert len(photographs.direct) == 0
