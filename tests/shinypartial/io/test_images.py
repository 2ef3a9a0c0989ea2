"""Pictures in and out: exact round trips, and one clear message for whatever can't be read."""

import errno
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image, ImageOps

from shinypartial.core.errors import InputError
from shinypartial.io.images import (
    picture_size,
    read_as_stored,
    read_exr,
    read_exr_rgb,
    read_light,
    read_picture,
    read_png,
    read_upright,
    require_latlong,
    stack_channels,
    unit_values,
    write_exr,
    write_exr_rgb,
    write_png,
)

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


def test_black_and_white_becomes_gray(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 255]], np.uint8)).convert("1").save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), [[[0], [255]]])


@pytest.mark.parametrize("content", [b"", b"not an image", None], ids=["empty", "text", "truncated"])
def test_a_damaged_png_is_an_input_error(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "a.png"
    write_png(path, GENERATOR.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    path.write_bytes(path.read_bytes()[:2000] if content is None else content)
    with pytest.raises(InputError, match="a complete image"):
        read_png(path)


def test_importing_the_module_loads_no_library() -> None:
    code = "import sys, shinypartial.io.images; print(sorted({'OpenImageIO', 'OpenEXR', 'PIL'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def store(path: Path, image: np.ndarray, straight: bool = True) -> None:
    """Write with OpenImageIO in the format that the suffix names."""
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], image.shape[2], str(image.dtype).replace("float32", "float"))
    spec.attribute("oiio:UnassociatedAlpha", int(straight))
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec), file.geterror()
    assert file.write_image(image)
    assert file.close()


def some_codes(dtype: type, channels: int) -> np.ndarray:
    return GENERATOR.integers(0, np.iinfo(dtype).max, (5, 7, channels), dtype=dtype, endpoint=True)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("suffix", [".png", ".tif", ".tiff"])
def test_codes_of_8_and_16_bits_come_back_exactly(tmp_path: Path, dtype: type, channels: int, suffix: str) -> None:
    image, path = some_codes(dtype, channels), tmp_path / f"a{suffix}"
    store(path, image)
    found = read_picture(path)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, image)
    assert picture_size(path) == (7, 5)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA"])
