"""Covariances of poses are those of derivatives by differences, and those that OpenCV states of its calibration."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from panoless.photographs.certainty import SeenPoints, pose_covariances
from panoless.photographs.lens import Lens
from shinypartial.core.camera import Camera, Similarity
from tests.support.photographed_planes import arc

SIZE, NOISE_PX = (640, 480), 0.3
LENS = Lens(700.0, 700.0, 320.0, 240.0, *SIZE, k1=-0.1)


def seen(cameras: list[Camera], points: np.ndarray, random: np.random.Generator) -> list[SeenPoints]:
    """All points in all views, their places with noise."""
    found = []
    for camera in cameras:
        pose = camera.camera_to_world
        turn = cv2.Rodrigues(pose[:3, :3].T)[0]
        places = cv2.projectPoints(points, turn, -pose[:3, :3].T @ pose[:3, 3], LENS.matrix, np.array(LENS.distortion))[
            0
        ]
        noisy = places[:, 0] + NOISE_PX * random.normal(size=(len(points), 2))
        found.append(SeenPoints(LENS, pose, np.arange(len(points)), points, noisy))
    return found


def residuals(views: list[SeenPoints], values: np.ndarray) -> np.ndarray:
    """What is left of the places after turns, shifts, a change of the focal length and of k1, and motions of points."""
    count, parts = len(views), []
    focal, k1 = 700 + values[6 * count], -0.1 + values[6 * count + 1]
    lens, motion = Lens(focal, focal, 320.0, 240.0, *SIZE, k1=k1), values[6 * count + 2 :].reshape(-1, 3)
    for view, change in zip(views, values[: 6 * count].reshape(count, 6), strict=True):
        rotation = Rotation.from_rotvec(change[:3]).as_matrix() @ view.camera_to_world[:3, :3]
        shift = -rotation.T @ (view.camera_to_world[:3, 3] + change[3:])
        points = view.points_world + motion[: len(view.points_world)]
        turn = cv2.Rodrigues(rotation.T)[0]
        places = cv2.projectPoints(points, turn, shift, lens.matrix, np.array(lens.distortion))[0][:, 0]
        parts.append((places - view.places_px).ravel())
    return np.concatenate(parts)


@pytest.mark.parametrize("known_points", [True, False])
def test_covariances_are_those_of_differences(known_points: bool) -> None:
    """σ² (JᵀJ)⁻¹ of central differences; of unknown points after these are eliminated, its seven smallest eigenvalues
    being zero.
    """
    random = np.random.default_rng(1)
    points = random.uniform(-0.5, 0.5, (20, 3))
    views = seen(arc(5, 2.5, SIZE, 700.0), points, random)
    poses = 6 * len(views) + 2
    count = poses + 3 * len(points)
    steps = 1e-5 * np.eye(count)
    jacobian = np.stack([(residuals(views, step) - residuals(views, -step)) / 2e-5 for step in steps], 1)
    matrix, size = jacobian.T @ jacobian, len(jacobian)
    if known_points:
        matrix, unknowns, dropped = matrix[:poses, :poses], poses, 0
    else:
        shared, own = matrix[:poses, poses:], matrix[poses:, poses:]
        matrix, unknowns, dropped = matrix[:poses, :poses] - shared @ np.linalg.solve(own, shared.T), count - 7, 7
    scale = 1 / np.sqrt(np.diag(matrix))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    inverse = vectors[:, dropped:] / values[dropped:] @ vectors[:, dropped:].T * np.outer(scale, scale)
    variance = float((residuals(views, np.zeros(count)) ** 2).sum()) / (size - unknowns)
    # The noise is known to 1/√(2 · 200).
    assert np.sqrt(variance) == pytest.approx(NOISE_PX, rel=0.2 if known_points else 0.5)
    found = pose_covariances(views, known_points=known_points)
    assert found is not None
    for index, covariance in enumerate(found):
        expected = variance * inverse[6 * index : 6 * index + 6, 6 * index : 6 * index + 6]
        np.testing.assert_allclose(covariance, expected, atol=1e-3 * np.abs(expected).max())


def test_shifts_are_as_sure_as_opencv_has_them() -> None:
    random = np.random.default_rng(2)
    points = np.concatenate([random.uniform(-0.4, 0.4, (30, 2)), np.zeros((30, 1))], 1)
    views = seen(arc(6, 2.5, SIZE, 700.0), points, random)
    flags = cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    known = [points.astype(np.float32)] * len(views)
    places = [view.places_px.astype(np.float32) for view in views]
    _, matrix, distortion, turns, shifts, _, deviations, _ = cv2.calibrateCameraExtended(
        known, places, SIZE, LENS.matrix, np.zeros(5), flags=flags
    )
    lens = Lens(matrix[0, 0], matrix[0, 0], 320.0, 240.0, *SIZE, k1=float(distortion.ravel()[0]))
    at = []
    for view, turn, shift in zip(views, turns, shifts, strict=True):
        inverse = np.eye(4)
        inverse[:3, :3], inverse[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        at.append(SeenPoints(lens, np.linalg.inv(inverse), view.numbers, points, view.places_px))
    covariances = pose_covariances(at, known_points=True)
    assert covariances is not None
    # OpenCV's shift is t = −Rᵀ c, so δt = Rᵀ (ω × c − τ).
    for view, covariance, expected in zip(at, covariances, deviations.reshape(-1, 6), strict=True):
        rotation, center = view.camera_to_world[:3, :3], view.camera_to_world[:3, 3]
        by_pose = rotation.T @ np.concatenate([np.cross(np.eye(3), center).T, -np.eye(3)], 1)
        found = np.sqrt(np.diag(by_pose @ covariance @ by_pose.T))
        # OpenCV divides by 2N where the unknowns are taken off here: 4 % of a variance with 30 points in 6 views.
        np.testing.assert_allclose(found, expected[3:], rtol=0.1)


def test_too_few_places_tell_nothing() -> None:
    random = np.random.default_rng(3)
    views = seen(arc(2, 2.5, SIZE, 700.0), random.uniform(-0.5, 0.5, (4, 3)), random)
    assert pose_covariances(views, known_points=False) is None


def test_a_covariance_moves_with_the_world() -> None:
    """A turn and a shift of a camera, seen in another world, are what the matrix of the covariance carries."""
    turn = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix()
    world = Similarity(2.5, turn, np.array([1.0, -2.0, 0.5]))
    pose, change = arc(2, 3.0, SIZE, 700.0)[0].camera_to_world, 1e-3 * np.array([1.0, 2, -3, 4, -5, 6])
    changed = pose.copy()
    changed[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ pose[:3, :3]
    changed[:3, 3] += change[3:]
    before, after = world.pose(pose), world.pose(changed)
    there = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
    expected = np.concatenate([there, after[:3, 3] - before[:3, 3]])
    np.testing.assert_allclose(
        world.pose_covariance(np.outer(change, change)), np.outer(expected, expected), atol=1e-12
    )
