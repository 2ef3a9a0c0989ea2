"""Which directions of the environment the training views see, independent of any method."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.sphere import cube_solid_angles, directions_to_cube, latlong_directions

#: Directions are counted in the cells of a cubemap with faces of 32 × 32: about 2.8° wide, nearly equal in solid angle.
CELLS_PER_SIDE = 32
#: A view resolves a cell when it spends this many pixels on it: one for every 0.7°, the texel of protocol linear-v1.
RESOLVING_PIXELS = 16

Cells = Bool[np.ndarray, "6 L L"]


@dataclass(frozen=True)
class ObservedCells:
    """Cells that at least one pixel mirrors, and cells that at least one view mirrors with RESOLVING_PIXELS."""

    observed: Cells
    resolved: Cells

    def union(self, other: "ObservedCells") -> "ObservedCells":
        """What either has seen."""
        return ObservedCells(self.observed | other.observed, self.resolved | other.resolved)


def nothing_observed() -> ObservedCells:
    """No cell seen yet."""
    empty = np.zeros((6, CELLS_PER_SIDE, CELLS_PER_SIDE), dtype=bool)
    return ObservedCells(empty, empty)


def _cell_of(directions: Float[np.ndarray, "... 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    face, st = directions_to_cube(directions)
    column, row = np.moveaxis(np.clip(((st + 1) * CELLS_PER_SIDE / 2).astype(int), 0, CELLS_PER_SIDE - 1), -1, 0)
    return face, row, column


def cells_of_view(reflection_directions: Float[np.ndarray, "P 3"]) -> ObservedCells:
    """The cells that one view sees, from the mirror direction of each of its pixels."""
    shape = (6, CELLS_PER_SIDE, CELLS_PER_SIDE)
    flat = np.ravel_multi_index(_cell_of(reflection_directions), shape)
    pixels = np.bincount(flat, minlength=math.prod(shape)).reshape(shape)
    return ObservedCells(pixels > 0, pixels >= RESOLVING_PIXELS)


def coverage(cells: Cells) -> float:
    """Solid-angle share of the sphere that the cells take, in [0, 1]."""
    return float((cells * cube_solid_angles(CELLS_PER_SIDE)).sum() / (4 * np.pi))


def cells_to_latlong(cells: Cells, height: int) -> Bool[np.ndarray, "H W"]:
    """For every texel of a lat-long map, whether its center lies in one of the cells."""
    return cells[_cell_of(latlong_directions(height))]
