"""Whether the camera moved at all: on a turntable, and before a tripod, what lies at the border stays as it is."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from panoless.photographs.options import LEAST_VIEWS
from panoless.photographs.video import luminance
from shinypartial.core.errors import InputError

LEAST_CHANGE = 0.25
"""By which share of its contrast the border of frames changes at least where the camera moves."""
LEAST_CONTRAST = 0.1
"""Standard deviation of light at the border of the median frame, as a share of its mean, that shows whether the camera
moved."""

#: Frames are looked at in so many cells a side, of which the outermost are their border.
CELLS, BORDER_CELLS = 24, 3
TINY = 1e-9


@dataclass
class StillCheck:
    """Collects the borders of frames as they are written."""

    borders: list[Float[np.ndarray, "P"]] = field(default_factory=list)

    def add(self, image: UInt8[np.ndarray, "H W C"]) -> None:
        """Means of light over cells of the border, as shares of their mean, so that exposure does not matter."""
        height, width = (size // CELLS * CELLS for size in image.shape[:2])
        if not height or not width:
            return
        # A few rows and columns of each cell are enough, and cheap for large pictures.
        rows, columns = (np.linspace(0, size - 1, 4 * CELLS).astype(int) for size in (height, width))
        cells = luminance(image[rows][:, columns, :3]).reshape(CELLS, 4, CELLS, 4).mean((1, 3))
        border = np.ones((CELLS, CELLS), bool)
        border[BORDER_CELLS:-BORDER_CELLS, BORDER_CELLS:-BORDER_CELLS] = False
        self.borders.append(cells[border] / max(float(cells[border].mean()), TINY))

    def require_motion(self) -> None:
        """Raise InputError where borders show something, and the same in all frames.

        With b the border of a frame and m the median of all, that is: the median of |b − m|² stays below a share of the
        variance of m.
        """
        sizes = {len(border) for border in self.borders}
        if len(self.borders) < LEAST_VIEWS or len(sizes) > 1:
            return
        borders = np.stack(self.borders)
        middle = np.median(borders, axis=0)
        contrast = float(middle.std())
        change = float(np.sqrt(np.median(np.mean((borders - middle) ** 2, axis=1))))
        if contrast > LEAST_CONTRAST and change < LEAST_CHANGE * contrast:
            raise InputError(
                expected="a camera that moves around the object, before surroundings at rest",
                found=f"borders that change by {change / contrast:.0%} of their contrast: the camera stood still",
                remedy="Do not use a turntable: walk around the object with the camera.",
            )
