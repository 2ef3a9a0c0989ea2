"""A triangle mesh: normals and shape operator."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

TENSOR_ROUNDS = 3
"""Averagings of a shape tensor over neighboring faces: enough for the slivers of marching cubes."""


@dataclass(frozen=True)
class TriangleMesh:
    """A triangle mesh in the normalized frame, its faces turned outward."""

    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "T 3"]

    def area_vectors(self) -> Float[np.ndarray, "T 3"]:
        """Normals of the faces, twice as long as their areas."""
        corners = self.vertices[self.triangles]
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    def vertex_normals(self) -> Float[np.ndarray, "V 3"]:
        """Unit means of the faces' normals, weighted by area."""
        return unit(_sum_at_vertices(np.repeat(self.area_vectors()[:, None], 3, 1), self))

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


def _sum_at_vertices(values: Float[np.ndarray, "T 3 C"], surface: TriangleMesh) -> Float[np.ndarray, "V C"]:
    """Sum what each corner of each face gives to its vertex."""
    index, count = surface.triangles.ravel(), len(surface.vertices)
    flat = values.reshape(len(index), -1)
    return np.stack([np.bincount(index, column, minlength=count) for column in flat.T], 1)


def unit(vectors: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Vectors of length one; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
