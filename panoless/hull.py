"""The first surface: the visual hull where silhouettes touch the object, a thin plate where none does.

From cameras on one side, most outlines' rays run on past the object, so the hull bulges there: a can seen over ±55°
has a wedge in front, with normals up to 35° wrong, and a flat mirror has a roof. Those parts are told by their
contact with the outlines and replaced by the smoothest surface that continues the parts that are right.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int

from panoless.carving import HULL_HALF_SIDE, Hull, outline_of
from panoless.views import TrainView, Views

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

#: Standard deviation of a hull vertex from an outline's cone, and of a contact from the rim, along its ray.
TOLERANCE_PX = 3.9
#: Below this the hull has no say.
LEAST_TRUST = 0.01
#: Keeps the thin plate solvable where nothing is trusted.
TRUST_FLOOR = 1e-7
#: The thin plate smooths the trusted hull over this length.
PLATE_LENGTH_PX = 5.0
#: Of sharper images than this, a grid shows the shape no finer.
MOST_PIXELS_A_VOXEL = 4.5
#: Views compared for a contact: from directions and at heights over the tangent plane within about these angles.
NEIGHBOR_VIEW_RAD = math.radians(12)
NEIGHBOR_HEIGHT_RAD = math.radians(8)
#: As many views tell contacts as well as all of a long video.
MOST_VIEWS = 150
#: A plate that leaves the hull by more is held on it, as if outlines touched it there.
OBSTACLE_PX = 0.25
OBSTACLE_TRUST = 0.5
OBSTACLE_ROUNDS = 3
PROJECTION_STEPS = 3
LEAST_SLOPE = 0.5
STEEPEST_COTANGENT = 5.0
TENSOR_ROUNDS = 3


@dataclass(frozen=True)
class Surface:
    """A triangle mesh in the normalized frame, its faces turned outward."""

    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "T 3"]

    def vertex_normals(self) -> Float[np.ndarray, "V 3"]:
        """Unit means of the faces' normals, weighted by area."""
        corners = self.vertices[self.triangles]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return unit(_sum_at_vertices(np.repeat(cross[:, None], 3, 1), self))

    def shape_tensors(self) -> Float[np.ndarray, "V 3 3"]:
        """S with dn = S dx, the change of the normal along the surface.

        Least squares over the edges of each face, averaged by area over the faces around a vertex (Rusinkiewicz 2004,
        without the rotation into a common plane), again and again, because marching cubes leaves slivers.
        """
        corners, normals = self.vertices[self.triangles], self.vertex_normals()[self.triangles]
        edges, turns = (np.roll(values, -1, 1) - values for values in (corners, normals))
        gram = np.einsum("tei,tej->tij", edges, edges)
        tensors = np.einsum("tei,tej->tij", turns, edges) @ np.linalg.pinv(gram, rcond=1e-6, hermitian=True)
        areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        total = np.maximum(_sum_at_vertices(np.repeat(areas[:, None, None], 3, 1), self), np.finfo(np.float64).tiny)
        flat = tensors.reshape(-1, 9)
        for _ in range(TENSOR_ROUNDS):
            at_vertices = _sum_at_vertices(np.repeat((flat * areas[:, None])[:, None], 3, 1), self) / total
            flat = at_vertices[self.triangles].mean(1)
        return at_vertices.reshape(-1, 3, 3)


@dataclass(frozen=True)
class Contact:
    """How each vertex of a hull meets the outline that comes nearest to it, in normalized units.

    `margin` is its distance inside the outline's cone; `offset` its distance, along the ray, from the rim where that
    cone touches the object.
    """

    margin: Float[np.ndarray, "V"]
    offset: Float[np.ndarray, "V"]

    def trust(self, tolerance: float) -> Float[np.ndarray, "V"]:
        """Near 1 where the hull is the object's own surface, near 0 where it is only a bound of it."""
        trust = np.exp(-(self.offset**2 + self.margin**2) / (2 * tolerance**2))
        return np.where(trust < LEAST_TRUST, 0.0, trust)


def hull_surface(hull: Hull) -> Surface:
    """The hull's zero level by marching cubes."""
    from skimage.measure import marching_cubes

    vertices, triangles, _, _ = marching_cubes(hull.distance, 0.0)
    return Surface(vertices * hull.voxel - HULL_HALF_SIDE, triangles.astype(np.int64))


def completed_surface(hull: Hull, views: Views) -> Surface:
    """The hull where outlines touch the object, continued as a thin plate that stays inside the hull.

    The plate is an obstacle problem: vertices that it would lift out of the hull are put on the hull, and held there
    while it is solved again; what is left outside is moved onto the hull.
    """
    surface = hull_surface(hull)
    pixel = max(hull.pixel, hull.voxel / MOST_PIXELS_A_VOXEL)
    trust = outline_contact(surface, views).trust(TOLERANCE_PX * pixel) + TRUST_FLOOR
    target, plate = surface.vertices, surface
    for _ in range(OBSTACLE_ROUNDS):
        plate = thin_plate(surface, trust, PLATE_LENGTH_PX * pixel, target)
        inside = _moved_inside(hull, plate.vertices)
        out = np.linalg.norm(inside - plate.vertices, axis=1) > OBSTACLE_PX * hull.pixel
        trust, target = np.where(out, np.maximum(trust, OBSTACLE_TRUST), trust), np.where(out[:, None], inside, target)
    return Surface(_moved_inside(hull, plate.vertices), surface.triangles)


