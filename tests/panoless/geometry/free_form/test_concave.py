"""Concave starts: what the score measures, what a concavity is, and that concavities are found where they are."""

from dataclasses import replace

import numpy as np
import pytest

from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.geometry.free_form import concave, fit
from panoless.geometry.free_form.concave import concave_start, unexplained_parts, unexplained_patches
from panoless.geometry.free_form.concavities import Chart, Concavity, Relief, smooth_maximum
from panoless.geometry.free_form.fit import fit_free_form
from panoless.geometry.free_form.kind import FreeFormFamily
from panoless.geometry.free_form.schedule import COARSE, Schedule
from panoless.geometry.free_form.spread import FinalRays, cells_of, disagreement
from panoless.geometry.free_form.surface import LevelSet
from panoless.problem.observations import solid_pixels
from tests.panoless.geometry.free_form.test_fit import normal_errors_deg
from tests.support.mirror_body import (
    Body,
    body_views,
    cameras_around,
    dented,
    ellipsoid,
    pattern,
)

OUTER, CONCAVITY_MIDDLE, CONCAVITY_AXES = (0.8, 1.0, 0.9), (0.75, 0.1, -0.05), (0.7, 0.7, 0.55)
RIM = 0.57
"""Height along x at which the two ellipsoids meet, about: the cap that silhouettes see."""
QUICK = {
    "RAYS": 12_000,
    "PIXELS": 1_000,
    "LEAST_PIXELS": 100,
    "LEAST_PART": 200,
    "CELLS": 32,
    "RESOLUTIONS": (6, 8),
    "EVALUATIONS": (120, 120),
    "DESCENTS": 1,
    "INSETS": (0.93, 0.86, 0.79),
    "DEPTHS": (0.6, 0.7, 0.8, 0.9),
    "EXPONENTS": (1.7, 2.5),
}
"""Few candidates, pixels and cells."""


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A short search."""
    for name, value in QUICK.items():
        monkeypatch.setattr(concave, name, value)


def level_set_of(body: Body, views: Views, cells: int = 36) -> LevelSet:
    """The spline through the values of a body, over a box about it."""
    frame, side = views.object_frame, 3.0
    empty = LevelSet(np.full(3, -side / 2), side / cells, np.zeros((cells + 3,) * 3))
    points = empty.points(empty.nodes().reshape(-1, 3)) * frame.radius + frame.center
    return empty.interpolating((body.value(points) / (frame.radius * empty.spacing)).reshape(empty.shape))


def directions(count: int) -> np.ndarray:
    found = np.random.default_rng(0).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def test_cells_of_directions_are_about_equally_large() -> None:
    cells = cells_of(directions(200_000), 6)
    share = np.bincount(cells, minlength=216) * 216 / 200_000
    # Equal angles: 1.37 at the corners of a face against 1 in its middle, about their mean.
    assert 0.75 < share.min() < share.max() < 1.3


def test_pixels_that_see_one_map_agree_and_those_of_a_wrong_surface_do_not() -> None:
    rays, view, left = directions(4000), np.arange(4000) % 7, np.ones(4000, dtype=bool)
    radiance = pattern(rays)
    right = disagreement(rays, left, radiance, view, 12, 0.3).mean()
    wrong = disagreement(np.roll(rays, 1, axis=0), left, radiance, view, 12, 0.3).mean()
    nothing = disagreement(rays, ~left, radiance, view, 12, 0.3).mean()
    assert right < 0.5 * nothing
    assert wrong > 0.95 * nothing


def test_pixels_of_one_view_are_not_compared() -> None:
    """Neighbors in a picture agree under any surface, so each is compared with other views only."""
    rays, view, left = directions(500), np.zeros(500, dtype=int), np.ones(500, dtype=bool)
    radiance = pattern(rays)
    found = disagreement(rays, left, radiance, view, 6, 0.3)
    np.testing.assert_array_equal(found, disagreement(rays, ~left, radiance, view, 6, 0.3))


def test_a_pixel_is_compared_with_the_mean_of_the_others() -> None:
    rays, left = np.tile([[1.0, 0.1, 0.1]], (4, 1)), np.ones(4, dtype=bool)
    radiance = np.array([[0.0] * 3, [0.3] * 3, [0.6] * 3, [0.9] * 3])
    found = disagreement(rays, left, radiance, np.array([0, 0, 1, 2]), 6, 1.0)
    squared = 3 * np.array([0.75, 0.45, 0.2, 0.6]) ** 2
    np.testing.assert_allclose(found, squared / (squared + 1))


def test_a_smooth_maximum_is_one_but_near_the_crossing() -> None:
    one, other = np.random.default_rng(0).normal(size=(2, 1000))
    found, largest = smooth_maximum(one, other, 0.5), np.maximum(one, other)
    far = np.abs(one - other) >= 0.5
    np.testing.assert_array_equal(found[far], largest[far])
    assert (found >= largest).all()
    assert found.max() - largest.max() <= 0.125


def test_numbers_of_a_concavity_come_back() -> None:
    concavity = Concavity.from_vector(np.linspace(0.1, 0.9, 13))
    np.testing.assert_array_equal(Concavity.from_vector(concavity.vector).vector, concavity.vector)


def test_a_chart_and_its_inverse() -> None:
    chart = Chart.about(np.array([0.3, -0.1, 0.2]), np.array([0.6, 0.0, 0.8]), 0.7)
    points = directions(50)
    np.testing.assert_allclose(chart.points(chart.coordinates(points)), points, atol=1e-12)
    np.testing.assert_allclose(chart.axes @ chart.axes.T, np.eye(3), atol=1e-12)


def flat_block() -> LevelSet:
    """Inside below z = 0."""
    empty = LevelSet(np.full(3, -1.5), 3 / 36, np.zeros((39, 39, 39)))
    heights = empty.points(empty.nodes().reshape(-1, 3))[:, 2] / empty.spacing
    return empty.interpolating(heights.reshape(empty.shape))


def test_a_bowl_of_reach_one_is_an_ellipsoid() -> None:
    """Cut into a flat block, half as deep as wide; points of its mesh lie on it."""
    chart = Chart.about(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.8)
    concavity = Concavity.bowl(0.0, np.zeros(4), 0.5)
    np.testing.assert_allclose(concavity.reach, 1)
    mesh, _ = Relief(flat_block(), chart).carved(concavity, 0.3).mesh(1)
    inside = mesh.vertices[(mesh.vertices[:, 2] < -0.1)]
    level = np.sqrt((inside[:, :2] ** 2).sum(1) / 0.8**2 + inside[:, 2] ** 2 / 0.4**2)
    assert len(inside) > 200
    np.testing.assert_allclose(level, 1, atol=0.01)


def test_nothing_is_carved_beyond_the_rim() -> None:
    chart = Chart.about(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.6)
    mesh, _ = Relief(flat_block(), chart).carved(Concavity.bowl(0.0, np.zeros(4), 0.5), 0.3).mesh(1)
    beyond = np.hypot(*mesh.vertices[:, :2].T) > 0.7
    np.testing.assert_allclose(mesh.vertices[beyond, 2], 0, atol=0.005)


def test_unexplained_points_are_gathered_by_where_they_are() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(size=(300, 3)) * 0.1 + middle for middle in ([0, 0, 0], [3, 0, 0], [6, 0, 0])])
    disagreed = np.repeat([1.1, 0.5, 1.2], 300)
    parts = unexplained_parts(points, disagreed, 0.3)
    assert sorted(round(float(points[part, 0].mean())) for part in parts) == [0, 6]


@pytest.fixture(scope="module")
def dish() -> tuple[Body, Views]:
    """An ellipsoid with a concavity off its middle."""
    body = dented(OUTER, CONCAVITY_MIDDLE, CONCAVITY_AXES)
    return body, body_views(body, 20, 56)


def test_the_score_is_least_at_the_true_depth(dish: tuple[Body, Views]) -> None:
    """Among bodies whose concavities are shallower or deeper."""
    views = dish[1]
    pixels, scores = solid_pixels(views, 4000), []
    factors = (0.6, 0.8, 1.0, 1.2, 1.4)
    for factor in factors:
        axes = (factor * CONCAVITY_AXES[0], *CONCAVITY_AXES[1:])
        final = FinalRays.of(level_set_of(dented(OUTER, CONCAVITY_MIDDLE, axes), views), pixels.rays, 3)
        known = final.directions, final.left, pixels.radiance, pixels.rays.view
        scores.append(float(disagreement(*known, 8, 0.3).mean()))
    assert factors[int(np.argmin(scores))] == 1.0


def hollow_errors_deg(surface: LevelSet, body: Body, views: Views) -> np.ndarray:
    return normal_errors_deg(surface, body, views, cameras_around(6, 50)[:3])


@pytest.mark.usefixtures("quick")
def test_a_concavity_that_no_silhouette_shows_is_found(dish: tuple[Body, Views]) -> None:
    body, views = dish
    lidded = Body(lambda x: np.maximum(ellipsoid(OUTER).value(x), x[:, 0] - RIM))
    start = level_set_of(lidded, views)
    found = concave_start(views, start, start)
    assert found is not None
    before, after = (hollow_errors_deg(each, body, views) for each in (start, found))
    wrong = before > 10
    assert wrong.mean() > 0.25
    # Measured 49° and 10°, of which most is at the rim: a coarse start, from few pixels.
    assert np.median(after[wrong]) < np.median(before[wrong]) / 3


@pytest.mark.usefixtures("quick")
def test_a_convex_body_is_left_alone() -> None:
    """Pixels agree all over it, so nothing is searched."""
    views = body_views(ellipsoid(), 14, 56)
    start = level_set_of(ellipsoid((0.97, 0.82, 0.65)), views)
    assert concave_start(views, start, start) is None


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_what_steps_explain_is_not_searched(dish: tuple[Body, Views]) -> None:
    body, views = dish
    lidded = Body(lambda x: np.maximum(ellipsoid(OUTER).value(x), x[:, 0] - RIM))
    assert concave_start(views, level_set_of(lidded, views), level_set_of(body, views)) is None


@pytest.mark.usefixtures("quick")
def test_a_patch_that_settled_steps_leave_unexplained_is_searched_as_a_whole(
    dish: tuple[Body, Views], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though no part of it is unexplained by itself; not where steps explain it."""
    body, views = dish
    cap = level_set_of(Body(lambda x: np.maximum(ellipsoid(OUTER).value(x), x[:, 0] - RIM)), views)
    monkeypatch.setattr(concave, "LEAST_DISAGREEMENT", 10.0)
    monkeypatch.setattr(concave, "SETTLED_DISAGREEMENT", 0.7)
    pixels, chart = solid_pixels(views, QUICK["RAYS"]), Chart.about(np.array([0.5, 0.0, 0.0]), np.eye(3)[0], 0.5)
    under_lid, under_body = (
        list(unexplained_patches(chart, cap, settled, pixels)) for settled in (cap, level_set_of(body, views, 60))
    )
    assert len(under_lid) == 1
    assert not under_body


