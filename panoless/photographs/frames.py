"""Photographs or a video to frames: upright 8-bit pictures of moderate size, and how sharp they are."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from panoless.photographs.options import CaptureOptions
from panoless.photographs.standstill import StillCheck
from panoless.photographs.video import VIDEO_SUFFIXES, decoded_video, luminance
from shinypartial.core.color import srgb_to_linear, to_display
from shinypartial.core.errors import InputError
from shinypartial.io.images import PICTURE_SUFFIXES, read_as_stored, read_upright, unit_values, write_png
from shinypartial.io.progress import Progress

#: What programs write beside a picture; no photograph of its own.
COMPANIONS = ("_alpha", "_mask", "_normal", "_self", "_depth")


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
    """The pictures of a folder, or a video alone; InputError when there is neither."""
    if source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES:
        return [source]
    if source.is_dir():
        # Structure-from-motion programs keep pictures in a folder `images`.
        for folder in (source, source / "images", source / "train"):
            pictures = [path for path in sorted(folder.iterdir()) if _is_photograph(path)] if folder.is_dir() else []
            if pictures:
                return pictures
        videos = [path for path in sorted(source.iterdir()) if path.suffix.lower() in VIDEO_SUFFIXES]
        if len(videos) == 1:
            return videos
    raise InputError(
        expected=f"photographs ({', '.join(PICTURE_SUFFIXES)}) in a folder, or a video, at {source}",
        found="nothing there" if not source.exists() else "none",
        remedy="Name the folder that holds the pictures.",
    )


def _is_photograph(path: Path) -> bool:
    return path.suffix.lower() in PICTURE_SUFFIXES and not path.stem.endswith(COMPANIONS)


def make_frames(files: list[Path], folder: Path, upright: bool, options: CaptureOptions) -> Frames:
    """Write frames into a folder. Raises InputError for too few of them, equal names, and where most are blurred."""
    video = files[0].suffix.lower() in VIDEO_SUFFIXES
    total = options.video_frames if video else len(files)
    progress = Progress("frames", total)
    photographs = []
    names: dict[str, Path] = {}
    borders = StillCheck()
    for name, file, image in decoded_video(files[0], total) if video else _decoded(files, upright):
        if name in names:
            raise InputError(
                expected="photographs with names of their own",
                found=f"{names[name].name} and {file.name}",
                remedy="Rename one of them.",
            )
        names[name] = file
        photographs.append(_write_frame(name, file, image, folder, options))
        borders.add(image)
        progress.advance()
    if len(photographs) < options.least_views:
        raise InputError(
            expected=f"at least {options.least_views} photographs",
            found=f"{len(photographs)} in {files[0].parent}",
            remedy="Take more of them, 50 to 100 from an arc as wide as you can.",
        )
    blur = float(np.median([photograph.blur for photograph in photographs]))
    if blur > options.most_blur:
        raise InputError(
            expected=f"sharp photographs: blur of at most {options.most_blur:.2f} in the median frame",
            found=f"{blur:.2f}",
            remedy="Lock the focus on the object, take more light or a tripod, and move slowly.",
        )
    borders.require_motion(options)
    return Frames(tuple(photographs))


def _decoded(files: list[Path], upright: bool) -> Iterator[tuple[str, Path, UInt8[np.ndarray, "H W C"]]]:
    for file in files:
        image = read_upright(file) if upright else read_as_stored(file)
        if image.dtype.kind == "f":
            raise InputError(
                expected=f"a photograph of 8 or 16 bits at {file}",
                found="floating-point radiance",
                remedy="Export it as PNG or JPEG in sRGB.",
            )
        levels = image if image.dtype == np.uint8 else np.rint(unit_values(image) * 255).astype(np.uint8)
        yield file.stem, file, np.repeat(levels, 3, 2) if levels.shape[2] == 1 else levels


def _write_frame(
    name: str, source: Path, image: UInt8[np.ndarray, "H W C"], folder: Path, options: CaptureOptions
) -> Photograph:
    from skimage.measure import blur_effect

    height, width = image.shape[:2]
    side = -(-max(height, width) // options.longest_side_px)
    small = block_means(image, side)
    write_png(folder / f"{name}.png", np.ascontiguousarray(small))
    light = luminance(small[..., :3])
    blur = float(blur_effect(light))
    return Photograph(name, source, small.shape[1], small.shape[0], side, width, height, blur, float(light.mean()))


def block_means(image: UInt8[np.ndarray, "H W *C"], side: int) -> UInt8[np.ndarray, "h w *C"]:
    """Means of linear light over squares of `side` pixels, as sRGB; of a mask or alpha, of its numbers."""
    if side == 1:
        return image
    rows, columns = (size // side for size in image.shape[:2])
    whole = unit_values(image[: rows * side, : columns * side].reshape(rows * side, columns * side, -1))
    if whole.shape[2] >= 3:
        whole[..., :3] = srgb_to_linear(whole[..., :3])
    means = whole.reshape(rows, side, columns, side, -1).mean((1, 3))
    levels = np.rint(means * 255).astype(np.uint8)
    if levels.shape[2] >= 3:
        levels[..., :3] = to_display(means[..., :3])
    return levels.reshape(rows, columns, *image.shape[2:])
