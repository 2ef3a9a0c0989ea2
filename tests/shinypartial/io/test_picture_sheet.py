"""A sheet of pictures is always small, shows every picture, and takes any size."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from shinypartial.io.picture_sheet import MAX_BYTES, TILE_PX, TITLE_PX, write_picture_sheet


def test_even_noise_stays_small(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (6, 700, 500, 3), dtype=np.uint8)
    write_picture_sheet(tmp_path / "sheet.jpg", {str(index): each for index, each in enumerate(noise)})
    assert (tmp_path / "sheet.jpg").stat().st_size < MAX_BYTES


@pytest.mark.parametrize("shape", [(1, 1), (9, 400, 3), (900, 20), (340, 340, 3)])
@pytest.mark.parametrize("count", [1, 3, 4, 6])
def test_every_picture_is_in_its_place(shape: tuple[int, ...], count: int, tmp_path: Path) -> None:
    """Pictures of one gray each: the middle of each tile has it."""
    levels = np.linspace(40, 250, count).astype(np.uint8)
    write_picture_sheet(tmp_path / "sheet.jpg", {f"p{i}": np.full(shape, v, np.uint8) for i, v in enumerate(levels)})
    with Image.open(tmp_path / "sheet.jpg") as opened:
        sheet = np.asarray(opened).astype(int)
    for index, level in enumerate(levels):
        row, column = divmod(index, 3)
        y, x = row * (TILE_PX + TITLE_PX) + TITLE_PX + TILE_PX // 2, column * TILE_PX + TILE_PX // 2
        assert abs(sheet[y, x] - int(level)).max() < 25


def test_nothing_is_no_sheet(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="picture"):
        write_picture_sheet(tmp_path / "sheet.jpg", {})
    assert not list(tmp_path.iterdir())
