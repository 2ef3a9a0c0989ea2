"""Heights from outlines and from what is mirrored: derivatives, what cannot be known, and what is recovered."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.silhouettes import mask_contours
from panoless.capture.views import Views
from panoless.geometry.height_field.fit import (
    EDGE_BENDING,
    EDGE_SCALES_PX,
    ROUNDS,
    apply_height_field_step,
    fit_height_field,
    step_height_field,
)
from panoless.geometry.height_field.model import HeightField, flat_height_field, visible_reflections
from panoless.geometry.height_field.photometric import Observations, Photographs, observe
from panoless.geometry.height_field.silhouette import edge_jacobian, edge_residuals
from panoless.geometry.plane.silhouette import apply_plane_step
from panoless.kernels.cubemap import cubemap_directions
from shinypartial.core.sphere import directions_to_cube
from tests.support.mirror_height_field import bumpy, height_field_views, normal_errors_deg, patterned
from tests.support.mirror_plane import RECTANGLE, arc, disc, plane_of

PLANE = plane_of(RECTANGLE, frame_height=0.08)
TILTED = apply_plane_step(
    PLANE, np.append([np.radians(0.8), np.radians(-0.6), 0.0, 0.0], np.zeros(PLANE.boundary.size))
)
"""By a degree, which photographs of a nearly flat mirror hardly tell."""
ALL_VOTE = 1e6
"""A robust scale at which weights do not change."""


@pytest.fixture(scope="module")
def truth() -> HeightField:
    return bumpy(PLANE, 0.008)


@pytest.fixture(scope="module")
def views(truth: HeightField) -> Views:
    return height_field_views(truth, arc(16))


@pytest.mark.parametrize("kind", ["tilt", "frame", "boundary", "heights"])
def test_derivatives_of_contour_distances_are_finite_differences(truth: HeightField, views: Views, kind: str) -> None:
    """Of each distance, a step away from the truth, but for points that change sides: 2 % of the root mean square."""
    contours = mask_contours(views)
    size, vertices = truth.coefficients.size, len(truth.plane.boundary)
    direction = np.zeros(4 + 2 * vertices + size)
    parts = {"tilt": slice(0, 2), "frame": slice(3, 4), "boundary": slice(4, -size), "heights": slice(-size, None)}
    chosen = direction[parts[kind]]
    chosen[:] = np.random.default_rng(3).normal(size=len(chosen))
    height_field = apply_height_field_step(truth, 5e-3 * direction)
    residuals = edge_residuals(contours, height_field)
    ahead, behind = (
        edge_residuals(contours, apply_height_field_step(height_field, step * direction)) for step in (1e-5, -1e-5)
    )
    kept = residuals.counted & (ahead.side == behind.side)
    difference = ((ahead.pixels - behind.pixels) / 2e-5)[kept]
    derivative = (edge_jacobian(residuals, height_field) @ direction)[kept]
    assert np.mean(kept) > 0.9
    assert np.sqrt(((derivative - difference) ** 2).mean()) < 0.02 * np.sqrt((difference**2).mean())


def test_contours_alone_recover_the_plane_of_the_frame_and_the_height_of_the_edge(
    truth: HeightField, views: Views
) -> None:
    """At 96 px a contour tells a tenth of the degree that was put in, and a tenth of the bumps."""
    contours, height_field = mask_contours(views), flat_height_field(TILTED, 4)
    for scale in EDGE_SCALES_PX:
        height_field, _ = step_height_field(contours, height_field, scale, EDGE_BENDING)
    assert np.degrees(np.arccos(height_field.plane.normal @ PLANE.normal)) < 0.15
    middles = (PLANE.boundary + np.roll(PLANE.boundary, -1, 0)) / 2
    found = height_field.heights(middles)[0] + height_field.plane.offset
    assert np.allclose(found, truth.heights(middles)[0] + PLANE.offset, atol=2e-3)
    assert np.abs(truth.heights(middles)[0]).max() > 5e-3


def photographs_at(height_field: HeightField, observed: Observations, environment: torch.Tensor) -> Photographs:
    return Photographs.at(height_field, observed, environment, ALL_VOTE)


def texel_map(resolution: int) -> torch.Tensor:
    directions = cubemap_directions(resolution).double().numpy()
    values = patterned(directions.reshape(-1, 3)).reshape(6, resolution, resolution, 3)
    return torch.from_numpy(values).permute(0, 3, 1, 2).float().contiguous()


def test_the_photometric_gradient_is_that_of_what_no_map_explains(truth: HeightField, views: Views) -> None:
    """Finite differences of ½ Σ ‖r − r̄‖², with r̄ the mean residual of all rays in a texel. The map is smooth, so that
    differences over a texel are derivatives to some percent.
    """
    height_field = replace(truth, coefficients=1.1 * truth.coefficients)
    observed = observe(views, height_field, 20_000)
    gradient, matrix = photographs_at(height_field, observed, texel_map(128)).equations()
    face, st = directions_to_cube(observed.rays.directions.numpy().astype(np.float64))
    column, row = ((st + 1) * 64).astype(int).T
    _, texel, count = np.unique((face * 128 + row) * 128 + column, return_inverse=True, return_counts=True)
    direction = np.random.default_rng(4).normal(size=len(gradient))
    step = 1e-5

    stride = max(1, sum(len(view.solid) for view in views.train) // 20_000)
    kept = [
        visible_reflections(height_field, view, view.solid[i % stride :: stride]).pixels
        for i, view in enumerate(views.train)
    ]

    def cost(sign: float) -> float:
        shifted = apply_height_field_step(
            height_field, sign * step * np.append(np.zeros(4 + truth.plane.boundary.size), direction)
        )
        bare = replace(shifted, plane=replace(shifted.plane, frame_height=0.0))
        total, parts = 0.0, []
        for view, pixels in zip(views.train, kept, strict=True):
            found = visible_reflections(bare, view, pixels)
            parts.append(patterned(found.outgoing) - view.radiance.flatten(1)[:, found.pixels].T.double().numpy())
        for residual in np.concatenate(parts).T:
            mean = np.bincount(texel, residual) / count
            total += ((residual - mean[texel]) ** 2).sum() / 2
        return float(total)

    difference = (cost(1) - cost(-1)) / (2 * step) / 0.05**2
    scale = np.sqrt(2 * cost(0) / 0.05**2 * (direction @ matrix @ direction))
    assert abs(gradient @ direction - difference) < 0.05 * scale


def test_no_photograph_tells_the_tilt_of_a_flat_mirror() -> None:
    """With the map eliminated a tilt has no curvature but what texels leave, which vanishes with their size."""
    flat = flat_height_field(PLANE, 4)
    observed = observe(height_field_views(flat, arc(16)), flat, 100_000)
    rows, columns = flat.coefficients.shape
    tilt = np.repeat(np.arange(rows) - (rows - 1) / 2, columns)
    bump = np.random.default_rng(5).normal(size=tilt.shape)
    bump *= np.linalg.norm(tilt) / np.linalg.norm(bump)
    shares = []
    for resolution in (32, 128):
        _, matrix = photographs_at(flat, observed, texel_map(resolution)).equations()
        shares.append((tilt @ matrix @ tilt) / (bump @ matrix @ bump))
    assert shares[1] < 0.02
    assert shares[1] < shares[0] / 3


def test_a_bent_and_tilted_mirror_is_recovered(truth: HeightField) -> None:
    """From the flat, tilted plane, by 16 views of 64 px."""
    views, camera = height_field_views(truth, arc(16, size=64)), arc(16)[8]
    found = fit_height_field(views, TILTED, halvings=0)
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
    found = fit_height_field(views, plane, cells=6, halvings=0)
    assert np.mean(normal_errors_deg(flat_height_field(plane, 6), truth, camera)) > 9
    assert np.mean(normal_errors_deg(found, truth, camera)) < 0.5


def test_a_round_outline_bends_no_mirror() -> None:
    """What a polygon of few sides misses of a circle, more than a pixel here, is not put down to heights."""
    views = height_field_views(flat_height_field(plane_of(disc(256)), 16), arc(12, size=96))
    contours, height_field = mask_contours(views), flat_height_field(plane_of(disc(16)), 16)
    for scale in EDGE_SCALES_PX:
        height_field, _ = step_height_field(contours, height_field, scale, EDGE_BENDING)
    middle = height_field.plane.boundary.mean(0, keepdims=True)
    assert abs(height_field.heights(middle, 0)[0, 0]) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("rim", [0.0, 0.1])
def test_what_a_rim_hides_of_the_surroundings_is_left_out(rim: float) -> None:
    """Outlines tell nothing of a rim that stands back, and mirrored rays that meet it see black. Without one, none is
    found.
    """
    truth = replace(flat_height_field(plane_of(RECTANGLE), 6).domed(0.3), clearance=rim)
    views, camera = height_field_views(truth, arc(16, size=64)), arc(16)[8]
    found = fit_height_field(views, plane_of(RECTANGLE), cells=6, halvings=0)
    assert found.clearance in ((0.06, 0.12) if rim else (0.0,))
    assert np.mean(normal_errors_deg(found, truth, camera)) < 0.5


def test_a_tilt_that_photographs_do_not_tell_changes_nothing_for_them(truth: HeightField, views: Views) -> None:
    """Neither gradient nor matrix has anything along coefficients of a linear height; the rest is as it was."""
    photographs = photographs_at(truth, observe(views, truth, 10_000), texel_map(32))
    gradient, matrix = photographs.equations()
    without, left = replace(photographs, tell_tilt=False).equations()
    rows, columns = truth.coefficients.shape
    linear = np.add.outer(3.0 * np.arange(rows), -2.0 * np.arange(columns) + 0.5).ravel()
    assert abs(linear @ without) < 1e-9 * np.linalg.norm(linear) * np.linalg.norm(gradient)
    assert np.linalg.norm(left @ linear) < 1e-9 * np.linalg.norm(linear) * np.linalg.norm(matrix)
    bump = np.random.default_rng(6).normal(size=truth.coefficients.size)
    bump -= truth.tilts() @ (truth.tilts().T @ bump)
    np.testing.assert_allclose([bump @ without, bump @ left @ bump], [bump @ gradient, bump @ matrix @ bump])


@pytest.mark.slow
def test_bumps_too_short_for_the_grid_are_recovered_on_a_finer_one() -> None:
    """Held-out views ask for halved cells, and for none where the mirror is flat."""
    for height, cells in ((0.0, 5), (0.004, 10)):
        truth = bumpy(PLANE, height, cells=10)
        found = fit_height_field(height_field_views(truth, arc(12, size=48)), PLANE, cells=5, rounds=ROUNDS[:3])
        assert found.spacing == pytest.approx(flat_height_field(PLANE, cells).spacing, rel=0.02)


def test_photographs_of_nothing_but_the_frame_say_nothing(views: Views) -> None:
    """A frame so high that every mirrored ray meets it: outlines alone decide, and the height field is finite."""
    walled = flat_height_field(replace(PLANE, frame_height=1e3), 4)
    observed = observe(views, walled, 10_000)
    assert len(observed.rays.radiance) == 0
    photographs = photographs_at(walled, observed, torch.zeros(6, 3, 16, 16))
    for part in photographs.equations():
        assert not part.any()
    assert photographs.cost(walled) == 0


def test_no_step_raises_the_cost_of_the_photographs(truth: HeightField, views: Views) -> None:
    """With contours too uncertain to speak and no bending energy, that cost is all of it. The map is the true one, its
    texels coarse: from bumps half again as high the cost falls; at the true ones a step of noise is refused or helps.
    """
    contours = mask_contours(views)
    for start in (replace(truth, coefficients=1.5 * truth.coefficients), truth):
        photographs = photographs_at(start, observe(views, start, 20_000), texel_map(32))
        moved, fall = step_height_field(contours, start, 1.0, 0.0, photographs, contour_sigma_px=1e6)
        assert fall == pytest.approx(1 - photographs.cost(moved) / photographs.cost(start), abs=1e-4)
        assert photographs.cost(moved) <= photographs.cost(start) * (1 + 1e-6)
        if start is not truth:
            assert photographs.cost(moved) < photographs.cost(start) / 2


def test_the_cost_of_photographs_has_the_gradient_of_their_equations(truth: HeightField, views: Views) -> None:
    """Under a map with texels that smooth it, so that differences over a texel are derivatives to some percent."""
    height_field = replace(truth, coefficients=1.1 * truth.coefficients)
    photographs = photographs_at(height_field, observe(views, height_field, 20_000), texel_map(128))
    gradient, matrix = photographs.equations()
    direction = np.random.default_rng(7).normal(size=len(gradient))
    step = 1e-3 * np.append(np.zeros(4 + truth.plane.boundary.size), direction)
    ahead, behind = (photographs.cost(apply_height_field_step(height_field, sign * step)) for sign in (1, -1))
    scale = np.sqrt(2 * photographs.cost(height_field) * (direction @ matrix @ direction))
    assert abs(gradient @ direction - (ahead - behind) / 2e-3) < 0.05 * scale