@pytest.mark.usefixtures("quick")
def test_photographs_of_one_color_show_no_concavity(dish: tuple[Body, Views]) -> None:
    body, views = dish
    plain = tuple(replace(view, radiance=0 * view.radiance + 0.5) for view in views.train)
    start = level_set_of(body, views)
    assert concave_start(replace(views, train=plain), start, start) is None


@pytest.mark.usefixtures("quick")
def test_a_surface_that_no_pixel_meets_has_no_concavity(dish: tuple[Body, Views]) -> None:
    far = level_set_of(Body(lambda x: np.linalg.norm(x - [0, 0, 9.0], axis=1)), dish[1])
    assert concave_start(dish[1], far, far) is None


def test_concavities_are_looked_for_under_lids_where_the_start_has_none(
    dish: tuple[Body, Views], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One after the other, until there is one."""
    start, cap, other = (level_set_of(ellipsoid(), dish[1], 20) for _ in range(3))
    searched = []

    def looked_for(views: Views, surface: LevelSet, settled: LevelSet) -> LevelSet | None:
        searched.append(surface)
        return None if surface is start else surface

    monkeypatch.setattr(fit, "concave_start", looked_for)
    rounds = (replace(COARSE[0], rays=2000, steps=1),)
    fit_free_form(dish[1], start, Schedule((), rounds, (), rounds, (), ()), caps=(cap, other))
    assert [each is known for each, known in zip(searched, (start, cap), strict=True)] == [True, True]


@pytest.mark.slow
def test_a_dish_is_recovered_from_its_visual_hull(dish: tuple[Body, Views]) -> None:
    body = dish[0]
    views = body_views(body, 30, 80)
    proposal = FreeFormFamily().propose(views, FitConfig(), requested=True)
    assert proposal is not None
    surface = fit_free_form(views, proposal.shape.surface, Schedule(finer=()))[0].surface
    errors = normal_errors_deg(surface, body, views, cameras_around(7, 60)[1::2])
    assert np.median(errors) < 0.3
    assert (errors < 5).mean() > 0.95
