"""Cameras that are turned are found beside a shape; those that are where they are said to be stay there."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from panoless.alignment.align import Alignment, pose_prior
from panoless.alignment.options import PoseOptions
from panoless.alignment.search import PosedProposal, align_proposal, fit_with_poses
from panoless.capture.poses import Poses, StatedCameras
from panoless.capture.rays import pose_of
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.geometry.base import Family
from panoless.geometry.plane.kind import PlaneFamily
from panoless.geometry.revolution.kind import RevolutionFamily
from shinypartial.core.camera import Similarity
from tests.support.mirror_plane import NORMAL, RECTANGLE, arc, plane_of, reflecting_views
from tests.support.mirror_revolution import around, goblet, revolution_views

CONFIG = replace(FitConfig(), poses=PoseOptions(silhouette_rounds=2, rounds=2, maps=2))
TURN_DEG = 0.5


def wrong_turns(views: Views, turn_deg: float = TURN_DEG) -> Poses:
    """Of that angle, about axes at random."""
    axes = np.random.default_rng(3).normal(size=(len(views.train), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return Poses(np.radians(turn_deg) * axes, np.zeros_like(axes))


def left_deg(found: Poses, wrong: Poses) -> float:
    """What is left of wrong turns but for a turn that all cameras share: median over views."""
    left = Rotation.from_rotvec(found.turns) * Rotation.from_rotvec(wrong.turns)
    return float(np.degrees(np.median((left.mean().inv() * left).magnitude())))


@cache
def flat_views() -> Views:
    return reflecting_views(plane_of(RECTANGLE), arc(15))


@cache
def goblet_views() -> Views:
    return revolution_views(goblet(), around(12))


def turned_world(views: Views) -> Views:
    """The same scene after a turn by 40°: cameras move around the object."""
    turn = Rotation.from_rotvec([0.3, -0.4, 0.5])
    centers = np.array([pose_of(view.camera)[1] for view in views.train])
    return Poses(np.tile(turn.as_rotvec(), (len(centers), 1)), turn.apply(centers) - centers).moved(views)


@pytest.mark.parametrize(
    ("family", "views"),
    [
        (PlaneFamily(), flat_views()),
        (PlaneFamily(), turned_world(flat_views())),
        (RevolutionFamily(), goblet_views()),
    ],
)
def test_true_cameras_are_left_alone(family: Family, views: Views) -> None:
    """Also in a world that is turned as a whole: what all cameras share is no error."""
    proposal = family.propose(views, CONFIG, asked=True)
    assert proposal is not None
    assert align_proposal(family, views, proposal, CONFIG) is None


@pytest.mark.slow
def test_turned_cameras_of_a_flat_mirror_are_found() -> None:
    """By outlines alone to a tenth of their error, and better by what is mirrored; the normal comes out right."""
    views, family = flat_views(), PlaneFamily()
    wrong = wrong_turns(views)
    turned = wrong.moved(views)
    proposal = family.propose(turned, CONFIG, asked=False)
    assert proposal is not None
    start = align_proposal(family, turned, proposal, CONFIG)
    assert start is not None
    assert start.poses is not None
    assert start.proposal.silhouette_px < 0.2 * proposal.silhouette_px
    assert left_deg(start.poses, wrong) < 0.2
    geometry = fit_with_poses(family, family, turned, start, CONFIG)
    assert geometry is not None
    assert geometry.poses is not None
    assert left_deg(geometry.poses, wrong) < 0.05
    assert geometry.state_dict()["plane"]["normal"] @ NORMAL > np.cos(np.radians(0.3))
    # What is left of the turns is as large as said, but for what pixels that err alike hide.
    left = Rotation.from_rotvec(geometry.poses.turns) * Rotation.from_rotvec(wrong.turns)
    errors = (left.mean().inv() * left).as_rotvec() / Alignment(turned, CONFIG.poses).uncertainty(geometry)[:, :3]
    assert 0.2 < np.sqrt((errors**2).mean()) < 10


def test_outlines_of_a_surface_of_revolution_turn_cameras_back() -> None:
    """To less than half of their error, without a look at colors."""
    views, family = goblet_views(), RevolutionFamily()
    wrong = wrong_turns(views)
    turned = wrong.moved(views)
    proposal = family.propose(turned, CONFIG, asked=True)
    assert proposal is not None
    start = align_proposal(family, turned, proposal, CONFIG)
    assert start is not None
    assert start.poses is not None
    assert left_deg(start.poses, wrong) < 0.2
    assert start.proposal.silhouette_px < 0.3 * proposal.silhouette_px


def test_poses_that_held_out_views_do_not_ask_for_are_refused() -> None:
    """Turns that nothing asked for, of cameras that were where they are said to be."""
    views, family = flat_views(), PlaneFamily()
    proposal = family.propose(views, CONFIG, asked=True)
    assert proposal is not None
    start = PosedProposal(proposal, wrong_turns(views, 2.0))
    assert fit_with_poses(family, family, views, start, CONFIG) is None
    assert fit_with_poses(family, family, views, PosedProposal(proposal), CONFIG) is not None


def test_off_means_off() -> None:
    views, family = flat_views(), PlaneFamily()
    turned, config = wrong_turns(views).moved(views), replace(CONFIG, poses=replace(CONFIG.poses, mode="off"))
    proposal = family.propose(turned, config, asked=False)
    assert proposal is not None
    assert align_proposal(family, turned, proposal, config) is None


def test_a_motion_that_all_cameras_share_is_taken_back() -> None:
    views = flat_views()
    centers = np.array([pose_of(view.camera)[1] for view in views.train])
    turn = Rotation.from_rotvec([0.004, -0.008, 0.005])
    common = Poses(np.tile(turn.as_rotvec(), (len(centers), 1)), turn.apply(centers) - centers + 0.01)
    found = Alignment(views, CONFIG.poses).without_common(common)
    # Least squares are those of small turns: squares of 0.01 rad are left.
    np.testing.assert_allclose(found.stacked, 0, atol=5e-4)


def test_a_wrong_principal_point_is_told_from_a_motion_that_all_cameras_share() -> None:
    """Turns by 1° about the cameras' own axes look much like a turn of the world, from an arc of views. They stay, with
    the errors of single cameras, where a turn, a shift and a scale of all of them were added.
    """
    views = flat_views()
    stated, rng = StatedCameras.of(views), np.random.default_rng(3)
    count = len(stated.centers)
    own = Rotation.from_rotvec(np.array([-0.012, 0.016, 0]) @ stated.rotations)
    single = Poses(own.as_rotvec() + 1e-3 * rng.normal(size=(count, 3)), 1e-3 * rng.normal(size=(count, 3)))
    turn = Rotation.from_rotvec([0.003, -0.002, 0.004])
    common = Similarity(1.002, turn.as_matrix(), np.array([0.01, 0.0, -0.01]))
    shifted = common(stated.centers + single.shifts) - stated.centers
    seen = Poses((turn * Rotation.from_rotvec(single.turns)).as_rotvec(), shifted)
    prior = pose_prior(views, CONFIG.poses)
    found = seen.without_common(stated, prior)[1]
    np.testing.assert_allclose(found.stacked, single.stacked, atol=1.5e-3)
    right, down = found.principal_point_px(views, prior) or (0.0, 0.0)
    camera = views.train[0].camera
    assert right == pytest.approx(-camera.fx * np.tan(0.016), rel=0.1)
    assert down == pytest.approx(-camera.fy * np.tan(0.012), rel=0.1)


@pytest.mark.parametrize(
    ("family", "views"),
    [(PlaneFamily(), flat_views()), pytest.param(RevolutionFamily(), goblet_views(), marks=pytest.mark.slow)],
)
def test_outlines_tell_a_principal_point_that_is_wrong_in_all_views(family: Family, views: Views) -> None:
    """To a tenth of it: all but a little looks like a motion of the object, and stays in the cameras nevertheless."""
    train = (
        replace(each, camera=replace(each.camera, cx=each.camera.cx + 2, cy=each.camera.cy + 1.5))
        for each in views.train
    )
    wrong = replace(views, train=tuple(train))
    proposal = family.propose(wrong, CONFIG, asked=True)
    assert proposal is not None
    start = align_proposal(family, wrong, proposal, CONFIG)
    assert start is not None
    assert start.poses is not None
    found = start.poses.principal_point_px(wrong, pose_prior(wrong, CONFIG.poses))
    assert found == pytest.approx((-2.0, -1.5), abs=0.25)
    assert start.proposal.silhouette_px < 0.5 * proposal.silhouette_px


def test_cameras_that_are_surer_stay_where_they_are_said_to_be() -> None:
    """Half of the cameras are turned alike: of equal priors the world takes half of that, of stated ones nothing."""
    views, turn = flat_views(), np.array([0.004, -0.008, 0.005])
    count = len(views.train)
    sure = np.diag(np.repeat([1e-5, 1e-4], 3) ** 2)
    stated = [replace(view, pose_covariance=None if i % 2 else sure) for i, view in enumerate(views.train)]
    turned = Poses(np.outer(np.arange(count) % 2, turn), np.zeros((count, 3)))
    left = [
        Alignment(each, CONFIG.poses).without_common(turned).turns
        for each in (views, replace(views, train=tuple(stated)))
    ]
    sizes = [np.linalg.norm(each[::2], axis=1).max() / np.linalg.norm(turn) for each in left]
    assert sizes[0] > 0.2  # Shifts take over a part of what half of the turn would be.
    # To what is stated a tenth of the usual deviation is added: weights differ by 100.
    assert sizes[1] < 0.02
    np.testing.assert_allclose(left[1][1::2], np.tile(turn, (count // 2, 1)), atol=0.02 * np.linalg.norm(turn))
