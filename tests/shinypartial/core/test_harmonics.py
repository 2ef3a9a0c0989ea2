"""Spherical harmonics: orthonormal, of the signs that graphics uses, and of known coefficients for known light."""

import numpy as np
import pytest

from shinypartial.core.harmonics import project_latlong, real_harmonics
from shinypartial.core.sphere import latlong_directions

DEGREE = 4
WORLD = np.eye(3)


def quadrature() -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights that integrate polynomials of degree 8 over the sphere exactly: Gauss by uniform."""
    z, weight = np.polynomial.legendre.leggauss(6)
    azimuth = 2 * np.pi * (np.arange(12) + 0.3) / 12
    across = np.sqrt(1 - z**2)[:, None]
    directions = np.stack(
        [across * np.cos(azimuth), across * np.sin(azimuth), np.broadcast_to(z[:, None], (6, 12))], -1
    )
    return directions.reshape(-1, 3), np.repeat(weight * 2 * np.pi / 12, 12)


def test_they_are_orthonormal() -> None:
    directions, weight = quadrature()
    basis = real_harmonics(directions, DEGREE)
    np.testing.assert_allclose(basis.T @ (basis * weight[:, None]), np.eye(25), atol=1e-12)


def test_the_first_nine_are_the_polynomials_of_ramamoorthi_and_hanrahan() -> None:
    """Their equation 3, which three.js, Unity and others copy, with its order and its signs."""
    directions, _ = quadrature()
    x, y, z = directions.T
    expected = [
        0.282095 * np.ones_like(x), 0.488603 * y, 0.488603 * z, 0.488603 * x, 1.092548 * x * y, 1.092548 * y * z,
        0.315392 * (3 * z**2 - 1), 1.092548 * x * z, 0.546274 * (x**2 - y**2),
    ]  # fmt: skip
    np.testing.assert_allclose(real_harmonics(directions, 2), np.stack(expected, -1), atol=2e-6)


def test_constant_light_has_one_coefficient() -> None:
    coefficients = project_latlong(np.full((64, 128, 1), 2.0), DEGREE, WORLD)[:, 0]
    # Centers of 64 rows stand for whole texels: measured 2e-3.
    np.testing.assert_allclose(coefficients, [2 * np.sqrt(4 * np.pi), *[0.0] * 24], atol=4e-3)


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.36, -0.48, 0.8)])
def test_a_cosine_lobe_has_its_known_coefficients(axis: tuple[float, float, float]) -> None:
    """max(0, d·a) has A_l Y_lm(a), by Funk and Hecke, with A = π, 2π/3, π/4, 0, −π/24."""
    lobe = np.maximum(latlong_directions(128) @ np.array(axis), 0)[..., None]
    factors = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4, 0, -np.pi / 24], [1, 3, 5, 7, 9])
    expected = factors * real_harmonics(np.array(axis), DEGREE)
    np.testing.assert_allclose(project_latlong(lobe, DEGREE, WORLD)[:, 0], expected, atol=1e-3)


def test_other_axes_turn_the_light() -> None:
    """Light from the second axis is light along y, whatever direction of the world that is."""
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    linear = latlong_directions(128) @ turn[:, 1:2]
    found = project_latlong(linear, 1, turn)[:, 0]
    np.testing.assert_allclose(found, [0, np.sqrt(4 * np.pi / 3), 0, 0], atol=1e-3)
