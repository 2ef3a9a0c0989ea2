"""A level set's kernels agree with their definitions, and these with finite differences."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from panoless.kernels.level_set import (
    add_rows,
    add_squares,
    apply_rows,
    evaluate,
    first_hits,
    mirror_rows,
    mirrored,
    nearest_approach,
    seen_with_slopes,
    third_differences,
    without_means,
)

SIDE = 14
MIDDLE = (SIDE - 3) / 2


def bumpy_ball(radius: float = 0.65, noise: float = 0.05) -> np.ndarray:
    """Distance from a sphere at the peaks of the coefficients, roughly, in cells."""
    axis = np.arange(SIDE) - 1 - MIDDLE
    distance = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), axis=-1)
    return distance - radius * MIDDLE + noise * np.random.default_rng(0).normal(size=distance.shape)


def rays(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """From all around toward the ball and past it."""
    generator = np.random.default_rng(seed)
    origins = generator.normal(size=(count, 3))
    origins *= 30 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = 3 * generator.normal(size=(count, 3)) - origins
    return origins + MIDDLE, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def hits() -> dict[str, np.ndarray]:
    """A ball's hits, and what is random about the pixels."""
    coefficients, (origins, directions) = bumpy_ball(), rays(300)
    distance = first_hits(coefficients, origins, directions)
    met, generator = np.isfinite(distance), np.random.default_rng(2)
    places = origins[met] + distance[met, None] * directions[met]
    return {
        "coefficients": coefficients,
        "directions": directions[met],
        "distance": distance[met],
        "places": places,
        "derivatives": evaluate(coefficients, places),
        "steps": 0.01 * generator.normal(size=(len(places), 2, 3)),
        "slopes": generator.normal(size=(len(places), 3, 3)),
        "weights": generator.random(len(places)) * (np.arange(len(places)) % 5 > 0),
    }


def test_values_and_derivatives_are_those_of_the_definition() -> None:
    places = np.random.default_rng(0).uniform(0, SIDE - 3, (400, 3))
    fast, plain = (evaluate(bumpy_ball(), places, backend=name) for name in ("cpu", "reference"))
    np.testing.assert_allclose(fast, plain, atol=1e-12)


def test_rays_meet_the_surface_where_dense_samples_do() -> None:
    coefficients, (origins, directions) = bumpy_ball(), rays(300)
    fast, plain = (first_hits(coefficients, origins, directions, backend=name) for name in ("cpu", "reference"))
    assert 0.3 < np.isfinite(plain).mean() < 0.7
    np.testing.assert_array_equal(np.isfinite(fast), np.isfinite(plain))
    met = np.isfinite(fast)
    np.testing.assert_allclose(fast[met], plain[met], rtol=1e-9)
    assert np.abs(evaluate(coefficients, origins[met] + fast[met, None] * directions[met])[:, 0]).max() < 1e-7


def test_rays_that_leave_a_dent_meet_its_other_side() -> None:
    """A ball with a ball cut out: from the bottom of the dent a slanted ray meets the wall, a straight one nothing."""
    axis = np.arange(SIDE) - 1 - MIDDLE
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    body = np.maximum(np.sqrt(x**2 + y**2 + z**2) - 4, 2.6 - np.sqrt((x - 3.4) ** 2 + y**2 + z**2))
    bottom = np.array([[MIDDLE - 2, MIDDLE, MIDDLE]])
    start = first_hits(body, bottom + np.array([[9.0, 0, 0]]), np.array([[-1.0, 0, 0]]))
    origin = bottom + np.array([[9.0 - start[0], 0, 0]])
    for direction, again in (((1.0, 0.0, 0.0), False), ((0.2, 0.98, 0.0), True)):
        unit = np.array([direction]) / np.linalg.norm(direction)
        for backend in ("cpu", "reference"):
            found = first_hits(body, origin, unit, leaving=True, backend=backend)
            assert np.isfinite(found[0]) == again


def test_rays_come_nearest_where_dense_samples_do() -> None:
    coefficients, (origins, directions) = bumpy_ball(), rays(200)
    fast, plain = (nearest_approach(coefficients, origins, directions, backend=name) for name in ("cpu", "reference"))
    np.testing.assert_array_equal(np.isfinite(fast), np.isfinite(plain))
    met = np.isfinite(fast)
    value = [evaluate(coefficients, (origins + t[:, None] * directions)[met])[:, 0] for t in (fast, plain)]
    np.testing.assert_allclose(*value, atol=1e-4)


@pytest.mark.parametrize("samples", [1, 4])
def test_mirrored_rays_are_those_of_the_definition(samples: int, hits: dict[str, np.ndarray]) -> None:
    arguments = hits["derivatives"], hits["directions"], hits["distance"], hits["steps"], samples
    for fast, plain in zip(mirrored(*arguments), mirrored(*arguments, backend="reference"), strict=True):
        np.testing.assert_allclose(fast, plain, atol=1e-10)


def test_mirrored_rays_turn_over_a_pixel_as_traced_ones_do(hits: dict[str, np.ndarray]) -> None:
    """Central differences of rays from one camera whose directions turn by a step."""
    origin = hits["places"] - hits["distance"][:, None] * hits["directions"]
    away = (hits["steps"] * hits["directions"][:, None]).sum(2)
    steps = 1e-3 * (hits["steps"] - away[..., None] * hits["directions"][:, None])
    normals, outgoing, _ = mirrored(hits["derivatives"], hits["directions"], hits["distance"], steps, 4)
    found = 2 * (outgoing[:, 1] - outgoing[:, 0])
    sides = []
    for sign in (-0.5, 0.5):
        directions = hits["directions"] + sign * steps[:, 0]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        distance = first_hits(hits["coefficients"], origin, directions)
        gradient = evaluate(hits["coefficients"], origin + distance[:, None] * directions)[:, 1:4]
        normal = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        sides.append(directions - 2 * (directions * normal).sum(1)[:, None] * normal)
    facing = -(normals * hits["directions"]).sum(1) > 0.2
    error = np.linalg.norm(sides[1] - sides[0] - found, axis=1) / np.linalg.norm(found, axis=1)
    assert np.quantile(error[facing], 0.9) < 0.01


