"""In near surroundings rays look where they meet the walls, and what they see there determines how near these are."""

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float

from panoless.environment.nearness import LeavingRays, Linearized, found_surroundings, upward, with_floor
from panoless.environment.surroundings import FAR, Floor, Surroundings, harmonics
from panoless.geometry.base import from_plain, to_plain
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.selection.surroundings import LARGEST_FLOOR_COST, LEAST_PULL
from tests.support.mirror_revolution import goblet
from tests.support.synthetic_dataset import environment_radiance

SPHERE = Surroundings(np.array([0.2]))
WALLS = Surroundings(np.array([0.2, 0.01, -0.02, 0.015, 0.01, -0.005, 0.01, 0.005, 0.02]))
LEANING = np.array([0.1, -0.05, 1.0]) / np.linalg.norm([0.1, -0.05, 1.0])
FLOOR = Floor(LEANING, 0.8, 2.5)
BELOW = Surroundings(np.array([0.2]), FLOOR)


def unit(count: int, seed: int = 0) -> Float[np.ndarray, "P 3"]:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def inside(count: int, seed: int = 1) -> Float[np.ndarray, "P 3"]:
    return unit(count, seed) * np.random.default_rng(seed).uniform(0, 1, (count, 1)) ** (1 / 3)


def met_sphere(
    points: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], radius: float
) -> Float[np.ndarray, "P 3"]:
    """Where rays from within meet a sphere about the origin, by the quadratic equation."""
    half = (points * directions).sum(1)
    distance = -half + np.sqrt(half**2 - (points**2).sum(1) + radius**2)
    return points + distance[:, None] * directions


@pytest.mark.parametrize("radius", [5.0, 1 / 0.59])
def test_a_sphere_is_looked_up_where_rays_meet_it(radius: float) -> None:
    """Also where it nearly touches the unit ball, and the ray begins on that."""
    sphere, points, directions = Surroundings(np.array([1 / radius])), inside(500), unit(500)
    hits = met_sphere(points, directions, radius)
    np.testing.assert_allclose(sphere.looked_up(points, directions), hits / radius, atol=1e-12)
    for start in (points[0], directions[0]):
        found = sphere.inverse_distance_from(start, directions)
        expected = np.linalg.norm(met_sphere(np.tile(start, (500, 1)), directions, radius) - start, axis=1)
        np.testing.assert_allclose(1 / found, expected, rtol=1e-12)


def test_walls_are_looked_up_where_rays_meet_them() -> None:
    """The wall's point in the direction ω′ lies on the ray, to the error of the fixed point."""
    points, directions = inside(500), unit(500)
    found = WALLS.looked_up(points, directions)
    way = found / WALLS.inverse_distance(found)[:, None] - points
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    np.testing.assert_allclose(way, directions, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)


def test_a_far_world_is_looked_up_as_it_is_mirrored() -> None:
    directions = unit(10)
    assert FAR.looked_up(inside(10), directions) is directions
    assert Surroundings(np.zeros(4)).is_far
    assert not FAR.inverse_distance(directions).any()


def test_harmonics_are_polynomials_in_the_order_of_stored_coefficients() -> None:
    """With a mean square of one over the sphere, which is that of x, xy and x² − y² to within their factors."""
    x, y, z = unit(100).T
    first = [np.ones_like(x), *(np.sqrt(3) * each for each in (x, y, z))]
    second = [np.sqrt(15) * each for each in (x * y, y * z, z * x, (x**2 - y**2) / 2)]
    expected = np.stack([*first, *second, np.sqrt(5) / 2 * (3 * z**2 - 1)], -1)
    for count in (0, 1, 4, 9):
        np.testing.assert_allclose(harmonics(unit(100), count), expected[:, :count], atol=1e-14)


def by_turns(
    around: Surroundings,
    points: Float[np.ndarray, "P 3"],
    directions: Float[np.ndarray, "P 3"],
    turned: Float[np.ndarray, "P 3"],
    step: float,
) -> Float[np.ndarray, "P 3"]:
    """Differences of ω′ by turns of ω."""
    ways = [directions + sign * step * turned for sign in (1, -1)]
    ahead, behind = (around.looked_up(points, way / np.linalg.norm(way, axis=1, keepdims=True)) for way in ways)
    return (ahead - behind) / (2 * step)


