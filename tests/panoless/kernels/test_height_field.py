"""Rays against a height over a plane: the fast kernel agrees with the definition, and that with a tilted plane."""

import numpy as np
import pytest

from panoless.kernels.height_field import first_hits

ROWS, COLUMNS = 9, 7


def rays(count: int) -> tuple[np.ndarray, np.ndarray]:
    """From above toward places on and around the knots; some rise, some start below."""
    generator = np.random.default_rng(0)
    origins = np.concatenate([generator.uniform(-3, 9, (count, 2)), generator.uniform(2, 6, (count, 1))], 1)
    ends = np.concatenate([generator.uniform(-2, 8, (count, 2)), np.zeros((count, 1))], 1)
    directions = ends - origins
    directions[:20, 2] *= -1
    origins[20:40, 2] *= -1
    return origins, directions


def test_hits_and_slopes_are_those_of_the_definition() -> None:
    coefficients = 0.3 * np.random.default_rng(1).normal(size=(ROWS, COLUMNS))
    origins, directions = rays(1000)
    fast, plain = (first_hits(origins, directions, coefficients, backend=name) for name in ("cpu", "reference"))
    met = np.isfinite(plain[0])
    assert 0.5 < met.mean() < 0.98
    assert not met[:40].any()
    np.testing.assert_array_equal(np.isfinite(fast[0]), met)
    np.testing.assert_allclose(fast[0][met], plain[0][met], atol=1e-8)
    np.testing.assert_allclose(fast[1], plain[1], atol=1e-6)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_coefficients_on_a_plane_are_that_plane(backend) -> None:
    """Within the knots and beyond them: z = 0.1 x − 0.2 y + 0.05, met at −(o_z − h(o))/(d_z − ∇h·d)."""
    i, j = np.meshgrid(np.arange(ROWS) - 1.0, np.arange(COLUMNS) - 1.0, indexing="ij")
    slope = np.array([0.1, -0.2])
    origins, directions = (part[40:] for part in rays(300))
    distance, slopes = first_hits(origins, directions, slope[0] * i + slope[1] * j + 0.05, backend=backend)
    expected = (0.05 + origins[:, :2] @ slope - origins[:, 2]) / (directions[:, 2] - directions[:, :2] @ slope)
    facing = (directions[:, 2] - directions[:, :2] @ slope < 0) & (expected > 0)
    assert facing.mean() > 0.9
    np.testing.assert_allclose(distance[facing], expected[facing], atol=1e-8)
    np.testing.assert_allclose(slopes[facing], np.tile(slope, (facing.sum(), 1)), atol=1e-12)
