"""Frames of a video: which are sharp, and what a video must be to hold photographs."""

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from panoless.photographs.lens import opencv
from shinypartial.core.color import LINEAR_OF_CODES
from shinypartial.core.errors import InputError
from shinypartial.io.events import warn

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
#: Luminance of linear light (IEC 61966-2-1).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
#: Sharpness for the choice within a video is judged at this width.
JUDGED_WIDTH_PX = 480
#: Transfer characteristics of high dynamic range (ISO/IEC 23091-2), by their numbers.
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
#: A box of MP4 and QuickTime that names primaries, transfer and matrix.
COLOR_BOX = b"colrnclx"
#: Share of the frames that the file announces and that must be there for nothing to be said.
COMPLETE = 0.98


def decoded_video(file: Path, count: int) -> Iterator[tuple[str, Path, UInt8[np.ndarray, "H W C"]]]:
    """The sharpest frames: each is found among those between half a step and one and a half after the last one.

    Raises InputError for a video that can't be decoded, and for one of high dynamic range, whose codes are not sRGB.
    One that ends before its announced length is used as far as it goes, and a line says so.
    """
    _require_standard_range(file)
    sharpness = np.array([_sharpness(image) for image in _video(file)])
    _tell_missing(file, len(sharpness))
    chosen = set(sharpest_frames(sharpness, count)) if len(sharpness) else set()
    for index, image in enumerate(_video(file)):
        if index in chosen:
            yield f"frame_{index:05d}", file, np.ascontiguousarray(image[..., ::-1])


def _require_standard_range(file: Path) -> None:
    """InputError where the container says that light is coded as PQ or HLG."""
    if not file.stat().st_size:
        return
    with file.open("rb") as opened, mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as content:
        at = content.find(COLOR_BOX)
        place = at + len(COLOR_BOX)
        transfer = struct.unpack(">3H", content[place : place + 6])[1] if 0 <= at <= len(content) - 14 else 0
    if transfer in HDR_TRANSFERS:
        raise InputError(
            expected=f"a video of standard dynamic range at {file}",
            found=f"one of high dynamic range ({HDR_TRANSFERS[transfer]})",
            remedy="Turn HDR off in the camera's settings, or convert it with tone mapping.",
        )


def _tell_missing(file: Path, decoded: int) -> None:
    video = opencv().VideoCapture(str(file))
    announced = int(video.get(opencv().CAP_PROP_FRAME_COUNT)) if video.isOpened() else 0
    video.release()
    if not decoded:
        raise InputError(
            expected=f"a whole video at {file}",
            found="no frame that can be decoded",
            remedy="Copy it from the camera again; its recording or its copy was cut off.",
        )
    if decoded < COMPLETE * announced:
        warn(f"{file.name} ends after {decoded} of {announced} frames; these are used")


def sharpest_frames(sharpness: Float[np.ndarray, "T"], count: int) -> list[int]:
    """About `count` of T frames, each the sharpest of its window, and none further from the last than 1.5 T / count."""
    step = max(len(sharpness) / count, 1.0)
    chosen = [int(np.argmax(sharpness[: max(int(step), 1)]))]
    while True:
        first = chosen[-1] + max(int(np.ceil(step / 2)), 1)
        window = sharpness[first : chosen[-1] + int(1.5 * step) + 1]
        if not len(window):
            return chosen
        chosen.append(first + int(np.argmax(window)))


def _video(file: Path) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Frames, upright, blue first."""
    video = opencv().VideoCapture(str(file))
    try:
        while True:
            found, image = video.read()
            if not found:
                return
            yield image
    finally:
        video.release()


def _sharpness(image: UInt8[np.ndarray, "H W 3"]) -> float:
    """Variance of the Laplacian of linear luminance over its squared mean, at a small size."""
    cv2 = opencv()
    scale = min(1.0, JUDGED_WIDTH_PX / image.shape[1])
    light = luminance(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)[..., ::-1])
    return float(cv2.Laplacian(light, cv2.CV_32F).var() / max(float(light.mean()) ** 2, 1e-8))


def luminance(image: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    """Of linear light, from sRGB codes."""
    return LINEAR_OF_CODES[image] @ LUMINANCE