def test_light_changes_with_direction_and_distance_as_rows_say() -> None:
    """Of linear light a·ω′ differences are derivatives: by mirrored directions for a sphere, by its distance, too."""
    points, directions, slope = inside(50), unit(50), np.array([0.3, -0.5, 0.7])
    looked_up = SPHERE.looked_up(points, directions)
    across = slope - (looked_up @ slope)[:, None] * looked_up
    turned = np.cross(unit(50, 5), directions)
    step = 1e-5
    expected = (by_turns(SPHERE, points, directions, turned, step) * across).sum(1)
    found = (SPHERE.slopes_by_mirrored(across[:, None], points, directions)[:, 0] * turned).sum(1)
    np.testing.assert_allclose(found, expected, atol=1e-8)
    nearer, farther = (SPHERE.after(np.array([sign * step])).looked_up(points, directions) for sign in (1, -1))
    expected = ((nearer - farther) / (2 * step) * across).sum(1)
    np.testing.assert_allclose(SPHERE.rows(across[:, None], points, directions)[:, 0, 0], expected, atol=1e-8)


def seen_in(radius: float | None, count: int = 10_000) -> LeavingRays:
    """What rays from all over a ball see of the synthetic environment, painted on a sphere or infinitely far."""
    points, directions = inside(count), unit(count)
    looked_up = directions if radius is None else met_sphere(points, directions, radius) / radius
    return LeavingRays(points, directions, environment_radiance(looked_up).clip(0, 1))


@pytest.mark.parametrize("radius", [4.0, 12.0])
def test_the_distance_of_a_sphere_is_found(radius: float) -> None:
    """Within 5 %: maps of 32 texels a side are still sharpened by further steps."""
    found = found_surroundings(seen_in(radius), FAR.with_degree(0), (8, 8, 16, 16, 16, 32, 32, 32))
    assert found.coefficients[0] == pytest.approx(1 / radius, rel=0.05)


def test_only_a_near_world_pulls() -> None:
    near, far = (Linearized.at(seen_in(radius, 40_000), FAR.with_degree(0), 8).pull() for radius in (8.0, None))
    assert far < LEAST_PULL < near


def test_a_surface_keeps_its_surroundings_on_disk_and_older_ones_are_far() -> None:
    content = to_plain(replace(goblet(), surroundings=WALLS))
    np.testing.assert_array_equal(
        from_plain(SurfaceOfRevolution, content).surroundings.coefficients, WALLS.coefficients
    )
    del content["surroundings"]
    assert from_plain(SurfaceOfRevolution, content).surroundings.is_far


def met_floor(
    points: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], floor: Floor
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P"]]:
    """Where lines meet its plane, by a linear system, and the distance of that from the middle of the disk; infinite
    where rays go up.
    """
    places = np.empty_like(points)
    for index, (point, way) in enumerate(zip(points, directions, strict=True)):
        first = np.cross(way, np.eye(3)[np.abs(way).argmin()])
        across = np.stack([first, np.cross(way, first), floor.up])
        places[index] = np.linalg.solve(across, [*(across[:2] @ point), -floor.depth])
    away = np.linalg.norm(places + floor.depth * floor.up, axis=1)
    return places, np.where(directions @ floor.up < 0, away, np.inf)


def above_floor(count: int, seed: int = 1) -> Float[np.ndarray, "P 3"]:
    return 0.75 * inside(count, seed)


def test_a_floor_is_looked_up_where_rays_meet_it_and_walls_elsewhere() -> None:
    points, directions = above_floor(2000), unit(2000)
    places, away = met_floor(points, directions, FLOOR)
    met = away < FLOOR.reach
    assert 500 < met.sum() < 1000
    found = BELOW.looked_up(points, directions)
    np.testing.assert_allclose(found[met], places[met] / np.linalg.norm(places[met], axis=1, keepdims=True), atol=1e-12)
    np.testing.assert_array_equal(found[~met], SPHERE.looked_up(points, directions)[~met])
    inverse = BELOW.inverse_distance_from(points[0], directions)
    places, away = met_floor(np.tile(points[0], (2000, 1)), directions, FLOOR)
    met = away < FLOOR.reach
    np.testing.assert_allclose(1 / inverse[met], np.linalg.norm(places[met] - points[0], axis=1), rtol=1e-9)
    np.testing.assert_array_equal(inverse[~met], SPHERE.inverse_distance_from(points[0], directions)[~met])


