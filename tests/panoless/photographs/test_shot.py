"""What a photograph's file says of its lens and its exposure, and its pixels as linear light."""

import math
from pathlib import Path

import numpy as np
import pytest

from panoless.photographs.frames import source_files
from panoless.photographs.shot import Shot, exposure_of, focal_of, given_focal, read_shot
from shinypartial.core.color import linear_to_srgb
from shinypartial.core.errors import InputError
from shinypartial.io.images import write_exr_rgb, write_jpeg, write_png
from tests.support.dng import write_dng

DIAGONAL_MM = 43.2666
CODES = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)


def test_the_focal_length_on_film_comes_first() -> None:
    found = focal_of({"Exif:FocalLengthIn35mmFilm": 26, "Exif:FocalLength": 5.4}, 4000, 3000)
    assert found.film_mm == pytest.approx(26)
    assert found.pixels(4000, 3000) == pytest.approx(26 / DIAGONAL_MM * 5000, rel=1e-5)
    assert found.sigma < 0.05


@pytest.mark.parametrize(("unit", "per_unit"), [(2, 25.4), (3, 10.0), (None, 25.4)])
def test_a_lens_and_its_sensor_tell_it(unit: int | None, per_unit: float) -> None:
    """50 mm before 36 mm of 6000 pixels are 50/36 · 6000 of them, or a third where a picture was made a third as
    large.
    """
    tags = {"Exif:FocalLength": 50.0, "Exif:FocalPlaneXResolution": 6000 / 36 * per_unit}
    tags |= {} if unit is None else {"Exif:FocalPlaneResolutionUnit": unit}
    assert focal_of(tags, 6000, 4000).pixels(6000, 4000) == pytest.approx(50 / 36 * 6000)
    smaller = tags | {"Exif:PixelXDimension": 6000, "Exif:PixelYDimension": 4000}
    assert focal_of(smaller, 2000, 1333).pixels(2000, 1333) == pytest.approx(50 / 36 * 2000)
    assert focal_of(smaller, 1333, 2000).pixels(1333, 2000) == pytest.approx(50 / 36 * 2000)


def test_a_phone_is_guessed_and_others_more_widely() -> None:
    phone, nothing = focal_of({"Exif:FocalLength": 4.2}, 400, 300), focal_of({}, 400, 300)
    assert 24 < phone.film_mm < 30
    assert phone.sigma < nothing.sigma
    assert "guess" in nothing.origin
    assert given_focal(35.0).film_mm == pytest.approx(35)
    assert given_focal(35.0).sigma < phone.sigma


@pytest.mark.parametrize("value", [0, -5.0, math.nan, "28 mm", None])
def test_tags_without_sense_are_none(value: object) -> None:
    assert focal_of({"Exif:FocalLengthIn35mmFilm": value}, 400, 300) == focal_of({}, 400, 300)
    assert exposure_of({"ExposureTime": value}) is None


def test_twice_as_much_light_is_twice_the_exposure() -> None:
    tags = {"ExposureTime": 0.01, "FNumber": 4.0, "Exif:PhotographicSensitivity": 200}
    base = exposure_of(tags)
    assert base == pytest.approx(0.01 * 200 / 16)
    assert exposure_of(tags | {"ExposureTime": 0.02}) == pytest.approx(2 * base)
    assert exposure_of(tags | {"FNumber": 2.0}) == pytest.approx(4 * base)
    assert exposure_of(tags | {"Exif:PhotographicSensitivity": 400}) == pytest.approx(2 * base)
    assert exposure_of({"FNumber": 4.0}) is None


def test_a_jpeg_keeps_what_its_camera_says(tmp_path: Path) -> None:
    """Written and read: pixels as far as JPEG keeps them, all tags."""
    tags = {
        "Exif:FocalLengthIn35mmFilm": 28,
        "ExposureTime": 0.005,
        "FNumber": 2.0,
        "Exif:PhotographicSensitivity": 400,
    }
    smooth = np.rint(np.linspace(20, 230, 60)[None, :, None] + np.zeros((40, 60, 3))).astype(np.uint8)
    write_jpeg(tmp_path / "one.jpg", smooth, 95, tags)
    shot = read_shot(tmp_path / "one.jpg")
    assert shot.name == "one"
    assert shot.size == (60, 40)
    assert shot.focal.film_mm == pytest.approx(28)
    assert shot.exposure == pytest.approx(0.005 * 400 / 4, rel=1e-3)
    np.testing.assert_allclose(shot.codes().astype(int), smooth.astype(int), atol=3)
    assert 0.9 < shot.clips_at < 1


