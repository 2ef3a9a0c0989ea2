"""What lies below the object: a flat sheet with a pattern, a printed board on it or not."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.board import BOARDS, Board, Paper
from shinypartial.core.trajectory import Seed, limits
from shinypartial.scene.shapes import Length

TEXTURE_PX = 1024
LEAVES = 6000
#: Radii of the pattern's disks in pixels; their number falls with the third power, so that every scale has its share.
LEAF_RADII_PX = (5.0, 120.0)
#: Radiance of black print and of the pattern's colors, as shares of that of white paper.
BLACK, LEAF_COLORS = 0.05, (0.08, 0.9)


@dataclass(frozen=True)
class Ground:
    """A horizontal square below the origin that gives off light as a sheet does under an even lamp.

    It neither receives light nor shadows, so that what it shows is known exactly from everywhere. Generated views look
    through it as through the walls of a room; a film shows it. A scene unit counts as a meter.
    """

    height: Annotated[float, limits(-1e3, -1e-3)]
    """z of the sheet in scene units."""
    side: Length
    """Length of its sides in scene units."""
    board: Paper | None = None
    """A board of `panoless board` on paper of that size, in the middle of the sheet, its columns along +X."""
    radiance: Annotated[float, limits(0.0, 1e4)] = 0.7
    """Of white paper; `Render.exposure` multiplies it as it does the world's."""
    seed: Seed = 0
    """Determines the sheet's pattern: disks of all sizes and colors, one upon another."""

    @property
    def printed(self) -> Board | None:
        """The board that lies there."""
        return None if self.board is None else BOARDS[self.board]

    @property
    def board_corner(self) -> tuple[float, float, float] | None:
        """Where the board's own world has its origin, in scene units; its axes are parallel to the scene's."""
        if self.printed is None:
            return None
        width, height = self.printed.size_m
        return -width / 2, height / 2, self.height

    def texture(self) -> Float[np.ndarray, "N N 3"]:
        """The sheet without a board, as radiance; the first row is the farthest along +Y (Lee et al. 2001)."""
        random = np.random.default_rng(self.seed)
        low, high = LEAF_RADII_PX
        radii = (low**-2 + random.random(LEAVES) * (high**-2 - low**-2)) ** -0.5
        centers = random.random((LEAVES, 2)) * TEXTURE_PX
        colors = random.uniform(*LEAF_COLORS, (LEAVES, 3)).astype(np.float32)
        sheet = np.full((TEXTURE_PX, TEXTURE_PX, 3), 0.5, np.float32)
        for (x, y), radius, color in zip(centers, radii, colors, strict=True):
            rows, columns = (
                np.arange(max(int(at - radius), 0), min(int(at + radius) + 2, TEXTURE_PX)) for at in (y, x)
            )
            disk = (rows[:, None] - y) ** 2 + (columns - x) ** 2 < radius**2
            sheet[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1][disk] = color
        return np.float32(self.radiance) * sheet

    def print_texture(self) -> Float[np.ndarray, "rows columns 3"]:
        """The board's cells as radiance; a sheet without a board has none."""
        cells = np.zeros((0, 0), bool) if self.printed is None else self.printed.cells()
        shades = np.where(cells, BLACK, 1.0).astype(np.float32)
        return np.repeat(np.float32(self.radiance) * shades[..., None], 3, -1)

    def radiance_at(self, points: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 3"]:
        """What the sheet gives off at (x, y) on it: the pattern's nearest pixel, or the board's cell."""
        found = _looked_up(self.texture(), points / self.side)
        if self.printed is not None:
            within = points / np.array(self.printed.size_m)
            on_board = (np.abs(within) < 0.5).all(-1)
            found[on_board] = _looked_up(self.print_texture(), within[on_board])
        return found

    def seen_from_origin(
        self, directions: Float[np.ndarray, "P 3"]
    ) -> tuple[Bool[np.ndarray, "P"], Float[np.ndarray, "S 3"]]:
        """Which unit directions from the origin meet the sheet, and where these do."""
        toward = directions[:, 2] < 0
        points = directions * (self.height / np.where(toward, directions[:, 2], np.inf))[:, None]
        meets = toward & (np.abs(points[:, :2]) < self.side / 2).all(-1)
        return meets, points[meets]


def _looked_up(picture: Float[np.ndarray, "H W 3"], places: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 3"]:
    """The nearest pixel at places in [−½, ½]², y upward."""
    rows, columns = picture.shape[:2]
    column = np.clip(np.floor((places[:, 0] + 0.5) * columns), 0, columns - 1).astype(int)
    row = np.clip(np.floor((0.5 - places[:, 1]) * rows), 0, rows - 1).astype(int)
    return picture[row, column]
