"""The cone of a ball: what its rays meet and mirror, and the cone of a rim."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from panoless.photographs.ball.adjust import cone_of
from panoless.photographs.ball.cone import BallCone
from panoless.photographs.lens import Lens
from tests.support.traced_ball import lens_of


def unit(values: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P 3"]:
    """Of length 1."""
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def ball_at(right: float, down: float, distance: float) -> BallCone:
    """In the direction (right, down, 1)."""
    return BallCone(unit(np.array([right, down, 1.0])), distance)


cones = st.builds(ball_at, st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(1.2, 100.0))


def directions_of(cone: BallCone, seed: int) -> Float[np.ndarray, "P 3"]:
    """Random ones at least a degree outside the cone: within it the ball hides what it would have to mirror."""
    found = unit(np.random.default_rng(seed).normal(size=(200, 3)))
    return found[found @ cone.axis < np.cos(cone.half_angle + np.radians(1))]


@given(cone=cones, seed=st.integers(0, 99))
def test_rays_and_directions_are_inverse(cone: BallCone, seed: int) -> None:
    """The ray that leaves along ω, sent again, meets the ball at the same place and leaves along ω."""
    directions = directions_of(cone, seed)
    seen = cone.toward(directions)
    again = cone.along(seen.rays)
    assert seen.met.all()
    assert again.met.all()
    # Rounding grows by d/cos θ toward the rim, up to 1e4.
    np.testing.assert_allclose(again.normals, seen.normals, atol=1e-9)
    np.testing.assert_allclose(again.directions, directions, atol=1e-9)


@given(cone=cones)
def test_the_ball_mirrors_nothing_that_it_hides(cone: BallCone) -> None:
    """No ray leaves along directions within the cone: the one beside the rim leaves along the rim's own."""
    turned = [
        Rotation.from_rotvec(share * cone.half_angle * cone.across[0]).apply(cone.axis) for share in (0.5, 0.99, 1.01)
    ]
    np.testing.assert_array_equal(cone.toward(np.stack(turned)).met, [False, False, True])
    grazing = cone.along(Rotation.from_rotvec((1 - 1e-9) * cone.half_angle * cone.across[0]).apply(cone.axis)[None])
    assert np.arccos(grazing.directions @ cone.axis) > 0.999 * cone.half_angle


@given(cone=cones, seed=st.integers(0, 99))
def test_what_leaves_obeys_the_law_of_reflection(cone: BallCone, seed: int) -> None:
    """ω and −v make one angle with n, on both sides of it, and the point d a + … of the ball lies on the ray."""
    around = Rotation.from_rotvec(cone.half_angle * 0.99 * cone.across[0]).apply(cone.axis)
    turns = np.random.default_rng(seed).uniform(0, 2 * np.pi, 50)
    share = np.linspace(0, 1, 50)[:, None]
    rim = np.stack([Rotation.from_rotvec(turn * cone.axis).apply(around) for turn in turns])
    rays = unit(share * rim + (1 - share) * cone.axis)
    seen = cone.along(rays)
    assert seen.met.all()
    np.testing.assert_allclose((seen.directions * seen.normals).sum(-1), seen.cosines, atol=1e-9)
    np.testing.assert_allclose(np.cross(seen.directions - rays, seen.normals), 0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(seen.directions, axis=-1), 1, atol=1e-9)
    points = cone.center + seen.normals
    # Lengths grow with the distance, up to 100.
    np.testing.assert_allclose(np.cross(points, rays), 0, atol=1e-9 * cone.distance)


@given(cone=cones)
def test_rays_beside_the_cone_miss(cone: BallCone) -> None:
    for share, met in ((0.999, True), (1.001, False)):
        ray = Rotation.from_rotvec(share * cone.half_angle * cone.across[1]).apply(cone.axis)
        assert cone.along(ray[None]).met.tolist() == [met]
    assert not cone.along(-cone.axis[None]).met.any()


@given(cone=cones)
def test_a_step_turns_the_axis_and_widens_the_cone(cone: BallCone) -> None:
    step = np.array([1e-4, -2e-4, 5e-5])
    moved = cone.moved(step)
    assert moved.half_angle == pytest.approx(cone.half_angle + 5e-5, abs=1e-9)
    # The turn is a step in the tangent plane: equal to second order.
    np.testing.assert_allclose(cone.across @ (moved.axis - cone.axis), step[:2], atol=1e-7)


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.3, 0.1), (-0.4, 0.3)])
@pytest.mark.parametrize("distance", [3.0, 6.0, 40.0])
def test_a_cone_is_that_of_its_rim(place: tuple[float, float], distance: float) -> None:
    """Also off the axis, where the rim is an oval, and with a third of it hidden."""
    cone, lens = ball_at(*place, distance), lens_of()
    turns = np.linspace(0, 4 / 3 * np.pi, 300)
    start = Rotation.from_rotvec(cone.half_angle * cone.across[0]).apply(cone.axis)
    rim = np.stack([Rotation.from_rotvec(turn * cone.axis).apply(start) for turn in turns])
    found, off = cone_of(lens.project(rim), lens)
    np.testing.assert_allclose(found.axis, cone.axis, atol=1e-6)
    assert found.distance == pytest.approx(cone.distance, rel=1e-6)
    assert np.abs(off).max() < 1e-6


def test_points_off_the_rim_do_not_pull_its_cone() -> None:
    """A tenth of them 3 px outside: the cone moves by less than 0.05 px."""
    cone, lens = ball_at(0.2, -0.1, 6.0), lens_of()
    start = Rotation.from_rotvec(cone.half_angle * cone.across[0]).apply(cone.axis)
    rim = np.stack([Rotation.from_rotvec(t * cone.axis).apply(start) for t in np.linspace(0, 2 * np.pi, 400)[:-1]])
    points = lens.project(rim) + np.random.default_rng(0).normal(0, 0.1, (399, 2))
    middle = lens.project(cone.axis)
    points[:40] += 3 * (points[:40] - middle) / np.linalg.norm(points[:40] - middle, axis=1, keepdims=True)
    found, _ = cone_of(points, lens)
    assert np.linalg.norm(lens.project(found.axis) - middle) < 0.05
    assert lens.fx * abs(found.half_angle - cone.half_angle) < 0.05


def test_a_wrong_focal_length_leaves_an_oval() -> None:
    """Off the axis the ray cone of a rim is circular for one focal length only."""
    cone, lens = ball_at(0.4, 0.2, 4.0), lens_of()
    start = Rotation.from_rotvec(cone.half_angle * cone.across[0]).apply(cone.axis)
    rim = np.stack([Rotation.from_rotvec(t * cone.axis).apply(start) for t in np.linspace(0, 2 * np.pi, 200)[:-1]])
    wrong = Lens(1.2 * lens.fx, 1.2 * lens.fy, lens.cx, lens.cy, lens.width, lens.height)
    assert np.median(np.abs(cone_of(lens.project(rim), wrong)[1])) > 0.3
