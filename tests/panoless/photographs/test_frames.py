"""Photographs and videos to frames."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from panoless.photographs import standstill
from panoless.photographs.frames import block_means, make_frames, source_files
from panoless.photographs.options import CaptureOptions
from panoless.photographs.video import sharpest_frames
from shinypartial.core.color import linear_to_srgb, srgb_to_linear
from shinypartial.core.errors import InputError
from shinypartial.io.images import read_png, to_bytes, write_png

RANDOM = np.random.default_rng(3)
TEXTURE = cv2.resize(RANDOM.integers(0, 256, (24, 32, 3), dtype=np.uint8), (128, 96), interpolation=cv2.INTER_NEAREST)


def write_photographs(folder: Path, count: int = 8, blur_px: float = 0.0) -> list[Path]:
    image = cv2.GaussianBlur(TEXTURE, (0, 0), blur_px) if blur_px else TEXTURE
    for index in range(count):
        write_png(folder / f"p_{index}.png", np.ascontiguousarray(np.roll(image, 3 * index, 1)))
    return source_files(folder)


@given(st.integers(1, 400), st.integers(1, 60), st.integers(0, 1000))
def test_no_gap_is_wider_than_one_and_a_half_windows(length: int, count: int, seed: int) -> None:
    sharpness = np.random.default_rng(seed).random(length)
    chosen = sharpest_frames(sharpness, count)
    step = max(length / count, 1)
    gaps = np.diff(chosen)
    assert (gaps > 0).all()
    assert (gaps <= 1.5 * step).all()
    assert chosen[-1] > length - 1 - 1.5 * step - 1


def test_the_sharpest_frames_of_a_video_are_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 12, (128, 96))
    sharp = set(range(2, 48, 5))
    for index in range(48):
        writer.write(TEXTURE if index in sharp else cv2.GaussianBlur(TEXTURE, (0, 0), 3))
    writer.release()
    monkeypatch.setattr(standstill, "LEAST_CHANGE", 0.0)
    found = make_frames(source_files(path), tmp_path / "frames", True, CaptureOptions(video_frames=9))
    assert {int(one.name.removeprefix("frame_")) for one in found.photographs} <= sharp
    # JPEG of chroma at half the resolution; red and blue in their places.
    first = read_png(tmp_path / "frames" / f"{found.photographs[0].name}.png").astype(int)
    assert np.abs(first - TEXTURE[..., ::-1]).mean() < 12


def test_large_photographs_are_averaged_over_blocks_in_linear_light(tmp_path: Path) -> None:
    files = write_photographs(tmp_path / "photos")
    found = make_frames(files, tmp_path / "frames", True, CaptureOptions(longest_side_px=70)).photographs[0]
    assert (found.side, found.width, found.height, found.full_width) == (2, 64, 48, 128)
    black_and_white = np.zeros((2, 2, 3), np.uint8)
    black_and_white[0] = 255
    assert block_means(black_and_white, 2).ravel().tolist() == [188] * 3  # sRGB of one half.


@pytest.mark.parametrize("channels", [0, 1, 3, 4])
@pytest.mark.parametrize("side", [2, 3])
def test_block_means_are_those_of_the_formula(channels: int, side: int) -> None:
    """More rows than are averaged at a time, and pixels that fill no block; masks and alpha are no light."""
    shape = (150, 47, channels) if channels else (150, 47)
    image = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    rows, columns = shape[0] // side, shape[1] // side
    values = image[: rows * side, : columns * side].reshape(rows, side, columns, side, -1) / 255
    light = values.copy()
    light[..., :3] = srgb_to_linear(values[..., :3])
    expected = values.mean((1, 3))
    if channels >= 3:
        expected[..., :3] = linear_to_srgb(light.mean((1, 3))[..., :3])
    found = block_means(image, side)
    assert found.shape == (rows, columns, *shape[2:])
    # Half a code and what a table of 65536 lights leaves.
    assert np.abs(found.reshape(expected.shape) - 255 * expected).max() < 0.53


def test_sixteen_bits_are_rounded_to_the_nearest_code() -> None:
    codes = np.arange(65536, dtype=np.uint16)
    np.testing.assert_array_equal(to_bytes(codes), np.rint(codes / 257))


@pytest.mark.parametrize(("count", "blur_px", "message"), [(3, 0.0, "at least 8"), (8, 8.0, "sharp photographs")])
def test_bad_photographs_end_in_a_message(tmp_path: Path, count: int, blur_px: float, message: str) -> None:
    files = write_photographs(tmp_path / "photos", count, blur_px)
    with pytest.raises(InputError, match=message):
        make_frames(files, tmp_path / "frames", True, CaptureOptions())


def test_sharp_photographs_of_few_colors_are_not_refused(tmp_path: Path) -> None:
    make_frames(write_photographs(tmp_path / "photos"), tmp_path / "frames", True, CaptureOptions())


def test_a_folder_without_photographs_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("none")
    with pytest.raises(InputError, match="photographs"):
        source_files(tmp_path)


def test_portraits_are_turned_as_their_tag_says(tmp_path: Path) -> None:
    from PIL import Image

    folder = tmp_path / "photos"
    write_photographs(folder, 7)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(TEXTURE).save(folder / "portrait.jpg", exif=exif, quality=95, subsampling=0)
    found = make_frames(source_files(folder), tmp_path / "frames", True, CaptureOptions()).photographs[-1]
    assert (found.width, found.height) == (96, 128)
    turned = read_png(tmp_path / "frames" / "portrait.png").astype(int)
    assert np.abs(turned - np.rot90(TEXTURE, -1)).mean() < 6  # What JPEG leaves.
    kept = make_frames(source_files(folder), tmp_path / "stored", False, CaptureOptions()).photographs[-1]
    assert (kept.width, kept.height) == (128, 96)


def write_video(path: Path, count: int, size: tuple[int, int] = (128, 96)) -> None:
    """A texture that moves along."""
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter_fourcc(*("MJPG" if path.suffix == ".avi" else "mp4v")), 12, size
    )
    for index in range(count):
        writer.write(cv2.resize(np.roll(TEXTURE, 7 * index, 1), size))
    writer.release()


def test_a_video_that_ends_in_the_middle_is_used_as_far_as_it_goes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_video(tmp_path / "whole.avi", 40)
    content = (tmp_path / "whole.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(content[: len(content) * 2 // 3])
    found = make_frames([tmp_path / "cut.avi"], tmp_path / "frames", True, CaptureOptions())
    assert 20 <= len(found.photographs) < 30
    assert "ends after" in capsys.readouterr().err


def test_a_video_without_its_end_where_the_index_stands_is_refused(tmp_path: Path) -> None:
    """An MP4 that was cut off while it was recorded has no index, so that no frame can be decoded."""
    write_video(tmp_path / "whole.mp4", 30)
    content = (tmp_path / "whole.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(content[: content.rindex(b"moov") - 4])
    with pytest.raises(InputError, match="no frame"):
        make_frames([tmp_path / "cut.mp4"], tmp_path / "frames", True, CaptureOptions())


@pytest.mark.parametrize(("transfer", "refused"), [(1, False), (16, True), (18, True)])
def test_videos_of_high_dynamic_range_are_refused(tmp_path: Path, transfer: int, refused: bool) -> None:
    """By the box `colr` of a container (ISO/IEC 14496-12, 12.1.5): primaries, transfer, matrix, range."""
    path = tmp_path / "clip.mp4"
    write_video(path, 12)
    box = b"colr" + b"nclx" + b"".join(value.to_bytes(2, "big") for value in (9, transfer, 9)) + b"\x00"
    path.write_bytes(path.read_bytes() + (len(box) + 4).to_bytes(4, "big") + box)
    if refused:
        with pytest.raises(InputError, match="high dynamic range"):
            make_frames([path], tmp_path / "frames", True, CaptureOptions())
    else:
        assert len(make_frames([path], tmp_path / "frames", True, CaptureOptions()).photographs) == 12


@pytest.mark.parametrize(("surroundings", "message"), [("textured", "turntable"), ("plain", None)])
def test_a_turntable_is_told_by_surroundings_at_rest(tmp_path: Path, surroundings: str, message: str | None) -> None:
    """An object that turns before a room at rest, with noise and drifting exposure; a plain studio determines
    nothing."""
    room = TEXTURE if surroundings == "textured" else np.full_like(TEXTURE, 140)
    random = np.random.default_rng(0)
    for index in range(9):
        image = room.astype(float) * (1 + 0.05 * np.sin(index)) + random.normal(0, 2, room.shape)
        image[30:66, 40:88] = np.roll(TEXTURE, 11 * index, 1)[30:66, 40:88]
        write_png(tmp_path / "photos" / f"p_{index}.png", np.clip(image, 0, 255).astype(np.uint8))
    files = source_files(tmp_path / "photos")
    if message:
        with pytest.raises(InputError, match=message):
            make_frames(files, tmp_path / "frames", True, CaptureOptions())
    else:
        make_frames(files, tmp_path / "frames", True, CaptureOptions())


@pytest.mark.slow
def test_pictures_of_twelve_megapixels_take_moderate_memory(tmp_path: Path) -> None:
    """Below 4 GB: 0.75 GB were measured with all libraries loaded."""
    big = cv2.resize(TEXTURE, (4000, 3000), interpolation=cv2.INTER_NEAREST)
    for index in range(8):
        path = tmp_path / "photos" / f"p_{index}.jpg"
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), np.roll(big, 97 * index, 1))
    program = (
        "import resource, sys; from pathlib import Path; from panoless.photographs.frames import *;"
        "make_frames(source_files(Path(sys.argv[1])), Path(sys.argv[2]), True, CaptureOptions());"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "photos"), str(tmp_path / "frames")]
    kilobytes = int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert kilobytes < 4e6
