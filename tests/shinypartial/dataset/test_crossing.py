"""Where a looped path crosses itself: found for turned, trembling and cut loops, and not invented for simple ones."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float

from shinypartial.core.camera import Camera, look_at
from shinypartial.core.errors import InputError
from shinypartial.dataset.crossing import angles_rad, find_crossings, look_at_point
from tests.support.shiny_blender import loop_directions

SEEDS = st.integers(0, 2**32 - 1)


def random_rotation(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Uniformly distributed, by the QR decomposition of a Gaussian matrix."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.linalg.det(q)


def trembling(
    directions: Float[np.ndarray, "V 3"], noise_deg: float, rng: np.random.Generator
) -> Float[np.ndarray, "V 3"]:
    """Directions with Gaussian noise of the given size along each axis."""
    moved = directions + np.radians(noise_deg) * rng.normal(size=directions.shape)
    return moved / np.linalg.norm(moved, axis=-1, keepdims=True)


@given(seed=SEEDS, count=st.integers(40, 300), start=st.floats(0, 0.999))
def test_the_crossing_of_a_turned_loop_is_found(seed: int, count: int, start: float) -> None:
    rotation = random_rotation(np.random.default_rng(seed))
    crossings = find_crossings(loop_directions(count, start) @ rotation.T)
    assert len(crossings) == 1
    # The curve is straightest where it crosses itself: measured 0.11° at 40 cameras, less for more.
    assert np.degrees(angles_rad(crossings[0][None], rotation[:, 0])[0]) < 0.2


@given(seed=SEEDS, count=st.integers(100, 300), start=st.floats(0, 0.999))
def test_the_crossing_of_a_trembling_loop_is_found(seed: int, count: int, start: float) -> None:
    rng = np.random.default_rng(seed)
    rotation = random_rotation(rng)
    crossings = find_crossings(trembling(loop_directions(count, start) @ rotation.T, 0.5, rng))
    assert len(crossings) == 1
    # Lines that cross at 77° and waver by 0.5°: measured 1.9° at most over 2000 draws.
    assert np.degrees(angles_rad(crossings[0][None], rotation[:, 0])[0]) < 3.0


@pytest.mark.parametrize("count", [40, 100, 200])
def test_a_crossing_at_a_camera_is_found_once(count: int) -> None:
    """Both passes have a camera exactly at the crossing, so that four arcs meet there."""
    crossings = find_crossings(loop_directions(count))
    assert len(crossings) == 1
    np.testing.assert_allclose(crossings[0], [1, 0, 0], atol=1e-9)


def test_a_loop_that_is_cut_open_far_from_its_crossing_still_has_it() -> None:
    directions = loop_directions(200, start=0.25)[5:-5]
    assert angles_rad(directions[:1], directions[-1])[0] > np.radians(30)
    assert len(find_crossings(directions)) == 1


def test_a_circle_has_no_crossing() -> None:
    turn = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    circle = np.stack([0.8 * np.cos(turn), 0.8 * np.sin(turn), np.full(100, 0.6)], -1)
    assert find_crossings(circle) == []
    assert find_crossings(trembling(circle, 1.0, np.random.default_rng(0))) == [], "Trembling is no crossing."


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_cameras_have_no_crossing(count: int) -> None:
    assert find_crossings(np.eye(3)[:count]) == []


def test_cameras_at_random_cross_often() -> None:
    directions = trembling(np.zeros((100, 3)), 1.0, np.random.default_rng(0))
    assert len(find_crossings(directions)) > 1


@given(seed=SEEDS)
def test_the_point_that_all_cameras_look_at_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    target = rng.uniform(-5, 5, 3)
    positions = target + rng.uniform(1, 4, (9, 1)) * loop_directions(9, 0.03)
    cameras = [Camera(look_at(each, target), 50.0, 50.0, 16.0, 16.0, 32, 32) for each in positions]
    np.testing.assert_allclose(look_at_point(cameras), target, atol=1e-8)


def test_parallel_cameras_look_at_no_point() -> None:
    pose = look_at(np.array([3.0, 0.0, 0.0]), np.zeros(3))
    with pytest.raises(InputError, match="several sides"):
        look_at_point([Camera(pose, 50.0, 50.0, 16.0, 16.0, 32, 32)] * 3)
