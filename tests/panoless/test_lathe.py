"""Surfaces of revolution: rays meet them where they are, outlines give axis and profile, reflections the rest."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.initialize import surfels_on_lathe
from panoless.kernels.cubemap import cubemap_directions
from panoless.kernels.reference.rasterize import rotation_matrices
from panoless.lathe import LEAVING, Lathe, followed, lathe_buffers, mirrored
from panoless.lathe_contours import contour_rays, touches
from panoless.lathe_fit import fit_lathe
from panoless.lathe_inside import searched_inside
from panoless.lathe_photometric import observations, photometric_equations
from panoless.lathe_profile import ProfileSplines, moved, resampled
from panoless.plane_contours import view_contours
from tests.support.mirror_lathe import TILTED, around, funnel, goblet, lathe_views, rays_of
from tests.support.synthetic_dataset import environment_radiance


def ball(radius: float, sides: int = 400) -> Lathe:
    angle = np.linspace(-np.pi / 2, np.pi / 2, sides + 1)
    profile = radius * np.stack([np.cos(angle).clip(0), np.sin(angle)], 1)
    return Lathe(np.array([0.1, -0.2, 0.05]) - 0.0, TILTED, profile, sides)


def environment(resolution: int = 64) -> torch.Tensor:
    directions = cubemap_directions(resolution).double().numpy()
    return torch.from_numpy(environment_radiance(directions).clip(0, 1).transpose(0, 3, 1, 2).copy()).float()


def test_rays_meet_a_sphere_where_they_should() -> None:
    """Distance and normal of every ray against the quadratic of the sphere, to the sagitta of a side."""
    lathe, radius = ball(0.7), 0.7
    origins, directions = rays_of(around(4, 40)[2])
    hits = lathe.hits(origins, directions)
    b = ((origins - lathe.origin) * directions).sum(1)
    under = b**2 - ((origins - lathe.origin) ** 2).sum(1) + radius**2
    clear = np.abs(under) > 1e-3
    np.testing.assert_array_equal(hits.met[clear], under[clear] > 0)
    inner = under > 1e-3
    distance = -b[inner] - np.sqrt(under[inner])
    np.testing.assert_allclose(hits.distance[inner], distance, atol=3e-4)
    points = origins[inner] + distance[:, None] * directions[inner]
    np.testing.assert_allclose(hits.normals[inner], (points - lathe.origin) / radius, atol=2e-3)


def test_two_mirrors_pass_a_ray_on() -> None:
    """Inside a right-angled cone a ray along the axis is mirrored twice and comes back the way it came."""
    cone = Lathe(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([[0.0, 0.0], [1.0, 1.0]]), 1)
    escapes = followed(cone, np.array([[0.5, 0.1, 3.0], [2.0, 0.0, 3.0]]), np.tile([[0.0, 0.0, -1.0]], (2, 1)), 6)
    np.testing.assert_array_equal(escapes.bounces, [2, 0])
    np.testing.assert_allclose(escapes.directions[0], [0, 0, 1], atol=1e-6)
    assert not escapes.directions[1].any()


def test_a_ray_is_followed_as_if_hit_and_mirrored_one_by_one() -> None:
    """In a funnel, until it leaves or six reflections have been."""
    lathe = funnel()
    origins, directions = rays_of(around(4, 60)[3])
    escapes = followed(lathe, origins, directions, 6)
    assert (escapes.bounces == 1).sum() > 50
    assert (escapes.bounces > 1).sum() > 50
    for ray in np.flatnonzero(escapes.first.met):
        start, way, times = origins[ray], directions[ray], 0
        while times < 7 and (hit := lathe.hits(start[None], way[None])).met[0]:
            times += 1
            way = mirrored(way[None], hit.normals)[0]
            way /= np.linalg.norm(way)
            start = hit.points[0] + LEAVING * way
        if escapes.bounces[ray]:
            assert times == escapes.bounces[ray]
            np.testing.assert_allclose(escapes.directions[ray], way, atol=1e-9)
        else:
            assert times == 7
            assert not escapes.directions[ray].any()


def test_surfels_of_a_ball_have_its_normals_and_curvature() -> None:
    """Normals point from the center; both principal curvatures are −1/R, as for outward normals."""
    lathe, radius = ball(0.7), 0.7
    surfels = surfels_on_lathe(lathe, 1500)
    outward = (surfels.means.numpy() - lathe.origin) / radius
    middle = np.abs(outward @ lathe.axis) < 0.95
    normals = rotation_matrices(surfels.quats)[:, :, 2].numpy()
    np.testing.assert_allclose(normals[middle], outward[middle], atol=5e-3)
    curvatures = surfels.curvatures.numpy()[middle]
    np.testing.assert_allclose(curvatures[:, [0, 2]], -1 / radius, rtol=0.02)
    assert np.abs(curvatures[:, 1]).max() == 0
    assert 0.8 < surfels.count / 1500 < 1.25


def test_buffers_cover_what_the_rays_cover() -> None:
    """Alpha is the covered share; where it is one, the depth is that of the hit and normals face the camera."""
    lathe = goblet()
    view = lathe_views(lathe, around(3, 48)).train[1]
    buffers = lathe_buffers(lathe, view.camera)
    np.testing.assert_allclose(buffers.alpha.numpy(), view.mask.numpy(), atol=1e-6)
    solid = buffers.alpha == 1
    rays = view.rays_camera
    assert ((buffers.raster_normals_camera * rays).sum(0)[solid] < 0).all()
    lengths = buffers.raster_normals_camera.norm(dim=0)[solid]
    np.testing.assert_allclose(lengths.numpy(), 1, atol=1e-5)


@pytest.fixture(scope="module")
def goblet_fit():
    return fit_lathe(lathe_views(goblet(), around(12)))


def test_outlines_give_axis_and_profile(goblet_fit) -> None:
    """A tilted axis to a tenth of a degree and the outside to a tenth of a pixel (0.02 units), from masks alone."""
    lathe, truth = goblet_fit.lathe, goblet()
    assert np.degrees(np.arccos(min(abs(lathe.axis @ truth.axis), 1.0))) < 0.1
    away = lathe.origin - truth.origin
    assert np.linalg.norm(away - (away @ truth.axis) * truth.axis) < 0.002
    assert float(np.median(goblet_fit.median_px)) < 0.1
    assert float(np.median(goblet_fit.iou)) > 0.99
    shift = (lathe.origin - truth.origin) @ truth.axis
    sign = np.sign(lathe.axis @ truth.axis)
    heights = sign * lathe.profile[1 : lathe.rim + 1, 1] + shift
    inner = (heights > -0.6) & (heights < 0.5)
    expected = 0.5 + 0.12 * np.cos(4 * heights)
    assert float(np.median(np.abs(lathe.profile[1 : lathe.rim + 1, 0] - expected)[inner])) < 0.002


def test_a_body_that_is_not_round_is_refused() -> None:
    """A square pillar: no axis makes its outlines agree to half a pixel, or overlap by 98 %."""
    from tests.support.mirror_lathe import pillar_views

    found = fit_lathe(pillar_views(around(16)))
    assert found is None or float(np.median(found.median_px)) > 0.5 or float(np.median(found.iou)) < 0.98


def test_splines_shift_the_profile_along_its_normals() -> None:
    """Equal coefficients move every vertex away from corners by that much; the sum of the four values is one."""
    lathe = resampled(goblet(), 0.02)
    splines = ProfileSplines.of(lathe, 0.05)
    step = np.zeros(4 + splines.count)
    step[4:] = 0.004
    after = moved(lathe, splines, step)
    middle = slice(3, lathe.rim - 2)
    shift = np.linalg.norm(after.profile - lathe.profile, axis=1)[middle]
    np.testing.assert_allclose(shift, 0.004, rtol=0.01)
    values, _ = splines.values(np.arange(1, 20), np.full(19, 0.3))
    np.testing.assert_allclose(values.sum(1), 1)


def test_equations_are_the_derivatives_of_the_residuals() -> None:
    """Jᵀ r predicts the change of Σ e²/2 under small moves of axis and profile, found by tracing the moved lathe."""
    views = lathe_views(goblet(), around(6, 64))
    lathe = resampled(replace(goblet(), origin=goblet().origin + 0.01), 0.02)
    splines, seen, scene = ProfileSplines.of(lathe, 0.1), observations(views, lathe, 20_000), environment(256)
    gradient, _ = photometric_equations(seen, lathe, splines, scene, 1e6, 0.0)
    generator = np.random.default_rng(1)
    for _ in range(3):
        direction = np.concatenate([generator.normal(size=4), generator.normal(size=splines.count) * 0.3])
        direction[4 + splines.counts[0] :] = 0
        direction[4 : 4 + 3] = direction[4 + splines.counts[0] - 3 : 4 + splines.counts[0]] = 0
        costs = [_cost(seen, moved(lathe, splines, sign * 1e-4 * direction), scene) for sign in (-1, 1)]
        assert (costs[1] - costs[0]) / 2e-4 == pytest.approx(float(gradient @ direction), rel=0.1)


def _cost(seen, lathe, scene) -> float:
    from panoless.kernels.cubemap import sample_cubemap
    from panoless.lathe import mirrored
    from panoless.lathe_photometric import RADIANCE_SIGMA

    origins = seen.hits.points - 3 * seen.directions
    hits = lathe.hits(origins, seen.directions)
    unit = seen.directions / np.linalg.norm(seen.directions, axis=1, keepdims=True)
    error = sample_cubemap(scene, torch.from_numpy(mirrored(unit, hits.normals)).float()) - seen.radiance
    cosine = np.abs((unit * seen.hits.normals).sum(1)) > 0.05
    return float(error[torch.from_numpy(cosine & hits.met)].double().square().sum()) / 2 / RADIANCE_SIGMA**2


def test_a_search_finds_the_funnel_inside() -> None:
    """A cone 0.3 deep under a known environment: the cheapest inside keeps near it, a flat lid does not."""
    truth = funnel(0.3)
    views = lathe_views(truth, around(12))
    closed = resampled(goblet(), 0.02)
    found = searched_inside(views, closed, environment(), 0.02)
    inner = found.profile[found.rim :]
    seen = inner[inner[:, 0] > 0.1]
    radius = goblet().profile[-2, 0]
    expected = 0.6 - 0.3 * (1 - seen[:, 0] / radius)
    assert float(np.median(np.abs(seen[:, 1] - expected))) < 0.03


def test_a_search_rises_above_the_end_of_the_outlines() -> None:
    """The wall rises by 0.04 within the rim before it goes down: the cheapest inside does so, to a pixel (0.02)."""
    body = goblet()
    radius = body.profile[-2, 0]
    way = np.linspace(0, 1, 30)
    bead = np.stack([radius - 0.12 * way, 0.6 + 0.04 * np.sin(np.pi * way)], 1)
    cone = np.linspace(bead[-1], [0.0, 0.35], 60)
    truth = replace(body, profile=np.concatenate([body.profile[: body.rim], bead, cone[1:]]))
    found = searched_inside(lathe_views(truth, around(16)), resampled(body, 0.02), environment(), 0.02)
    inner = found.profile[found.rim :]
    assert 0.62 < inner[:, 1].max() < 0.66
    seen = inner[inner[:, 0] > 0.1][::-1]
    expected = np.interp(seen[:, 0], truth.profile[: body.rim - 1 : -1, 0], truth.profile[: body.rim - 1 : -1, 1])
    assert float(np.median(np.abs(seen[:, 1] - expected))) < 0.02


def test_closed_contours_touch_the_true_body() -> None:
    """Distances of the contours from the lathe that made them are a small part of a pixel."""
    views = lathe_views(goblet(), around(6))
    found = touches(contour_rays(views), goblet(), 0.02)
    assert len(found.pixels) == len(view_contours(views).view)
    assert float(np.median(np.abs(found.pixels))) < 0.15
