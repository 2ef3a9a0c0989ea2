"""A triangle mesh: normals, shape operator, Laplacian."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


STEEPEST_COTANGENT = 5.0
TENSOR_ROUNDS = 3


@dataclass(frozen=True)
class TriangleMesh:
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


def cotangent_laplacian(surface: TriangleMesh) -> "csr_matrix":
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


def vertex_areas(surface: TriangleMesh) -> Float[np.ndarray, "V"]:
    """A third of the area of each vertex's faces, bounded from below."""
    first, second, third = surface.vertices[surface.triangles].transpose(1, 0, 2)
    doubled = np.linalg.norm(np.cross(second - first, third - first), axis=1)
    areas = _sum_at_vertices(np.repeat(doubled[:, None, None] / 6, 3, 1), surface)[:, 0]
    return np.maximum(areas, 1e-3 * areas.mean())


def _sum_at_vertices(values: Float[np.ndarray, "T 3 C"], surface: TriangleMesh) -> Float[np.ndarray, "V C"]:
    """Sum what each corner of each face gives to its vertex."""
    index, count = surface.triangles.ravel(), len(surface.vertices)
    flat = values.reshape(len(index), -1)
    return np.stack([np.bincount(index, column, minlength=count) for column in flat.T], 1)


def unit(vectors: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Vectors of length one; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
