"""Meshes of polygons."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Mesh:
    """Polygons with one outward unit normal a vertex; a face lists its vertices counterclockwise from outside."""

    vertices: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]
    faces: list[tuple[int, ...]]


def polygon_normals(vertices: Float[np.ndarray, "P 3"], faces: list[tuple[int, ...]]) -> Float[np.ndarray, "P 3"]:
    """Unit normal of each vertex from the faces around it, weighted by their area."""
    total = np.zeros_like(vertices)
    for count in {len(face) for face in faces}:
        corners = np.array([face for face in faces if len(face) == count])
        ring = vertices[corners] - vertices[corners[:, :1]]
        area = np.cross(ring[:, 1:-1], ring[:, 2:]).sum(1)
        for i in range(count):
            np.add.at(total, corners[:, i], area)
    return total / np.maximum(np.linalg.norm(total, axis=-1, keepdims=True), 1e-30)
