"""Heights from outlines and from what is mirrored: derivatives, what cannot be known, and what is recovered."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.silhouettes import mask_contours
from panoless.capture.views import Views
from panoless.geometry.height_field.fit import EDGE_BENDING, EDGE_SCALES_PX, apply_step, fit_height_field
from panoless.geometry.height_field.model import HeightField, flat_height_field, visible_reflections
from panoless.geometry.height_field.photometric import photometric_equations, select_observations
from panoless.geometry.height_field.silhouette import edge_equations
from panoless.geometry.plane.silhouette import apply_plane_step, boundary_residuals, robust_weights
from panoless.kernels.cubemap import cubemap_directions
from shinypartial.core.sphere import directions_to_cube
from tests.support.mirror_height_field import bumpy, height_field_views, normal_errors_deg, patterned
from tests.support.mirror_plane import RECTANGLE, arc, plane_of

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


def displaced(height_field: HeightField, step: np.ndarray) -> HeightField:
    size = height_field.coefficients.size
    plane, coefficients = (
        apply_plane_step(height_field.plane, step[:-size]),
        height_field.coefficients.ravel() + step[-size:],
    )
    return replace(height_field, plane=plane, coefficients=coefficients.reshape(height_field.coefficients.shape))


@pytest.mark.parametrize("kind", ["tilt", "frame", "boundary", "heights"])
def test_derivatives_of_contour_distances_are_finite_differences(truth: HeightField, views: Views, kind: str) -> None:
    """Of half their sum of squares, a step away from the truth. Left out is that an boundary takes its height along,
    and that a frame turns with its plane: these shares of frame height over half a width slow steps down, but move no
    end.
    """
    contours = mask_contours(views)
    size, vertices = truth.coefficients.size, len(PLANE.boundary)
    direction = np.zeros(4 + 2 * vertices + size)
    parts = {"tilt": slice(0, 2), "frame": slice(3, 4), "boundary": slice(4, -size), "heights": slice(-size, None)}
    chosen = direction[parts[kind]]
    chosen[:] = np.random.default_rng(3).normal(size=len(chosen))
    height_field = displaced(truth, 5e-3 * direction)
    weights = robust_weights(
        boundary_residuals(contours, height_field.plane, lambda at: height_field.heights(at)[0]), ALL_VOTE
    )

    def half_sum_of_squares(step: float) -> float:
        there = displaced(height_field, step * direction)
        found = boundary_residuals(contours, there.plane, lambda at: there.heights(at)[0])
        return float((weights * found.pixels**2).sum() / 2)

    gradient, _ = edge_equations(contours, height_field, ALL_VOTE)
    difference = (half_sum_of_squares(1e-4) - half_sum_of_squares(-1e-4)) / 2e-4
    assert gradient @ direction == pytest.approx(difference, rel=0.25 if kind == "tilt" else 0.06)


def test_contours_alone_recover_the_plane_of_the_frame_and_the_height_of_the_edge(
    truth: HeightField, views: Views
) -> None:
    """At 96 px a contour tells a tenth of the degree that was put in, and a tenth of the bumps."""
    contours, height_field = mask_contours(views), flat_height_field(TILTED, 4)
    for scale in EDGE_SCALES_PX:
        height_field = apply_step(height_field, *edge_equations(contours, height_field, scale), EDGE_BENDING)
    assert np.degrees(np.arccos(height_field.plane.normal @ PLANE.normal)) < 0.15
    middles = (PLANE.boundary + np.roll(PLANE.boundary, -1, 0)) / 2
    found = height_field.heights(middles)[0] + height_field.plane.offset
    assert np.allclose(found, truth.heights(middles)[0] + PLANE.offset, atol=2e-3)
    assert np.abs(truth.heights(middles)[0]).max() > 5e-3


def texel_map(resolution: int) -> torch.Tensor:
    directions = cubemap_directions(resolution).double().numpy()
    values = patterned(directions.reshape(-1, 3)).reshape(6, resolution, resolution, 3)
    return torch.from_numpy(values).permute(0, 3, 1, 2).float().contiguous()


def test_the_photometric_gradient_is_that_of_what_no_map_explains(truth: HeightField, views: Views) -> None:
    """Finite differences of ½ Σ ‖r − r̄‖², with r̄ the mean residual of all rays in a texel. The map is smooth, so that
    differences over a texel are derivatives to some percent.
    """
    height_field = replace(truth, coefficients=1.1 * truth.coefficients)
    seen, environment = select_observations(views, height_field, 20_000), texel_map(128)
    gradient, matrix = photometric_equations(seen, height_field, environment, ALL_VOTE)
    face, st = directions_to_cube(seen.rays.directions.numpy().astype(np.float64))
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
        shifted = displaced(height_field, sign * step * np.append(np.zeros(4 + PLANE.boundary.size), direction))
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
    seen = select_observations(height_field_views(flat, arc(16)), flat, 100_000)
    rows, columns = flat.coefficients.shape
    tilt = np.repeat(np.arange(rows) - (rows - 1) / 2, columns)
    bump = np.random.default_rng(5).normal(size=tilt.shape)
    bump *= np.linalg.norm(tilt) / np.linalg.norm(bump)
    shares = []
    for resolution in (32, 128):
        _, matrix = photometric_equations(seen, flat, texel_map(resolution), ALL_VOTE)
        shares.append((tilt @ matrix @ tilt) / (bump @ matrix @ bump))
    assert shares[1] < 0.02
    assert shares[1] < shares[0] / 3


def test_a_bent_and_tilted_mirror_is_recovered(truth: HeightField) -> None:
    """From the flat, tilted plane, by 16 views of 64 px."""
    views, camera = height_field_views(truth, arc(16, size=64)), arc(16)[8]
    found = fit_height_field(views, TILTED)
    assert (
        np.mean(normal_errors_deg(found, truth, camera))
        < np.mean(normal_errors_deg(flat_height_field(TILTED, 4), truth, camera)) / 10
    )


def test_photographs_of_nothing_but_the_frame_say_nothing(views: Views) -> None:
    """A frame so high that every mirrored ray meets it: outlines alone decide, and the height field is finite."""
    walled = flat_height_field(replace(PLANE, frame_height=1e3), 4)
    seen = select_observations(views, walled, 10_000)
    assert len(seen.rays.radiance) == 0
    for part in photometric_equations(seen, walled, torch.zeros(6, 3, 16, 16), 0.3):
        assert not part.any()
