"""Pixels as areas: a groove of some pixels, which single rays can't determine, is found by the means of several."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool2d

from panoless.capture.views import Views
from panoless.geometry.revolution.fit import Refinement
from panoless.geometry.revolution.footprints import informative_pixels
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.revolution.photometric import RADIANCE_SIGMA, Photometry, photometric_equations, solve_map
from panoless.geometry.revolution.pixels import PixelBundles
from panoless.geometry.revolution.profile import ProfileSplines, apply_step, resample_profile
from panoless.kernels.cubemap import cubemap_directions
from tests.support.mirror_revolution import around, goblet, rays_of, revolution_views
from tests.support.synthetic_dataset import environment_radiance

PIXEL = 0.024
FINE = 4


def environment(resolution: int) -> torch.Tensor:
    directions = cubemap_directions(resolution).double().numpy()
    return torch.from_numpy(environment_radiance(directions).clip(0, 1).transpose(0, 3, 1, 2).copy()).float()


def grooved(depth: float = 0.045) -> SurfaceOfRevolution:
    """The goblet with a sharp-edged groove of six pixels."""
    body = goblet()
    height = np.linspace(-0.7, 0.6, 1000)
    radius = 0.5 + 0.12 * np.cos(4 * height)
    radius -= depth * np.cos((height / 0.075).clip(-1, 1) * np.pi / 2)
    outer = np.stack([radius, height], 1)
    return replace(body, profile=np.concatenate([[[0.0, -0.7]], outer, [[0.0, 0.6]]]), lip=len(outer))


def averaged_views(surface: SurfaceOfRevolution, count: int, size: int = 72) -> Views:
    """Views whose pixels are means over 4×4 rays."""
    fine = revolution_views(surface, around(count, FINE * size), 1)
    coarse = []
    for view, camera in zip(fine.train, around(count, size), strict=True):
        mask = avg_pool2d(view.mask[None], FINE)[0]
        radiance = avg_pool2d(view.radiance, FINE)
        solid = torch.nonzero(mask.flatten() > 0.999)[:, 0]
        coarse.append(replace(view, camera=camera, mask=mask, radiance=radiance, solid=solid))
    return replace(fine, train=tuple(coarse))


def error_deg(surface: SurfaceOfRevolution, truth: SurfaceOfRevolution, size: int = 72) -> float:
    """Mean angle between normals where rays of some cameras meet the groove of the true body and its edges."""
    origins, directions = (np.concatenate(each) for each in zip(*map(rays_of, around(4, size)), strict=True))
    found, expected = surface.hits(origins, directions), truth.hits(origins, directions)
    height = (expected.points - truth.origin) @ truth.axis
    seen = found.met & expected.met & (np.abs(height) < 0.12)
    cosine = np.abs((found.normals * expected.normals).sum(1)[seen]).clip(0, 1)
    return float(np.degrees(np.arccos(cosine)).mean())


def refine_areas(views: Views, start: SurfaceOfRevolution) -> SurfaceOfRevolution:
    """What held-out views leave of the refinement by areas; the two coarse rounds take a tenth of the time."""
    with torch.no_grad():
        fit = Refinement(views, start, rounds=2, pixels=24_000)
        return fit.by_areas(start, solve_map(views, start, 1_000_000, 64))


@pytest.fixture(scope="module")
def grooved_views() -> Views:
    return averaged_views(grooved(), 10)


def test_equations_are_the_derivatives_of_the_mean_of_rays() -> None:
    """Jᵀ r predicts the change of Σ e²/2 under small moves of axis and profile, found by tracing the moved surface."""
    views = averaged_views(goblet(), 6)
    surface = resample_profile(replace(goblet(), origin=goblet().origin + 0.01), 0.02)
    scene, splines = environment(128), ProfileSplines.of(surface, 0.1)
    # Away from silhouettes and edges, where no ray of a pixel comes or goes.
    pixels = []
    for view in views.train:
        hits = surface.hits(*rays_of(view.camera))
        facing = np.abs((hits.normals * rays_of(view.camera)[1]).sum(1))
        height = (hits.points - surface.origin) @ surface.axis
        pixels.append((view, np.flatnonzero(hits.met & (facing > 0.4) & (np.abs(height + 0.05) < 0.45))))
    areas = PixelBundles.of(pixels)
    found = Photometry.of(areas, surface, scene, 6)
    gradient, _ = photometric_equations(areas, found, surface, splines, scene, 1e6, 0.0)

    def cost(changed: SurfaceOfRevolution) -> float:
        residual = Photometry.of(areas, changed, scene, 6).residual
        return float((residual**2).sum()) / 2 / RADIANCE_SIGMA**2

    generator = np.random.default_rng(1)
    for _ in range(3):
        direction = np.concatenate([generator.normal(size=4), generator.normal(size=splines.count) * 0.3])
        direction[4 + splines.counts[0] :] = 0
        change = cost(apply_step(surface, splines, 1e-4 * direction)) - cost(
            apply_step(surface, splines, -1e-4 * direction)
        )
        # Derivatives are differences over a texel.
        assert change / 2e-4 == pytest.approx(float(gradient @ direction), rel=0.15)


def test_a_groove_of_some_pixels_is_found(grooved_views: Views) -> None:
    """From the body without its groove: the normals there, wrong by tens of degrees, become right to half of that."""
    start = resample_profile(goblet(), PIXEL)
    found = refine_areas(grooved_views, start)
    assert error_deg(found, grooved()) < error_deg(start, grooved()) / 2


def test_what_held_out_views_do_not_show_is_not_kept(grooved_views: Views) -> None:
    """Every fifth view shows a body without the groove that the others show: the start is returned."""
    plain = averaged_views(goblet(), 10)
    mixed = tuple(
        without if index % 5 == 2 else with_groove
        for index, (without, with_groove) in enumerate(zip(plain.train, grooved_views.train, strict=True))
    )
    views, start = replace(plain, train=mixed), resample_profile(goblet(), PIXEL)
    assert refine_areas(views, start) is start


def test_pixels_are_taken_where_the_profile_turns() -> None:
    """Three quarters of them see the groove or another bend, which are a smaller part of what all see."""
    views, surface = averaged_views(grooved(), 5), resample_profile(grooved(), PIXEL / 3)
    chosen = informative_pixels(views.train, surface, 1000, PIXEL)
    assert 800 < sum(len(pixels) for _, pixels in chosen) < 1200
    shares = []
    for pixels_of in (lambda i: chosen[i][1], lambda i: views.train[i].solid.numpy()):
        points = [
            surface.hits(*(each[pixels_of(i)] for each in rays_of(view.camera))).points
            for i, view in enumerate(views.train)
        ]
        height = (np.concatenate(points) - surface.origin) @ surface.axis
        shares.append(float((np.abs(height) < 0.12).mean()))
    assert shares[0] > 1.2 * shares[1]
