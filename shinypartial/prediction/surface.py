"""The surface of a prediction, read from its PLY, in polygons or triangles."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from shinypartial.core.errors import InputError
from shinypartial.core.mesh import Mesh, polygon_normals


@dataclass(frozen=True)
class PredictedSurface(Mesh):
    """Polygons in world units, and how far the method trusts each vertex, in [0, 1]; None where it does not say."""

    confidence: Float[np.ndarray, "P"] | None = None

    @cached_property
    def triangles(self) -> Int[np.ndarray, "T 3"]:
        """Its faces, as `triangles_of` cuts them."""
        return triangles_of(self)


def surface_of(prediction: Path, *, clouds: bool = False) -> PredictedSurface | None:
    """The one PLY of the folder, in world units; None where there is none, or a cloud of points, unless `clouds` are
    requested as surfaces without faces.

    Normals are its columns nx, ny, nz; where it has none, those of the faces around a vertex, weighted by area.
    Confidence is its column `confidence`. Raises InputError for a PLY that is incomplete, has vertices that are not
    finite, faces of vertices that are not there, or no face with an area.
    """
    paths = sorted(prediction.glob("*.ply"))
    if len(paths) > 1:
        raise InputError(
            expected=f"one PLY in {prediction}",
            found=", ".join(path.name for path in paths),
            remedy="Remove those that are not the surface.",
        )
    if not paths:
        return None
    table, faces = _read_ply(paths[0])
    if not faces and not clouds:
        return None
    names = set() if table is None else set(table.dtype.names or ())
    if table is None or not set("xyz") <= names:
        raise _unusable(paths[0], "no vertices with x, y and z")
    vertices = np.stack([table[name] for name in "xyz"], 1).astype(np.float64)
    if not np.isfinite(vertices).all():
        raise _unusable(paths[0], "coordinates that are not finite")
    if not all(0 <= index < len(vertices) for face in faces for index in face):
        raise _unusable(paths[0], f"faces of other vertices than the {len(vertices)} that there are")
    if {"nx", "ny", "nz"} <= names:
        normals = np.stack([table[name] for name in ("nx", "ny", "nz")], 1).astype(np.float64)
    else:
        normals = polygon_normals(vertices, faces)
    confidence = table["confidence"].astype(np.float64) if "confidence" in names else None
    surface = PredictedSurface(vertices, normals, faces, confidence)
    if faces and not len(surface.triangles):
        raise _unusable(paths[0], "no face with an area")
    return surface


def _read_ply(path: Path) -> tuple[np.ndarray | None, list[tuple[int, ...]]]:
    """The table of vertices, None where there is none, and the first list of each face."""
    from plyfile import PlyData, PlyListProperty, PlyParseError

    try:
        content = PlyData.read(str(path))
    except PlyParseError as error:
        raise _unusable(path, str(error)) from None
    vertices = content["vertex"].data if "vertex" in content else None
    if "face" not in content:
        return vertices, []
    lists = [each.name for each in content["face"].properties if isinstance(each, PlyListProperty)]
    return vertices, [tuple(face.tolist()) for face in content["face"].data[lists[0]]] if lists else []


def _unusable(path: Path, found: str) -> InputError:
    return InputError(expected=f"a whole surface in {path}", found=found, remedy="Export the prediction again.")


def triangles_of(mesh: Mesh) -> Int[np.ndarray, "T 3"]:
    """Every face in triangles, counterclockwise as it is; those without area are left out."""
    cut = [each for face in mesh.faces for each in _cut(face, mesh.vertices)]
    triangles = np.array(cut, dtype=np.int64).reshape(-1, 3)
    corners = mesh.vertices[triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return triangles[areas > 1e-12 * areas.max(initial=0)]


def _cut(face: tuple[int, ...], vertices: Float[np.ndarray, "P 3"]) -> list[tuple[int, int, int]]:
    """Triangles of a flat polygon, convex or not, by clipping ears (Meisters 1975)."""
    if len(face) < 5:
        return [(face[0], face[i], face[i + 1]) for i in range(1, len(face) - 1)]
    ring = vertices[list(face)] - vertices[face[0]]
    normal = np.cross(ring[1:-1], ring[2:]).sum(0)

    def turn(a: int, b: int, c: int) -> float:
        return float(np.cross(vertices[b] - vertices[a], vertices[c] - vertices[b]) @ normal)

    left, triangles = list(face), []
    while len(left) > 3:
        for i, tip in enumerate(left):
            before, after = left[i - 1], left[(i + 1) % len(left)]
            others = (each for each in left if each not in (before, tip, after))
            sides = ((before, tip), (tip, after), (after, before))
            if turn(before, tip, after) > 0 and not any(all(turn(*s, p) >= 0 for s in sides) for p in others):
                break
        else:  # Only rounding leaves none: corners on one line.
            i, before, after = 0, left[-1], left[1]
        triangles.append((before, left.pop(i), after))
    return [*triangles, (left[0], left[1], left[2])]