def test_codes_are_light_and_back(tmp_path: Path) -> None:
    write_png(tmp_path / "one.png", CODES)
    shot = read_shot(tmp_path / "one.png")
    np.testing.assert_array_equal(np.rint(linear_to_srgb(shot.radiance()) * 255).astype(np.uint8), CODES)
    np.testing.assert_array_equal(shot.codes(), CODES)
    assert shot.exposure is None


def test_gray_is_three_channels_and_alpha_is_dropped(tmp_path: Path) -> None:
    write_png(tmp_path / "gray.png", CODES[..., :1])
    write_png(tmp_path / "alpha.png", np.concatenate([CODES, CODES[..., :1]], -1))
    np.testing.assert_array_equal(read_shot(tmp_path / "gray.png").pixels, np.repeat(CODES[..., :1], 3, 2))
    np.testing.assert_array_equal(read_shot(tmp_path / "alpha.png").pixels, CODES)


def test_linear_light_stays_as_it_is(tmp_path: Path) -> None:
    """An EXR clips nowhere; its codes are for people and detectors."""
    light = np.random.default_rng(1).uniform(0, 50, (8, 9, 3)).astype(np.float16).astype(np.float32)
    write_exr_rgb(tmp_path / "one.exr", light)
    shot = read_shot(tmp_path / "one.exr")
    assert shot.linear
    assert shot.clips_at == math.inf
    np.testing.assert_array_equal(shot.radiance(), light)
    assert shot.codes().dtype == np.uint8


@pytest.mark.parametrize("kind", ["codes", "light"])
def test_blocks_are_averaged_in_linear_light(kind: str) -> None:
    """What fills no block is left out; 8-bit codes stay codes."""
    pixels = CODES[:39, :59] if kind == "codes" else CODES[:39, :59].astype(np.float32)
    shot = Shot("one", Path("one"), pixels, focal_of({}, 59, 39), None, math.inf)
    found = shot.reduced(2)
    assert found.size == (29, 19)
    means = shot.radiance()[:38, :58].reshape(19, 2, 29, 2, 3).mean((1, 3))
    np.testing.assert_allclose(found.radiance(), means, atol=0.005 if kind == "codes" else 1e-3)
    assert shot.reduced(1) is shot


@pytest.mark.parametrize("content", [b"", b"no picture"])
def test_a_file_that_is_no_picture_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "one.jpg").write_bytes(content)
    with pytest.raises(InputError):
        read_shot(tmp_path / "one.jpg")
    with pytest.raises(InputError):
        read_shot(tmp_path / "none.jpg")


def test_raw_is_linear_light_whatever_it_shows(tmp_path: Path) -> None:
    """One scale for bright and dark photographs, or exposures would say nothing; and what EXIF says beside it."""
    light = np.stack([np.tile(np.linspace(0.05, 0.9, 256), (192, 1)) * share for share in (1.0, 0.7, 0.4)], -1)
    for share in (1.0, 0.3):
        write_dng(tmp_path / "shot.dng", share * light, 0.02, 28)
        shot = read_shot(tmp_path / "shot.dng")
        assert shot.linear
        assert shot.exposure == pytest.approx(0.02 * 100 / 4, rel=1e-3)
        assert shot.focal.film_mm == pytest.approx(28)
        inside = np.s_[20:-20, 20:-20]
        np.testing.assert_allclose(shot.radiance()[inside], (share * light)[inside], atol=0.002)


def test_a_folder_has_raw_photographs_where_none_are_developed(tmp_path: Path) -> None:
    for name in ("a.dng", "b.NEF"):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in source_files(tmp_path)] == ["a.dng", "b.NEF"]
    (tmp_path / "a.jpg").write_bytes(b"")
    assert [path.name for path in source_files(tmp_path)] == ["a.jpg"]
