"""A bent mirror: surfels follow from heights, and heights from what the mirror shows."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.cubemap import solve_environment
from panoless.kernels.reference.rasterize import rotation_matrices
from panoless.observation import observed_rays, prediction_error, reflections
from panoless.shading import rasterize_surfels
from panoless.sheet import Sheet, SheetSurfels, flat_sheet, sheet_surfels
from panoless.sheet_fit import NOTHING, _bout
from panoless.surfels import Surfels
from panoless.views import Normalization, Views
from tests.support.mirror_plane import NORMAL, RECTANGLE, arc, mirror_views, plane_of
from tests.support.mirror_sphere import tiny_config

COUNT = 300
PLANE = plane_of(RECTANGLE)


def normals_of(surfels: Surfels) -> Float[np.ndarray, "K 3"]:
    return rotation_matrices(surfels.quats)[:, :, 2].detach().numpy().astype(np.float64)


def coordinates_of(surfels: Surfels) -> Float[np.ndarray, "K 2"]:
    tangents = np.stack([PLANE.tangent_u, PLANE.tangent_v], 1)
    return surfels.means.detach().numpy().astype(np.float64) @ tangents


def spline_through(sheet: Sheet, bend: Float[np.ndarray, "2 2"]) -> Float[Tensor, "M N"]:
    """Coefficients of h = ½ pᵀ bend p: a cubic B-spline of a quadratic is its value less spacing²/6 of each bend."""
    rows, columns = sheet.coefficients.shape
    u = sheet.low[0] + sheet.spacing * (np.arange(rows) - 1)
    v = sheet.low[1] + sheet.spacing * (np.arange(columns) - 1)
    height = (bend[0, 0] * u[:, None] ** 2 + bend[1, 1] * v**2) / 2 + bend[0, 1] * u[:, None] * v
    return torch.from_numpy(height - np.trace(bend) * sheet.spacing**2 / 6).float()


def test_without_height_the_surfels_are_those_of_the_plane() -> None:
    surfels = SheetSurfels(flat_sheet(PLANE, 8), COUNT, 0).surfels(flat_sheet(PLANE, 8).coefficients)
    assert np.allclose(normals_of(surfels), NORMAL, atol=1e-6)
    assert np.allclose(surfels.means.numpy() @ NORMAL, PLANE.offset, atol=1e-6)
    assert torch.count_nonzero(surfels.curvatures) == 0


def test_a_tilt_is_exact() -> None:
    """Every surfel turns by atan |slope| about the same axis and none bends."""
    tilted = flat_sheet(PLANE, 8).tilted(0.03, -0.02)
    surfels = SheetSurfels(tilted, COUNT, 0).surfels(tilted.coefficients)
    expected = NORMAL - 0.03 * PLANE.tangent_u + 0.02 * PLANE.tangent_v
    assert np.allclose(normals_of(surfels), expected / np.linalg.norm(expected), atol=1e-5)
    assert surfels.curvatures.abs().max() < 1e-3


def test_a_quadratic_has_its_normals_heights_and_curvatures() -> None:
    """h = ½ pᵀ B p has the gradient B p and the bending B everywhere."""
    sheet, bend = flat_sheet(PLANE, 8), np.array([[0.1, 0.03], [0.03, -0.08]])
    surfels = SheetSurfels(sheet, COUNT, 0).surfels(spline_through(sheet, bend))
    p = coordinates_of(surfels)
    slope = p @ bend
    expected = NORMAL - slope[:, :1] * PLANE.tangent_u - slope[:, 1:] * PLANE.tangent_v
    norm = np.linalg.norm(expected, axis=1, keepdims=True)
    height = surfels.means.numpy().astype(np.float64) @ NORMAL - PLANE.offset
    assert np.allclose(height, (p @ bend * p).sum(1) / 2, atol=1e-5)
    assert np.allclose(normals_of(surfels), expected / norm, atol=1e-4)
    assert np.allclose(surfels.curvatures.numpy() * norm, [0.1, 0.03, -0.08], atol=2e-3)


def test_normals_turn_as_their_curvatures_say() -> None:
    """Along the tangent u a normal changes by −curvature per length, to first order in the slope."""
    sheet = flat_sheet(PLANE, 6)
    sheet = replace(sheet, coefficients=0.02 * torch.randn(sheet.coefficients.shape, generator=torch.manual_seed(1)))
    mirror = SheetSurfels(sheet, COUNT, 0)
    surfels, step = mirror.surfels(sheet.coefficients), 1e-2 * sheet.spacing
    shifted = replace(sheet, low=sheet.low - np.array([step, 0.0]))
    moved = SheetSurfels(shifted, COUNT, 0).surfels(sheet.coefficients)
    turn = (normals_of(moved) - normals_of(surfels)) @ PLANE.tangent_u / step
    scale = float(surfels.curvatures[:, 0].abs().max())
    assert np.abs(turn + surfels.curvatures[:, 0].numpy()).max() < 0.1 * scale


def test_gradients_are_those_of_finite_differences() -> None:
    sheet = flat_sheet(PLANE, 5)
    mirror = SheetSurfels(sheet, COUNT, 0)
    start = 0.05 * torch.randn(sheet.coefficients.shape, generator=torch.manual_seed(2))
    weights = torch.randn(10, COUNT + 200, generator=torch.manual_seed(3))

    def value(coefficients: Tensor) -> Tensor:
        surfels = mirror.surfels(coefficients)
        numbers = torch.cat([surfels.means, surfels.quats, surfels.curvatures], 1).T
        return (numbers * weights[:, : numbers.shape[1]]).sum() + mirror.bending(coefficients)

    leaf = start.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    direction = torch.randn(start.shape, generator=torch.manual_seed(4))
    step = 2e-3
    difference = (value(start + step * direction) - value(start - step * direction)) / (2 * step)
    assert float((gradient * direction).sum()) == pytest.approx(float(difference), rel=1e-2)


def patterned(directions: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """An environment with detail everywhere, in [0, 1]."""
    waves = 6 * torch.randn(3, 3, generator=torch.manual_seed(6)).numpy()
    return 0.5 + 0.25 * np.sin(directions @ waves) + 0.25 * np.sin(2 * directions @ waves[::-1].T)


def test_heights_explain_a_bent_mirror_better_than_its_plane() -> None:
    """Steps from a flat start lower the error of the closed-form map by a third."""
    bent = flat_sheet(PLANE, 4)
    bent = replace(bent, coefficients=0.006 * torch.randn(bent.coefficients.shape, generator=torch.manual_seed(5)))
    truth, train = sheet_surfels(bent, 1500, 1), []
    for view in mirror_views(PLANE, arc(12, size=64)).train:
        raster = rasterize_surfels(truth, view.camera, curved=True, channels=NOTHING)
        radiance = torch.zeros_like(view.radiance)
        seen = patterned(reflections(view, raster.normals_camera, view.solid).double().numpy())
        radiance.flatten(1)[:, view.solid] = torch.from_numpy(seen.T).float()
        train.append(replace(view, radiance=radiance))
    views = Views(tuple(train), Normalization(np.zeros(3), 1.0), 0.3)
    config = tiny_config(iterations=500, count=400)
    config = replace(config, environment=replace(config.environment, resolution=32))

    def error(sheet: Sheet) -> float:
        rays = list(observed_rays(views, sheet_surfels(sheet, 400, 0), config, 100_000))
        return prediction_error(rays, solve_environment(rays, 32))

    flat = flat_sheet(PLANE, 6)
    found = _bout(views, config, SheetSurfels(flat, 400, 0), flat, range(500))
    assert error(found) < 2 / 3 * error(flat)
