"""The solver recovers a known map from rays, outliers lose their vote, gaps are filled smoothly, seams don't show."""

import numpy as np
import pytest
from jaxtyping import Float

from shinypartial.core.sphere import latlong_directions, latlong_solid_angles
from shinypartial.oracle.latlong_solver import Rays, fill_gaps, solve_latlong
from tests.support.synthetic_dataset import environment_radiance

HEIGHT = 32


def directions(count: int, seed: int = 0) -> Float[np.ndarray, "P 3"]:
    """Uniform on the sphere."""
    drawn = np.random.default_rng(seed).normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def smooth_radiance(at: Float[np.ndarray, "*S 3"]) -> Float[np.ndarray, "*S 3"]:
    """Bands of the second order, in [0.2, 0.8]."""
    x, y, z = np.moveaxis(at, -1, 0)
    return np.stack([0.5 + 0.3 * x, 0.5 + 0.6 * x * y, 0.5 + 0.3 * y * z], -1)


def rms(estimate: Float[np.ndarray, "H W 3"], truth: Float[np.ndarray, "H W 3"]) -> float:
    weights = latlong_solid_angles(truth.shape[0])
    return float(np.sqrt(((estimate - truth) ** 2).mean(-1).ravel() @ weights.ravel() / (4 * np.pi)))


def rays(at: Float[np.ndarray, "P 3"], radiance: Float[np.ndarray, "P 3"], footprint_sr: float = 0.0) -> Rays:
    return Rays(at, radiance, np.full(len(at), footprint_sr))


def test_a_smooth_map_is_recovered_everywhere() -> None:
    at = directions(60_000)
    solved = solve_latlong(rays(at, smooth_radiance(at)), HEIGHT)
    truth = smooth_radiance(latlong_directions(HEIGHT))
    # What bilinear interpolation leaves of second-order bands at this size: 1.2e-3 measured.
    assert rms(solved.robust, truth) < 3e-3
    # Beyond the last row the map is flat, which costs half a texel of slope: 0.3 · sin 2.8° = 0.015, measured 0.02.
    for part in (np.s_[:, [0, -1]], np.s_[[0, -1]]):
        assert np.abs(solved.robust[part] - truth[part]).max() < 0.03
    assert solved.evidence.sum() == pytest.approx(len(at), rel=1e-2)  # Robust weights stay near 1.


def test_outliers_lose_their_vote_but_shift_the_average() -> None:
    at = directions(60_000)
    radiance = smooth_radiance(at)
    wrong = np.random.default_rng(1).random(len(at)) < 0.15
    radiance[wrong] = 0.0
    solved = solve_latlong(rays(at, radiance), HEIGHT)
    truth = smooth_radiance(latlong_directions(HEIGHT))
    assert rms(solved.averaged, truth) > 0.05  # 15 % of 0.5 is 0.075.
    assert rms(solved.robust, truth) < 4e-3


def test_pixels_that_see_much_say_little() -> None:
    """Half of the rays see black, through pixels of the size of the sky."""
    at = directions(40_000)
    radiance, footprint = smooth_radiance(at), np.zeros(len(at))
    radiance[::2], footprint[::2] = 0.0, 10.0
    solved = solve_latlong(Rays(at, radiance, footprint), HEIGHT)
    # A footprint of 10 sr is a thousand texels.
    assert rms(solved.averaged, smooth_radiance(latlong_directions(HEIGHT))) < 0.02


def test_lights_keep_their_brightness() -> None:
    at = directions(60_000)
    solved = solve_latlong(rays(at, environment_radiance(at)), HEIGHT)
    truth = environment_radiance(latlong_directions(HEIGHT))
    peak = np.unravel_index(truth.max(-1).argmax(), truth.shape[:2])
    assert truth[peak].min() > 2
    np.testing.assert_allclose(solved.robust[peak], truth[peak], rtol=0.05)


def test_the_solution_turns_with_the_rays() -> None:
    at = directions(30_000)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    maps = [solve_latlong(rays(seen, smooth_radiance(at)), HEIGHT).robust for seen in (at, at @ quarter.T)]
    # +X turns into +Y, which lies a quarter of the width to the left. Float32 sums: 1e-5 measured.
    np.testing.assert_allclose(maps[1], np.roll(maps[0], -HEIGHT // 2, 1), atol=2e-4)


def test_gaps_lie_between_their_surroundings() -> None:
    at = directions(60_000)
    seen = at[at[:, 0] > -0.3]
    solved = solve_latlong(rays(seen, smooth_radiance(seen)), HEIGHT)
    assert np.isfinite(solved.robust).all()
    assert solved.robust.min() > 0.15
    assert solved.robust.max() < 0.85
    inside = latlong_directions(HEIGHT)[..., 0] < -0.6
    assert (solved.evidence[inside] == 0).all()
    steps = np.abs(np.diff(solved.robust, axis=1))[inside[:, 1:] & inside[:, :-1]]
    assert steps.max() < 0.1


@pytest.mark.parametrize("height", [1, 2, 6, 32])
def test_filling_keeps_what_is_known_and_constants(height: int) -> None:
    random = np.random.default_rng(0)
    evidence = (random.random((height, 2 * height)) < 0.4).astype(float)
    evidence[0, 0] = 1.0
    values = random.random((height, 2 * height, 3))
    filled = fill_gaps(values, evidence)
    np.testing.assert_allclose(filled[evidence > 0], values[evidence > 0], atol=1e-12)
    np.testing.assert_allclose(fill_gaps(np.full_like(values, 0.3), evidence), 0.3, atol=1e-12)


def test_no_rays_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one ray"):
        solve_latlong(rays(np.zeros((0, 3)), np.zeros((0, 3))), HEIGHT)
