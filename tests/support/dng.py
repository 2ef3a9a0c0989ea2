"""A RAW photograph: the smallest DNG (a TIFF with a mosaic of red, green and blue) that programs develop."""

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float

BLACK, WHITE = 256, 4095
SHORT, LONG, RATIONAL, SIGNED_RATIONAL, ASCII, BYTE = 3, 4, 5, 10, 2, 1
SIZES = {SHORT: 2, LONG: 4, RATIONAL: 8, SIGNED_RATIONAL: 8, ASCII: 1, BYTE: 1}
SRGB_OF_XYZ = (3.2405, -1.5371, -0.4985, -0.9693, 1.8760, 0.0416, 0.0556, -0.2040, 1.0572)
"""A camera whose primaries are those of sRGB."""


def write_dng(path: Path, light: Float[np.ndarray, "H W 3"], seconds: float, film_mm: int) -> None:
    """Linear light in [0, 1] before a mosaic RGGB of 12 bits, with the exposure time and the focal length of EXIF."""
    height, width = light.shape[:2]
    row, column = np.indices((height, width))
    mosaic = np.take_along_axis(light, (row % 2 + column % 2)[..., None], 2)[..., 0]
    codes = np.rint(BLACK + (WHITE - BLACK) * np.clip(mosaic, 0, 1)).astype("<u2").tobytes()
    exif = _directory(
        [(0x829A, RATIONAL, [seconds]), (0x829D, RATIONAL, [2.0]), (0x8827, SHORT, [100]), (0xA405, SHORT, [film_mm])],
        8,
    )
    after = 8 + len(exif)
    entries = [
        (254, LONG, [0]), (256, LONG, [width]), (257, LONG, [height]), (258, SHORT, [16]), (259, SHORT, [1]),
        (262, SHORT, [32803]), (271, ASCII, "Test"), (272, ASCII, "Mosaic"), (273, LONG, [0]), (274, SHORT, [1]),
        (277, SHORT, [1]), (278, LONG, [height]), (279, LONG, [len(codes)]), (33421, SHORT, [2, 2]),
        (33422, BYTE, [0, 1, 1, 2]), (34665, LONG, [8]), (50706, BYTE, [1, 4, 0, 0]), (50707, BYTE, [1, 1, 0, 0]),
        (50708, ASCII, "Test Mosaic"), (50714, SHORT, [BLACK]), (50717, SHORT, [WHITE]),
        (50721, SIGNED_RATIONAL, list(SRGB_OF_XYZ)), (50728, RATIONAL, [1.0, 1.0, 1.0]), (50778, SHORT, [21]),
    ]  # fmt: skip
    start = after + len(_directory(entries, after))
    entries[8] = (273, LONG, [start])
    path.write_bytes(b"II*\0" + struct.pack("<I", after) + exif + _directory(entries, after) + codes)


def _directory(entries: list[tuple[int, int, list[float] | str]], offset: int) -> bytes:
    """A TIFF directory that stands at an offset, and its values that do not fit into entries behind it."""
    head, tail = struct.pack("<H", len(entries)), b""
    behind = offset + 2 + 12 * len(entries) + 4
    for tag, kind, values in entries:
        data = _values(kind, values)
        count = len(data) // SIZES[kind]
        if len(data) <= 4:
            head += struct.pack("<HHI", tag, kind, count) + data.ljust(4, b"\0")
        else:
            head += struct.pack("<HHII", tag, kind, count, behind + len(tail))
            tail += data + b"\0" * (len(data) % 2)
    return head + struct.pack("<I", 0) + tail


def _values(kind: int, values: list[float] | str) -> bytes:
    if isinstance(values, str):
        return values.encode() + b"\0"
    if kind in (RATIONAL, SIGNED_RATIONAL):
        letter = "I" if kind == RATIONAL else "i"
        return b"".join(struct.pack(f"<2{letter}", round(10000 * each), 10000) for each in values)
    return struct.pack(
        f"<{len(values)}{ {SHORT: 'H', LONG: 'I', BYTE: 'B'}[kind] }".replace(" ", ""), *map(int, values)
    )
