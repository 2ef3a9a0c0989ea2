"""Heights from silhouettes and from what is mirrored: derivatives, what cannot be known, and what is recovered."""

from dataclasses import replace

import numpy as np
import pytest

from panoless.capture.silhouettes import mask_contours
from panoless.capture.views import Views
from panoless.geometry.height_field.fit import best_dome, cleared
from panoless.geometry.height_field.model import HeightField, flat_height_field
from panoless.geometry.height_field.silhouette import edge_jacobian, edge_residuals
from panoless.geometry.height_field.unknowns import STIFF, HeightFieldUnknowns
from panoless.geometry.plane.model import Plane
from panoless.geometry.plane.silhouette import apply_plane_step
from panoless.problem.equations import Data, Equations, Photographs, Round, State, Traced
from panoless.problem.nuisance import NO_NUISANCE
from panoless.problem.solve import ROUNDS, by_silhouettes_alone, solve
from tests.support.mirror_height_field import bumpy, height_field_views, normal_errors_deg
from tests.support.mirror_plane import RECTANGLE, arc, disc, plane_of

PLANE = plane_of(RECTANGLE, frame_height=0.08)
TILTED = apply_plane_step(
    PLANE, np.append([np.radians(0.8), np.radians(-0.6), 0.0, 0.0], np.zeros(PLANE.boundary.size))
)
"""By a degree, which photographs of a nearly flat mirror hardly determine."""


@pytest.fixture(scope="module")
def truth() -> HeightField:
    return bumpy(PLANE, 0.008)


@pytest.fixture(scope="module")
def views(truth: HeightField) -> Views:
    return height_field_views(truth, arc(16))


def of_edges(views: Views, start: HeightField) -> HeightField:
    """By silhouettes alone."""
    return by_silhouettes_alone(views, HeightFieldUnknowns(start, STIFF)).height_field


def fitted(views: Views, plane: Plane, cells: int = 16, rounds: int = len(ROUNDS)) -> HeightField:
    """The joint solve of a plane without nuisance blocks, and what the rim hides."""

    def begun(state: State) -> HeightFieldUnknowns:
        assert isinstance(state.surface, HeightFieldUnknowns)
        return HeightFieldUnknowns(best_dome(views, state.surface.height_field))

    start = HeightFieldUnknowns(flat_height_field(plane, cells), STIFF)
    found = solve(views, start, (), (), begun, ROUNDS[:rounds]).state.surface
    assert isinstance(found, HeightFieldUnknowns)
    return cleared(views, found.height_field)


@pytest.mark.parametrize("kind", ["tilt", "frame", "boundary", "heights"])
def test_derivatives_of_contour_distances_are_finite_differences(truth: HeightField, views: Views, kind: str) -> None:
    """Of each distance, a step away from the truth, but for points that change sides: 2 % of the root mean square."""
    contours = mask_contours(views)
    size, vertices = truth.coefficients.size, len(truth.plane.boundary)
    direction = np.zeros(4 + 2 * vertices + size)
    parts = {"tilt": slice(0, 2), "frame": slice(3, 4), "boundary": slice(4, -size), "heights": slice(-size, None)}
    chosen = direction[parts[kind]]
    chosen[:] = np.random.default_rng(3).normal(size=len(chosen))
    unknowns = HeightFieldUnknowns(truth).stepped(5e-3 * direction)
    residuals = edge_residuals(contours, unknowns.height_field)
    ahead, behind = (
        edge_residuals(contours, unknowns.stepped(step * direction).height_field) for step in (1e-5, -1e-5)
    )
    kept = residuals.counted & (ahead.side == behind.side)
    difference = ((ahead.pixels - behind.pixels) / 2e-5)[kept]
    derivative = (edge_jacobian(residuals, unknowns.height_field) @ direction)[kept]
    assert np.mean(kept) > 0.9
    assert np.sqrt(((derivative - difference) ** 2).mean()) < 0.02 * np.sqrt((difference**2).mean())


