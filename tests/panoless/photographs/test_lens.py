"""Pictures without distortion, against COLMAP's own cameras."""

import numpy as np
import pycolmap
import pytest

from panoless.photographs.lens import Lens, lens_of_model
from shinypartial.core.errors import InputError

SIZE = (120, 90)
PARAMETERS = {
    "SIMPLE_PINHOLE": [100, 61, 44],
    "PINHOLE": [100, 104, 61, 44],
    "SIMPLE_RADIAL": [100, 61, 44, -0.12],
    "RADIAL": [100, 61, 44, -0.12, 0.05],
    "OPENCV": [100, 104, 61, 44, -0.12, 0.05, 0.01, -0.008],
}


def lens_of(camera) -> Lens:
    names = [name.strip() for name in camera.params_info.split(",")]
    return lens_of_model(camera.model_name, dict(zip(names, camera.params, strict=True)), camera.width, camera.height)


def camera_of(model: str, parameters: list[float]):
    return pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=parameters)


def pattern(directions: np.ndarray) -> np.ndarray:
    """A smooth picture at infinity, by directions (x, y, 1)."""
    return 128 + 50 * np.sin(9 * directions[..., 0] + 1) + 50 * np.cos(7 * directions[..., 1] - 4 * directions[..., 0])


@pytest.mark.parametrize("model", PARAMETERS)
def test_pictures_become_those_of_a_pinhole(model: str) -> None:
    """To 1.8 of 255 levels, where 1.4 were measured: OpenCV places samples to 1/32 px. Half a pixel is worth 3.5."""
    camera = camera_of(model, PARAMETERS[model])
    lens = lens_of(camera)
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5), -1)
    seen = pattern(camera.cam_from_img(pixels.reshape(-1, 2)).reshape(*SIZE[::-1], 2))
    flat = lens.undistorted(np.rint(seen).astype(np.uint8))
    truth = pattern((pixels - (lens.cx, lens.cy)) / (lens.fx, lens.fy))
    assert np.abs(flat - truth)[3:-3, 3:-3].max() < 1.8


def test_without_distortion_pixels_stay_as_they_are() -> None:
    image = np.random.default_rng(0).integers(0, 256, (90, 120, 3), dtype=np.uint8)
    assert lens_of(camera_of("PINHOLE", PARAMETERS["PINHOLE"])).undistorted(image) is image


def test_larger_pixels_are_of_the_same_lens() -> None:
    """A direction that falls on (x, y) falls on (x, y)/2 where pixels are twice as large."""
    lens = lens_of(camera_of("OPENCV", PARAMETERS["OPENCV"])).downscaled(2)
    half = camera_of("OPENCV", [*(value / 2 for value in PARAMETERS["OPENCV"][:4]), *PARAMETERS["OPENCV"][4:]])
    assert (lens.width, lens.height) == (60, 45)
    assert (lens.fx, lens.cx, lens.k1, lens.p2) == (half.params[0], half.params[2], half.params[4], half.params[7])


def test_other_lenses_are_refused() -> None:
    with pytest.raises(InputError, match="OPENCV_FISHEYE"):
        lens_of(camera_of("OPENCV_FISHEYE", [100, 100, 60, 45, 0, 0, 0, 0]))


def test_what_is_hidden_by_alpha_does_not_leak_into_the_edge() -> None:
    """A disk of one color keeps it up to its edge, whatever color stands where alpha is zero."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    alpha = np.clip(30.5 - np.hypot(x - 60, y - 45), 0, 1)
    image = np.dstack([np.where(alpha[..., None] > 0, (200, 120, 40), 0), 255 * alpha]).round().astype(np.uint8)
    flat = lens_of(camera_of("SIMPLE_RADIAL", PARAMETERS["SIMPLE_RADIAL"])).undistorted(image)
    seen = flat[..., 3] > 60  # Rounding of what is hardly there is worth some levels.
    assert np.abs(flat[seen][:, :3].astype(int) - (200, 120, 40)).max() <= 4
