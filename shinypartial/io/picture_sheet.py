"""Several small pictures as one JPEG with titles, small enough to be kept with every result."""

import io
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from shinypartial.io.files import atomic_write

TILE_PX = 340
TITLE_PX = 22
MAX_BYTES = 300_000
#: Tried in turn until the file is small enough; the last one is taken in any case.
QUALITIES = (90, 80, 65, 50, 30, 10)
INK, PAPER = (225, 225, 225), (24, 24, 24)


def write_picture_sheet(
    path: Path,
    pictures: Mapping[str, np.ndarray],
    *,
    widths: tuple[int, ...] = (TILE_PX, TILE_PX, TILE_PX),
    height: int = TILE_PX,
    max_bytes: int = MAX_BYTES,
) -> None:
    """Write 8-bit gray or RGB pictures of any size, their titles above, as a JPEG below `max_bytes`.

    Tiles are as wide as their column in `widths`, and `height` pixels high.

    Raises ValueError when there is no picture.
    """
    from PIL import Image, ImageDraw, ImageFont

    if not pictures:
        raise ValueError("a sheet needs a picture")
    rows = math.ceil(len(pictures) / len(widths))
    sheet = Image.new("RGB", (sum(widths[: len(pictures)]), rows * (height + TITLE_PX)), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    for index, (title, picture) in enumerate(pictures.items()):
        row, column = divmod(index, len(widths))
        left, top, width = sum(widths[:column]), row * (height + TITLE_PX), widths[column]
        draw.text((left + 6, top + 3), title, INK, font=font)
        tile = Image.fromarray(picture).convert("RGB")
        scale = min(width / tile.width, height / tile.height)
        size = (max(1, round(tile.width * scale)), max(1, round(tile.height * scale)))
        tile = tile.resize(size, Image.Resampling.BOX if scale < 1 else Image.Resampling.BICUBIC)
        sheet.paste(tile, (left + (width - size[0]) // 2, top + TITLE_PX + (height - size[1]) // 2))
    encoded = b""
    for quality in QUALITIES:
        stream = io.BytesIO()
        sheet.save(stream, "JPEG", quality=quality, optimize=True)
        encoded = stream.getvalue()
        if len(encoded) < max_bytes:
            break
    with atomic_write(path) as temporary:
        temporary.write_bytes(encoded)
