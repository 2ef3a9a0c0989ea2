"""What a phone makes of light, against closed forms and OpenCV's lens."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from shinypartial.core.camera import Camera
from shinypartial.core.color import to_display
from shinypartial.generate.recording import Moment, exif_tags, moments, recorded_mask, recorded_picture, smeared
from shinypartial.io.images import write_jpeg
from shinypartial.scene import Phone, Photographs, load_film

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


def test_shots_of_a_bracket_share_focus_and_drift() -> None:
    spec = load_film("chrome-ball-board")
    shots = moments(replace(spec, photographs=Photographs(bracket_stops=(-4.0, 0.0, 2.0))))
    for index, alone in enumerate(moments(spec)):
        bracket = shots[3 * index : 3 * index + 3]
        assert [each.gain / alone.gain for each in bracket] == pytest.approx([1 / 16, 1.0, 4.0])
        assert {each.focus_px for each in bracket} == {alone.focus_px}
    assert len({each.seed for each in shots}) == len(shots)


def test_tags_of_a_photograph_can_be_read(tmp_path: Path) -> None:
    """Of a lens as long as a sensor of 4:3 is wide: before 35 mm film of the same diagonal it has 34.6 mm."""
    camera = replace(CAMERA, fx=64.0, fy=64.0)
    for focal_plane in (False, True):
        photographs = Photographs(sensor_width_mm=8.0, focal_plane=focal_plane)
        tags = exif_tags(camera, photographs, replace(STILL, gain=0.5))
        write_jpeg(tmp_path / "a.jpg", np.zeros((48, 64, 3), np.uint8), 95, tags)
        with Image.open(tmp_path / "a.jpg") as photograph:
            basic, found = photograph.getexif(), photograph.getexif().get_ifd(0x8769)
        assert [basic[tag] for tag in (0x10F, 0x110, 0x112)] == ["Rendered", "Rendered", 1]
        assert found[0x829A] == pytest.approx(1 / 120, abs=1e-6)
        assert (found[0x829D], found[0x8827], found[0x920A], found[0xA405]) == (1.8, 100, 8.0, 35)
        # Sensor's width = pixels / (pixels per inch), in inches.
        assert (0xA20E in found) == focal_plane
        if focal_plane:
            assert found[0xA210] == 2
            assert 64 / found[0xA20E] * 25.4 == pytest.approx(8.0, rel=1e-4)
