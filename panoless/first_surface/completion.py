"""The first surface: the visual hull where silhouettes touch the object, a thin plate where none does.

From cameras on one side, most silhouettes' rays run on past the object, so the hull bulges there: a can seen over ±55°
has a wedge in front, with normals up to 35° wrong, and a flat mirror has a roof. Those parts are recognized by their
contact with the silhouettes and replaced by the smoothest surface that continues the parts that are right.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from panoless.capture.views import Views
from panoless.first_surface.contact import silhouette_contact
from panoless.first_surface.mesh import TriangleMesh
from panoless.first_surface.visual_hull import Hull
from panoless.numeric.factorize import factorize

CONTACT_PX = 3.9
"""Standard deviation (px) of a hull vertex from a silhouette's cone, and of its contact from the contour generator
along the ray."""
TRUST_FLOOR = 1e-7
"""Trust added to every vertex, so that the plate is determined where nothing is trusted."""
PLATE_LENGTH_PX = 5.0
"""Details of the trusted hull shorter than this are smoothed."""
PIXELS_A_VOXEL = 4.5
"""Lengths are in pixels, or in voxels divided by this where the grid is coarser than the images."""
OBSTACLE_PX = 0.25
"""A plate that leaves the hull by more than this is put back on it, as if a silhouette touched it there."""
OBSTACLE_TRUST = 0.5
"""Trust in such a point."""
OBSTACLE_ROUNDS = 3
"""Solutions of the plate with ever more such points."""
PROJECTION_STEPS = 3
"""Newton steps by which points outside the hull are moved onto it."""
LEAST_SLOPE = 0.5
"""Lower bound of |∇h| in such a step, dimensionless: 1 for a distance."""

LEAST_AREA = 1e-3
"""Of the mean area of a vertex: a smaller one counts as this."""


def hull_surface(hull: Hull) -> TriangleMesh:
    """The hull's zero level by marching cubes."""
    from skimage.measure import marching_cubes

    vertices, triangles, _, _ = marching_cubes(hull.distance, 0.0)
    return TriangleMesh(vertices * hull.voxel - hull.half_side, triangles.astype(np.int64))


@dataclass(frozen=True)
class TrustedHull:
    """A hull's surface, how far each vertex is trusted to be the object's own, and what a pixel is there."""

    hull: Hull
    surface: TriangleMesh
    trust: Float[np.ndarray, "V"]
    pixel: float


def trusted_hull(hull: Hull, views: Views) -> TrustedHull:
    """By the contact of silhouettes; a hull that none touches is all that is known."""
    surface = hull_surface(hull)
    pixel = max(hull.pixel, hull.voxel / PIXELS_A_VOXEL)
    contact = silhouette_contact(surface, views)
    touched = contact.trust(CONTACT_PX * pixel)
    trust = (touched if touched.any() else np.ones_like(touched)) + TRUST_FLOOR
    return TrustedHull(hull, surface, trust, pixel)


def complete_surface(hull: Hull, views: Views) -> TriangleMesh:
    """The hull where silhouettes touch the object, continued as a thin plate that stays inside the hull."""
    return completed(trusted_hull(hull, views))


def completed(known: TrustedHull, tension: float = 0.0, rounds: int = OBSTACLE_ROUNDS) -> TriangleMesh:
    """What is trusted, continued as a thin plate under tension that stays inside the hull.

    The plate is an obstacle problem: vertices that it would lift out of the hull are put on the hull, and held there
    while it is solved again, `rounds` times; what is left outside is moved
    onto the hull.
    """
    trust, target, inside = known.trust, known.surface.vertices, known.surface.vertices
    for _ in range(rounds):
        plate = thin_plate(known.surface, trust, PLATE_LENGTH_PX * known.pixel, target, tension)
        inside = _move_inside(known.hull, plate.vertices)
        out = np.linalg.norm(inside - plate.vertices, axis=1) > OBSTACLE_PX * known.hull.pixel
        trust = np.where(out, np.maximum(trust, OBSTACLE_TRUST), trust)
        target = np.where(out[:, None], inside, target)
    return TriangleMesh(inside, known.surface.triangles)


def _move_inside(hull: Hull, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Points outside the hull on its surface, the others where they are: Newton steps along the gradient, from within
    the cube that holds the hull.
    """
    points = np.clip(points, -hull.half_side, hull.half_side)
    for _ in range(PROJECTION_STEPS):
        value, gradient = hull.sample(points)
        step = np.maximum(value, 0) / np.maximum((gradient**2).sum(1), LEAST_SLOPE**2)
        points = points - step[:, None] * gradient
    return points


def thin_plate(
    surface: TriangleMesh,
    trust: Float[np.ndarray, "V"],
    length: float,
    target: Float[np.ndarray, "V 3"] | None = None,
    tension: float = 0.0,
) -> TriangleMesh:
    """Vertices x that minimize Σ A t ‖x − x₀‖² + ℓ⁴ (Σ A ‖Δx‖² + τ ∫‖∇x‖²), a plate through the trusted ones.

    x₀ are the targets, or else the given vertices; A are vertex areas, t the trust, Δ the intrinsic Delaunay Laplacian
    of the given mesh (Sharp & Crane 2020), which slivers don't harm. Where t is 1, details shorter than ℓ are smoothed;
    where it is 0, the plate continues its surroundings' position and slope. Tension τ (1/length²) draws parts longer
    than 1/√τ straight: without any a plate bulges between the edges of a flat face. A mesh without area has no plate:
    its vertices are the targets.
    """
    from robust_laplacian import mesh_laplacian
    from scipy import sparse

    goals = (surface.vertices if target is None else target).astype(np.float64)
    if not surface.area_vectors().any():
        return TriangleMesh(goals, surface.triangles)
    laplacian, mass = mesh_laplacian(surface.vertices.astype(np.float64), surface.triangles)
    areas = np.maximum(mass.diagonal(), LEAST_AREA * mass.diagonal().mean())
    stiffness = length**4 * (laplacian.T @ sparse.diags(1 / areas) @ laplacian + tension * laplacian)
    # Solved for x − x₀: a part that hardly anything holds then stays, where x itself would go to the origin.
    solve = factorize(stiffness + sparse.diags(areas * trust), "the first surface")
    moved = np.stack([solve(column) for column in -(stiffness @ goals).T], 1)
    return TriangleMesh(goals + moved, surface.triangles)
