"""Photographs or a video to frames: upright 8-bit pictures of moderate size, and how sharp they are."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from panoless.photographs.lens import opencv
from panoless.photographs.options import LEAST_VIEWS, CaptureOptions
from panoless.photographs.shot import RAW_SUFFIXES
from panoless.photographs.standstill import StillCheck
from panoless.photographs.video import VIDEO_SUFFIXES, decoded_video, luminance
from shinypartial.core.color import CODES_OF_LINEAR, LINEAR_OF_CODES
from shinypartial.core.errors import InputError
from shinypartial.dataset.bundled import bundled_photographs
from shinypartial.io.images import EXR, PICTURE_SUFFIXES, read_as_stored, read_upright, to_bytes, write_png
from shinypartial.io.progress import Progress
from shinypartial.io.threads import in_threads

MOST_BLUR = 0.75
"""Blur (Crete et al. 2007, 0 to 1) of the median frame above which a capture is refused: 0.67 after a Gaussian blur
of 2 pixels, 0.78 after 3."""

#: What programs write beside a picture; no photograph of its own.
COMPANIONS = ("_alpha", "_mask", "_normal", "_self", "_depth")
#: Blocks are averaged in so many rows of them at a time: what is between stays in the processor's cache.
BLOCK_ROWS = 32
#: Channels of color; a fourth is alpha.
COLORS = 3

#: What a frame is made of: its name, its file, and its pixels where a video has them.
Source = tuple[str, Path, UInt8[np.ndarray, "H W C"] | None]


@dataclass(frozen=True)
class Photograph:
    """A frame on disk: `NAME.png` in the folder of frames."""

    name: str
    source: Path
    """The file that it came from."""
    width: int
    height: int
    side: int
    """It was averaged over blocks of so many pixels a side."""
    full_width: int
    full_height: int
    """Size before that, upright."""
    blur: float
    """Crete et al. 2007: 0 sharp, 1 blurred."""
    brightness: float
    """Mean linear luminance, for drifting exposures."""


@dataclass(frozen=True)
class Frames:
    """All frames of a capture in the order of their names, or of time."""

    photographs: tuple[Photograph, ...]


def source_files(source: Path) -> list[Path]:
    """The pictures of a folder, or a video alone, or those that are bundled by that name; InputError when there is none
    of these.
    """
    if not source.exists() and (bundled := bundled_photographs(str(source))):
        return list(bundled)
    if source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES:
        return [source]
    if source.is_dir():
        # Structure-from-motion programs keep pictures in a folder `images`.
        for folder in (source, source / "images", source / "train"):
            files = [path for path in sorted(folder.iterdir()) if _is_photograph(path)] if folder.is_dir() else []
            # A camera may write a JPEG beside each RAW.
            developed = [path for path in files if path.suffix.lower() in PICTURE_SUFFIXES]
            if files:
                return developed or files
        videos = [path for path in sorted(source.iterdir()) if path.suffix.lower() in VIDEO_SUFFIXES]
        if len(videos) == 1:
            return videos
    raise InputError(
        expected=f"photographs ({', '.join(PICTURE_SUFFIXES)}) in a folder, or a video, at {source}",
        found="nothing there" if not source.exists() else "none",
        remedy="Name the folder that holds the pictures.",
    )


def _is_photograph(path: Path) -> bool:
    return path.suffix.lower() in (*PICTURE_SUFFIXES, EXR, *RAW_SUFFIXES) and not path.stem.endswith(COMPANIONS)


def make_frames(files: list[Path], folder: Path, upright: bool, options: CaptureOptions) -> Frames:
    """Write frames into a folder. Raises InputError for too few of them, equal names, and where most are blurred."""
    video = files[0].suffix.lower() in VIDEO_SUFFIXES
    total = options.video_frames if video else len(files)
    progress = Progress("frames", total)
    photographs = []
    borders = StillCheck()

    def made(source: Source) -> Photograph:
        name, file, pixels = source
        image = _decoded(file, upright) if pixels is None else pixels
        borders.add(image)
        return _write_frame(name, file, image, folder, options)

    sources: Iterable[Source] = decoded_video(files[0], total) if video else _named(files)
    for photograph in in_threads(made, sources):
        photographs.append(photograph)
        progress.advance()
    if len(photographs) < LEAST_VIEWS:
        raise InputError(
            expected=f"at least {LEAST_VIEWS} photographs",
            found=f"{len(photographs)} in {files[0].parent}",
            remedy="Take more of them, 50 to 100 from an arc as wide as you can.",
        )
    blur = float(np.median([photograph.blur for photograph in photographs]))
    if blur > MOST_BLUR:
        raise InputError(
            expected=f"sharp photographs: blur of at most {MOST_BLUR:.2f} in the median frame",
            found=f"{blur:.2f}",
            remedy="Lock the focus on the object, take more light or a tripod, and move slowly.",
        )
    borders.require_motion()
    return Frames(tuple(photographs))


def _named(files: list[Path]) -> list[Source]:
    """Files by the names of their frames; InputError where two have the same."""
    names: dict[str, Path] = {}
    for file in files:
        if file.stem in names:
            raise InputError(
                expected="photographs with names of their own",
                found=f"{names[file.stem].name} and {file.name}",
                remedy="Rename one of them.",
            )
        names[file.stem] = file
    return [(name, file, None) for name, file in names.items()]


def _decoded(file: Path, upright: bool) -> UInt8[np.ndarray, "H W C"]:
    if file.suffix.lower() in RAW_SUFFIXES:
        raise InputError(
            expected=f"a developed photograph, as poses and masks are found in, at {file}",
            found="RAW",
            remedy="Develop all alike, to JPEG, PNG or TIFF; RAW of a ball is read with --object ball.",
        )
    image = read_upright(file) if upright else read_as_stored(file)
    if image.dtype.kind == "f":
        raise InputError(
            expected=f"a photograph of 8 or 16 bits at {file}",
            found="floating-point radiance",
            remedy="Export it as PNG or JPEG in sRGB.",
        )
    codes = to_bytes(image)
    return np.repeat(codes, COLORS, 2) if codes.shape[2] == 1 else codes


def _write_frame(
    name: str, source: Path, image: UInt8[np.ndarray, "H W C"], folder: Path, options: CaptureOptions
) -> Photograph:
    from skimage.measure import blur_effect

    height, width = image.shape[:2]
    side = -(-max(height, width) // options.longest_side_px)
    small = block_means(image, side)
    write_png(folder / f"{name}.png", small, quick=True)
    light = luminance(small[..., :COLORS])
    blur = float(blur_effect(light))
    return Photograph(name, source, small.shape[1], small.shape[0], side, width, height, blur, float(light.mean()))


def block_means(image: UInt8[np.ndarray, "H W *C"], side: int) -> UInt8[np.ndarray, "h w *C"]:
    """Means of linear light over squares of `side` pixels, as sRGB; of a mask or alpha, of its numbers."""
    if side == 1:
        return image
    rows, columns = (size // side for size in image.shape[:2])
    whole = image[: rows * side, : columns * side].reshape(rows * side, columns * side, -1)
    channels = whole.shape[2]
    codes = np.linspace(0, 1, 256, dtype=np.float32)
    tables = [LINEAR_OF_CODES if channels >= COLORS > channel else codes for channel in range(channels)]
    lookup = np.stack(tables, -1)[None]
    found = np.empty((rows, columns, channels), np.uint8)
    for top in range(0, rows, BLOCK_ROWS):
        bottom = min(top + BLOCK_ROWS, rows)
        values = opencv().LUT(np.ascontiguousarray(whole[top * side : bottom * side]), lookup)
        # Of whole blocks, INTER_AREA takes the mean.
        means = opencv().resize(values, (columns, bottom - top), interpolation=opencv().INTER_AREA)
        means = means.reshape(bottom - top, columns, channels)
        found[top:bottom] = np.rint(255 * means)
        if channels >= COLORS:
            found[top:bottom, :, :COLORS] = CODES_OF_LINEAR[np.rint(65535 * means[..., :COLORS]).astype(np.uint16)]
    return found.reshape(rows, columns, *image.shape[2:])
