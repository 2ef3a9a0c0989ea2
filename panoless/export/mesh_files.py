"""Geometry as PLY files in world units."""

from pathlib import Path

import numpy as np

from panoless.geometry.base import Mesh
from shinypartial.io.files import atomic_write


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a mesh in double, or a cloud of points in single precision, as binary PLY."""
    from plyfile import PlyData, PlyElement

    columns = {**dict(zip("xyz", mesh.vertices.T, strict=True)), **mesh.columns}
    number = "<f4" if mesh.faces is None else "<f8"
    vertices = np.zeros(len(mesh.vertices), dtype=[(name, number) for name in columns])
    for name, column in columns.items():
        vertices[name] = column
    elements = [PlyElement.describe(vertices, "vertex")]
    if mesh.faces is not None:
        faces = np.zeros(len(mesh.faces), dtype=[("vertex_indices", "<i4", mesh.faces.shape[1:])])
        faces["vertex_indices"] = mesh.faces
        elements.append(PlyElement.describe(faces, "face"))
    with atomic_write(path) as temporary:
        PlyData(elements, byte_order="<").write(str(temporary))
