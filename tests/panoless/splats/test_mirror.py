"""What is trusted: surfels that agree with what others saw, and a map as fine as held-out views can determine."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.rays import pixel_rays, reflect
from panoless.capture.views import Views
from panoless.environment.rays import Rays, normalize_confidence
from panoless.environment.resolution import prediction_error
from panoless.environment.solve import solve_environment
from panoless.geometry.base import observe_views
from panoless.geometry.plane.kind import PlaneMirror
from panoless.geometry.revolution.kind import RevolutionMirror
from panoless.geometry.revolution.model import trace_reflections
from panoless.kernels.cubemap import cubemap_directions, sample_cubemap
from panoless.splats.mirror import PRIOR_TRUST, SurfelMirror, finest_resolution, surfel_trust
from panoless.splats.model import Surfels
from tests.support.mirror_plane import RECTANGLE, arc, plane_of, reflecting_views
from tests.support.mirror_revolution import around, funnel, revolution_views
from tests.support.mirror_sphere import clipped_environment, sphere_surfels, tiny_config

CONFIG = tiny_config()
TURN_RAD = np.radians(20)


def mirror(surfels: Surfels) -> SurfelMirror:
    return SurfelMirror.of(surfels, CONFIG)


def directions_of(surfels: Surfels, views: Views) -> Float[Tensor, "K 3"]:
    """Unit directions of surfels from the sphere's center."""
    center = torch.from_numpy(-views.object_frame.center / views.object_frame.radius).float()
    return torch.nn.functional.normalize(surfels.means - center, dim=1)


def exact_sphere(views: Views, count: int = 1200) -> Surfels:
    frame = views.object_frame
    surfels = sphere_surfels(count, 1 / frame.radius)
    return replace(surfels, means=surfels.means - torch.from_numpy(frame.center / frame.radius).float())


@pytest.fixture(scope="module")
def right(views: Views) -> Surfels:
    return exact_sphere(views)


@pytest.fixture(scope="module")
def patch(right: Surfels, views: Views) -> Tensor:
    """Surfels around one direction that the cameras see, a tenth of what they see."""
    return directions_of(right, views) @ torch.tensor([0.8, 0.6, 0.0]) > 0.92


@pytest.fixture(scope="module")
def partly_wrong(right: Surfels, patch: Tensor) -> Surfels:
    """The normals of the patch turned by 20° about tangent_u: quats times (cos 10°, sin 10°, 0, 0)."""
    w, x, y, z = right.quats.unbind(1)
    cos, sin = np.cos(TURN_RAD / 2), np.sin(TURN_RAD / 2)
    turned = torch.stack([w * cos - x * sin, x * cos + w * sin, y * cos + z * sin, z * cos - y * sin], 1)
    return replace(right, quats=torch.where(patch[:, None], turned, right.quats))


@pytest.fixture(scope="module")
def truth() -> Float[Tensor, "6 3 L L"]:
    return clipped_environment(cubemap_directions(64)).permute(0, 3, 1, 2).contiguous()


def test_surfels_with_wrong_normals_are_not_trusted(
    views: Views, right: Surfels, partly_wrong: Surfels, patch: Tensor, truth: Tensor
) -> None:
    """By a map that is right, and by one that all surfels together made."""
    with torch.no_grad():
        own = solve_environment(list(observe_views(views, mirror(partly_wrong), 10**6)), 24)
        seen = surfel_trust(views, mirror(right), truth) > 0.8
        assert (seen & patch).sum() > 20
        assert (seen & ~patch).sum() > 200
        for environment, least_gap in ((truth, 0.5), (own, 0.2)):
            trust = surfel_trust(views, mirror(partly_wrong), environment)
            assert float(trust[seen & patch].median()) < float(trust[seen & ~patch].median()) - least_gap


def test_trust_is_a_share_and_what_is_not_seen_has_that_of_the_start(
    views: Views, right: Surfels, truth: Tensor
) -> None:
    """The first ten surfels stand behind every camera."""
    hidden = replace(right, means=torch.cat([right.means[:10] + torch.tensor([50.0, 0, 0]), right.means[10:]]))
    trust = surfel_trust(views, mirror(hidden), truth)
    assert 0 <= float(trust.min()) <= float(trust.max()) <= 1
    torch.testing.assert_close(trust[:10], torch.full((10,), PRIOR_TRUST))


def test_a_map_solved_with_trust_is_nearer_to_the_truth(
    views: Views, right: Surfels, partly_wrong: Surfels, truth: Tensor
) -> None:
    """Where the exact sphere reflects to, against the environment itself."""
    with torch.no_grad():
        plain = solve_environment(list(observe_views(views, mirror(partly_wrong), 10**6)), 24)
        trusted, rays = mirror(partly_wrong).solve_map(views, CONFIG)
        where = torch.cat([batch.directions for batch in observe_views(views, mirror(right), 10**6)])
        expected = clipped_environment(where)
        errors = [float((sample_cubemap(m, where) - expected).square().mean()) for m in (plain, trusted)]
    assert all(batch.trust is not None and batch.trust.min() >= 0 and batch.trust.max() <= 1 for batch in rays)
    assert errors[1] < 0.8 * errors[0]