def test_contours_alone_recover_the_plane_of_the_frame_and_the_height_of_the_edge(
    truth: HeightField, views: Views
) -> None:
    """At 96 px a contour determines a tenth of the degree that was put in, and a tenth of the bumps."""
    height_field = of_edges(views, flat_height_field(TILTED, 4))
    assert np.degrees(np.arccos(height_field.plane.normal @ PLANE.normal)) < 0.15
    middles = (PLANE.boundary + np.roll(PLANE.boundary, -1, 0)) / 2
    found = height_field.heights(middles)[0] + height_field.plane.offset
    assert np.allclose(found, truth.heights(middles)[0] + PLANE.offset, atol=2e-3)
    assert np.abs(truth.heights(middles)[0]).max() > 5e-3


def data_of(views: Views, resolution: int, *, last: bool = True) -> Data:
    """Of a tenth of a million pixels, whose weights do not change."""
    return Data.of(views, Round(resolution, 1e6, 100_000, 1), resolution if last else resolution + 1)


def linearized(data: Data, height_field: HeightField) -> Equations:
    return Equations.at(data, State(HeightFieldUnknowns(height_field, 0.0), NO_NUISANCE))


def of_photographs(data: Data, height_field: HeightField) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and matrix over the coefficients, without silhouettes, which have no contour point there."""
    silent = replace(data, silhouettes=data.silhouettes.chosen(slice(0, 0)))
    found, first = linearized(silent, height_field), -height_field.coefficients.size
    return found.gradient[first:], found.matrix[first:, first:]


def test_no_photograph_determines_the_tilt_of_a_flat_mirror() -> None:
    """With the map eliminated a tilt has no curvature but what texels leave, which vanishes with their size."""
    flat = flat_height_field(PLANE, 4)
    views = height_field_views(flat, arc(16))
    rows, columns = flat.coefficients.shape
    tilt = np.repeat(np.arange(rows) - (rows - 1) / 2, columns)
    bump = np.random.default_rng(5).normal(size=tilt.shape)
    bump *= np.linalg.norm(tilt) / np.linalg.norm(bump)
    shares = []
    for resolution in (32, 128):
        _, matrix = of_photographs(data_of(views, resolution), flat)
        shares.append((tilt @ matrix @ tilt) / (bump @ matrix @ bump))
    assert shares[1] < 0.02
    assert shares[1] < shares[0] / 3


def test_a_bent_and_tilted_mirror_is_recovered(truth: HeightField) -> None:
    """From the flat, tilted plane, by 16 views of 64 px."""
    views, camera = height_field_views(truth, arc(16, size=64)), arc(16)[8]
    found = fitted(views, TILTED)
    assert (
        np.mean(normal_errors_deg(found, truth, camera))
        < np.mean(normal_errors_deg(flat_height_field(TILTED, 4), truth, camera)) / 10
    )


@pytest.mark.slow
@pytest.mark.parametrize("slope", [0.45, -0.3])
def test_a_dome_and_a_bowl_are_found_from_a_flat_start(slope: float) -> None:
    """Round convex mirrors turn rays by 50 degrees from edge to edge; a flat mirror explains nothing of that."""
    plane = plane_of(disc(24))
    truth = flat_height_field(plane, 6).domed(slope)
    views, camera = height_field_views(truth, arc(16, size=64)), arc(16)[8]
    found = fitted(views, plane, cells=6)
    assert np.mean(normal_errors_deg(flat_height_field(plane, 6), truth, camera)) > 9
    assert np.mean(normal_errors_deg(found, truth, camera)) < 0.5


def test_a_round_silhouette_bends_no_mirror() -> None:
    """What a polygon of few sides misses of a circle, more than a pixel here, is not put down to heights."""
    views = height_field_views(flat_height_field(plane_of(disc(256)), 16), arc(12, size=96))
    height_field = of_edges(views, flat_height_field(plane_of(disc(16)), 16))
    middle = height_field.plane.boundary.mean(0, keepdims=True)
    assert abs(height_field.heights(middle, 0)[0, 0]) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("rim", [0.0, 0.1])
def test_what_a_rim_hides_of_the_surroundings_is_left_out(rim: float) -> None:
    """Silhouettes determine nothing of a rim that stands back, and mirrored rays that meet it see black. Without one,
    none is found.
    """
    truth = replace(flat_height_field(plane_of(RECTANGLE), 6).domed(0.3), clearance=rim)
    views, camera = height_field_views(truth, arc(16, size=64)), arc(16)[8]
    found = fitted(views, plane_of(RECTANGLE), cells=6)
    assert found.clearance in ((0.06, 0.12) if rim else (0.0,))
    assert np.mean(normal_errors_deg(found, truth, camera)) < 0.5


def test_a_tilt_that_photographs_leave_open_changes_nothing_for_them(truth: HeightField, views: Views) -> None:
    """Neither gradient nor matrix has anything along coefficients of a linear height; the rest is as it was."""
    gradient, matrix = of_photographs(data_of(views, 32), truth)
    without, left = of_photographs(data_of(views, 32, last=False), truth)
    rows, columns = truth.coefficients.shape
    linear = np.add.outer(3.0 * np.arange(rows), -2.0 * np.arange(columns) + 0.5).ravel()
    assert abs(linear @ without) < 1e-9 * np.linalg.norm(linear) * np.linalg.norm(gradient)
    assert np.linalg.norm(left @ linear) < 1e-9 * np.linalg.norm(linear) * np.linalg.norm(matrix)
    bump = np.random.default_rng(6).normal(size=truth.coefficients.size)
    bump -= truth.tilts() @ (truth.tilts().T @ bump)
    np.testing.assert_allclose([bump @ without, bump @ left @ bump], [bump @ gradient, bump @ matrix @ bump])


@pytest.mark.slow
@pytest.mark.parametrize("height", [0.0, 0.004])
def test_bumps_too_short_for_the_first_grid_are_recovered(height: float) -> None:
    """Its cells are halved before the last round; a flat mirror stays flat to 0.2° in 12 views of 48 px."""
    truth, camera = bumpy(PLANE, height, cells=10), arc(12, size=48)[6]
    found = fitted(height_field_views(truth, arc(12, size=48)), PLANE, cells=5)
    flat = normal_errors_deg(flat_height_field(PLANE, 5), truth, camera)
    assert np.mean(normal_errors_deg(found, truth, camera)) < max(0.25 * np.mean(flat), 0.2)


def test_photographs_of_nothing_but_the_frame_are_left_out(views: Views) -> None:
    """A frame so high that every mirrored ray meets it: silhouettes alone decide."""
    walled = flat_height_field(replace(PLANE, frame_height=1e3), 4)
    data, state = data_of(views, 16), State(HeightFieldUnknowns(walled), NO_NUISANCE)
    traced = Traced.of(data, state)
    assert traced is not None
    assert not traced.hits.clear.any()
    assert Photographs.at(data, state, traced, estimated=False) is None


@pytest.mark.parametrize("factor", [1.5, 1.0])
def test_no_step_raises_the_cost(truth: HeightField, views: Views, factor: float) -> None:
    """From bumps half again as high, of which the map that is solved there takes a part, that of photographs falls by a
    third; at the true ones a step of noise is refused or helps.
    """
    data = data_of(views, 32)
    silent = replace(data, silhouettes=data.silhouettes.chosen(slice(0, 0)))
    found = linearized(silent, replace(truth, coefficients=factor * truth.coefficients))
    moved, fall, traced = found.after_step()
    before, after = (found.cost(state, np.zeros(state.surface.count), traced) for state in (found.state, moved))
    assert after <= before
    assert fall == pytest.approx(1 - after / before, abs=1e-4)
    assert factor == 1.0 or fall > 1 / 3


def test_the_cost_has_the_gradient_of_its_equations(truth: HeightField, views: Views) -> None:
    """Under a map with texels that smooth it, so that differences over a texel are derivatives to some percent."""
    found = linearized(data_of(views, 128), replace(truth, coefficients=1.1 * truth.coefficients))
    direction = np.zeros(found.state.surface.count)
    direction[-truth.coefficients.size :] = np.random.default_rng(7).normal(size=truth.coefficients.size)

    def cost(step: np.ndarray) -> float:
        moved = found.state.stepped(step)
        return found.cost(moved, step, Traced.of(found.data, moved))

    difference = (cost(1e-3 * direction) - cost(-1e-3 * direction)) / 2e-3
    scale = np.sqrt(2 * cost(0 * direction) * (direction @ found.matrix @ direction))
    assert abs(found.gradient @ direction - difference) < 0.05 * scale
