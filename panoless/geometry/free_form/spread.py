"""How well pixels agree on what they mirror, without a map: the spread of colors among rays that leave alike."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from panoless.capture.rays import reflect
from panoless.geometry.free_form.surface import LevelSet
from panoless.kernels.reference.cubemap import project_to_face
from panoless.numeric.robust import bounded_error
from panoless.problem.rays import PixelRays


@dataclass(frozen=True)
class FinalRays:
    """Where rays of pixels go after all reflections, which of them met the surface, and left it again, where they met
    it first and last, and the normals at the first point (the normalized frame).
    """

    directions: Float[np.ndarray, "P 3"]
    met: Bool[np.ndarray, "P"]
    left: Bool[np.ndarray, "P"]
    points: Float[np.ndarray, "P 3"]
    last: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]

    @classmethod
    def of(cls, surface: LevelSet, rays: PixelRays, bounces: int) -> "FinalRays":
        """By tracing rays through at most so many reflections."""
        hits = surface.hits(rays.origins, rays.directions)
        first = surface.points(hits.places)
        directions, last, going = rays.directions.copy(), first.copy(), np.flatnonzero(hits.met)
        points, normals = first[going], hits.normals[going]
        for _ in range(bounces):
            directions[going], last[going] = reflect(directions[going], normals), points
            again = surface.hits(points, directions[going], leaving=True)
            going, normals = going[again.met], again.normals[again.met]
            points = surface.points(again.places[again.met])
            if not len(going):
                break
        left = hits.met.copy()
        left[going] = False
        return cls(directions, hits.met, left, first, last, hits.normals)


def cells_of(directions: Float[np.ndarray, "P 3"], resolution: int) -> Int[np.ndarray, "P"]:
    """Flat index of the cell of each direction on a cube whose faces have so many cells of equal angle along a side."""
    face, st, _ = project_to_face(torch.from_numpy(directions))
    place = (torch.atan(st) * (4 / np.pi) + 1) * (resolution / 2)
    column, row = place.floor().long().clamp(0, resolution - 1).unbind(-1)
    found: np.ndarray = ((face * resolution + row) * resolution + column).numpy()
    return found


def disagreement(
    directions: Float[np.ndarray, "P 3"],
    left: Bool[np.ndarray, "P"],
    radiance: Float[np.ndarray, "P 3"],
    view: Int[np.ndarray, "P"],
    resolution: int,
    scale: float,
) -> Float[np.ndarray, "P"]:
    """ρ = ‖e‖²/(‖e‖² + s²) with e a pixel's color less the mean of those from other views in its cell of directions.

    A pixel whose ray never left, or is alone in its cell, is compared with the mean of all. Pixels of the same view are
    left out because neighbors in it agree whatever the shape.
    """
    found = bounded_error(radiance - radiance.mean(0), scale)
    if not left.any():
        return found
    colors, cells = radiance[left], cells_of(directions[left], resolution)
    _, cell = np.unique(cells, return_inverse=True)
    _, of_view = np.unique(cell * (int(view.max()) + 1) + view[left], return_inverse=True)
    count = np.bincount(cell)[cell] - np.bincount(of_view)[of_view]
    others = np.stack([np.bincount(cell, each)[cell] - np.bincount(of_view, each)[of_view] for each in colors.T], 1)
    compared = np.flatnonzero(count > 0)
    error = others[compared] / count[compared, None] - colors[compared]
    found[np.flatnonzero(left)[compared]] = bounded_error(error, scale)
    return found
