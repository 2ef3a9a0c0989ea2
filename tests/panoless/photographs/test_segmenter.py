"""A segmentation model is given what the contract says, and its answer becomes masks."""

import struct
from pathlib import Path

import numpy as np
import pytest

from panoless.photographs.frames import Frames, Photograph
from panoless.photographs.options import CaptureOptions
from panoless.photographs.segmenter import segment
from shinypartial.core.errors import InputError
from shinypartial.io.images import read_png, write_png

SIDE = 32
OPTIONS = CaptureOptions(segmenter_side_px=SIDE, segmenter_mean=(0.2, 0.4, 0.6), segmenter_deviation=(0.5, 1.0, 2.0))


def varint(number: int) -> bytes:
    low, rest = number & 127, number >> 7
    return bytes([low | 128]) + varint(rest) if rest else bytes([low])


def message(*fields: tuple[int, int | bytes | str]) -> bytes:
    """Protocol buffers: whole numbers as varints, all else with its length before it."""
    parts = []
    for number, value in fields:
        if isinstance(value, int):
            parts.append(varint(8 * number) + varint(value))
        else:
            content = value.encode() if isinstance(value, str) else value
            parts.append(varint(8 * number + 2) + varint(len(content)) + content)
    return b"".join(parts)


def tensor(name: str, values: np.ndarray) -> bytes:
    packed = struct.pack(f"<{values.size}f", *values.ravel())
    return message(*((1, size) for size in values.shape), (2, 1), (8, name), (9, packed))


def value_info(name: str, shape: tuple[int, ...]) -> bytes:
    sizes = message(*((1, message((1, size))) for size in shape))
    return message((1, name), (2, message((1, message((1, 1), (2, sizes))))))


def write_model(path: Path, weights: tuple[float, float, float], bias: float, last: str = "Sigmoid") -> Path:
    """ONNX of last(w · x + b) at each pixel, written by hand."""
    kernel = np.array(weights, np.float32).reshape(1, 3, 1, 1)
    kernel_shape = message((1, "kernel_shape"), (8, 1), (8, 1), (20, 7))
    nodes = [
        message((1, "x"), (1, "w"), (1, "b"), (2, "y"), (4, "Conv"), (5, kernel_shape)),
        message((1, "y"), (2, "z"), (4, last)),
    ]
    graph = message(
        *((1, node) for node in nodes),
        (2, "graph"),
        (5, tensor("w", kernel)),
        (5, tensor("b", np.array([bias], np.float32))),
        (11, value_info("x", (1, 3, SIDE, SIDE))),
        (12, value_info("z", (1, 1, SIDE, SIDE))),
    )
    path.write_bytes(message((1, 8), (7, graph), (8, message((1, ""), (2, 13)))))
    return path


@pytest.fixture
def pictures(tmp_path: Path) -> tuple[Path, Frames]:
    """Two pictures of plain colors, 48 × 24 pixels, the left half bright."""
    frames = []
    for index in range(2):
        image = np.full((24, 48, 3), (30, 60, 90 + 60 * index), np.uint8)
        image[:, :24] = 200, 220, 240
        path = tmp_path / f"p_{index}.png"
        write_png(path, image)
        frames.append(Photograph(path.stem, path, 48, 24, 1, 48, 24, blur=0.0, brightness=0.5))
    return tmp_path, Frames(tuple(frames))


@pytest.mark.parametrize("channel", range(3))
def test_the_model_sees_one_channel_by_its_mean_and_deviation(
    tmp_path: Path, pictures: tuple[Path, Frames], channel: int
) -> None:
    """Far from the middle a pixel's share is σ((v/255 − mean)/deviation) of its own color, within a code of 8 bits."""
    folder, frames = pictures
    weights = tuple(float(index == channel) for index in range(3))
    model = write_model(tmp_path / "model.onnx", (weights[0], weights[1], weights[2]), 0.0)
    found = segment(model, frames, folder, tmp_path / "masks", OPTIONS)
    assert found.names == ("p_0", "p_1")
    for name in found.names:
        image, mask = read_png(folder / f"{name}.png"), read_png(tmp_path / f"masks/{name}.png")[..., 0]
        assert mask.shape == (24, 48)
        for column in (4, 44):
            value = image[12, column, channel] / 255
            expected = 1 / (
                1 + np.exp(-(value - OPTIONS.segmenter_mean[channel]) / OPTIONS.segmenter_deviation[channel])
            )
            assert mask[12, column] == pytest.approx(255 * expected, abs=1)


def test_models_that_break_the_contract_are_refused(tmp_path: Path, pictures: tuple[Path, Frames]) -> None:
    folder, frames = pictures
    logits = write_model(tmp_path / "logits.onnx", (9.0, 9.0, 9.0), 0.0, last="Relu")
    (tmp_path / "text.onnx").write_text("no model")
    for model, word in ((logits, "values from"), (tmp_path / "text.onnx", "ONNX"), (tmp_path / "none.onnx", "no such")):
        with pytest.raises(InputError, match=word):
            segment(model, frames, folder, tmp_path / "masks", OPTIONS)
