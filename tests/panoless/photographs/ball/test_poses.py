"""Where the cameras of traced balls are, by what these mirror alone, and how well that is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from panoless.photographs.ball.beside import PosedBall, agreement, log_light, refraction_agreement, ring_agreement
from panoless.photographs.ball.find import find_ball
from panoless.photographs.ball.poses import PosedBalls, posed_balls
from tests.panoless.photographs.ball.conftest import FAR, Taken, shot_of
from tests.support.traced_ball import Room, aligned_turns, camera_at, turns_between


@pytest.mark.parametrize(("room", "limit_deg"), [("far", 0.25), ("near", 0.5)])
def test_cameras_from_all_around_are_found(room: str, limit_deg: float, request: pytest.FixtureRequest) -> None:
    """Two of them on opposite sides; a pixel spans 1.5° where it spans least, and 0.21° and 0.16° are left."""
    taken: Taken = request.getfixturevalue(room)
    assert taken.posed.members == (0, 1, 2, 3)
    assert np.median(turns_between(rotations(taken.posed), taken.truth)) < limit_deg


def rotations(posed: PosedBalls) -> np.ndarray:
    """World to camera, of the members."""
    return np.stack([posed.adjusted.rotations[i] for i in posed.members])


def test_two_cameras_on_opposite_sides_are_found(far: Taken) -> None:
    """What one mirrors beside its rim the other one mirrors in its middle."""
    posed = posed_balls([far.balls[0], far.balls[2]], [far.lens] * 2)
    assert posed.members == (0, 1)
    assert turns_between(rotations(posed), far.truth[[0, 2]]).max() < 0.5


@pytest.mark.parametrize("room", ["far", "near"])
def test_turns_are_as_uncertain_as_stated(room: str, request: pytest.FixtureRequest) -> None:
    """Turns of all cameras together are no error; the others are within 4 standard deviations in the median camera.

    They are 2 to 4 of them: features of one picture are off alike, which the adjustment takes for independent.
    """
    posed = request.getfixturevalue(room).posed
    turns = aligned_turns(rotations(posed), request.getfixturevalue(room).truth)
    covariances = np.stack([posed.adjusted.covariance[i] for i in posed.members])
    assert (np.linalg.eigvalsh(covariances) > -1e-12).all()
    stated = np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2))
    assert np.median(np.linalg.norm(turns, axis=1) / stated) < 4


def test_a_photograph_of_another_room_is_left_out(far: Taken) -> None:
    other = replace(FAR, room=Room(seed=9))
    stranger = find_ball(shot_of(other.radiance(camera_at(45, 15), far.lens), "stranger"))
    posed = posed_balls([far.balls[0], stranger, far.balls[1], far.balls[3]], [far.lens] * 4)
    assert posed.members == (0, 2, 3)
    assert posed.left_out == ("stranger",)
    assert 1 not in posed.adjusted.rotations


@pytest.mark.slow
def test_wrong_rotations_of_another_program_are_not_kept(far: Taken) -> None:
    """Structure from motion that mistook three equal cans for one another: two cameras by a quarter turn each."""
    wrong = dict(enumerate(far.truth))
    for i, turn in ((1, 90.0), (2, -90.0)):
        wrong[i] = wrong[i] @ Rotation.from_euler("z", turn, degrees=True).as_matrix()
    posed = posed_balls(far.balls, [far.lens] * 4, wrong)
    assert not posed.by_stated
    assert posed.stated_unexplained > 0.5
    np.testing.assert_array_equal(rotations(posed), rotations(far.posed))


def test_right_rotations_of_another_program_agree(far: Taken) -> None:
    """In whatever world they are."""
    world = Rotation.from_euler("xyz", [40, 10, 70], degrees=True).as_matrix()
    posed = posed_balls(far.balls, [far.lens] * 4, dict(enumerate(far.truth @ world)))
    assert posed.stated_unexplained < 0.3
    assert np.median(turns_between(rotations(posed), far.truth)) < 0.25


def test_a_single_photograph_has_the_cone_of_its_rim(far: Taken) -> None:
    posed = posed_balls(far.balls[:1], [far.lens])
    assert posed.members == (0,)
    np.testing.assert_array_equal(posed.adjusted.rotations[0], np.eye(3))
    center = -far.truth[0] @ far.poses[0][:3, 3]
    np.testing.assert_allclose(posed.adjusted.cones[0].axis, center / np.linalg.norm(center), atol=0.005)


def beside(taken: Taken) -> list[PosedBall]:
    """The photographs of a scene with the poses found."""
    adjusted = taken.posed.adjusted
    return [
        PosedBall(log_light(taken.shots[i].pixels), taken.lens, adjusted.cones[i], adjusted.rotations[i])
        for i in taken.posed.members
    ]


@pytest.mark.parametrize("room", ["far", "near"])
def test_what_lies_beside_a_ball_is_what_it_mirrors(room: str, request: pytest.FixtureRequest) -> None:
    """For the poses found; not for cameras that are turned by 60° about the ball's vertical."""
    lights = beside(request.getfixturevalue(room))
    assert agreement(lights)[0] > 0.3
    turn = Rotation.from_rotvec([0, 0, np.pi / 3]).as_matrix()
    wrong = [replace(each, rotation=each.rotation @ (turn if i % 2 else turn.T)) for i, each in enumerate(lights)]
    assert agreement(wrong)[0] < 0.1


def test_a_single_photograph_agrees_with_its_own_rim(far: Taken) -> None:
    """Correlations around the balls of four photographs are high in the median; where a cone misses its ball by half
    of its radius they are not.
    """
    lights = beside(far)
    right = [ring_agreement(each) for each in lights]
    missed = [ring_agreement(replace(each, cone=each.cone.moved(np.array([0.08, 0.08, 0.0])))) for each in lights]
    assert np.nanmedian(right) > 0.5
    assert np.nanmedian(missed) < np.nanmedian(right) - 0.2
    assert agreement(lights[:1])[0] == right[0]


def test_glass_shows_what_lies_behind_it(far: Taken) -> None:
    """Bent as Snell's law has it, which a mirror does not do."""
    light = replace(FAR, glass=True).radiance(far.poses[1], far.lens)
    cone = far.posed.adjusted.cones[1]
    glass = PosedBall(log_light(shot_of(light).pixels), far.lens, cone, np.eye(3))
    assert refraction_agreement(glass) > 0.5
    assert max(refraction_agreement(each) for each in beside(far)) < 0.2
