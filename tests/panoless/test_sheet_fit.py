"""Heights from outlines and from what is mirrored: derivatives, what cannot be known, and what is recovered."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.cubemap import Rays
from panoless.kernels.cubemap import cubemap_directions
from panoless.plane_contours import moved_plane, outline_distances, view_contours
from panoless.sheet import Sheet, flat_sheet, sightings
from panoless.sheet_contours import edge_equations
from panoless.sheet_fit import EDGE_SCALES_PX, fit_sheet, moved
from panoless.sheet_photometric import Observations, observations, photometric_equations
from panoless.views import Views
from shinypartial.sphere import directions_to_cube
from tests.support.mirror_plane import RECTANGLE, arc, plane_of
from tests.support.mirror_sheet import bumpy, normal_errors_deg, patterned, sheet_views

PLANE = plane_of(RECTANGLE, rim_height=0.08)
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
    """In the mean over all contour points, where the nearest side stays the same; plane and edge move alike to first
    order in heights, which are a hundredth.
    """
    contours = view_contours(views)
    size, vertices = truth.coefficients.size, len(PLANE.outline)
    direction = np.zeros(4 + 2 * vertices + size)
    parts = {"tilt": slice(0, 2), "rim": slice(3, 4), "outline": slice(4, -size), "heights": slice(-size, None)}
    chosen = direction[parts[kind]]
    chosen[:] = np.random.default_rng(3).normal(size=len(chosen))
    step = 1e-4

    def half_sum_of_squares(sign: float) -> float:
        moved_sheet = displaced(truth, sign * step * direction)
        found = outline_distances(contours, moved_sheet.plane, lambda places: moved_sheet.heights(places)[0])
        return float((weights * found.pixels**2).sum() / 2)

    from panoless.plane_contours import robust_weights

    here = outline_distances(contours, truth.plane, lambda places: truth.heights(places)[0])
    weights = robust_weights(here, ALL_VOTE)
    gradient, _ = edge_equations(contours, truth, ALL_VOTE)
    difference = (half_sum_of_squares(1) - half_sum_of_squares(-1)) / (2 * step)
    scale = np.sqrt(
        (weights * here.pixels**2).sum() * (direction @ edge_equations(contours, truth, ALL_VOTE)[1] @ direction)
    )
    assert abs(gradient @ direction - difference) < 0.02 * scale


def test_contours_alone_recover_the_plane_of_the_frame_and_the_height_of_the_edge(truth: Sheet, views: Views) -> None:
    """A tilt of 0.3° that was put in is gone, although a bent mirror gave it away to no color."""
    tilted = moved_plane(PLANE, np.append([np.radians(0.3), np.radians(-0.2), 0.0, 0.0], np.zeros(PLANE.outline.size)))
    contours, sheet = view_contours(views), flat_sheet(tilted, 4)
    for scale in EDGE_SCALES_PX:
        sheet = moved(sheet, *edge_equations(contours, sheet, scale))
    assert np.degrees(np.arccos(sheet.plane.normal @ PLANE.normal)) < 0.03
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

    def cost(sign: float) -> float:
        shifted = displaced(sheet, sign * step * np.append(np.zeros(4 + PLANE.outline.size), direction))
        total, first = 0.0, 0
        residual = np.concatenate([residual_of(shifted, index) for index in range(len(views.train))])
        assert len(residual) == len(texel)
        for channel in residual.T:
            mean = np.bincount(texel, channel) / count
            total += ((channel - mean[texel]) ** 2).sum() / 2
        return total + first

    stride = max(1, sum(len(view.solid) for view in views.train) // 20_000)
    kept = [sightings(sheet, view, view.solid[i % stride :: stride]).pixels for i, view in enumerate(views.train)]

    def residual_of(shifted: Sheet, index: int) -> np.ndarray:
        view = views.train[index]
        bare = replace(shifted, plane=replace(shifted.plane, rim_height=0.0))
        found = sightings(bare, view, kept[index])
        return patterned(found.outgoing) - view.radiance.flatten(1)[:, found.pixels].T.double().numpy()

    difference = (cost(1) - cost(-1)) / (2 * step) / 0.05**2
    scale = np.sqrt(2 * cost(0) / 0.05**2 * (direction @ matrix @ direction))
    assert abs(gradient @ direction - difference) < 0.05 * scale


def test_no_photograph_tells_the_tilt_of_a_flat_mirror(views: Views) -> None:
    """Its curvature in the eliminated matrix is a hundredth of what it is for a map that stands still."""
    flat = flat_sheet(PLANE, 4)
    seen = observations(sheet_views(flat, arc(16)), flat, 100_000)
    _, eliminated = photometric_equations(seen, flat, texel_map(64), ALL_VOTE)
    alone = Observations(seen.ways, seen.hits, Rays(seen.rays.directions, seen.rays.radiance))
    rows, columns = flat.coefficients.shape
    tilt = np.repeat(np.arange(rows) - rows / 2, columns)
    bump = np.random.default_rng(5).normal(size=tilt.shape)
    bump *= np.linalg.norm(tilt) / np.linalg.norm(bump)
    assert len(alone.ways) > 0
    assert tilt @ eliminated @ tilt < 0.01 * (bump @ eliminated @ bump)


def test_a_bent_and_tilted_mirror_is_recovered(truth: Sheet, views: Views) -> None:
    """From a flat start whose plane is tilted by 0.4°; the mirror itself turns by up to 8°."""
    tilted = moved_plane(PLANE, np.append([np.radians(0.3), np.radians(-0.2), 0.0, 0.0], np.zeros(PLANE.outline.size)))
    found = fit_sheet(views, tilted)
    start = np.mean(normal_errors_deg(flat_sheet(tilted, 4), truth, views.train[8].camera))
    assert start > 1.5
    assert np.mean(normal_errors_deg(found, truth, views.train[8].camera)) < start / 20
