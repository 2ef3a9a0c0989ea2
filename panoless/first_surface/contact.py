"""Where silhouettes touch the visual hull."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.silhouettes import mask_distance
from panoless.capture.views import TrainView, Views
from panoless.first_surface.mesh import TriangleMesh, unit

LEAST_TRUST = 0.01
"""Trust in a hull vertex below this is none."""
NEIGHBOR_VIEW_DEG = 12.0
"""Views are compared for a contact over about this angle between their directions."""
NEIGHBOR_HEIGHT_DEG = 8.0
"""…and over about this difference of their heights above the tangent plane."""
CONTACT_VIEWS = 150
"""Views that determine contacts, at most: as well as all of a long video."""


@dataclass(frozen=True)
class Contact:
    """How each vertex of a hull meets the silhouette that comes nearest to it, in normalized units.

    `margin` is its distance inside the silhouette's cone; `offset` its distance, along the ray, from the contour
    generator where that cone touches the object. Both are infinite where no view shows one.
    """

    margin: Float[np.ndarray, "V"]
    offset: Float[np.ndarray, "V"]

    def trust(self, tolerance: float) -> Float[np.ndarray, "V"]:
        """Near 1 where the hull is the object's own surface, near 0 where it is only a bound of it, or none."""
        trust = np.exp(-(self.offset**2 + self.margin**2) / (2 * tolerance**2))
        return np.where(trust < LEAST_TRUST, 0.0, trust)


def silhouette_contact(surface: TriangleMesh, views: Views) -> Contact:
    """Where along its ray each vertex is touched by the silhouette that comes nearest to it.

    Let m(θ) be a point's distance inside the cone of a camera whose direction stands θ over the tangent plane.
    At the contour generator the cone turns about the point itself, m'(0) = 0; at a distance s from the contour
    generator along the ray the cone sweeps past it, |m'(0)| = s. The derivative is a regression over neighboring views,
    without those whose picture doesn't show the point.
    """
    normals = surface.vertex_normals()
    stride = math.ceil(len(views.train) / CONTACT_VIEWS)
    chosen = views.train[::stride]
    measured = [_margin_and_height(view, surface, normals) for view in chosen]
    margins, heights = (np.stack(columns, 1) for columns in zip(*measured, strict=True))
    directions = unit(np.stack([view.position for view in chosen]))
    nearest = margins.argmin(1)
    rows = np.arange(len(nearest))
    angle = np.arccos(np.clip(directions @ directions.T, -1, 1))[nearest]
    above = heights - heights[rows, nearest][:, None]
    view_scale, height_scale = np.radians((NEIGHBOR_VIEW_DEG, NEIGHBOR_HEIGHT_DEG))
    known = np.isfinite(margins)
    weights = known * np.exp(-((angle / view_scale) ** 2 + (above / height_scale) ** 2) / 2)
    weights /= np.maximum(weights.sum(1, keepdims=True), np.finfo(float).tiny)
    above -= (weights * above).sum(1, keepdims=True)
    slope = (weights * above * np.where(known, margins, 0)).sum(1) / np.maximum((weights * above**2).sum(1), 1e-9)
    return Contact(margins[rows, nearest], np.where(known.any(1), np.abs(slope), np.inf))


def _margin_and_height(
    view: TrainView, surface: TriangleMesh, normals: Float[np.ndarray, "V 3"]
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """Margin inside the silhouette, and height of the camera over the tangent plane (rad)."""
    points = torch.from_numpy(surface.vertices.astype(np.float32)).to(view.mask.device)
    margin = -mask_distance(view).distances(points).cpu().numpy().astype(np.float64)
    toward = unit(view.position - surface.vertices)
    return margin, np.arcsin(np.clip((toward * normals).sum(1), -1, 1))
