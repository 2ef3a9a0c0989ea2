"""Masks by a segmentation model that the user names: an ONNX file, which OpenCV reads.

The model takes one picture as 1 × 3 × S × S, (RGB / 255 − mean)/deviation, and its first output, 1 × 1 × any size, is
the share of each pixel that belongs to the object, 0 to 1.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from panoless.photographs.frames import Frames
from panoless.photographs.lens import opencv
from panoless.photographs.options import CaptureOptions
from shinypartial.core.errors import InputError
from shinypartial.io.images import read_png, write_png
from shinypartial.io.progress import Progress

#: By how much a share may leave [0, 1] by rounding.
ROUNDING = 1e-3


@dataclass(frozen=True)
class Segmented:
    """The frames that have a mask by the model."""

    names: tuple[str, ...]


def segment(model: Path, frames: Frames, pictures: Path, folder: Path, options: CaptureOptions) -> Segmented:
    """Write a mask for each frame to `folder`. Raises InputError for files and outputs that are not of the contract."""
    network = _network(model)
    progress = Progress("segmentation", len(frames.photographs))
    for photograph in frames.photographs:
        image = read_png(pictures / f"{photograph.name}.png")[..., :3]
        share = segmented(network, image, f"{model.name} for {photograph.name}", options)
        write_png(folder / f"{photograph.name}.png", np.rint(255 * share).astype(np.uint8))
        progress.advance()
    return Segmented(tuple(photograph.name for photograph in frames.photographs))


def _network(model: Path) -> Any:
    cv2 = opencv()
    if not model.is_file():
        raise InputError(expected=f"a segmentation model at {model}", found="no such file", remedy="Check --segmenter.")
    try:
        return cv2.dnn.readNetFromONNX(str(model))
    except cv2.error as error:
        raise _refused(model.name, str(error.err)) from None


def segmented(
    network: Any, image: UInt8[np.ndarray, "H W 3"], what: str, options: CaptureOptions
) -> Float[np.ndarray, "H W"]:
    """The share of each pixel that belongs to the object, by a network of the contract."""
    cv2, side = opencv(), options.segmenter_side_px
    resized = cv2.resize(np.ascontiguousarray(image), (side, side), interpolation=cv2.INTER_AREA)
    mean, deviation = (np.array(each, np.float32) for each in (options.segmenter_mean, options.segmenter_deviation))
    values = (resized.astype(np.float32) / 255 - mean) / deviation
    network.setInput(np.ascontiguousarray(values.transpose(2, 0, 1)[None]))
    try:
        output = network.forward()
    except cv2.error as error:
        raise _refused(what, str(error.err)) from None
    if output.ndim != 4 or output.shape[:2] != (1, 1):
        raise _refused(what, f"an output of shape {output.shape}")
    low, high = float(output.min()), float(output.max())
    if not (low >= -ROUNDING and high <= 1 + ROUNDING):
        raise _refused(what, f"values from {low:.3g} to {high:.3g}")
    share = cv2.resize(output[0, 0].astype(np.float32), image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    clipped: np.ndarray = share.clip(0, 1)
    return clipped


def _refused(what: str, found: str) -> InputError:
    return InputError(
        expected=f"an ONNX model that OpenCV reads, and whose first output is 1×1×H×W in [0, 1]: {what}",
        found=found.strip().splitlines()[-1].strip("> ") if found.strip() else "an error in OpenCV",
        remedy="See docs/how-to/capture.md; --options.segmenter-side-px, -mean and -deviation say what it is given. "
        "Or run the model yourself, and give --masks.",
    )
