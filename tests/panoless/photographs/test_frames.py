"""Photographs and videos to frames."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from panoless.photographs.frames import block_means, make_frames, sharpest_frames, source_files
from panoless.photographs.options import CaptureOptions
from shinypartial.core.errors import InputError
from shinypartial.io.images import read_png, write_png

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


def test_the_sharpest_frames_of_a_video_are_taken(tmp_path: Path) -> None:
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 12, (128, 96))
    sharp = set(range(2, 48, 5))
    for index in range(48):
        writer.write(TEXTURE if index in sharp else cv2.GaussianBlur(TEXTURE, (0, 0), 3))
    writer.release()
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
