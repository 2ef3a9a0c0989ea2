"""Geometry as PLY files in world units."""

from pathlib import Path

import numpy as np

from panoless.geometry.base import Mesh
from shinypartial.io.files import atomic_write


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a mesh, or a cloud of points, as binary PLY."""
    from plyfile import PlyData, PlyElement

    columns = {**dict(zip("xyz", mesh.vertices.T, strict=True)), **mesh.columns}
    vertices = np.zeros(len(mesh.vertices), dtype=[(name, "<f4") for name in columns])
    for name, column in columns.items():
        vertices[name] = column
    elements = [PlyElement.describe(vertices, "vertex")]
    if mesh.faces is not None:
        faces = np.zeros(len(mesh.faces), dtype=[("vertex_indices", "<i4", mesh.faces.shape[1:])])
        faces["vertex_indices"] = mesh.faces
        elements.append(PlyElement.describe(faces, "face"))
    with atomic_write(path) as temporary:
        PlyData(elements, byte_order="<").write(str(temporary))
