"""Pixels as areas: a groove of some pixels, which single rays can't tell, is found by the means of several."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool2d

from panoless import lathe_pixels
from panoless.kernels.cubemap import cubemap_directions
from panoless.lathe import Lathe
from panoless.lathe_contours import contour_rays
from panoless.lathe_photometric import RADIANCE_SIGMA
from panoless.lathe_pixels import area_equations, pixel_areas, refined_in_pixels, telling_pixels
from panoless.lathe_profile import ProfileSplines, moved, resampled
from panoless.views import Views
from tests.support.mirror_lathe import around, goblet, lathe_views, rays_of
from tests.support.synthetic_dataset import environment_radiance

PIXEL = 0.024
FINE = 4


def environment(resolution: int) -> torch.Tensor:
    directions = cubemap_directions(resolution).double().numpy()
    return torch.from_numpy(environment_radiance(directions).clip(0, 1).transpose(0, 3, 1, 2).copy()).float()


def grooved(depth: float = 0.045) -> Lathe:
    """The goblet with a sharp-edged groove of six pixels."""
    body = goblet()
    height = np.linspace(-0.7, 0.6, 1000)
    radius = 0.5 + 0.12 * np.cos(4 * height)
    radius -= depth * np.cos((height / 0.075).clip(-1, 1) * np.pi / 2)
    outer = np.stack([radius, height], 1)
    return replace(body, profile=np.concatenate([[[0.0, -0.7]], outer, [[0.0, 0.6]]]), rim=len(outer))


def averaged_views(lathe: Lathe, count: int, size: int = 72) -> Views:
    """Views whose pixels are means over 4×4 rays."""
    fine = lathe_views(lathe, around(count, FINE * size), 1)
    coarse = []
    for view, camera in zip(fine.train, around(count, size), strict=True):
        mask = avg_pool2d(view.mask[None], FINE)[0]
        radiance = avg_pool2d(view.radiance, FINE)
        solid = torch.nonzero(mask.flatten() > 0.999)[:, 0]
        coarse.append(replace(view, camera=camera, mask=mask, radiance=radiance, solid=solid))
    return replace(fine, train=tuple(coarse))


def error_deg(lathe: Lathe, truth: Lathe, size: int = 72) -> float:
    """Mean angle between normals where rays of some cameras meet the groove of the true body and its edges."""
    origins, directions = (np.concatenate(each) for each in zip(*map(rays_of, around(4, size)), strict=True))
    found, expected = lathe.hits(origins, directions), truth.hits(origins, directions)
    height = (expected.points - truth.origin) @ truth.axis
    seen = found.met & expected.met & (np.abs(height) < 0.12)
    cosine = np.abs((found.normals * expected.normals).sum(1)[seen]).clip(0, 1)
    return float(np.degrees(np.arccos(cosine)).mean())


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """The two coarse rounds, which take a tenth of the time."""
    monkeypatch.setattr(lathe_pixels, "MAP_RESOLUTION", 64)
    monkeypatch.setattr(lathe_pixels, "ROUNDS", lathe_pixels.ROUNDS[:2])
    monkeypatch.setattr(lathe_pixels, "BENDING", lathe_pixels.BENDING[:2])
    monkeypatch.setattr(lathe_pixels, "PIXELS", 12_000)


@pytest.fixture(scope="module")
def grooved_views() -> Views:
    return averaged_views(grooved(), 10)


def test_equations_are_the_derivatives_of_the_mean_of_rays() -> None:
    """Jᵀ r predicts the change of Σ e²/2 under small moves of axis and profile, found by tracing the moved lathe."""
    views = averaged_views(goblet(), 6)
    lathe = resampled(replace(goblet(), origin=goblet().origin + 0.01), 0.02)
    scene, splines = environment(128), ProfileSplines.of(lathe, 0.1)
    # Away from outlines and edges, where no ray of a pixel comes or goes.
    pixels = []
    for view in views.train:
        hits = lathe.hits(*rays_of(view.camera))
        facing = np.abs((hits.normals * rays_of(view.camera)[1]).sum(1))
        height = (hits.points - lathe.origin) @ lathe.axis
        pixels.append(np.flatnonzero(hits.met & (facing > 0.4) & (np.abs(height + 0.05) < 0.45)))
    gradient, _ = area_equations(pixel_areas(views.train, lathe, pixels), lathe, splines, scene, 1e6, 0.0)

    def cost(changed: Lathe) -> float:
        areas = pixel_areas(views.train, changed, pixels)
        return float(((areas.shown(scene) - areas.radiance) ** 2).sum()) / 2 / RADIANCE_SIGMA**2

    generator = np.random.default_rng(1)
    for _ in range(3):
        direction = np.concatenate([generator.normal(size=4), generator.normal(size=splines.count) * 0.3])
        direction[4 + splines.counts[0] :] = 0
        change = cost(moved(lathe, splines, 1e-4 * direction)) - cost(moved(lathe, splines, -1e-4 * direction))
        # Derivatives are differences over a texel.
        assert change / 2e-4 == pytest.approx(float(gradient @ direction), rel=0.15)


@pytest.mark.usefixtures("coarse")
def test_a_groove_of_some_pixels_is_found(grooved_views: Views) -> None:
    """From the body without its groove: the normals there, wrong by tens of degrees, become right to half of that."""
    start = resampled(goblet(), PIXEL)
    found = refined_in_pixels(grooved_views, contour_rays(grooved_views), start, PIXEL)
    assert error_deg(found, grooved()) < error_deg(start, grooved()) / 2


@pytest.mark.usefixtures("coarse")
def test_what_held_out_views_do_not_show_is_not_kept(grooved_views: Views) -> None:
    """Every fifth view shows a body without the groove that the others show: the start is returned."""
    plain = averaged_views(goblet(), 10)
    mixed = tuple(
        without if index % 5 == 2 else with_groove
        for index, (without, with_groove) in enumerate(zip(plain.train, grooved_views.train, strict=True))
    )
    views, start = replace(plain, train=mixed), resampled(goblet(), PIXEL)
    assert refined_in_pixels(views, contour_rays(views), start, PIXEL) is start


def test_pixels_are_taken_where_the_profile_turns() -> None:
    """Three quarters of them see the groove or another bend, which are a smaller part of what all see."""
    views, lathe = averaged_views(grooved(), 5), resampled(grooved(), PIXEL / 3)
    chosen = telling_pixels(views.train, lathe, 1000, PIXEL)
    assert 800 < sum(map(len, chosen)) < 1200
    shares = []
    for pixels_of in (lambda i: chosen[i], lambda i: views.train[i].solid.numpy()):
        points = [
            lathe.hits(*(each[pixels_of(i)] for each in rays_of(view.camera))).points
            for i, view in enumerate(views.train)
        ]
        height = (np.concatenate(points) - lathe.origin) @ lathe.axis
        shares.append(float((np.abs(height) < 0.12).mean()))
    assert shares[0] > 1.2 * shares[1]
