"""A surface as binary glTF 2.0."""

import json
import struct
from pathlib import Path

import numpy as np

from shinypartial.core.conventions import Y_UP_TO_WORLD
from shinypartial.core.mesh import Mesh
from shinypartial.io.files import atomic_write
from shinypartial.prediction.surface import triangles_of

#: glTF's numbers for what buffers hold.
FLOAT, UNSIGNED_INT, ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 5126, 5125, 34962, 34963
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942


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
