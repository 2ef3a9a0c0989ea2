"""Geometry as PLY files in world units."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from panoless.capture.object_frame import ObjectFrame
from panoless.geometry.height_field.model import HeightField
from panoless.geometry.plane.model import Plane
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.geometry.surfels.model import Surfels
from panoless.kernels.reference.rasterize import rotation_matrices
from shinypartial.io.files import atomic_write

PLY_NAME = "surfels.ply"
PLANE_PLY_NAME = "plane.ply"
REVOLUTION_PLY_NAME = "surface.ply"
HEIGHT_FIELD_PLY_NAME = "height field.ply"
MERIDIANS = 128


SH_DEGREE_0 = 0.28209479177387814


def write_ply(path: Path, surfels: Surfels, object_frame: ObjectFrame) -> None:
    """Write surfels in world units as binary PLY with the property names that Gaussian-splat viewers read.

    Colors are degree-0 spherical harmonics of the albedo; curvature_a, _b, _c are the shape operator.
    """
    world = surfels.detached()
    normals = rotation_matrices(world.quats)[:, :, 2]
    columns = {
        **_columns("xyz", world.means * object_frame.radius + torch.from_numpy(object_frame.center).float()),
        **_columns(("nx", "ny", "nz"), normals),
        **_columns(("f_dc_0", "f_dc_1", "f_dc_2"), (world.albedo - 0.5) / SH_DEGREE_0),
        "opacity": world.opacity_logits.numpy(),
        **_columns(("scale_0", "scale_1"), world.log_scales + float(np.log(object_frame.radius))),
        **_columns(("rot_0", "rot_1", "rot_2", "rot_3"), normalize(world.quats, dim=1)),
        **_columns(("curvature_a", "curvature_b", "curvature_c"), world.curvatures / object_frame.radius),
    }
    table = np.zeros(world.count, dtype=[(name, "<f4") for name in columns])
    for name, column in columns.items():
        table[name] = column
    properties = "".join(f"property float {name}\n" for name in columns)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {world.count}\n{properties}end_header\n"
    with atomic_write(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + table.tobytes())


def write_plane_ply(path: Path, plane: Plane, object_frame: ObjectFrame) -> None:
    """Write the plane in world units as an ASCII PLY of one polygon."""
    corners = plane.points(plane.boundary) * object_frame.radius + object_frame.center
    lines = ["ply", "format ascii 1.0", f"element vertex {len(corners)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{value:.9g}" for value in corner) for corner in corners]
    lines.append(" ".join(map(str, [len(corners), *range(len(corners))])))
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_revolution_ply(path: Path, surface: SurfaceOfRevolution, object_frame: ObjectFrame) -> None:
    """Write the surface of revolution in world units as an ASCII PLY of quadrilaterals, 128 around."""
    rings = surface.rings(MERIDIANS) * object_frame.radius + object_frame.center
    count, around = rings.shape[:2]
    index = np.arange(count * around).reshape(count, around)
    following = np.roll(index, -1, 1)
    faces = np.stack([index[:-1], following[:-1], following[1:], index[1:]], -1).reshape(-1, 4)
    _write_quadrilaterals(path, rings.reshape(-1, 3), faces)


def write_height_field_ply(path: Path, height_field: HeightField, object_frame: ObjectFrame) -> None:
    """Write the bent plane in world units as an ASCII PLY of quadrilaterals, those within the boundary."""
    points, faces = height_field.quadrilaterals()
    _write_quadrilaterals(path, points * object_frame.radius + object_frame.center, faces)


def _write_quadrilaterals(path: Path, points: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 4"]) -> None:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{value:.9g}" for value in corner) for corner in points]
    lines += ["4 " + " ".join(map(str, face)) for face in faces.tolist()]
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")


def _columns(names: str | tuple[str, ...], matrix: Tensor) -> dict[str, np.ndarray]:
    return {name: matrix[:, index].numpy() for index, name in enumerate(names)}