def _moved_inside(hull: Hull, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Points outside the hull on its surface, the others where they are: Newton steps along the gradient."""
    for _ in range(PROJECTION_STEPS):
        value, gradient = hull.sample(points)
        step = np.maximum(value, 0) / np.maximum((gradient**2).sum(1), LEAST_SLOPE**2)
        points = points - step[:, None] * gradient
    return points


def outline_contact(surface: Surface, views: Views) -> Contact:
    """Where along its ray each vertex is touched by the outline that comes nearest to it.

    Let m(θ) be a point's distance inside the cone of a camera whose direction stands θ over the tangent plane.
    At the rim the cone turns about the point itself, m'(0) = 0; at a distance s from the rim along the ray
    the cone sweeps past it, |m'(0)| = s. The derivative is a regression over neighboring views.
    """
    normals = surface.vertex_normals()
    stride = math.ceil(len(views.train) / MOST_VIEWS)
    chosen = views.train[::stride]
    seen = [_seen_from(view, surface, normals) for view in chosen]
    margins, heights = (np.stack([each[part] for each in seen], 1) for part in (0, 1))
    directions = unit(np.stack([view.position for view in chosen]))
    nearest = margins.argmin(1)
    rows = np.arange(len(nearest))
    apart = np.arccos(np.clip(directions @ directions.T, -1, 1))[nearest]
    above = heights - heights[rows, nearest][:, None]
    weights = np.exp(-((apart / NEIGHBOR_VIEW_RAD) ** 2 + (above / NEIGHBOR_HEIGHT_RAD) ** 2) / 2)
    weights /= weights.sum(1, keepdims=True)
    above -= (weights * above).sum(1, keepdims=True)
    slope = (weights * above * margins).sum(1) / np.maximum((weights * above**2).sum(1), 1e-9)
    return Contact(margins[rows, nearest], np.abs(slope))


def _seen_from(
    view: TrainView, surface: Surface, normals: Float[np.ndarray, "V 3"]
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """Margin inside the outline, and height of the camera over the tangent plane (rad)."""
    points = torch.from_numpy(surface.vertices.astype(np.float32)).to(view.mask.device)
    margin = -outline_of(view).distances(points).cpu().numpy().astype(np.float64)
    toward = unit(view.position - surface.vertices)
    return margin, np.arcsin(np.clip((toward * normals).sum(1), -1, 1))


def thin_plate(
    surface: Surface,
    trust: Float[np.ndarray, "V"],
    length: float,
    target: Float[np.ndarray, "V 3"] | None = None,
) -> Surface:
    """Vertices x that minimize Σ A t ‖x − x₀‖² + ℓ⁴ Σ A ‖Δx‖², the bending of a plate through the trusted ones.

    x₀ are the targets, or else the given vertices; A are vertex areas, t the trust, Δ the cotangent Laplacian of the
    given mesh. Where t is 1, details shorter than ℓ are smoothed; where it is 0, the plate continues its surroundings'
    position and slope.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    areas = _vertex_areas(surface)
    laplacian = _cotangent_laplacian(surface)
    data = areas * trust
    goals = surface.vertices if target is None else target
    system = length**4 * (laplacian.T @ sparse.diags(1 / areas) @ laplacian) + sparse.diags(data)
    factors = splu(system.tocsc())
    moved = np.stack([factors.solve(data * column) for column in goals.T.astype(np.float64)], 1)
    return Surface(moved, surface.triangles)


def _cotangent_laplacian(surface: Surface) -> "csr_matrix":
    """The Laplacian integrated over the surface, positive semidefinite."""
    from scipy import sparse

    count = len(surface.vertices)
    weights = sparse.csr_matrix((count, count))
    for k in range(3):
        i, j, opposite = (surface.triangles[:, (k + step) % 3] for step in range(3))
        first, second = (surface.vertices[end] - surface.vertices[opposite] for end in (i, j))
        sine = np.maximum(np.linalg.norm(np.cross(first, second), axis=1), 1e-12)
        half = np.clip((first * second).sum(1) / sine, -STEEPEST_COTANGENT, STEEPEST_COTANGENT) / 2
        one_way = sparse.coo_matrix((half, (i, j)), shape=(count, count)).tocsr()
        weights = weights + one_way + one_way.T
    return sparse.diags(np.asarray(weights.sum(1)).ravel()) - weights


def _vertex_areas(surface: Surface) -> Float[np.ndarray, "V"]:
    """A third of the area of each vertex's faces, bounded from below."""
    first, second, third = surface.vertices[surface.triangles].transpose(1, 0, 2)
    doubled = np.linalg.norm(np.cross(second - first, third - first), axis=1)
    areas = _sum_at_vertices(np.repeat(doubled[:, None, None] / 6, 3, 1), surface)[:, 0]
    return np.maximum(areas, 1e-3 * areas.mean())


def _sum_at_vertices(values: Float[np.ndarray, "T 3 C"], surface: Surface) -> Float[np.ndarray, "V C"]:
    """Sum what each corner of each face gives to its vertex."""
    index, count = surface.triangles.ravel(), len(surface.vertices)
    flat = values.reshape(len(index), -1)
    return np.stack([np.bincount(index, column, minlength=count) for column in flat.T], 1)


def unit(vectors: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Vectors of length one; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
