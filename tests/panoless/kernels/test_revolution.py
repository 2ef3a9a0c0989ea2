"""Rays against surfaces of revolution: the fast kernels agree with the definition, and that with closed forms."""

import numpy as np
import pytest
from jaxtyping import Float

from panoless.kernels.revolution import closest_approach, distance_grid, envelope, first_hits, follow, slope_votes

GOBLET = np.array(
    [[0, -0.8], [0.5, -0.8], [0.5, -0.7], [0.1, -0.6], [0.12, 0.0], [0.55, 0.3], [0.6, 0.8], [0.5, 0.35], [0, 0.1]]
)
"""Level, steep and hollow sides; outside up to (0.6, 0.8), then inside."""
COUNT = 600


def rays(seed: int) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """From outside toward points near the goblet; directions are not unit."""
    generator = np.random.default_rng(seed)
    origins, targets = 3 * generator.normal(size=(COUNT, 3)), generator.uniform(-0.8, 0.8, (COUNT, 3))
    return origins, 0.3 * (targets - origins)


def unit_rays(seed: int) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    origins, directions = rays(seed)
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def angles() -> Float[np.ndarray, "S 2"]:
    """Directions of the sides, bent a little so that they are interpolated."""
    steps = np.diff(GOBLET, axis=0)
    own = np.arctan2(steps[:, 1], steps[:, 0])
    return np.stack([own - 0.05, own + 0.05], 1)


def test_first_hits_are_those_of_the_definition() -> None:
    origins, directions = rays(0)
    # Some rays start inside the bowl, some run along the axis or level.
    origins[:50], directions[50:60, :2], directions[60:70, 2] = [0.05, 0.02, 0.6], 0.0, 0.0
    fast, plain = (first_hits(origins, directions, GOBLET, backend=name) for name in ("cpu", "reference"))
    met = plain[1] >= 0
    assert 0.2 < met.mean() < 0.9
    np.testing.assert_array_equal(fast[1], plain[1])
    for own, expected in zip(fast, plain, strict=True):
        np.testing.assert_allclose(own[met], expected[met], atol=1e-6)
    assert np.isinf(fast[0][~met]).all()
    assert np.isinf(plain[0][~met]).all()
    # What is met lies on the side that is named, at the place that is named.
    points = origins + np.where(met, plain[0], 0.0)[:, None] * directions
    on_profile = GOBLET[plain[1]] + plain[2][:, None] * np.diff(GOBLET, axis=0)[plain[1]]
    np.testing.assert_allclose(np.hypot(points[met, 0], points[met, 1]), on_profile[met, 0], atol=1e-7)
    np.testing.assert_allclose(points[met, 2], on_profile[met, 1], atol=1e-7)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_cone_is_met_where_algebra_says(backend) -> None:
    """ρ = 1 − h for h in [0, 1]; a level ray at height 0.25 along x meets it at x = −0.75."""
    distance, side, along = first_hits(
        np.array([[-3.0, 0.0, 0.25], [-3.0, 0.8, 0.25]]), np.array([[2.0, 0, 0]] * 2), np.array([[1.0, 0], [0, 1.0]]),
        backend=backend,
    )  # fmt: skip
    assert distance[0] == pytest.approx(2.25 / 2)
    assert (side.tolist(), along[0]) == ([0, -1], pytest.approx(0.25))


def test_rays_are_followed_as_the_definition_does() -> None:
    origins, directions = unit_rays(1)
    distance, side, along = first_hits(origins, directions, GOBLET)
    met = side >= 0
    points = origins[met] + distance[met, None] * directions[met]
    arguments = (points, directions[met], (side[met], along[met]), GOBLET, angles(), 1e-4, 6)
    (left, fast, times), (last, plain, expected) = (follow(*arguments, backend=name) for name in ("cpu", "reference"))
    assert set(np.unique(expected)) > {1, 2, 3}
    # Reflections multiply differences of rounding, and a ray that grazes an edge may go either way.
    same = times == expected
    assert same.mean() > 0.99
    np.testing.assert_allclose(fast[same & (times < 4)], plain[same & (times < 4)], atol=1e-6)
    np.testing.assert_allclose(left[same & (times < 4)], last[same & (times < 4)], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(fast[times > 0], axis=1), 1)
    assert not fast[times == 0].any()


