"""Image files at the door: exact round trips, and one clear message for whatever can't be read."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from shinypartial.core.errors import InputError
from shinypartial.io.images import read_exr, read_exr_rgb, read_png, stack_channels, write_exr, write_exr_rgb, write_png

GENERATOR = np.random.default_rng(0)


def test_exr_keeps_every_channel_bit_for_bit(tmp_path: Path) -> None:
    channels = {
        "R": GENERATOR.normal(size=(5, 7)).astype(np.float16),
        "depth.Z": GENERATOR.normal(size=(5, 7)).astype(np.float32) * 1e30,
        "normal.X": np.asfortranarray(GENERATOR.normal(size=(5, 7)).astype(np.float32)),
    }
    write_exr(tmp_path / "a.exr", channels)
    found = read_exr(tmp_path / "a.exr")
    assert found.keys() == channels.keys()
    for name, plane in channels.items():
        assert found[name].dtype == plane.dtype
        np.testing.assert_array_equal(found[name], plane)
    assert list(tmp_path.iterdir()) == [tmp_path / "a.exr"]


def test_exr_radiance_is_rounded_to_half_and_clipped_to_its_largest_value(tmp_path: Path) -> None:
    radiance = np.array([[[0.1, 1e6, -1e6], [3.0, 0.0, 65504.0]]], np.float32)
    write_exr_rgb(tmp_path / "a.exr", radiance)
    found = read_exr_rgb(tmp_path / "a.exr")
    # Half floats keep 11 bits.
    np.testing.assert_allclose(found, [[[0.1, 65504, -65504], [3, 0, 65504]]], rtol=2**-11)


@pytest.mark.parametrize("keep", [0.0, 0.02, 0.5, 0.98])
def test_truncated_exr_is_an_input_error(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "a.exr"
    write_exr_rgb(path, GENERATOR.uniform(size=(32, 32, 3)))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(InputError, match="a truncated or damaged file") as caught:
        read_exr(path)
    assert str(path) in caught.value.expected


def test_missing_images_are_input_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_exr(tmp_path / "a.exr")
    with pytest.raises(InputError, match="no such file"):
        read_png(tmp_path / "a.png")


def test_a_missing_channel_is_named_beside_those_found() -> None:
    with pytest.raises(InputError, match=r"channels R, G, B in a\.exr; found G, Y"):
        stack_channels({"G": np.ones((1, 1)), "Y": np.ones((1, 1))}, ("R", "G", "B"), Path("a.exr"))


def test_a_failed_exr_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, {"Y": np.ones((2, 2), np.float32)})
    before = path.read_bytes()
    with pytest.raises(OSError, match="could not write the EXR"):
        write_exr(path, {"Y": np.ones((2, 2), dtype=bool)})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 3), (4, 6, 4)], ids=["gray", "RGB", "RGBA"])
def test_png_round_trip_is_exact(tmp_path: Path, shape: tuple[int, ...]) -> None:
    image = GENERATOR.integers(0, 256, shape, dtype=np.uint8)
    write_png(tmp_path / "a.png", image)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), image.reshape(4, 6, -1))


def test_png_with_16_bits_is_reduced_to_8(tmp_path: Path) -> None:
    values = np.array([[0, 128, 257, 32896, 65535]], np.uint16)
    Image.fromarray(values).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_png(tmp_path / "a.png")[..., 0], [[0, 0, 1, 128, 255]])


COLORS = np.array([[[10, 20, 30], [200, 100, 0]]], np.uint8)


def test_an_opaque_palette_becomes_rgb_without_a_made_up_mask(tmp_path: Path) -> None:
    Image.fromarray(COLORS).convert("P", palette=Image.Palette.ADAPTIVE).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), COLORS)


def test_a_palette_with_transparency_becomes_rgba(tmp_path: Path) -> None:
    image = Image.fromarray(COLORS).convert("P", palette=Image.Palette.ADAPTIVE)
    image.save(tmp_path / "a.png", transparency=image.getpixel((0, 0)))
    found = read_png(tmp_path / "a.png")
    np.testing.assert_array_equal(found[..., 3], [[0, 255]])
    np.testing.assert_array_equal(found[0, 1, :3], COLORS[0, 1])


def test_gray_with_alpha_becomes_rgba(tmp_path: Path) -> None:
    Image.fromarray(np.array([[[7, 0], [9, 255]]], np.uint8), mode=None).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), [[[7, 7, 7, 0], [9, 9, 9, 255]]])


def test_black_and_white_becomes_rgb(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 255]], np.uint8)).convert("1").save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), [[[0, 0, 0], [255, 255, 255]]])


@pytest.mark.parametrize("content", [b"", b"not an image", None], ids=["empty", "text", "truncated"])
def test_a_damaged_png_is_an_input_error(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "a.png"
    write_png(path, GENERATOR.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    path.write_bytes(path.read_bytes()[:2000] if content is None else content)
    with pytest.raises(InputError, match="a complete image"):
        read_png(path)
