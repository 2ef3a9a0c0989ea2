"""A hand along a path: a steady one follows it, and the motions of another have the sizes that were requested."""

from dataclasses import replace

import numpy as np

from shinypartial.core.camera import look_at
from shinypartial.core.handheld import Hand, handheld_poses
from shinypartial.core.trajectory import CameraPath, path_offsets

PATH = CameraPath(path="zigzag", radius=2.0, target=(0.1, 0.2, 0.3), azimuth_deg=(-40, 40), elevation_deg=(10, 40))
STEADY = Hand(sway=0.0, aim_deg=0.0, lean_deg=0.0, tremor_deg=0.0)


def test_a_steady_hand_follows_the_path() -> None:
    target = np.array(PATH.target)
    for pose, offset in zip(handheld_poses(PATH, STEADY, 20), path_offsets(PATH, 20), strict=True):
        np.testing.assert_allclose(pose, look_at(target + offset, target), atol=1e-12)


def test_motions_have_their_sizes() -> None:
    """Over 1000 frames, some 40 independent windows: their root mean squares vary by a tenth or two."""
    count = 1000
    steady = handheld_poses(PATH, STEADY, count)
    moved = handheld_poses(PATH, Hand(), count)
    sway = (moved - steady)[:, :3, 3] / PATH.radius
    np.testing.assert_allclose(np.sqrt((sway**2).mean(0)), Hand().sway, rtol=0.3)
    still = handheld_poses(PATH, replace(Hand(), sway=0.0), count)
    turns = np.swapaxes(steady[:, :3, :3], 1, 2) @ still[:, :3, :3]
    angles = np.degrees(np.stack([turns[:, 2, 1], turns[:, 0, 2], turns[:, 1, 0]], -1))
    np.testing.assert_allclose(np.sqrt((angles**2).mean(0)), [1.0, 1.0, 2.0], rtol=0.3)
    # From frame to frame the tremor is all that counts: smooth motions change by less than their size over the window.
    trembles = handheld_poses(PATH, replace(STEADY, tremor_deg=0.5), count)
    jumps = np.degrees((np.swapaxes(steady[:, :3, :3], 1, 2) @ trembles[:, :3, :3])[:, 2, 1])
    np.testing.assert_allclose(np.diff(jumps).std(), 0.5 * np.sqrt(2), rtol=0.1)


def test_a_hand_goes_all_around() -> None:
    poses = handheld_poses(replace(PATH, path="around"), Hand(), 12)
    assert min((poses[:, :3, 3] - PATH.target)[:, 0]) < 0 < max((poses[:, :3, 3] - PATH.target)[:, 0])
