"""First surfels: the hull of a sphere is nearly that sphere, with its normals and its curvature."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.first_surface.options import FirstSurfaceOptions
from panoless.first_surface.visual_hull import HULL_HALF_SIDE, carve_hull
from panoless.splats.kernels.reference.rasterize import rotation_matrices
from panoless.splats.model import Surfels
from panoless.splats.options import SurfelConfig
from panoless.splats.placement import (
    LEAST_RADIUS_PX,
    OVERLAP,
    SAG_PX,
    _radii,
    _reach,
    initial_surfels,
)

CONFIG, FIRST = SurfelConfig(count=800), FirstSurfaceOptions(hull_resolution=48)


def config_of(count: int, seed: int) -> FitConfig:
    return replace(FitConfig(), splats=replace(FitConfig().splats, surfels=SurfelConfig(count=count)), seed=seed)


VOXEL = 2 * HULL_HALF_SIDE / 47


@pytest.fixture(scope="module")
def hull(views: Views) -> Surfels:
    return initial_surfels(views, CONFIG, 0, FIRST)


def radial(surfels: Surfels, views: Views) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Unit directions from the sphere's center and distances from it, with its radius, in the normalized frame."""
    frame = views.object_frame
    offsets = surfels.means - torch.from_numpy(-frame.center / frame.radius).float()
    return torch.nn.functional.normalize(offsets, dim=1), offsets.norm(dim=1), 1 / frame.radius


def facing_the_cameras(surfels: Surfels, views: Views) -> torch.Tensor:
    """Where the arc of cameras around +X bounds the hull from both sides."""
    return radial(surfels, views)[0][:, 0] > 0.5


def test_surfels_lie_on_the_sphere(hull: Surfels, views: Views) -> None:
    _, distances, radius = radial(hull, views)
    front = facing_the_cameras(hull, views)
    assert hull.count == CONFIG.count
    assert front.float().mean() > 0.2
    error = (distances - radius).abs()[front]
    # A mask pixel is 0.06 units here, more than a voxel (0.047).
    assert float(error.median()) < VOXEL
    assert float(error.quantile(0.95)) < 2 * VOXEL


def test_normals_point_outward(hull: Surfels, views: Views) -> None:
    directions, _, _ = radial(hull, views)
    normals = rotation_matrices(hull.quats)[:, :, 2]
    front = facing_the_cameras(hull, views)
    angles = torch.rad2deg(torch.acos((directions * normals).sum(1).clamp(-1, 1)))[front]
    assert float(angles.median()) < 5.0
    assert float(angles.quantile(0.95)) < 15.0


def test_curvature_is_that_of_the_sphere(hull: Surfels, views: Views) -> None:
    """The shape operator of a sphere with outward normals is −1/r in every direction."""
    front = facing_the_cameras(hull, views)
    _, _, radius = radial(hull, views)
    a, b, c = hull.curvatures[front].median(0).values.tolist()
    assert a == pytest.approx(-1 / radius, rel=0.25)
    assert c == pytest.approx(-1 / radius, rel=0.25)
    assert b == pytest.approx(0.0, abs=0.1 / radius)


def test_the_normal_field_bends_as_the_sphere_does(hull: Surfels, views: Views) -> None:
    """n(u, v) at an offset of a fifth of the radius is nearer to the sphere's normal there than n₀ is."""
    front = facing_the_cameras(hull, views)
    surfels, (_, _, radius) = hull.select(front), radial(hull, views)
    frames = rotation_matrices(surfels.quats)
    a, b, c = surfels.curvatures.unbind(1)
    for du, dv in ((0.2, 0.0), (0.0, -0.2), (0.15, 0.15)):
        u, v = du * radius, dv * radius
        own = frames[:, :, 2]
        bent = own - (a * u + b * v)[:, None] * frames[:, :, 0] - (b * u + c * v)[:, None] * frames[:, :, 1]
        truth = own + (u * frames[:, :, 0] + v * frames[:, :, 1]) / radius
        cosine, unbent = (
            torch.nn.functional.cosine_similarity(normal, truth, dim=1).clamp(-1, 1).acos() for normal in (bent, own)
        )
        assert float(cosine.median()) < 0.35 * float(unbent.median())


