"""Where silhouettes touch the visual hull."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.silhouettes import mask_distance
from panoless.capture.views import TrainView, Views
from panoless.first_surface.mesh import TriangleMesh, unit

#: Standard deviation of a hull vertex from an outline's cone, and of a contact from the contour generator, along its
#: ray.
TOLERANCE_PX = 3.9
#: Below this the hull has no say.
LEAST_TRUST = 0.01
#: Keeps the thin plate solvable where nothing is trusted.
TRUST_FLOOR = 1e-7
#: Views compared for a contact: from directions and at heights over the tangent plane within about these angles.
NEIGHBOR_VIEW_RAD = math.radians(12)
NEIGHBOR_HEIGHT_RAD = math.radians(8)
#: As many views tell contacts as well as all of a long video.
MOST_VIEWS = 150


@dataclass(frozen=True)
class Contact:
    """How each vertex of a hull meets the outline that comes nearest to it, in normalized units.

    `margin` is its distance inside the outline's cone; `offset` its distance, along the ray, from the contour
    generator where that cone touches the object.
    """

    margin: Float[np.ndarray, "V"]
    offset: Float[np.ndarray, "V"]

    def trust(self, tolerance: float) -> Float[np.ndarray, "V"]:
        """Near 1 where the hull is the object's own surface, near 0 where it is only a bound of it."""
        trust = np.exp(-(self.offset**2 + self.margin**2) / (2 * tolerance**2))
        return np.where(trust < LEAST_TRUST, 0.0, trust)


def outline_contact(surface: TriangleMesh, views: Views) -> Contact:
    """Where along its ray each vertex is touched by the outline that comes nearest to it.

    Let m(θ) be a point's distance inside the cone of a camera whose direction stands θ over the tangent plane.
    At the contour generator the cone turns about the point itself, m'(0) = 0; at a distance s from the contour
    generator along the ray the cone sweeps past it, |m'(0)| = s. The derivative is a regression over neighboring views.
    """
    normals = surface.vertex_normals()
    stride = math.ceil(len(views.train) / MOST_VIEWS)
    chosen = views.train[::stride]
    seen = [_seen_from(view, surface, normals) for view in chosen]
    margins, heights = (np.stack([each[part] for each in seen], 1) for part in (0, 1))
    directions = unit(np.stack([view.position for view in chosen]))
    nearest = margins.argmin(1)
    rows = np.arange(len(nearest))
    excluded = np.arccos(np.clip(directions @ directions.T, -1, 1))[nearest]
    above = heights - heights[rows, nearest][:, None]
    weights = np.exp(-((excluded / NEIGHBOR_VIEW_RAD) ** 2 + (above / NEIGHBOR_HEIGHT_RAD) ** 2) / 2)
    weights /= weights.sum(1, keepdims=True)
    above -= (weights * above).sum(1, keepdims=True)
    slope = (weights * above * margins).sum(1) / np.maximum((weights * above**2).sum(1), 1e-9)
    return Contact(margins[rows, nearest], np.abs(slope))


def _seen_from(
    view: TrainView, surface: TriangleMesh, normals: Float[np.ndarray, "V 3"]
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """Margin inside the outline, and height of the camera over the tangent plane (rad)."""
    points = torch.from_numpy(surface.vertices.astype(np.float32)).to(view.mask.device)
    margin = -mask_distance(view).distances(points).cpu().numpy().astype(np.float64)
    toward = unit(view.position - surface.vertices)
    return margin, np.arcsin(np.clip((toward * normals).sum(1), -1, 1))
