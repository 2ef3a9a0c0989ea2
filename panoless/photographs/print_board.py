"""The command that writes a board to print."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class PrintBoard:
    """Write the board that lies under the object while photographs are taken, at its true size."""

    output: Path = Path("board.pdf")
    """File to write: .pdf or .svg."""
    paper: Literal["A4", "Letter", "A3"] = "A4"
    """The larger, the better: the object must not hide most of it."""

    def run(self) -> None:
        """Write the file and say how to print it."""
        from panoless.photographs.board import write_board
        from shinypartial.core.board import BOARDS

        board = BOARDS[self.paper]
        write_board(board, self.output)
        print(f"Print {self.output} at 100 % and measure: five squares are {5 * board.square_mm:g} mm.")
        print("Then: panoless capture FOLDER")
