"""Camera paths: their shapes, the hemisphere that holds them, where all cameras look, and both placements."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shinypartial.core.camera import project
from shinypartial.core.errors import InputError
from shinypartial.core.trajectory import (
    PATHS,
    PLACEMENTS,
    CameraPath,
    Trajectory,
    arc_angles_deg,
    check_hemisphere,
    diamond_angles_deg,
    golden_spiral_angles_deg,
    path_offsets,
    plan_cameras,
    plus_offsets,
    train_indices,
    unit_vectors,
    zigzag_angles_deg,
)

COUNTS = st.integers(1, 60)
SEEDS = st.integers(0, 2**31 - 1)


def ranges(reach: float) -> st.SearchStrategy[tuple[float, float]]:
    """Two different angles in rising order."""
    pair = st.tuples(st.floats(-reach, reach), st.floats(-reach, reach)).map(lambda ends: (min(ends), max(ends)))
    return pair.filter(lambda ends: ends[1] - ends[0] > 0.1)


#: Wider than recipes allow, so that some leave the hemisphere.
SPECS = st.builds(
    CameraPath,
    path=st.sampled_from(PATHS),
    placement=st.sampled_from(PLACEMENTS),
    azimuth_deg=ranges(120.0),
    elevation_deg=ranges(85.0),
    facing_azimuth_deg=st.floats(-360, 360),
    radius=st.floats(0.5, 50),
    sweeps=st.integers(1, 7),
    train=COUNTS,
    test=COUNTS,
    seed=SEEDS,
    target=st.just((0.3, -0.2, 0.1)),
)


def planned(spec: CameraPath) -> Trajectory | None:
    """The cameras, or None where the path is refused."""
    try:
        return plan_cameras(spec, 64)
    except InputError:
        return None


def inside_recipes(spec: CameraPath) -> CameraPath:
    """The same with ranges at most as wide as recipes allow and well away from the boundary."""
    return dataclasses.replace(spec, azimuth_deg=tuple(0.6 * angle for angle in spec.azimuth_deg))


@given(spec=SPECS)
def test_every_path_stays_in_the_hemisphere_or_is_refused(spec: CameraPath) -> None:
    path = planned(spec)
    if path is None:
        return
    for camera in (*path.train, *path.test):
        assert path.hemisphere_axis is None or (camera.position_world - path.target) @ path.hemisphere_axis > 0


@given(spec=SPECS.map(inside_recipes).filter(lambda spec: spec.path not in ("plus", "around")))
def test_paths_on_the_sphere_are_not_refused_within_the_ranges_of_recipes(spec: CameraPath) -> None:
    path = plan_cameras(spec, 64)
    for camera in (*path.train, *path.test):
        offset = camera.position_world - path.target
        assert np.linalg.norm(offset) == pytest.approx(spec.radius)
        azimuth = np.degrees(np.arctan2(offset[1], offset[0])) - spec.facing_azimuth_deg
        elevation = np.degrees(np.arcsin(np.clip(offset[2] / spec.radius, -1, 1)))
        # Arcsine is steep near 85°: rounding of the positions measures 1e-11 degrees here.
        low, high = np.array([spec.azimuth_deg, spec.elevation_deg]).T
        inside = np.array([(azimuth - low[0] + 1e-8) % 360 + low[0] - 1e-8, elevation])
        assert (inside >= low - 1e-8).all()
        assert (inside <= high + 1e-8).all()


@given(spec=SPECS)
def test_every_camera_looks_at_the_target(spec: CameraPath) -> None:
    path = planned(spec)
    if path is None:
        return
    for camera in (*path.train, *path.test):
        distance = np.linalg.norm(camera.position_world - path.target)
        # The optical axis meets the target at the image center, in front.
        np.testing.assert_allclose(project(camera, path.target[None])[0], [32, 32, distance], rtol=1e-9, atol=1e-9)


@given(spec=SPECS)
def test_counts_are_exact_and_no_camera_stands_twice(spec: CameraPath) -> None:
    path = planned(spec)
    if path is None:
        return
    assert (len(path.train), len(path.test)) == (spec.train, spec.test)
    positions = np.stack([camera.position_world for camera in (*path.train, *path.test)]) / spec.radius
    assert len(np.unique(positions.round(9), axis=0)) == spec.train + spec.test


@given(spec=SPECS)
def test_the_same_recipe_gives_the_same_cameras(spec: CameraPath) -> None:
    first, second = planned(spec), planned(spec)
    if first is None or second is None:
        assert first is second
        return
    for one, other in zip((*first.train, *first.test), (*second.train, *second.test), strict=True):
        np.testing.assert_array_equal(one.camera_to_world, other.camera_to_world)


@given(train=COUNTS, test=COUNTS, seed=SEEDS)
def test_interleaved_training_views_are_spread_evenly(train: int, test: int, seed: int) -> None:
    chosen = sorted(train_indices(CameraPath(train=train, test=test, seed=seed)))
    assert len(chosen) == train
    assert 0 <= chosen[0] <= chosen[-1] < train + test
    gaps = set(np.diff(chosen).tolist())
    assert not gaps or max(gaps) - min(gaps) <= 1


@pytest.mark.parametrize(("seed", "first"), [(0, 1), (1, 0), (2, 2)])
def test_every_third_view_of_the_default_path_is_for_training(seed: int, first: int) -> None:
    assert sorted(train_indices(CameraPath(seed=seed))) == list(range(first, 300, 3))


def test_random_splits_are_those_of_their_seeds() -> None:
    splits = [train_indices(CameraPath(placement="random", seed=seed)) for seed in range(20)]
    assert splits == [train_indices(CameraPath(placement="random", seed=seed)) for seed in range(20)]
    assert all(len(split) == 100 and split <= set(range(300)) for split in splits)
    assert all(one != other for one, other in itertools.combinations(splits, 2))


def test_the_default_path_has_five_level_sweeps_walked_back_and_forth() -> None:
    azimuth, elevation = arc_angles_deg(CameraPath(), 300).T
    np.testing.assert_allclose(elevation.reshape(5, 60), np.repeat([[-10], [5], [20], [35], [50]], 60, 1))
    forward = np.linspace(-75, 75, 60)
    np.testing.assert_allclose(azimuth.reshape(5, 60)[::2], np.tile(forward, (3, 1)))
    np.testing.assert_allclose(azimuth.reshape(5, 60)[1::2], np.tile(forward[::-1], (2, 1)))


def test_a_plus_is_two_crossing_lines_in_a_plane() -> None:
    spec = CameraPath(path="plus", azimuth_deg=(-32, 32), elevation_deg=(-20, 20), facing_azimuth_deg=90, radius=2)
    x, y, z = plus_offsets(spec, 300).T
    # Facing +Y: the plane is y = 2, the first line runs along x and the second along z, through the middle.
    np.testing.assert_allclose(y, 2, atol=1e-12)
    np.testing.assert_allclose(z[:150], 0, atol=1e-12)
    np.testing.assert_allclose(x[150:], 0, atol=1e-12)
    np.testing.assert_allclose(np.abs(x[:150]), np.abs(np.linspace(-1, 1, 150)) * 2 * np.tan(np.radians(32)))
    np.testing.assert_allclose(z[150:], np.linspace(-1, 1, 150) * 2 * np.tan(np.radians(20)), atol=1e-12)


@given(elevation=ranges(80.0), count=st.integers(8, 100))
def test_the_upright_line_of_a_plus_reaches_from_elevation_to_elevation(
    elevation: tuple[float, float], count: int
) -> None:
    upright = plus_offsets(CameraPath(path="plus", elevation_deg=elevation), count)[-2 * ((count + 1) // 4) :]
    found = np.degrees(np.arctan2(upright[:, 2], np.hypot(upright[:, 0], upright[:, 1])))
    np.testing.assert_allclose([found[0], found[-1]], elevation, atol=1e-9)


def test_a_plus_of_nearly_a_half_circle_is_refused() -> None:
    with pytest.raises(InputError, match=r"80°.*azimuth_deg"):
        plan_cameras(CameraPath(path="plus", azimuth_deg=(-85, 85)), 64)


def test_a_golden_spiral_fills_its_ellipse_evenly() -> None:
    spec = CameraPath(path="golden_spiral", azimuth_deg=(-60, 60), elevation_deg=(-10, 50))
    points = (golden_spiral_angles_deg(spec, 300) - [0, 20]) / [60, 30]
    outward = np.linalg.norm(points, axis=-1)
    np.testing.assert_allclose(outward**2, (np.arange(300) + 0.5) / 300)
    distances = np.linalg.norm(points[:, None] - points, axis=-1) + 10 * np.eye(300)
    # For a hexagonal lattice of 300 points in the unit disk every neighbor would be at 0.110.
    assert distances.min() > 0.08
    assert distances.min(1).max() < 0.12


def test_a_zigzag_rises_steadily_from_side_to_side() -> None:
    spec = CameraPath(path="zigzag", azimuth_deg=(-50, 50), elevation_deg=(0, 40), sweeps=4)
    azimuth, elevation = zigzag_angles_deg(spec, 81).T
    np.testing.assert_allclose(elevation, np.linspace(0, 40, 81), atol=1e-12)
    np.testing.assert_allclose(azimuth[::20], [-50, 50, -50, 50, -50], atol=1e-12)
    np.testing.assert_allclose(np.abs(np.diff(azimuth)), 5)


def test_diamonds_are_nested_and_evenly_walked() -> None:
    spec = CameraPath(path="diamond", azimuth_deg=(-60, 60), elevation_deg=(-30, 30), sweeps=3)
    points = diamond_angles_deg(spec, 72) / [60, 30]
    sizes = np.abs(points).sum(-1)
    np.testing.assert_allclose(sizes, np.repeat([1 / 3, 2 / 3, 1], [12, 24, 36]))
    corners = points[36:][::9]
    np.testing.assert_allclose(corners, [[1, 0], [0, 1], [-1, 0], [0, -1]], atol=1e-12)
    steps = np.linalg.norm(np.diff(points[36:], axis=0), axis=-1)
    np.testing.assert_allclose(steps, np.sqrt(2) / 9)


@pytest.mark.parametrize("path", PATHS)
def test_a_single_camera_is_placed_within_the_ranges(path: str) -> None:
    offset = path_offsets(CameraPath(path=path, facing_azimuth_deg=0), 1)[0]
    assert offset[0] > 0
    assert -10.001 <= np.degrees(np.arcsin(offset[2] / np.linalg.norm(offset))) <= 50.001


def test_cameras_all_around_are_evenly_spread_over_their_belt() -> None:
    spec = CameraPath(path="around", azimuth_deg=(-5, 5), elevation_deg=(-50, 65), facing_azimuth_deg=20)
    directions = path_offsets(spec, 400) / spec.radius
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1)
    assert np.degrees(np.arctan2(directions[0, 1], directions[0, 0])) == pytest.approx(20)
    # Rings of equal height have equal areas on a sphere, and so have slices of equal azimuth.
    low, high = np.sin(np.radians(spec.elevation_deg))
    assert np.histogram(directions[:, 2], 8, (low, high))[0].tolist() == [50] * 8
    sectors = np.histogram(np.arctan2(directions[:, 1], directions[:, 0]), 8, (-np.pi, np.pi))[0]
    assert sectors.min() >= 48
    apart = np.linalg.norm(directions[:, None] - directions, axis=-1) + 10 * np.eye(400)
    # A hexagonal lattice of 400 points on this belt has neighbors at 0.175.
    assert apart.min() > 0.12
    assert plan_cameras(spec, 64).hemisphere_axis is None


def test_focal_length_follows_lens_and_sensor() -> None:
    camera = plan_cameras(CameraPath(lens_mm=50, sensor_mm=36), 800).train[0]
    assert camera.fx == camera.fy == pytest.approx(800 * 50 / 36)
    assert (camera.cx, camera.cy, camera.width, camera.height) == (400, 400, 800, 800)


def test_angles_turn_from_x_toward_y_and_up() -> None:
    angles = np.array([[0.0, 0.0], [90.0, 0.0], [-90.0, 0.0], [0.0, 90.0]])
    np.testing.assert_allclose(unit_vectors(angles), [[1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], atol=1e-15)


def test_a_camera_outside_the_hemisphere_is_refused() -> None:
    path = plan_cameras(CameraPath(azimuth_deg=(-80.0, 80.0)), 64)
    offsets = np.stack([camera.position_world for camera in path.train])
    check_hemisphere(offsets, path.hemisphere_axis)
    with pytest.raises(InputError, match="outside"):
        check_hemisphere(offsets, -path.hemisphere_axis)


@pytest.mark.parametrize("reach", [90.0, 90.5, 180.0])
@pytest.mark.parametrize("path", ["arc", "zigzag"])
def test_a_path_that_reaches_the_boundary_is_refused(path: str, reach: float) -> None:
    with pytest.raises(InputError, match="azimuth_deg"):
        plan_cameras(CameraPath(path=path, azimuth_deg=(-reach, 75.0)), 64)


def test_a_high_plus_can_leave_the_hemisphere() -> None:
    with pytest.raises(InputError, match="outside"):
        plan_cameras(CameraPath(path="plus", azimuth_deg=(0, 80), elevation_deg=(50, 70)), 64)
