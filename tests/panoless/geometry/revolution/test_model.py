"""Surfaces of revolution: rays meet them where they are, silhouettes give axis and profile, reflections the rest."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.rays import reflect
from panoless.capture.silhouettes import mask_contours
from panoless.geometry.revolution.fit import propose_revolution
from panoless.geometry.revolution.interior import search_interior
from panoless.geometry.revolution.model import RAY_EPSILON, SurfaceOfRevolution, revolution_buffers, trace_reflections
from panoless.geometry.revolution.photometric import RADIANCE_SIGMA, Photometry, photometric_equations
from panoless.geometry.revolution.pixels import CENTER, PixelBundles, evenly
from panoless.geometry.revolution.profile import ProfileSplines, apply_step, resample_profile
from panoless.geometry.revolution.silhouette import (
    EXTENTS,
    axis_starts,
    contour_rays,
    outer_surface,
    silhouette_residuals,
)
from panoless.kernels.cubemap import cubemap_directions
from tests.support.mirror_revolution import TILTED, around, funnel, goblet, pillar_views, rays_of, revolution_views
from tests.support.synthetic_dataset import environment_radiance


def ball(radius: float, sides: int = 400) -> SurfaceOfRevolution:
    angle = np.linspace(-np.pi / 2, np.pi / 2, sides + 1)
    profile = radius * np.stack([np.cos(angle).clip(0), np.sin(angle)], 1)
    return SurfaceOfRevolution(np.array([0.1, -0.2, 0.05]) - 0.0, TILTED, profile, sides)


def environment(resolution: int = 64) -> torch.Tensor:
    directions = cubemap_directions(resolution).double().numpy()
    return torch.from_numpy(environment_radiance(directions).clip(0, 1).transpose(0, 3, 1, 2).copy()).float()


def test_rays_meet_a_sphere_where_they_should() -> None:
    """Distance and normal of every ray against the quadratic of the sphere, to the sagitta of a side."""
    surface, radius = ball(0.7), 0.7
    origins, directions = rays_of(around(4, 40)[2])
    hits = surface.hits(origins, directions)
    b = ((origins - surface.origin) * directions).sum(1)
    under = b**2 - ((origins - surface.origin) ** 2).sum(1) + radius**2
    clear = np.abs(under) > 1e-3
    np.testing.assert_array_equal(hits.met[clear], under[clear] > 0)
    inner = under > 1e-3
    distance = -b[inner] - np.sqrt(under[inner])
    np.testing.assert_allclose(hits.distance[inner], distance, atol=3e-4)
    points = origins[inner] + distance[:, None] * directions[inner]
    np.testing.assert_allclose(hits.normals[inner], (points - surface.origin) / radius, atol=2e-3)


def test_two_mirrors_pass_a_ray_on() -> None:
    """Inside a right-angled cone a ray along the axis is mirrored twice and comes back the way it came."""
    cone = SurfaceOfRevolution(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([[0.0, 0.0], [1.0, 1.0]]), 1)
    escapes = trace_reflections(
        cone, np.array([[0.5, 0.1, 3.0], [2.0, 0.0, 3.0]]), np.tile([[0.0, 0.0, -1.0]], (2, 1)), max_bounces=6
    )
    np.testing.assert_array_equal(escapes.bounces, [2, 0])
    np.testing.assert_allclose(escapes.directions[0], [0, 0, 1], atol=1e-6)
    assert not escapes.directions[1].any()


def test_a_ray_is_followed_as_if_hit_and_mirrored_one_by_one() -> None:
    """In a funnel, until it leaves or six reflections have been."""
    surface = funnel()
    origins, directions = rays_of(around(4, 60)[3])
    escapes = trace_reflections(surface, origins, directions, max_bounces=6)
    assert (escapes.bounces == 1).sum() > 50
    assert (escapes.bounces > 1).sum() > 50
    for ray in np.flatnonzero(escapes.first.met):
        start, way, times = origins[ray], directions[ray], 0
        while times < 7 and (hit := surface.hits(start[None], way[None])).met[0]:
            times += 1
            way = reflect(way[None], hit.normals)[0]
            way /= np.linalg.norm(way)
            start = hit.points[0] + RAY_EPSILON * way
        if escapes.bounces[ray]:
            assert times == escapes.bounces[ray]
            np.testing.assert_allclose(escapes.directions[ray], way, atol=1e-9)
        else:
            assert times == 7
            assert not escapes.directions[ray].any()


def test_without_an_occlusion_test_the_last_direction_stands() -> None:
    """After one and after two reflections, whatever is met then; where nothing is met, as with the test."""
    surface = funnel()
    for count, camera, least in ((1, around(4, 60)[3], 100), (2, around(4, 60)[2], 10)):
        origins, directions = rays_of(camera)
        tested = trace_reflections(surface, origins, directions, max_bounces=count)
        free = trace_reflections(surface, origins, directions, max_bounces=count, occlusion_test=False)
        left = tested.bounces > 0
        np.testing.assert_array_equal(free.bounces[left], tested.bounces[left])
        np.testing.assert_allclose(free.directions[left], tested.directions[left], atol=1e-9)
        again = free.first.met & ~left
        assert again.sum() > least
        np.testing.assert_array_equal(free.bounces[again], count)
        np.testing.assert_allclose(np.linalg.norm(free.directions[again], axis=1), 1)


def test_a_body_turned_over_is_where_it_was() -> None:
    """Its silhouette is the same, its lid the former base, and turned over again it is the body."""
    body = goblet()
    over = body.turned_over()
    np.testing.assert_allclose(over.axis, -body.axis)
    camera = around(3, 48)[1]
    first, second = (each.hits(*rays_of(camera)) for each in (body, over))
    np.testing.assert_array_equal(first.met, second.met)
    np.testing.assert_allclose(first.points, second.points, atol=1e-9)
    np.testing.assert_allclose(over.turned_over().profile, body.profile, atol=1e-12)


def test_buffers_cover_what_the_rays_cover() -> None:
    """Alpha is the covered share; where it is one, the depth is that of the hit and normals face the camera."""
    surface = goblet()
    view = revolution_views(surface, around(3, 48)).train[1]
    buffers = revolution_buffers(surface, view.camera)
    np.testing.assert_allclose(buffers.alpha.numpy(), view.mask.numpy(), atol=1e-6)
    solid = buffers.alpha == 1
    rays = view.rays_camera
    assert ((buffers.normals_camera * rays).sum(0)[solid] < 0).all()
    lengths = buffers.normals_camera.norm(dim=0)[solid]
    np.testing.assert_allclose(lengths.numpy(), 1, atol=1e-5)


@pytest.fixture(scope="module")
def goblet_fit():
    return propose_revolution(revolution_views(goblet(), around(12)))


def test_silhouettes_give_axis_and_profile(goblet_fit) -> None:
    """A tilted axis to a tenth of a degree, toward the end that cameras look into, and the outside to a tenth of a
    pixel (0.02 units), from masks alone.
    """
    surface, truth = goblet_fit.surface, goblet()
    assert np.degrees(np.arccos(min(surface.axis @ truth.axis, 1.0))) < 0.1
    away = surface.origin - truth.origin
    assert np.linalg.norm(away - (away @ truth.axis) * truth.axis) < 0.002
    assert float(np.median(goblet_fit.median_px)) < 0.1
    assert float(np.median(goblet_fit.iou)) > 0.99
    shift = (surface.origin - truth.origin) @ truth.axis
    heights = surface.profile[1 : surface.lip + 1, 1] + shift
    inner = (heights > -0.6) & (heights < 0.5)
    expected = 0.5 + 0.12 * np.cos(4 * heights)
    assert float(np.median(np.abs(surface.profile[1 : surface.lip + 1, 0] - expected)[inner])) < 0.002


def test_a_body_that_is_not_round_is_refused() -> None:
    """A square pillar: no axis makes its silhouettes agree to half a pixel, or overlap by 98 %."""
    from tests.support.mirror_revolution import pillar_views

    found = propose_revolution(pillar_views(around(16)))
    assert found is None or float(np.median(found.median_px)) > 0.5 or float(np.median(found.iou)) < 0.98


def test_splines_shift_the_profile_along_its_normals() -> None:
    """Equal coefficients move every vertex away from corners by that much; the sum of the four values is one."""
    surface = resample_profile(goblet(), 0.02)
    splines = ProfileSplines.of(surface, 0.05)
    step = np.zeros(4 + splines.count)
    step[4:] = 0.004
    after = apply_step(surface, splines, step)
    middle = slice(3, surface.lip - 2)
    shift = np.linalg.norm(after.profile - surface.profile, axis=1)[middle]
    np.testing.assert_allclose(shift, 0.004, rtol=0.01)
    values, _ = splines.values(np.arange(1, 20), np.full(19, 0.3))
    np.testing.assert_allclose(values.sum(1), 1)


def test_equations_are_the_derivatives_of_the_residuals() -> None:
    """Jᵀ r predicts the change of Σ e²/2 under small moves of axis and profile, found by tracing the moved surface."""
    views = revolution_views(goblet(), around(6, 64))
    surface = resample_profile(replace(goblet(), origin=goblet().origin + 0.01), 0.02)
    splines, scene = ProfileSplines.of(surface, 0.1), environment(256)
    seen = PixelBundles.of(evenly(views, 20_000), CENTER)
    found = Photometry.of(seen, surface, scene)
    gradient, _ = photometric_equations(seen, found, surface, splines, scene, 1e6, 0.0)
    generator = np.random.default_rng(1)
    for _ in range(3):
        direction = np.concatenate([generator.normal(size=4), generator.normal(size=splines.count) * 0.3])
        direction[4 + splines.counts[0] :] = 0
        direction[4 : 4 + 3] = direction[4 + splines.counts[0] - 3 : 4 + splines.counts[0]] = 0
        costs = [_cost(seen, found, apply_step(surface, splines, sign * 1e-4 * direction), scene) for sign in (-1, 1)]
        assert (costs[1] - costs[0]) / 2e-4 == pytest.approx(float(gradient @ direction), rel=0.1)


def _cost(seen: PixelBundles, found: Photometry, surface: SurfaceOfRevolution, scene: torch.Tensor) -> float:
    """Over pixels that count in the equations."""
    unit = seen.directions / np.linalg.norm(seen.directions, axis=1, keepdims=True)
    counted = found.whole & (np.abs((unit * found.paths.first.normals).sum(1)) > 0.05)
    residual = Photometry.of(seen, surface, scene).residual[counted]
    return float((residual**2).sum()) / 2 / RADIANCE_SIGMA**2


def test_a_search_finds_the_funnel_inside() -> None:
    """A cone 0.3 deep under a known environment: the cheapest inside keeps near it, a flat lid does not."""
    truth = funnel(0.3)
    views = revolution_views(truth, around(12))
    closed = resample_profile(goblet(), 0.02)
    found = search_interior(views, closed, environment(), 0.02)
    inner = found.profile[found.lip :]
    seen = inner[inner[:, 0] > 0.1]
    radius = goblet().profile[-2, 0]
    expected = 0.6 - 0.3 * (1 - seen[:, 0] / radius)
    assert float(np.median(np.abs(seen[:, 1] - expected))) < 0.03


def test_a_search_rises_above_the_end_of_the_silhouettes() -> None:
    """The wall rises by 0.04 within the lip before it goes down: the cheapest inside does so, to a pixel (0.02)."""
    body = goblet()
    radius = body.profile[-2, 0]
    way = np.linspace(0, 1, 30)
    bead = np.stack([radius - 0.12 * way, 0.6 + 0.04 * np.sin(np.pi * way)], 1)
    cone = np.linspace(bead[-1], [0.0, 0.35], 60)
    truth = replace(body, profile=np.concatenate([body.profile[: body.lip], bead, cone[1:]]))
    found = search_interior(revolution_views(truth, around(16)), resample_profile(body, 0.02), environment(), 0.02)
    inner = found.profile[found.lip :]
    assert 0.62 < inner[:, 1].max() < 0.66
    seen = inner[inner[:, 0] > 0.1][::-1]
    expected = np.interp(seen[:, 0], truth.profile[: body.lip - 1 : -1, 0], truth.profile[: body.lip - 1 : -1, 1])
    assert float(np.median(np.abs(seen[:, 1] - expected))) < 0.02


def test_silhouettes_go_on_beyond_a_thin_stem() -> None:
    """A cup on a stem that is three pixels thick, and a foot, around an axis that is turned by 6°."""
    height = np.linspace(-0.8, 0.8, 300)
    cup = 0.45 * np.sqrt(np.clip(1 - ((height - 0.45) / 0.4) ** 2, 0, 1))
    foot = 0.4 * np.exp(-((height + 0.8) ** 2) / 0.02)
    outer = np.stack([np.maximum(np.maximum(cup, foot), 0.03), height], 1)
    body = replace(goblet(), profile=np.concatenate([[[0.0, -0.8]], outer, [[0.0, 0.8]]]), lip=len(outer))
    rays = contour_rays(revolution_views(body, around(12)))
    tilted = body.axis + np.tan(np.radians(6)) * body.frame[0]
    start = replace(body, axis=tilted / np.linalg.norm(tilted))
    found = [outer_surface(rays, start, 0.04, extent) for extent in range(EXTENTS)]
    reach = [np.ptp(each.profile[:, 1]) for each in found if each is not None]
    assert len(reach) == EXTENTS
    assert reach[0] < 1.2
    assert reach[-1] > 1.5


def test_closed_contours_touch_the_true_body() -> None:
    """Distances of the contours from the surface that made them are a small part of a pixel."""
    views = revolution_views(goblet(), around(6))
    found = silhouette_residuals(contour_rays(views), goblet(), 0.02)
    assert len(found.pixels) == len(mask_contours(views).view)
    assert float(np.median(np.abs(found.pixels))) < 0.15


def test_pixels_of_one_half_propose_an_axis_as_whole_ones_do() -> None:
    views = pillar_views(around(4, 24))
    halves = replace(views, train=tuple(replace(view, mask=view.mask / 2) for view in views.train))
    for start, other in zip(axis_starts(views), axis_starts(halves), strict=True):
        np.testing.assert_array_equal(start.axis, other.axis)