def test_surfels_cover_the_visible_sphere(hull: Surfels, views: Views) -> None:
    """No direction toward the cameras is further than three surfel radii from a surfel."""
    directions, distances, _ = radial(hull, views)
    rng = np.random.default_rng(0)
    probes = torch.from_numpy(rng.normal(size=(300, 3))).float()
    probes = torch.nn.functional.normalize(probes, dim=1)
    probes = probes[probes[:, 0] > 0.5]
    gaps = torch.cdist(probes, directions).amin(1) * float(distances.mean())
    assert float(gaps.max()) < 3 * float(hull.scales.mean())


@pytest.mark.slow
def test_the_same_seed_gives_the_same_surfels(views: Views) -> None:
    for config in (replace(CONFIG, count=50), SurfelConfig(initial="random", count=50)):
        first, again, other = (initial_surfels(views, config, seed) for seed in (3, 3, 4))
        for name, value in first.named().items():
            assert torch.equal(value, again.named()[name])
        assert not torch.equal(first.means, other.means)


def test_random_surfels_fill_the_cube(views: Views) -> None:
    surfels = initial_surfels(views, SurfelConfig(initial="random", count=2000), seed=0)
    assert float(surfels.means.abs().max()) <= 1.0
    # Uniform in [−1, 1]: mean 0 ± 0.013, variance 1/3 ± 0.007.
    torch.testing.assert_close(surfels.means.mean(0), torch.zeros(3), rtol=0, atol=0.06)
    torch.testing.assert_close(surfels.means.var(0), torch.full((3,), 1 / 3), rtol=0, atol=0.03)
    normals = rotation_matrices(surfels.quats)[:, :, 2]
    torch.testing.assert_close(normals.mean(0), torch.zeros(3), rtol=0, atol=0.06)
    assert float(surfels.opacities.min()) == pytest.approx(0.1)


def test_select_and_named_keep_rows_together(hull: Surfels) -> None:
    index = torch.tensor([5, 1])
    chosen = hull.select(index)
    assert list(chosen.named()) == list(hull.named())
    for name, value in chosen.named().items():
        assert torch.equal(value, hull.named()[name][index])


@pytest.mark.parametrize("bend", [2.0, 200.0])
def test_a_disk_leaves_a_curved_surface_by_a_pixel_at_twice_its_radius(bend: float) -> None:
    """A parabola of curvature κ falls by κ (2 s)²/2 there; radii below a pixel and a half are not made."""
    pixel = 0.005
    radius = float(_reach(np.array([[bend, bend]]), pixel)[0, 0])
    assert bend * (2 * radius) ** 2 / 2 == pytest.approx(pixel) or radius == pytest.approx(LEAST_RADIUS_PX * pixel)
    assert radius >= LEAST_RADIUS_PX * pixel


def test_strong_curvature_gets_smaller_surfels_and_more_of_them_across_it_only() -> None:
    """Half of an area is flat, half a cylinder: the radius along its axis is that of the flat half."""
    pixel, bend, count = 0.005, 20.0, 4000
    areas = np.full(100, 0.01)
    bends = np.zeros((100, 2))
    bends[50:, 1] = bend
    radii, largest = _radii(areas, bends, pixel, count)
    limit = np.sqrt(pixel / (2 * bend))
    np.testing.assert_allclose(radii[:50], largest)
    np.testing.assert_allclose(radii[50:, 0], largest)
    np.testing.assert_allclose(radii[50:, 1], limit)
    assert limit < largest
    density = areas / radii.prod(1)
    assert density.sum() * OVERLAP**2 == pytest.approx(count)
    assert density[-1] / density[0] == pytest.approx(largest / limit)


def test_no_surfel_reaches_far_out_of_the_hull(views: Views) -> None:
    """Disks at twice the radius stay within a pixel, or are as small as surfels start."""
    surfels, carved = (
        initial_surfels(views, CONFIG, 0, FIRST),
        carve_hull(views, FIRST.hull_resolution, FIRST.hull_votes),
    )
    frames, radii = rotation_matrices(surfels.quats).double().numpy(), surfels.scales.double().numpy()
    points = surfels.means.double().numpy()
    for axis in (0, 1):
        tips = 2 * radii[:, axis, None] * frames[:, :, axis]
        outside = np.maximum(carved.at(points + tips), carved.at(points - tips)) / carved.pixel
        assert ((outside < SAG_PX + 0.01) | (radii[:, axis] < 1.01 * LEAST_RADIUS_PX * carved.pixel)).mean() > 0.99
