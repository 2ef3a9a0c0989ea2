"""What a phone makes of light, against closed forms and OpenCV's lens."""

from dataclasses import replace

import numpy as np
import pytest

from shinypartial.core.camera import Camera
from shinypartial.core.color import to_display
from shinypartial.generate.recording import Moment, moments, recorded_mask, recorded_picture, smeared
from shinypartial.scene import Phone, load_film

CAMERA = Camera(np.eye(4), 70.0, 70.0, 32.0, 24.0, 64, 48)
IDEAL = Phone(k1=0.0, focus_px=0.0, shake_px=0.0, vignette_stops=0.0, drift_stops=0.0, shot_noise=0.0, read_noise=0.0)
STILL = Moment(1.0, 0.0, (0.0, 0.0), 0)


def test_an_ideal_phone_only_encodes() -> None:
    light = np.random.default_rng(0).uniform(0, 1.2, (48, 64, 3)).astype(np.float32)
    assert np.abs(recorded_picture(light, CAMERA, IDEAL, STILL).astype(int) - to_display(light)).max() <= 1


@pytest.mark.parametrize("way", [(4.0, 0.0), (0.0, 3.0), (2.5, -4.5), (0.6, 0.2)])
def test_a_smeared_point_is_a_line_of_that_length(way: tuple[float, float]) -> None:
    """Mass one, its middle where it was, the variance of a uniform line: way²/12, and of bilinear splats at most ¼."""
    point = np.zeros((25, 25, 1))
    point[12, 12] = 1.0
    line = smeared(point, way)[..., 0]
    row, column = np.indices(line.shape) - 12
    assert line.sum() == pytest.approx(1.0)
    assert (line * column).sum() == pytest.approx(0.0, abs=1e-9)
    assert (line * row).sum() == pytest.approx(0.0, abs=1e-9)
    for axis, length in ((column, way[0]), (row, way[1])):
        assert length**2 / 12 - 1e-6 <= (line * axis**2).sum() <= length**2 / 12 + 0.3


def test_the_lens_is_that_of_opencv() -> None:
    """A disk's middle moves to x (1 + k1 r²)."""
    cv2 = pytest.importorskip("cv2")
    alpha = np.zeros((48, 64), np.float32)
    row, column = np.indices(alpha.shape) + 0.5
    alpha[(row - 10) ** 2 + (column - 12) ** 2 < 16] = 1.0
    mask = recorded_mask(alpha, CAMERA, replace(IDEAL, k1=0.2)) / 255
    found = [(mask * each).sum() / mask.sum() for each in (column, row)]
    point = np.array([[(12 - CAMERA.cx) / CAMERA.fx, (10 - CAMERA.cy) / CAMERA.fy, 1.0]])
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    expected = cv2.projectPoints(point, np.zeros(3), np.zeros(3), matrix, np.array([0.2, 0, 0, 0, 0]))[0].ravel()
    np.testing.assert_allclose(found, expected, atol=0.1)  # 0.04 px, by the disk's extent.
    assert np.linalg.norm(expected - [12, 10]) > 0.5


def test_moments_have_the_sizes_that_the_phone_states() -> None:
    spec = load_film("chrome-ball-board")
    many = replace(spec, scene=replace(spec.scene, camera=replace(spec.scene.camera, train=4000)))
    found = moments(many)
    assert moments(many) == found
    assert np.std(np.log2([each.gain for each in found])) == pytest.approx(spec.phone.drift_stops, rel=0.1)
    assert np.sqrt(np.mean(np.sum(np.square([each.shake_px for each in found]), -1))) == pytest.approx(0.5, rel=0.05)
    assert max(each.focus_px for each in found) == pytest.approx(spec.phone.focus_px)
    assert len({each.seed for each in found}) == len(found)