def test_rays_of_a_plane_point_where_it_mirrors() -> None:
    """Radiance is that of the environment in the ray's own direction, and no ray needs a trust."""
    plane = plane_of(RECTANGLE)
    rays = list(observe_views(reflecting_views(plane, arc(4, size=48)), PlaneMirror(plane), 10**6))
    for batch in rays:
        assert len(batch.directions) > 100
        assert batch.trust is None
        torch.testing.assert_close(batch.radiance, clipped_environment(batch.directions), rtol=0, atol=1e-4)


def test_a_limit_thins_the_rays_and_none_are_no_error(views: Views, right: Surfels) -> None:
    everything, fewer = (
        sum(len(batch.directions) for batch in observe_views(views, mirror(right), most)) for most in (10**6, 300)
    )
    assert everything > 1000
    assert 0.5 * 300 < fewer <= 300 + len(views.train)
    nothing = replace(views, train=tuple(replace(view, solid=view.solid[:0]) for view in views.train))
    assert all(len(batch.directions) == 0 for batch in observe_views(nothing, mirror(right), 300))


def rays_of(count: int, batches: int = 10) -> list[Rays]:
    """Rays in a cone of 25° that see stripes of 8°, drawn at random."""
    generator = torch.Generator().manual_seed(0)
    result = []
    for _ in range(batches):
        across = torch.rand(count, 2, generator=generator) * 0.8 - 0.4
        directions = torch.nn.functional.normalize(torch.cat([torch.ones(count, 1), across], 1), dim=1)
        stripes = 0.5 + 0.4 * torch.sin(across * (2 * np.pi / np.radians(8)))
        result.append(Rays(directions, stripes[:, [0, 1, 0]]))
    return result


def test_few_rays_take_a_coarser_map_than_many() -> None:
    chosen = []
    for count in (40, 10_000):
        rays = rays_of(count)
        chosen.append(finest_resolution(rays, solve_environment(rays, 64)))
    assert chosen[0] < chosen[1]


def test_one_view_cannot_be_held_out() -> None:
    rays = rays_of(50, batches=1)
    assert finest_resolution(rays, solve_environment(rays, 64)) == 64


def test_the_prediction_error_is_that_of_the_rays_that_are_trusted() -> None:
    """0 for the map that rays were taken from; e²/(e² + s²) for one off by e; distrusted rays do not count."""
    environment = torch.rand(6, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=1)
    exact = Rays(directions, sample_cubemap(environment, directions))
    assert prediction_error([exact], environment) == pytest.approx(0, abs=1e-9)
    off = replace(exact, radiance=exact.radiance + torch.tensor([0.0, 0.3, 0.4]))
    share = 0.25 / (0.25 + 0.1**2)
    assert prediction_error([off], environment) == pytest.approx(share, rel=1e-5)
    assert prediction_error([exact, off], environment) == pytest.approx(share / 2, rel=1e-5)
    assert prediction_error([exact, replace(off, trust=torch.zeros(500))], environment) == pytest.approx(0, abs=1e-9)
    nothing = Rays(directions[:0], directions[:0])
    assert prediction_error([nothing], environment) == prediction_error([], environment) == 1


def test_a_map_does_not_depend_on_how_far_all_rays_are_trusted_alike() -> None:
    """A thousandth of the trust gives the same map, though gaps and pulls count in rays."""
    truth = clipped_environment(cubemap_directions(16)).permute(0, 3, 1, 2).contiguous()
    directions = torch.nn.functional.normalize(torch.randn(4000, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    trust = 0.5 + 0.5 * torch.rand(4000, generator=torch.Generator().manual_seed(2))
    rays = Rays(directions, sample_cubemap(truth, directions), trust)
    faint = replace(rays, trust=trust / 1000)
    usual, same = (solve_environment([each], 16) for each in (rays, faint))
    torch.testing.assert_close(usual, same)
    assert float(normalize_confidence([faint])[0].initial_weight().mean()) == pytest.approx(1.0, rel=1e-5)


def test_what_mirrors_itself_votes_only_if_nothing_is_traced() -> None:
    """In a funnel: traced, the pixels whose mirrored ray leaves; else all that meet it, in its mirrored direction."""
    views = revolution_views(funnel(), around(4)[2:])
    traced, blind = ([*observe_views(views, RevolutionMirror(funnel(), test), 10**6)] for test in (True, False))
    for view, some, every in zip(views.train, traced, blind, strict=True):
        origins, directions_local = pixel_rays(view.camera, view.solid.numpy())
        normals = funnel().hits(origins, directions_local).normals
        expected = torch.nn.functional.normalize(torch.from_numpy(reflect(directions_local, normals)), dim=1)
        torch.testing.assert_close(every.directions.double(), expected, atol=1e-6, rtol=0)
        assert len(some.directions) < len(every.directions) == len(view.solid)
        leaves = torch.from_numpy(trace_reflections(funnel(), origins, directions_local).bounces == 1)
        torch.testing.assert_close(some.directions, every.directions[leaves], atol=1e-6, rtol=0)
