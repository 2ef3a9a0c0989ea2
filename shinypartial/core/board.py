"""The ChArUco board under an object: a chessboard with a marker in each white square, and the world that it defines.

The pattern is made of cells, nine to a square and seven to a marker, so that it prints as rectangles.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float

CELLS_OF_SQUARE, CELLS_OF_MARKER = 9, 7
MM = 1e-3
Paper = Literal["A4", "Letter", "A3"]
PAPERS = get_args(Paper)
#: The first markers of OpenCV's DICT_5X5_100, in the order of their numbers: 25 bits row by row, the first is the
#: highest, 1 is black.
MARKERS = (
    "0ba4d43 1e3f919 050f122 0fc6a08 0514adb 02bf7d2 12c2813 11deb94 0f29ecd 0cec05a 0c311fc 05d253f 019d4ee 1a18e99 "
    "0030357 1ae1c80 16858a7 1415d90 109b23b 0f9e217 0d2258a 0af1bbf 094f35e 145ed21 0632fdc 05a668d 03c3174 1ddbdb9 "
    "1c4698d 1dbddc4 1d8c891 1c9778c 1bf2f31 1b55537 1b9bc45 1859015 1667553 17d2efe 16552e2 179c38d 152d7da 15ad061 "
    "127b608 13cf626 12581ce 1169d85 1164668 106b7f9 10a6eda 1094828 0e4a71b 0e52d86 0e1c7f4 0e96bba 0d004b5 0a73472 "
    "0a6780f 0bdd020 0b1edd8 0a920dd 08c240e 09b36c3 0834479 077f578 06eb822 07b1475 0727a52 04d3256 045428c 0162bcd"
)
BITS_OF_MARKER = CELLS_OF_MARKER - 2


@dataclass(frozen=True)
class Board:
    """A chessboard with markers in its white squares, and the paper that it is printed on.

    Its world has the origin at the board's top left corner, x to the right, y up the sheet and z out of it, in meters.
    """

    columns: int
    rows: int
    paper_mm: tuple[float, float]
    square_mm: float = 27.0

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of all squares together, in meters."""
        return self.columns * self.square_mm * MM, self.rows * self.square_mm * MM

    def corners_world(self) -> Float[np.ndarray, "4 3"]:
        """Top left, top right, bottom right and bottom left corner, in meters."""
        width, height = self.size_m
        return np.array([[0, 0, 0], [width, 0, 0], [width, -height, 0], [0, -height, 0]])

    def cells(self) -> Bool[np.ndarray, "rows columns"]:
        """Which cells are black: squares with an even sum of row and column, and markers in the middle of the others.

        Markers are numbered row by row.
        """
        markers = iter(MARKERS.split())
        squares = [
            [np.ones((CELLS_OF_SQUARE,) * 2, bool) if (row + column) % 2 == 0 else _marked(next(markers))]
            for row in range(self.rows)
            for column in range(self.columns)
        ]
        each = np.array(squares).reshape(self.rows, self.columns, CELLS_OF_SQUARE, CELLS_OF_SQUARE)
        return np.swapaxes(each, 1, 2).reshape(self.rows * CELLS_OF_SQUARE, self.columns * CELLS_OF_SQUARE)


def _marked(code: str) -> Bool[np.ndarray, "rows columns"]:
    """A white square with a marker: a black border about its bits."""
    bits = np.array(list(f"{int(code, 16):0{BITS_OF_MARKER**2}b}")) == "1"
    marker = np.pad(bits.reshape(BITS_OF_MARKER, BITS_OF_MARKER), 1, constant_values=True)
    return np.pad(marker, (CELLS_OF_SQUARE - CELLS_OF_MARKER) // 2)


#: By the name of the paper. All have squares of 27 mm, and margins that printers leave.
BOARDS: dict[Paper, Board] = {
    "A4": Board(7, 10, (210.0, 297.0)),
    "Letter": Board(7, 9, (215.9, 279.4)),
    "A3": Board(10, 14, (297.0, 420.0)),
}
