"""The interior of a mouth or a lid, which no silhouette determines: a shortest path through what photographs say of
slopes.

In the half-plane of radius and height, the ray of a pixel that looks onto the lid of a closed surface passes through
cells below it. If the surface were there, with the profile's direction θ, the pixel would show the environment in a
known direction. The mean disagreement over all such pixels and azimuths is the cost of going through that cell in that
direction, and the interior is the cheapest path from the lip to the axis.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.rays import pixel_rays
from panoless.capture.views import TrainView, Views
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.revolution.pixels import evenly
from panoless.geometry.revolution.profile import resample_profile
from panoless.journal import remembered
from panoless.kernels.revolution import slope_votes

SEARCHED_PIXELS = 60_000
"""Most pixels that vote."""
SLOPES = 48
"""Directions of the profile that the search distinguishes."""
CELL_PX = 0.75
"""Size of the search's cells (px)."""
CELLS = 128
"""Most cells along the radius; wider mouths have larger cells."""
DEPTH = 0.8
"""Of the search, in radii of the mouth."""
ROWS_ABOVE = 3
"""Cells above the lip: a rolled lip rises on where silhouettes end."""
ERROR_SCALE = 0.15
"""Scale s of a vote ‖e‖²/(‖e‖² + s²)."""
FEW_PIXELS = 4.0
"""Votes' worth of the cost of an unseen cell that every cell starts with."""
UNSEEN_COST = 0.7
"""Cost of a cell and slope that no pixel sees: worse than a fair one, better than a wrong one."""
REACH = 3
"""Cells that an edge of the path spans at most."""


def end_pixels(
    views: Views, closed: SurfaceOfRevolution, count: int
) -> tuple[list[tuple[TrainView, Int[np.ndarray, "_"]]], list[tuple[TrainView, Int[np.ndarray, "_"]]]]:
    """Those of about `count` pixels that see the base of a closed surface first, and those that see its lid."""
    base, lid = [], []
    for view, pixels in evenly(views, count):
        side = closed.hits(*pixel_rays(view.camera, pixels)).side
        base.append((view, pixels[side == 0]))
        lid.append((view, pixels[side >= closed.lip]))
    return base, lid


@dataclass(frozen=True)
class Grid:
    """Cells of the half-plane within the lip: ρ = (column + ½)·cell, h = top − (row + ½)·cell."""

    cell: float
    top: float
    columns: int
    rows: int
    above: int
    """Rows above the lip: a wall may rise on where silhouettes end."""


@remembered()
def search_interior(
    views: Views,
    closed: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    pixel: float,
) -> SurfaceOfRevolution:
    """The closed surface with the cheapest interior in place of its lid."""
    radius = float(closed.profile[closed.lip, 0])
    cell = max(CELL_PX * pixel, radius / CELLS)
    columns = max(int(np.ceil(radius / cell)), 2)
    top = float(closed.profile[closed.lip, 1]) + ROWS_ABOVE * cell
    grid = Grid(cell, top, columns, max(int(DEPTH * columns), 2) + ROWS_ABOVE, ROWS_ABOVE)
    path = _cheapest(slope_costs(views, closed, environment, grid), grid, REACH)
    inner = np.stack([(path[:, 1] + 0.5) * cell, grid.top - (path[:, 0] + 0.5) * cell], 1)
    inner = _smoothed(np.concatenate([closed.profile[closed.lip, None], inner, [[0.0, inner[-1, 1]]]]))
    return resample_profile(replace(closed, profile=np.concatenate([closed.profile[: closed.lip], inner])), pixel)


def _smoothed(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    middle = (points[:-2] + 2 * points[1:-1] + points[2:]) / 4
    return np.concatenate([points[:1], middle, points[-1:]]) if len(points) > 3 else points


def slope_costs(
    views: Views,
    closed: SurfaceOfRevolution,
    environment: Float[Tensor, "6 3 L L"],
    grid: Grid,
) -> Float[np.ndarray, "rows columns slopes"]:
    """Mean of ‖e‖²/(‖e‖² + s²) for each cell and direction of the profile, 2π k/slopes from outward level.

    Only rays count that leave through the mouth again, which alone is known to be open, or above it.
    """
    origins, rays, radiance = _lid_pixels(views, closed, SEARCHED_PIXELS)
    summed, count = slope_votes(
        (origins - closed.origin) @ closed.frame.T,
        rays @ closed.frame.T,
        radiance,
        environment.permute(0, 2, 3, 1).cpu().numpy().astype(np.float64),
        closed.frame,
        np.array([grid.cell, grid.top, grid.columns, grid.rows, closed.profile[closed.lip, 1]]),
        2 * np.pi * np.arange(SLOPES) / SLOPES,
        ERROR_SCALE,
    )
    mean = (summed + UNSEEN_COST * FEW_PIXELS) / (count + FEW_PIXELS)
    return mean.reshape(grid.rows, grid.columns, SLOPES)


def _lid_pixels(
    views: Views, closed: SurfaceOfRevolution, count: int
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Unit rays that meet the lid first, and what they see."""
    parts = []
    for view in views.train:
        origins, rays = pixel_rays(view.camera, view.solid.cpu().numpy())
        lid = np.flatnonzero(closed.hits(origins, rays).side >= closed.lip)
        radiance = view.radiance_at(view.solid).cpu().numpy()
        parts.append((origins[lid], rays[lid] / np.linalg.norm(rays[lid], axis=1, keepdims=True), radiance[lid]))
    origins, rays, radiance = (np.concatenate([part[k] for part in parts]) for k in range(3))
    stride = max(1, len(rays) // count)
    return origins[::stride], rays[::stride], radiance[::stride].astype(np.float64)


def _cheapest(costs: Float[np.ndarray, "rows columns slopes"], grid: Grid, reach: int) -> Int[np.ndarray, "M 2"]:
    """Cells (row, column) from the lip to the axis that minimize ∫ cost ds, the slope that of the way."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    count = grid.rows * grid.columns
    row, column = np.divmod(np.arange(count), grid.columns)
    heads, tails, weights = [], [], []
    spacing = 2 * np.pi / costs.shape[2]
    for down in range(-reach, reach + 1):
        for left in range(reach + 1):
            if np.gcd(down, left) != 1:
                continue
            angle, length = np.arctan2(-down, -left), np.hypot(down, left)
            slopes = np.round(angle / spacing + np.arange(-1, 2)).astype(np.int64) % costs.shape[2]
            own = costs[:, :, slopes].min(2).ravel()
            to_row, to_column = row + down, column - left
            valid = (to_row >= 0) & (to_row < grid.rows) & (to_column >= 0)
            target = (to_row * grid.columns + to_column)[valid]
            heads.append(np.flatnonzero(valid))
            tails.append(target)
            weights.append(length * (own[valid] + own[target]) / 2)
    graph = csr_matrix((np.concatenate(weights), (np.concatenate(heads), np.concatenate(tails))), (count, count))
    start = grid.above * grid.columns + grid.columns - 1
    distance, before = dijkstra(graph, indices=start, return_predecessors=True)
    node = int(np.arange(grid.rows)[np.argmin(distance[:: grid.columns])] * grid.columns)
    path = [node]
    while node != start:
        node = int(before[node])
        path.append(node)
    return np.stack(np.divmod(np.array(path[::-1]), grid.columns), 1)
