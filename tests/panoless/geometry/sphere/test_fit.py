"""A mirror ball from silhouettes, against one that is traced in closed form by `tests.support.synthetic_dataset`."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float

from panoless.capture.views import Photograph, Views, views_of
from panoless.config import FitConfig
from panoless.environment.options import SurroundingsOptions
from panoless.environment.solve import solve_environment
from panoless.geometry.base import observe_views
from panoless.geometry.sphere.fit import Cones, fit_sphere
from panoless.geometry.sphere.kind import SphereFamily, SphereMirror
from panoless.geometry.sphere.options import SphereOptions
from panoless.kernels.cubemap import sample_cubemap
from panoless.problem.rays import PixelRays
from panoless.selection.candidates import Verdict
from panoless.selection.choose import DOUBTED_ERROR, LARGEST_ERROR, choose_geometry
from panoless.selection.options import CorrectionOptions
from shinypartial.core.camera import Camera, ray_directions_world, reflect
from shinypartial.core.errors import InputError
from tests.support.mirror_revolution import around, goblet, revolution_views
from tests.support.mirror_sphere import tiny_config
from tests.support.synthetic_dataset import environment_radiance, render_sphere, sphere_cameras

SIZE_PX = 64
CONFIG = replace(
    tiny_config(),
    model="auto",
    corrections=CorrectionOptions(masks="off", exposure="off", lens="off"),
    surroundings=SurroundingsOptions(mode="off"),
    environment=replace(tiny_config().environment, solve_resolution=16),
)


def photograph(camera: Camera) -> Photograph:
    """A ball of radius 1 about the origin under the analytic environment, clipped as training views are."""
    view = render_sphere(camera)
    radiance, alpha = (torch.from_numpy(np.ascontiguousarray(each)) for each in (view.radiance.clip(0, 1), view.alpha))
    return Photograph(camera, radiance.permute(2, 0, 1).contiguous(), alpha)


def ball_views(count: int, radius: float = 0.0) -> Views:
    return views_of([photograph(camera) for camera in sphere_cameras("train", count, SIZE_PX)], radius)


def in_world(views: Views, mirror: SphereMirror) -> tuple[Float[np.ndarray, "3"], float]:
    frame = views.object_frame
    return frame.to_world(mirror.sphere.center), mirror.sphere.radius * frame.radius


def fitted(views: Views, config: FitConfig = CONFIG) -> SphereMirror:
    family = SphereFamily()
    proposal = family.propose(views, config, requested=False)
    assert proposal is not None
    geometry, _, _ = family.solve(views, proposal, (), (), config, lambda _: None)
    assert isinstance(geometry, SphereMirror)
    return geometry


def tangent_rays(
    center: Float[np.ndarray, "3"], half_axes: Float[np.ndarray, "3"], origins: Float[np.ndarray, "V 3"]
) -> PixelRays:
    """Rays that touch an ellipsoid, by way of the unit sphere that it is a stretched image of.

    Seen from the distance d, tangent points of that lie on a circle at 1/d before its center, of radius √(1 − 1/d²).
    """
    parts, turn = [], 2 * np.pi * np.arange(40) / 40
    for view, origin in enumerate(origins):
        away = (origin - center) / half_axes
        distance = np.linalg.norm(away)
        across = np.linalg.svd(away[None])[2][1:]
        ring = np.sqrt(1 - distance**-2) * np.stack([np.cos(turn), np.sin(turn)], 1) @ across
        rays = center + half_axes * (away / distance**2 + ring) - origin
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        steps, size = np.zeros((40, 2, 3)), np.full(40, 1 / 300)
        parts.append((np.tile(origin, (40, 1)), rays, steps, size, np.full(40, view)))
    return PixelRays(*(np.concatenate(each) for each in zip(*parts, strict=True)))


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 5))
def test_exact_cones_give_the_sphere(seed: int, count: int) -> None:
    """Rays that touch a sphere lead back to it, wherever it and the cameras are."""
    rng = np.random.default_rng(seed)
    center, radius, away = rng.uniform(-1, 1, 3), rng.uniform(0.1, 1.0), rng.normal(size=(count, 3))
    away *= radius * rng.uniform(2.0, 5.0, (count, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    rays = tangent_rays(center, np.full(3, radius), center + away)
    cones = Cones.of(rays)
    found = cones.sphere(0.0)
    # Lines that are nearly parallel amplify rounding.
    np.testing.assert_allclose(np.append(found.center, found.radius), np.append(center, radius), atol=1e-4)
    assert cones.are_of_a_sphere()


@pytest.mark.parametrize(
    ("half_axes", "is_sphere"), [((1, 1, 0.999), True), ((1, 1, 0.97), False), ((1.03, 1, 1), False)]
)
@pytest.mark.parametrize("noise_px", [0.0, 0.3])
def test_an_egg_is_no_sphere_whatever_the_noise_of_masks(
    half_axes: tuple[float, float, float], is_sphere: bool, noise_px: float
) -> None:
    """Three hundredths of an axis are detected through a noise of 0.3 px on a radius of 75."""
    turns = np.radians(np.linspace(-60, 60, 9))
    origins = 4 * np.stack([np.sin(turns), -np.cos(turns), 0.2 + 0 * turns], 1)
    rays = tangent_rays(np.array([0.1, 0.0, 0.2]), np.array(half_axes, float), origins)
    rng = np.random.default_rng(1)
    shaken = rays.directions + rng.normal(size=rays.directions.shape) * noise_px * rays.size[:, None]
    shaken /= np.linalg.norm(shaken, axis=1, keepdims=True)
    assert Cones.of(replace(rays, directions=shaken)).are_of_a_sphere() == is_sphere


@pytest.mark.parametrize("count", [2, 3, 9])
def test_silhouettes_give_center_and_radius(count: int) -> None:
    """0.002 is a thirtieth of a pixel; 5×5 samples a pixel make the masks."""
    views = ball_views(count)
    found = fit_sphere(views, requested=False)
    assert found is not None
    center, radius = in_world(views, SphereMirror(found.shape))
    assert np.abs(center).max() < 2e-3
    assert radius == pytest.approx(1.0, abs=2e-3)
    assert found.silhouette_px < 0.05
    assert found.overlap > 0.99


@pytest.mark.parametrize("radius", [0.0, 2.5])
def test_one_photograph_is_unwrapped_exactly(radius: float) -> None:
    """Its rays are those of a ball of any size at the distance where it looks so large: a known radius scales both."""
    config = replace(CONFIG, sphere=SphereOptions(radius=radius))
    views, (camera,) = ball_views(1, radius), sphere_cameras("train", 1, SIZE_PX)
    geometry, selection = choose_geometry(views, config)
    assert geometry.kind == selection.chosen == "sphere"
    view = views.train[0]
    rays = geometry.observe(view, view.solid)
    # At most the environment's slope of 1.4 by rad or so times what a twentieth of a pixel turns, but for the rim.
    error = rays.radiance - torch.from_numpy(environment_radiance(rays.directions.double().numpy()).clip(0, 1)).float()
    assert float(error.abs().median()) < 2e-3
    center, size = in_world(views, geometry)
    expected = radius or 1.0
    assert size == pytest.approx(expected, rel=3e-3)
    np.testing.assert_allclose(center, (1 - expected) * camera.position_world, atol=0.02)


def test_reflections_are_those_of_a_sphere_in_closed_form() -> None:
    """Directions of pixel centers, by a tracer that shares no code."""
    views = ball_views(9)
    mirror = fitted(views)
    camera = sphere_cameras("train", 9, SIZE_PX)[4]
    view = views.train[4]
    truth = render_sphere(camera)
    outgoing = reflect(ray_directions_world(camera), truth.normals_world)
    left = round(camera.cx - view.camera.cx)
    top = round(camera.cy - view.camera.cy)
    rows, columns = np.divmod(view.solid.numpy(), view.camera.width)
    inner = truth.normals_world[rows + top, columns + left] @ -ray_directions_world(camera)[32, 32] > 0.3
    expected = outgoing[rows + top, columns + left][inner]
    found = mirror.observe(view, view.solid[torch.from_numpy(inner)]).directions.numpy()
    angles = np.degrees(np.arccos(np.clip((expected * found).sum(1), -1, 1)))
    # A thirtieth of a pixel turns the normal by 0.1° in the middle, and by 0.3° at a cosine of 0.3.
    assert np.median(angles) < 0.2
    assert angles.max() < 1.0


def test_what_is_seen_is_what_was_seen() -> None:
    """The map of some views, by the sphere, shows the others: depth, normals, coverage and light."""
    views = ball_views(9)
    mirror = fitted(views)
    buffers = mirror.buffers(views.train[4].camera)
    assert float((buffers.alpha - views.train[4].mask).abs().max()) < 0.15
    environment = solve_environment(list(observe_views(views, mirror, 1_000_000)), 32)
    view = views.train[4]
    light = mirror.shade(environment, view.camera, view.solid, buffers.normals_camera.flatten(1)[:, view.solid])
    assert float((light - view.radiance_at(view.solid)).abs().median()) < 0.01


def test_other_shapes_are_no_spheres() -> None:
    views = revolution_views(goblet(), around(3, 48))
    assert fit_sphere(views, requested=False) is None
    assert SphereFamily().propose(views, CONFIG, requested=False) is None


def test_views_along_one_line_show_spheres_only(sphere_dataset) -> None:
    """An ellipse leaves open how far away and how large it is; no kind of geometry is guessed."""
    (camera,) = sphere_cameras("train", 1, SIZE_PX)
    seen = photograph(camera)
    wide = replace(camera, fy=camera.fy / 2)
    with pytest.raises(InputError, match="single line"):
        choose_geometry(views_of([replace(seen, camera=wide)]), CONFIG)
    with pytest.raises(InputError, match="single line"):
        choose_geometry(views_of([seen]), replace(CONFIG, model="plane"))


def test_model_selection_takes_the_sphere() -> None:
    _, selection = choose_geometry(ball_views(9), CONFIG)
    assert selection.chosen == "sphere"
    assert [each.verdict for each in selection.candidates] == [Verdict.CHOSEN]


def test_of_two_views_none_is_held_out_and_no_error_is_stated() -> None:
    _, selection = choose_geometry(ball_views(2), CONFIG)
    (candidate,) = selection.candidates
    assert candidate.verdict == Verdict.CHOSEN
    assert candidate.held_out_error is None
    assert candidate.reason == "too few views to hold one out"


def test_noise_raises_no_doubt_of_a_sphere() -> None:
    """Silhouettes suffice, so no other kind is examined where photographs leave more than right ones do of
    another."""
    views, noise = ball_views(12), torch.Generator().manual_seed(3)
    noisy = [
        replace(view, radiance=(view.radiance + 0.03 * torch.randn(view.radiance.shape, generator=noise)).clamp(0, 1))
        for view in views.train
    ]
    mirror, selection = choose_geometry(replace(views, train=tuple(noisy)), CONFIG)
    (candidate,) = selection.candidates
    assert mirror.kind == candidate.kind == "sphere"
    assert DOUBTED_ERROR < candidate.held_out_error < LARGEST_ERROR


@pytest.mark.parametrize("count", [2, 9])
def test_the_operator_of_one_view_is_replaced_by_another(count: int) -> None:
    """A black figure that stands at each camera, 8° wide, where others see the surroundings."""
    train, views = [], ball_views(count)
    mirror = fitted(views)
    for view in views.train:
        back = view.position / np.linalg.norm(view.position)
        image = view.radiance.flatten(1).clone()
        outgoing = mirror.observe(view, view.solid).directions.numpy()
        assert len(outgoing) == len(view.solid)
        image[:, view.solid[torch.from_numpy(outgoing @ back > np.cos(np.radians(8)))]] = 0
        train.append(replace(view, radiance=image.view_as(view.radiance)))
    seen, clear = (
        solve_environment(list(observe_views(each, mirror, 10**6)), 32)
        for each in (replace(views, train=tuple(train)), views)
    )
    backs = [view.position / np.linalg.norm(view.position) for view in views.train]
    directions = torch.from_numpy(np.stack(backs)).float()
    error = sample_cubemap(seen, directions) - sample_cubemap(clear, directions)
    # Without that trust it is 0.8 of two views.
    assert float(error.abs().max()) < 0.05


def test_a_state_is_read_as_it_was_written() -> None:
    mirror = fitted(ball_views(2))
    again = SphereMirror.from_state_dict(mirror.state_dict())
    assert again.operator_deg == mirror.operator_deg > 0
    np.testing.assert_array_equal(again.sphere.center, mirror.sphere.center)
    assert again.sphere.radius == mirror.sphere.radius
