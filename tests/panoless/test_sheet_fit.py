"""Heights from outlines and from what is mirrored: derivatives, what cannot be known, and what is recovered."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.kernels.cubemap import cubemap_directions
from panoless.plane_contours import moved_plane, outline_distances, robust_weights, view_contours
from panoless.sheet import Sheet, flat_sheet, sightings
from panoless.sheet_contours import edge_equations
from panoless.sheet_fit import EDGE_BENDING, EDGE_SCALES_PX, fit_sheet, moved
from panoless.sheet_photometric import observations, photometric_equations
from panoless.views import Views
from shinypartial.sphere import directions_to_cube
from tests.support.mirror_plane import RECTANGLE, arc, plane_of
from tests.support.mirror_sheet import bumpy, normal_errors_deg, patterned, sheet_views

PLANE = plane_of(RECTANGLE, rim_height=0.08)
TILTED = moved_plane(PLANE, np.append([np.radians(0.8), np.radians(-0.6), 0.0, 0.0], np.zeros(PLANE.outline.size)))
"""By a degree, which photographs of a nearly flat mirror hardly tell."""
ALL_VOTE = 1e6
"""A robust scale at which weights do not change."""


@pytest.fixture(scope="module")
def truth() -> Sheet:
    return bumpy(PLANE, 0.008)


@pytest.fixture(scope="module")
def views(truth: Sheet) -> Views:
    return sheet_views(truth, arc(16))


def displaced(sheet: Sheet, step: np.ndarray) -> Sheet:
    size = sheet.coefficients.size
    plane, coefficients = moved_plane(sheet.plane, step[:-size]), sheet.coefficients.ravel() + step[-size:]
    return replace(sheet, plane=plane, coefficients=coefficients.reshape(sheet.coefficients.shape))


@pytest.mark.parametrize("kind", ["tilt", "rim", "outline", "heights"])
def test_derivatives_of_contour_distances_are_finite_differences(truth: Sheet, views: Views, kind: str) -> None:
    """Of half their sum of squares, a step away from the truth. Left out is that an outline takes its height along, and
    that a rim turns with its plane: these shares of rim height over half a width slow steps down, but move no end.
    """
    contours = view_contours(views)
    size, vertices = truth.coefficients.size, len(PLANE.outline)
    direction = np.zeros(4 + 2 * vertices + size)
    parts = {"tilt": slice(0, 2), "rim": slice(3, 4), "outline": slice(4, -size), "heights": slice(-size, None)}
    chosen = direction[parts[kind]]
    chosen[:] = np.random.default_rng(3).normal(size=len(chosen))
    sheet = displaced(truth, 5e-3 * direction)
    weights = robust_weights(outline_distances(contours, sheet.plane, lambda at: sheet.heights(at)[0]), ALL_VOTE)

    def half_sum_of_squares(step: float) -> float:
        there = displaced(sheet, step * direction)
        found = outline_distances(contours, there.plane, lambda at: there.heights(at)[0])
        return float((weights * found.pixels**2).sum() / 2)

    gradient, _ = edge_equations(contours, sheet, ALL_VOTE)
    difference = (half_sum_of_squares(1e-4) - half_sum_of_squares(-1e-4)) / 2e-4
    assert gradient @ direction == pytest.approx(difference, rel=0.25 if kind == "tilt" else 0.06)


def test_contours_alone_recover_the_plane_of_the_frame_and_the_height_of_the_edge(truth: Sheet, views: Views) -> None:
    """At 96 px a contour tells a tenth of the degree that was put in, and a tenth of the bumps."""
    contours, sheet = view_contours(views), flat_sheet(TILTED, 4)
    for scale in EDGE_SCALES_PX:
        sheet = moved(sheet, *edge_equations(contours, sheet, scale), EDGE_BENDING)
    assert np.degrees(np.arccos(sheet.plane.normal @ PLANE.normal)) < 0.15
    middles = (PLANE.outline + np.roll(PLANE.outline, -1, 0)) / 2
    found = sheet.heights(middles)[0] + sheet.plane.offset
    assert np.allclose(found, truth.heights(middles)[0] + PLANE.offset, atol=2e-3)
    assert np.abs(truth.heights(middles)[0]).max() > 5e-3


def texel_map(resolution: int) -> torch.Tensor:
    directions = cubemap_directions(resolution).double().numpy()
    values = patterned(directions.reshape(-1, 3)).reshape(6, resolution, resolution, 3)
    return torch.from_numpy(values).permute(0, 3, 1, 2).float().contiguous()


def test_the_photometric_gradient_is_that_of_what_no_map_explains(truth: Sheet, views: Views) -> None:
    """Finite differences of ½ Σ ‖r − r̄‖², with r̄ the mean residual of all rays in a texel. The map is smooth, so that
    differences over a texel are derivatives to some percent.
    """
    sheet = replace(truth, coefficients=1.1 * truth.coefficients)
    seen, environment = observations(views, sheet, 20_000), texel_map(128)
    gradient, matrix = photometric_equations(seen, sheet, environment, ALL_VOTE)
    face, st = directions_to_cube(seen.rays.directions.numpy().astype(np.float64))
    column, row = ((st + 1) * 64).astype(int).T
    _, texel, count = np.unique((face * 128 + row) * 128 + column, return_inverse=True, return_counts=True)
    direction = np.random.default_rng(4).normal(size=len(gradient))
    step = 1e-5

    stride = max(1, sum(len(view.solid) for view in views.train) // 20_000)
    kept = [sightings(sheet, view, view.solid[i % stride :: stride]).pixels for i, view in enumerate(views.train)]

    def cost(sign: float) -> float:
        shifted = displaced(sheet, sign * step * np.append(np.zeros(4 + PLANE.outline.size), direction))
        bare = replace(shifted, plane=replace(shifted.plane, rim_height=0.0))
        total, parts = 0.0, []
        for view, pixels in zip(views.train, kept, strict=True):
            found = sightings(bare, view, pixels)
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
    flat = flat_sheet(PLANE, 4)
    seen = observations(sheet_views(flat, arc(16)), flat, 100_000)
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


def test_a_bent_and_tilted_mirror_is_recovered(truth: Sheet) -> None:
    """From the flat, tilted plane, by 16 views of 64 px."""
    views, camera = sheet_views(truth, arc(16, size=64)), arc(16)[8]
    found = fit_sheet(views, TILTED)
    assert (
        np.mean(normal_errors_deg(found, truth, camera))
        < np.mean(normal_errors_deg(flat_sheet(TILTED, 4), truth, camera)) / 10
    )


def test_photographs_of_nothing_but_the_frame_say_nothing(views: Views) -> None:
    """A frame so high that every mirrored ray meets it: outlines alone decide, and the sheet is finite."""
    walled = flat_sheet(replace(PLANE, rim_height=1e3), 4)
    seen = observations(views, walled, 10_000)
    assert len(seen.rays.radiance) == 0
    for part in photometric_equations(seen, walled, torch.zeros(6, 3, 16, 16), 0.3):
        assert not part.any()