def test_envelopes_are_those_of_the_definition() -> None:
    arguments = (*unit_rays(2), -1.0, 0.05, 40, 3, 1.5)
    fast, plain = (envelope(*arguments, backend=name) for name in ("cpu", "reference"))
    assert np.isfinite(plain).all()
    np.testing.assert_allclose(fast, plain, atol=1e-9)
    few = (*(part[:2] for part in unit_rays(2)), *arguments[2:])
    np.testing.assert_allclose(envelope(*few), envelope(*few, backend="reference"), atol=1e-9)
    assert np.isinf(envelope(*few)[:, 2]).all()


def test_distances_from_a_profile_are_those_of_the_definition() -> None:
    fast, plain = (distance_grid(GOBLET, -1.0, 0.05, 41, 21, backend=name) for name in ("cpu", "reference"))
    np.testing.assert_allclose(fast, plain, atol=1e-12)
    # On the axis at the height −0.5, inside the stem, whose wall leans by 0.02 over 0.6 from ρ = 0.1 on.
    assert plain[10, 0] == pytest.approx(-(0.1 + 0.1 * 0.02 / 0.6) * 0.6 / np.hypot(0.6, 0.02))
    assert plain[20, 10] > 0


def test_rays_come_nearest_where_the_definition_has_it() -> None:
    cell = 0.02
    grid = distance_grid(GOBLET, -1.2, cell, 120, 70)
    arguments = (*unit_rays(3), GOBLET, grid, -1.2, cell, 1.5)
    arguments[0][:40] += 10.0
    fast, plain = (closest_approach(*arguments, backend=name) for name in ("cpu", "reference"))
    assert 30 <= (plain[2] < 0).sum() <= 40
    for own, expected in zip(fast, plain, strict=True):
        np.testing.assert_allclose(own, expected, atol=1e-9)
    # Along a ray that passes outside no point is nearer than the one named, but for what a grid of cells leaves.
    origins, directions = arguments[:2]
    for ray in np.flatnonzero((plain[2] >= 0) & (plain[1] > 0))[:20]:
        points = origins[ray] + np.linspace(0, 12, 4001)[:, None] * directions[ray]
        meridian = np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], 1)
        starts, sides = GOBLET[:-1], np.diff(GOBLET, axis=0)
        along = (((meridian[:, None] - starts) * sides).sum(-1) / (sides**2).sum(1)).clip(0, 1)
        gaps = np.linalg.norm(starts + along[..., None] * sides - meridian[:, None], axis=-1)
        assert plain[1][ray] < gaps.min() + cell / 2


def test_rays_come_nearest_to_a_profile_that_begins_off_the_axis() -> None:
    """What is inside then jumps from one height to the next, so no step may be left out."""
    cell, profile = 0.02, GOBLET[1:]
    grid = distance_grid(profile, -1.2, cell, 120, 70)
    arguments = (*unit_rays(3), profile, grid, -1.2, cell, 1.5)
    fast, plain = (closest_approach(*arguments, backend=name) for name in ("cpu", "reference"))
    for own, expected in zip(fast, plain, strict=True):
        np.testing.assert_allclose(own, expected, atol=1e-9)


def test_votes_of_slopes_are_those_of_the_definition() -> None:
    generator = np.random.default_rng(4)
    origins = np.concatenate([generator.uniform(-0.3, 0.3, (80, 2)), np.full((80, 1), 2.0)], 1)
    directions = np.concatenate([generator.uniform(-0.3, 0.3, (80, 2)), np.full((80, 1), -1.0)], 1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[0] = [0.6, 0.0, 0.8]
    frame = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    arguments = (
        origins, directions, generator.uniform(size=(80, 3)), generator.uniform(size=(6, 8, 8, 3)),
        frame, np.array([0.05, 0.55, 10, 8, 0.4]), np.linspace(0.1, 3.0, 12), 0.15,
    )  # fmt: skip
    fast, plain = (slope_votes(*arguments, backend=name) for name in ("cpu", "reference"))
    assert plain[1].max() > 3
    assert (plain[1] == 0).any()
    np.testing.assert_array_equal(fast[1], plain[1])
    np.testing.assert_allclose(fast[0], plain[0], atol=1e-9)