def test_png_is_read_as_pillow_reads_it(tmp_path: Path, mode: str) -> None:
    image = some_codes(np.uint8, {"L": 1, "RGB": 3, "RGBA": 4}[mode])
    Image.fromarray(image if mode != "L" else image[..., 0]).save(tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as stored:
        np.testing.assert_array_equal(read_picture(tmp_path / "a.png"), np.asarray(stored).reshape(5, 7, -1))


def test_jpeg_is_read_as_pillow_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "a.JPG"
    Image.fromarray(some_codes(np.uint8, 3)).save(path, "JPEG")
    with Image.open(path) as stored:
        # Decoders may round the inverse cosine transform and the color conversion differently.
        np.testing.assert_allclose(read_picture(path), np.asarray(stored), atol=2)


def test_light_of_hdr_comes_back_to_its_shared_exponent(tmp_path: Path) -> None:
    light = GENERATOR.uniform(0, 40, (5, 7, 3)).astype(np.float32)
    store(tmp_path / "a.hdr", light)
    found = read_picture(tmp_path / "a.hdr")
    assert found.dtype == np.float32
    # Eight bits of the largest channel of a pixel.
    assert (np.abs(found - light) <= light.max(-1, keepdims=True) * 2**-7).all()


@pytest.mark.parametrize("straight", [True, False])
def test_light_of_tiff_is_premultiplied_as_that_of_exr(tmp_path: Path, straight: bool) -> None:
    light = GENERATOR.uniform(0, 1, (5, 7, 4)).astype(np.float32)
    store(tmp_path / "a.tif", light, straight)
    expected = light * np.append(light[..., 3:].repeat(3, -1), np.ones((5, 7, 1)), -1) if straight else light
    np.testing.assert_allclose(read_picture(tmp_path / "a.tif"), expected, rtol=1e-6)


@pytest.mark.parametrize("names", ["Y", "RGB", "RGBA"])
def test_exr_is_a_picture_too(tmp_path: Path, names: str) -> None:
    planes = {name: GENERATOR.uniform(size=(5, 7)).astype(np.float32) for name in names}
    write_exr(tmp_path / "a.exr", planes)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.exr"), np.stack([planes[name] for name in names], -1))


def test_unit_values_reach_0_and_1() -> None:
    for dtype in (np.uint8, np.uint16):
        np.testing.assert_array_equal(unit_values(np.array([0, np.iinfo(dtype).max], dtype)), [0, 1])
    assert unit_values(np.array([3.5])) == 3.5


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_a_picture_on_its_side_is_refused(tmp_path: Path, suffix: str, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / f"a{suffix}"
    Image.fromarray(some_codes(np.uint8, 3)).save(path, exif=exif)
    if orientation == 1:
        assert read_picture(path).shape == (5, 7, 3)
        return
    with pytest.raises(InputError, match=f"the EXIF orientation {orientation}"):
        read_picture(path)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_are_turned_upright_as_pillow_turns_them(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "a.png"
    codes = some_codes(np.uint8, 3)
    Image.fromarray(codes).save(path, exif=exif)
    np.testing.assert_array_equal(read_upright(path), np.asarray(ImageOps.exif_transpose(Image.open(path))))
    np.testing.assert_array_equal(read_as_stored(path), codes)


@pytest.mark.parametrize("suffix", [".jpg", ".tif", ".hdr", ".png"])
def test_a_truncated_picture_is_an_input_error(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    noise = GENERATOR.integers(0, 256, (40, 50, 3), dtype=np.uint8)
    store(path, noise.astype(np.float32) if suffix == ".hdr" else noise)
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(InputError, match="a complete image"):
        read_picture(path)


def test_premultiplied_codes_are_refused(tmp_path: Path) -> None:
    store(tmp_path / "a.tif", some_codes(np.uint8, 4), straight=False)
    with pytest.raises(InputError, match="straight"):
        read_picture(tmp_path / "a.tif")


def test_other_types_are_refused(tmp_path: Path) -> None:
    Image.fromarray(np.ones((5, 7), np.int32)).save(tmp_path / "a.tif")
    with pytest.raises(InputError, match="type int32"):
        read_picture(tmp_path / "a.tif")


def test_an_unknown_format_is_refused_with_those_that_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    with pytest.raises(InputError, match="export it again as PNG, JPEG, TIFF, HDR or EXR"):
        read_picture(tmp_path / "a.heic")


def test_a_full_disk_leaves_no_short_png(tmp_path: Path) -> None:
    """The libraries report a success there; a limit on the size of files stands for the disk."""
    resource = pytest.importorskip("resource")
    path = tmp_path / "a.png"
    code = (
        "import resource, sys, numpy as np; from pathlib import Path; from shinypartial.io.images import write_png\n"
        "image = np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8)\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, (4300, {resource.RLIM_INFINITY}))\n"
        f"try: write_png(Path({str(path)!r}), image)\nexcept OSError as error: sys.exit(error.errno)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == errno.ENOSPC
    assert list(tmp_path.iterdir()) == []


def test_a_lat_long_map_is_finite_twice_as_wide_as_high_and_within_its_bounds() -> None:
    good = GENERATOR.uniform(size=(4, 8, 3))
    require_latlong(good, Path("a.exr"), "radiance", "Mend it.", lowest=0.0, highest=1.0)
    require_latlong(good[..., 0] * 100 - 50, Path("a.exr"), "radiance", "Mend it.")
    spoiled = good.copy()
    for value in (np.nan, np.inf, -np.inf, -0.01, 1.01):
        spoiled[1, 2, 1] = value
        with pytest.raises(InputError, match="finite and twice as wide as high"):
            require_latlong(spoiled, Path("a.exr"), "radiance", "Mend it.", lowest=0.0, highest=1.0)
    for shape in ((8, 4), (4, 7), (4, 9)):
        with pytest.raises(InputError, match=f"{shape[1]}×{shape[0]}"):
            require_latlong(GENERATOR.uniform(size=shape), Path("a.exr"), "radiance", "Mend it.")


def test_light_loses_what_compression_left_below_zero_and_is_refused_below_that(tmp_path: Path) -> None:
    light = GENERATOR.uniform(1, 2, size=(4, 8, 3))
    light[0, 0] = -0.002
    write_exr_rgb(tmp_path / "a.exr", light)
    found = read_light(tmp_path / "a.exr")
    np.testing.assert_array_equal(found[0, 0], 0)
    np.testing.assert_allclose(found[1:], light[1:], rtol=2**-11)
    light[0, 0] = -0.5
    write_exr_rgb(tmp_path / "b.exr", light)
    with pytest.raises(InputError, match="radiance ≥ 0"):
        read_light(tmp_path / "b.exr")


def png_of_size(path: Path, width: int, height: int) -> Path:
    """A PNG that says so in its header and holds one row."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    row = zlib.compress(bytes(1 + 4 * width))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", row) + chunk(b"IEND", b""))
    return path


@pytest.mark.parametrize("read", [read_picture, read_upright, read_as_stored, read_png, picture_size])
def test_a_small_file_that_claims_a_huge_picture_is_refused_before_it_is_decoded(tmp_path: Path, read) -> None:
    """By its size, or by OpenImageIO 3.2 as a file too small for it."""
    path = png_of_size(tmp_path / "a.png", 30_000, 30_000)
    with pytest.raises(InputError, match=r"200 megapixels.*30000×30000, 900 megapixels|claims a 3433 MB image"):
        read(path)


def test_a_picture_of_a_medium_format_camera_is_no_huge_one(tmp_path: Path) -> None:
    assert picture_size(png_of_size(tmp_path / "a.png", 11_648, 8_736)) == (11_648, 8_736)


def test_an_exr_that_claims_a_huge_picture_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, {"R": np.zeros((2, 2), np.float16)})
    content = bytearray(path.read_bytes())
    window = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    content[window : window + 16] = struct.pack("<4i", 0, 0, 29_999, 29_999)
    path.write_bytes(content)
    with pytest.raises(InputError, match="900 megapixels"):
        read_exr(path)
