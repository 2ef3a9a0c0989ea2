"""Rotations between cameras: matches of directions, their average, groups, and the tracks of points."""

import numpy as np
import pytest
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from panoless.photographs.ball.adjust import Tracks
from panoless.photographs.ball.cone import BallCone
from panoless.photographs.ball.panorama import Features, faces
from panoless.photographs.ball.rotations import Pair, average, best_rotation, largest_group, pair_of

CONE = BallCone(np.array([0.0, 0.0, 1.0]), 6.0)


def random_directions(count: int, seed: int) -> Float[np.ndarray, "P 3"]:
    """Unit, not along the cone's axis."""
    found = np.random.default_rng(seed).normal(size=(4 * count, 3))
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return found[found[:, 2] < 0.9][:count]


def features(directions: Float[np.ndarray, "P 3"], kinds: Float[np.ndarray, "P 128"]) -> Features:
    """With given descriptors."""
    count = len(directions)
    return Features(kinds.astype(np.float32), np.zeros((count, 2)), CONE.toward(directions), np.full(count, 0.02))


def descriptors(count: int, seed: int) -> Float[np.ndarray, "P 128"]:
    """Random, of length 1."""
    found = np.abs(np.random.default_rng(seed).normal(size=(count, 128)))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def test_the_best_rotation_is_the_true_one() -> None:
    turn = Rotation.from_rotvec([0.4, -1.9, 0.8]).as_matrix()
    x = random_directions(40, 0)
    np.testing.assert_allclose(best_rotation(x, x @ turn.T), turn, atol=1e-12)


def test_faces_look_all_around() -> None:
    """Rotations, of which one looks within 40° of any direction but the poles."""
    looks = faces()
    np.testing.assert_allclose(looks @ looks.transpose(0, 2, 1), np.broadcast_to(np.eye(3), looks.shape), atol=1e-12)
    assert (random_directions(300, 1) @ looks[:, 2].T).max(1).min() > np.cos(np.radians(40))


@pytest.mark.parametrize("wrong", [0.0, 0.5, 0.8])
def test_a_pair_is_found_among_wrong_matches(wrong: float) -> None:
    """60 matches, of which up to four fifths show something else; the others are right to half a degree."""
    generator, turn, count = np.random.default_rng(2), Rotation.from_rotvec([2.0, 1.0, -1.5]), 60
    x, kinds = random_directions(count, 3), descriptors(count, 4)
    y = turn.apply(x) + 0.01 * generator.normal(size=x.shape)
    y[: round(wrong * count)] = random_directions(round(wrong * count), 5)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    pair = pair_of(features(x, kinds), features(y, kinds), generator)
    assert pair is not None
    off = Rotation.from_matrix(pair.rotation @ turn.inv().as_matrix()).magnitude()
    assert np.degrees(off) < 0.5
    assert len(pair.first) >= 0.8 * (1 - wrong) * count


def test_matches_that_agree_on_nothing_are_no_pair() -> None:
    kinds = descriptors(60, 6)
    for seed in range(5):
        one, two = (features(random_directions(60, 10 * seed + k), kinds) for k in range(2))
        assert pair_of(one, two, np.random.default_rng(seed)) is None


def test_photographs_without_features_are_no_pair() -> None:
    nothing, some = features(np.zeros((0, 3)), np.zeros((0, 128))), features(random_directions(9, 0), descriptors(9, 0))
    assert pair_of(nothing, some, np.random.default_rng(0)) is None
    assert pair_of(some, nothing, np.random.default_rng(0)) is None


def pair(rotation: Float[np.ndarray, "3 3"], log_nfa: float = -50.0, features: tuple[int, ...] = (0,)) -> Pair:
    """With features of the same numbers in both photographs."""
    numbers = np.array(features)
    return Pair(rotation, log_nfa, numbers, numbers)


def test_the_average_outvotes_a_wrong_pair() -> None:
    """Five photographs, all pairs right to 0.2° but a sure one that is off by 40°: rotations are right to 0.5°."""
    generator = np.random.default_rng(7)
    truth = Rotation.random(5, random_state=8).as_matrix()
    pairs = {}
    for i in range(5):
        for j in range(i + 1, 5):
            noise = Rotation.from_rotvec(0.003 * generator.normal(size=3)).as_matrix()
            pairs[i, j] = pair(noise @ truth[j] @ truth[i].T)
    pairs[1, 3] = pair(Rotation.from_rotvec([0.7, 0, 0]).as_matrix() @ pairs[1, 3].rotation, -40.0)
    found = average(range(5), pairs)
    common = found[0].T @ truth[0]
    off = [Rotation.from_matrix(found[i] @ common @ truth[i].T).magnitude() for i in range(5)]
    assert np.degrees(max(off)) < 0.5


def test_the_largest_group_is_taken() -> None:
    eye = pair(np.eye(3))
    assert largest_group(6, {(0, 1): eye, (2, 3): eye, (3, 5): eye}) == [2, 3, 5]
    assert largest_group(1, {}) == [0]


def test_a_track_has_one_feature_of_a_view() -> None:
    """A match that would join two features of one view is left out, the less sure one."""
    pairs = {
        (0, 1): Pair(np.eye(3), -90.0, np.array([0, 1]), np.array([0, 1])),
        (1, 2): Pair(np.eye(3), -80.0, np.array([0, 1]), np.array([0, 1])),
        (0, 2): Pair(np.eye(3), -20.0, np.array([0]), np.array([1])),
    }
    tracks = Tracks.of(pairs)
    assert tracks.count == 2
    for number in range(2):
        rows = tracks.track == number
        assert sorted(tracks.view[rows].tolist()) == [0, 1, 2]
        assert len(set(tracks.feature[rows].tolist())) == 1
