"""Bodies of which one half is painted: what places mirror and scatter is measured with their shape."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.views import TrainView, Views
from panoless.environment.material_field import MaterialField
from panoless.geometry.free_form.fit import coarse_stage, fit_free_form
from panoless.geometry.free_form.map import Mirrored
from panoless.geometry.free_form.material import EVEN, Material, measured_material
from panoless.geometry.free_form.photometric import Linearization
from panoless.geometry.free_form.schedule import DETAILED, Round
from panoless.geometry.free_form.start import first_surfaces
from panoless.geometry.free_form.surface import LevelSet
from panoless.geometry.free_form.task import make_task
from panoless.geometry.free_form.trust import full_trust
from panoless.problem.rays import PixelRays
from tests.panoless.geometry.free_form.test_fit import CONFIG, FEW_PIXELS, normal_errors_deg
from tests.support.mirror_body import body_views, cameras_around, wavy_ball

SHARE, PAINT = 0.4, np.array([0.25, 0.1, 0.05])
"""Of the light that paint mirrors at normal incidence, and what it scatters."""


def painted(views: Views, surface: LevelSet) -> Views:
    """One half of a body, which is that surface but for little, mirrors less and scatters light."""
    return replace(views, train=tuple(_painted(view, surface) for view in views.train))


def _painted(view: TrainView, surface: LevelSet) -> TrainView:
    rays = PixelRays.centers(view.camera, np.arange(view.mask.numel()))
    hits = surface.hits(rays.origins, rays.directions)
    half = hits.met & (surface.points(hits.places)[:, 2] > 0)
    share = SHARE + (1 - SHARE) * (1 + (hits.normals * rays.directions).sum(1).clip(-1, 0)) ** 5
    seen = view.radiance.flatten(1).double().numpy()
    seen = np.where(half, share * seen + PAINT[:, None], seen)
    return replace(view, radiance=torch.from_numpy(seen).float().reshape(view.radiance.shape))


def test_what_a_perfect_mirror_would_have_shown_is_what_a_material_leaves() -> None:
    """(c − d)/F is E again, and channels that mirror nothing count nothing."""
    rng, count = np.random.default_rng(0), 200
    field = MaterialField(8, np.arange(9**3), rng.uniform(-0.9, 0, (9**3, 3)), rng.uniform(0, 1, (9**3, 3)))
    points, facing, light = rng.uniform(-1, 1, (count, 3)), rng.uniform(0.2, 1, count), rng.uniform(0, 2, (count, 3))
    share, scattered = Material(field).at(points, facing)
    taken = share * light + scattered
    found = Mirrored.by(Material(field), taken, taken, points, facing)
    np.testing.assert_allclose(found.radiance, light, atol=1e-9)
    np.testing.assert_allclose(found.share, share)
    matte = Material(replace(field, share=np.full((9**3, 3), -1.0)))
    assert not Mirrored.by(matte, taken, taken, points, np.ones(count)).gain(light, 1.0).any()


def test_a_saturated_pixel_may_be_any_brighter() -> None:
    taken = np.ones((1, 3))
    found = Mirrored.by(EVEN, taken, taken, np.zeros((1, 3)), np.ones(1))
    brighter, darker = (found.gain(np.full((1, 3), light), 1.0) for light in (3.0, 0.5))
    assert not brighter.any()
    assert darker.all()


def test_paint_is_measured_beside_chrome() -> None:
    """Light is known up to its scale and a constant alone: the gauge makes the chrome perfect."""
    views = body_views(wavy_ball(), 20, 64)
    surface = coarse_stage(views, first_surfaces(views, CONFIG).plain, FEW_PIXELS.coarse).surface
    task = replace(make_task(painted(views, surface), Round(28, 16, 0.3, 1, 20_000, 30.0, 5)), material=EVEN)
    found = Linearization.at(task, surface, full_trust(surface), None, 3)
    for _ in range(12):
        found = found.under(replace(found.task, material=measured_material(found)))
    assert found.task.material is not None
    seen = found.points[found.free > 0]
    share, scattered = found.task.material.at(seen, np.ones(len(seen)))
    assert measured_material(replace(found, free=np.zeros_like(found.free))) == EVEN
    paint, chrome = seen[:, 2] > 0.1, seen[:, 2] < -0.1
    assert np.median(share[chrome], axis=0) == pytest.approx(np.ones(3), abs=0.1)
    assert np.median(share[paint], axis=0) == pytest.approx(np.full(3, SHARE), abs=0.1)
    assert np.median(scattered[chrome], axis=0) == pytest.approx(np.zeros(3), abs=0.03)
    assert np.median(scattered[paint], axis=0) == pytest.approx(PAINT, abs=0.05)


@pytest.mark.slow
def test_a_painted_half_keeps_the_shape_of_a_body() -> None:
    """Held-out views choose the material; on a perfect mirror they refuse it."""
    body, cameras = wavy_ball(0.03, 9.0), cameras_around(16, 64)
    views = body_views(body, len(cameras), 64)
    short = tuple(replace(each, rays=8_000, steps=4) for each in DETAILED[:4])
    schedule = replace(FEW_PIXELS, refit=(), detailed=short)
    first = first_surfaces(views, CONFIG).plain
    true = fit_free_form(views, first, schedule, materials=(None, EVEN))[0]
    assert true.material is None
    half = painted(views, true.surface)
    wrong, right = (fit_free_form(half, first, schedule, materials=each)[0] for each in ((None,), (None, EVEN)))
    assert right.material is not None
    before, after = (np.median(normal_errors_deg(each.surface, body, views, cameras[::5])) for each in (wrong, right))
    assert after < before / 2
