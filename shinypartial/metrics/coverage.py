"""Which directions of the environment the training views see, independent of any method."""

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.sphere import cube_solid_angles, directions_to_cube, latlong_directions

#: Directions are counted in the cells of a cubemap with faces of 32 × 32: about 2.8° wide, nearly equal in solid angle.
CELLS_PER_SIDE = 32

Cells = Bool[np.ndarray, "6 L L"]


def no_cells() -> Cells:
    """Nothing observed."""
    return np.zeros((6, CELLS_PER_SIDE, CELLS_PER_SIDE), dtype=bool)


def _cell_of(directions: Float[np.ndarray, "... 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    face, st = directions_to_cube(directions)
    column, row = np.moveaxis(np.clip(((st + 1) * CELLS_PER_SIDE / 2).astype(int), 0, CELLS_PER_SIDE - 1), -1, 0)
    return face, row, column


def cells_seen(reflection_directions: Float[np.ndarray, "P 3"]) -> Cells:
    """The cells in which at least one of the mirror directions lies."""
    cells = no_cells()
    cells[_cell_of(reflection_directions)] = True
    return cells


def coverage(cells: Cells) -> float:
    """Solid-angle share of the sphere that the observed cells take, in [0, 1]."""
    return float((cells * cube_solid_angles(CELLS_PER_SIDE)).sum() / (4 * np.pi))


def observed_latlong(cells: Cells, height: int) -> Bool[np.ndarray, "H 2H"]:
    """For every texel of a lat-long map, whether its center lies in an observed cell."""
    return cells[_cell_of(latlong_directions(height))]
