"""The surface of a prediction: read from its PLY, triangulated, written as binary glTF 2.0."""

import json
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from shinypartial.blender.mesh import Mesh, polygon_normals
from shinypartial.core.conventions import Y_UP_TO_WORLD
from shinypartial.core.errors import InputError
from shinypartial.io.files import atomic_write

#: glTF's numbers for what buffers hold.
FLOAT, UNSIGNED_INT, ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 5126, 5125, 34962, 34963
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942


def surface_of(prediction: Path) -> Mesh | None:
    """The one PLY of the folder, in world units; None where there is none, or a cloud of points.

    Normals are its columns nx, ny, nz; where it has none, those of the faces around a vertex, weighted by area.
    """
    from plyfile import PlyData, PlyParseError

    paths = sorted(prediction.glob("*.ply"))
    if len(paths) > 1:
        raise InputError(
            expected=f"one PLY in {prediction}",
            found=", ".join(path.name for path in paths),
            remedy="Remove those that are not the surface.",
        )
    if not paths:
        return None
    try:
        content = PlyData.read(str(paths[0]))
    except PlyParseError as error:
        raise InputError(
            expected=f"a complete PLY at {paths[0]}", found=str(error), remedy="Export the prediction again."
        ) from None
    if "face" not in content or not len(content["face"].data):
        return None
    table, lists = content["vertex"].data, content["face"].data
    vertices = np.stack([table[name] for name in "xyz"], 1).astype(np.float64)
    faces = [tuple(face.tolist()) for face in lists[lists.dtype.names[0]]]
    if {"nx", "ny", "nz"} <= set(table.dtype.names):
        normals = np.stack([table[name] for name in ("nx", "ny", "nz")], 1).astype(np.float64)
    else:
        normals = polygon_normals(vertices, faces)
    return Mesh(vertices, normals, faces)


def triangles_of(mesh: Mesh) -> Int[np.ndarray, "T 3"]:
    """Every face in triangles, counterclockwise as it is; those without area are left out."""
    triangles = np.array([each for face in mesh.faces for each in _cut(face, mesh.vertices)]).reshape(-1, 3)
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


def write_glb(path: Path, mesh: Mesh, reflectance: tuple[float, float, float]) -> None:
    """Write a mirror as binary glTF 2.0: +Y up, (x, −z, y) of a vertex being its place in the world; float32.

    The material is metallic and without roughness, its base color the reflectance (linear), and seen from both sides.
    Source: Khronos glTF 2.0 specification, sections 3.6 (accessors), 3.9 (materials) and 4.4 (GLB).
    """
    positions, normals = ((each @ Y_UP_TO_WORLD).astype("<f4") for each in (mesh.vertices, mesh.normals))
    indices = triangles_of(mesh).astype("<u4")
    arrays = (positions, normals, indices)
    starts = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    targets = (ARRAY_BUFFER, ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER)
    content = {
        "asset": {"version": "2.0", "generator": "shinypartial"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "mirror"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2, "material": 0}]}],
        "materials": [
            {
                "name": "mirror",
                "pbrMetallicRoughness": {
                    "baseColorFactor": [*reflectance, 1.0],
                    "metallicFactor": 1.0,
                    "roughnessFactor": 0.0,
                },
                "doubleSided": True,
            }
        ],
        "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target}
            for start, array, target in zip(starts, arrays, targets, strict=False)
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": FLOAT,
                "count": len(positions),
                "type": "VEC3",
                "min": positions.min(0).tolist(),
                "max": positions.max(0).tolist(),
            },
            {"bufferView": 1, "componentType": FLOAT, "count": len(normals), "type": "VEC3"},
            {"bufferView": 2, "componentType": UNSIGNED_INT, "count": indices.size, "type": "SCALAR"},
        ],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(array.tobytes() for array in arrays)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    chunks = (struct.pack("<II", len(text), JSON_CHUNK), text, struct.pack("<II", len(binary), BINARY_CHUNK), binary)
    with atomic_write(path) as temporary:
        temporary.write_bytes(b"".join((header, *chunks)))