@pytest.mark.parametrize("resolution", [4, 9])
def test_the_light_and_its_slopes_are_those_of_the_definition(resolution: int) -> None:
    generator = np.random.default_rng(3)
    padded = generator.random((6, resolution + 2, resolution + 2, 3))
    directions = generator.normal(size=(500, 4, 3))
    pairs = zip(
        seen_with_slopes(padded, directions), seen_with_slopes(padded, directions, backend="reference"), strict=True
    )
    for fast, plain in pairs:
        np.testing.assert_allclose(fast, plain, atol=1e-12)


def test_rows_are_those_of_the_definition(hits: dict[str, np.ndarray]) -> None:
    arguments = hits["derivatives"], hits["directions"], hits["slopes"]
    np.testing.assert_allclose(mirror_rows(*arguments), mirror_rows(*arguments, backend="reference"), atol=1e-10)


def test_rows_predict_how_mirrored_light_changes_with_the_surface(hits: dict[str, np.ndarray]) -> None:
    """Under light that is linear in the direction, against central differences with the rays traced again."""
    rows = mirror_rows(hits["derivatives"], hits["directions"], hits["slopes"])
    origins = hits["places"] - hits["distance"][:, None] * hits["directions"]
    change = np.random.default_rng(4).normal(size=hits["coefficients"].shape)
    light = []
    for sign in (-1, 1):
        moved = hits["coefficients"] + sign * 1e-5 * change
        distance = first_hits(moved, origins, hits["directions"])
        gradient = evaluate(moved, origins + distance[:, None] * hits["directions"])[:, 1:4]
        normal = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        facing = (hits["directions"] * normal).sum(1)
        light.append(np.einsum("pci,pi->pc", hits["slopes"], hits["directions"] - 2 * facing[:, None] * normal))
    found = apply_rows(change, hits["places"], rows, np.ones(len(rows)))
    steep = -(hits["directions"] * hits["derivatives"][:, 1:4]).sum(1) > 0.2
    expected = (light[1] - light[0]) / 2e-5
    error = np.abs(found - expected).sum(1) / np.abs(expected).sum(1)
    assert np.quantile(error[steep], 0.95) < 0.01


def test_products_are_those_of_the_definition() -> None:
    generator = np.random.default_rng(5)
    shape, places = (6, 5, 7), generator.uniform(0, 2, (40, 3))
    rows, weights, residual = (
        generator.normal(size=(40, 3, 4)),
        generator.normal(size=40),
        generator.normal(size=(40, 3)),
    )
    coefficients = generator.normal(size=shape)
    for product in (
        lambda backend: apply_rows(coefficients, places, rows, weights, backend=backend),
        lambda backend: add_rows(residual, places, rows, weights, shape, backend=backend),
        lambda backend: add_squares(places, rows, weights, shape, backend=backend),
    ):
        np.testing.assert_allclose(product("cpu"), product("reference"), atol=1e-12)


@given(st.integers(0, 1000), st.integers(1, 400))
def test_gathering_and_scattering_are_adjoint(seed: int, count: int) -> None:
    generator = np.random.default_rng(seed)
    coefficients, places = generator.normal(size=(9, 8, 10)), generator.uniform(0, 5, (count, 3))
    rows, weights = generator.normal(size=(count, 2, 4)), generator.random(count)
    residual = generator.normal(size=(count, 2))
    forward = (apply_rows(coefficients, places, rows, weights) * weights[:, None] * residual).sum()
    backward = (coefficients * add_rows(residual, places, rows, weights, coefficients.shape)).sum()
    assert forward == pytest.approx(backward, rel=1e-9, abs=1e-9)


def test_means_of_groups_are_taken_out() -> None:
    generator = np.random.default_rng(7)
    values, weights, groups = generator.normal(size=(200, 3)), generator.random(200), generator.integers(0, 9, 200)
    total = np.bincount(groups, weights, 9) + 0.5
    fast, plain = (without_means(values, weights, groups, total, backend=name) for name in ("cpu", "reference"))
    np.testing.assert_allclose(fast, plain, atol=1e-12)


def test_third_differences_are_those_of_the_definition_and_vanish_on_quadratics() -> None:
    active = np.random.default_rng(8).random((SIDE, SIDE, SIDE)) < 0.9
    fast, plain = (third_differences(bumpy_ball(), active, backend=name) for name in ("cpu", "reference"))
    np.testing.assert_allclose(fast, plain, atol=1e-10)
    i, j, k = np.indices(active.shape)
    np.testing.assert_allclose(third_differences(i * j - 2.0 * k**2 + 3 * i + j * k, active), 0, atol=1e-9)


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    generator = np.random.default_rng(9)
    places, rows, weights = generator.uniform(0, 5, (5000, 3)), generator.normal(size=(5000, 3, 4)), np.ones(5000)
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            residual = apply_rows(bumpy_ball(), places, rows, weights)
            found.append(add_rows(residual, places, rows, weights, (9, 9, 9)))
    finally:
        torch.set_num_threads(threads)
    np.testing.assert_array_equal(*found)


def test_what_fits_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="four coefficients"):
        evaluate(np.zeros((3, 5, 5)), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="samples"):
        mirrored(np.zeros((1, 10)), np.zeros((1, 3)), np.zeros(1), np.zeros((1, 2, 3)), 2)