def test_light_from_the_floor_changes_as_rows_and_slopes_say() -> None:
    points, directions = above_floor(400), unit(400)
    _, away = met_floor(points, directions, FLOOR)
    kept = np.abs(away - FLOOR.reach) > 0.1
    kept &= np.abs(directions @ FLOOR.up) > 0.05
    points, directions = points[kept], directions[kept]
    looked_up = BELOW.looked_up(points, directions)
    across = unit(len(points), 3) - (unit(len(points), 3) * looked_up).sum(1, keepdims=True) * looked_up
    step, turned = 1e-6, np.cross(unit(len(points), 5), directions)
    expected = (by_turns(BELOW, points, directions, turned, step) * across).sum(1)
    found = (BELOW.slopes_by_mirrored(across[:, None], points, directions)[:, 0] * turned).sum(1)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    rows = BELOW.rows(across[:, None], points, directions)[:, 0]
    assert rows.shape[1] == BELOW.num_unknowns == 4
    for number, change in enumerate(np.eye(4)):
        ahead, behind = (BELOW.after(sign * step * change).looked_up(points, directions) for sign in (1, -1))
        expected = ((ahead - behind) / (2 * step) * across).sum(1)
        np.testing.assert_allclose(rows[:, number], expected, atol=1e-5)


def test_a_floor_stays_below_the_center() -> None:
    assert FLOOR.after(np.array([0.0, 0.0, -5.0])).depth > 0


def test_a_scaled_room_is_looked_up_alike() -> None:
    points, directions = above_floor(200), unit(200)
    np.testing.assert_allclose(
        BELOW.scaled(0.9).looked_up(0.9 * points, directions), BELOW.looked_up(points, directions), atol=1e-12
    )


def test_a_floor_is_found_by_what_is_mirrored() -> None:
    """Depth within 1 %, and the walls behind within 5 %; it stays as level as cameras have it."""
    points, directions = above_floor(20_000), unit(20_000)
    light = environment_radiance(BELOW.looked_up(points, directions)).clip(0, 1)
    seen, resolutions = LeavingRays(points, directions, light), (16, 16, 16, 32, 32, 32, 32)
    level, left = with_floor(seen, LEANING)
    assert left < LARGEST_FLOOR_COST
    found = found_surroundings(seen, level, resolutions)
    assert found.floor is not None
    np.testing.assert_allclose(found.floor.up, LEANING, atol=1e-12)
    assert found.floor.depth == pytest.approx(FLOOR.depth, rel=0.01)
    assert found.coefficients[0] == pytest.approx(0.2, rel=0.05)


@pytest.mark.parametrize("radius", [None, 5.0])
def test_a_world_without_a_floor_asks_for_none(radius: float | None) -> None:
    _, left = with_floor(seen_in(radius), np.array([0.0, 0.0, 1.0]))
    assert left > LARGEST_FLOOR_COST


def test_up_is_across_the_right_axes_of_level_cameras() -> None:
    turns, leans = np.random.default_rng(0).uniform(-1, 1, (2, 12))
    rights = np.stack([np.cos(turns), np.sin(turns), np.zeros(12)], 1)
    ahead = np.stack([-np.sin(turns) * np.cos(leans), np.cos(turns) * np.cos(leans), np.sin(leans)], 1)
    np.testing.assert_allclose(upward(rights, np.cross(rights, ahead)), [0, 0, 1], atol=1e-12)


def test_a_floor_is_kept_on_disk() -> None:
    kept = from_plain(SurfaceOfRevolution, to_plain(replace(goblet(), surroundings=BELOW))).surroundings.floor
    assert kept is not None
    np.testing.assert_array_equal(kept.up, FLOOR.up)
    assert (kept.depth, kept.reach) == (FLOOR.depth, FLOOR.reach)
