"""Polygons with exact normals: what every shape becomes, and how pieces are joined and displaced (numpy only)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from shinypartial.core.mesh import Mesh, polygon_normals
from shinypartial.scene import Deformation

#: Waves whose sum makes a displacement; with 24 it is close to a Gaussian random field.
WAVES = 24
#: Vertices nearer than this share of the mesh's size are one point: both sides of a crease move together.
SAME_POINT = 1e-6


@dataclass(frozen=True)
class Outline:
    """Samples of a profile curve from bottom to top: (radius, z) and the outward normal in that half-plane."""

    points: Float[np.ndarray, "P 2"]
    normals: Float[np.ndarray, "P 2"]


def grid_faces(rows: int, columns: int, wrap: bool = False) -> list[tuple[int, ...]]:
    """Quadrilaterals between the points of a grid stored row by row; `wrap` joins the last column to the first."""
    index = np.arange(rows * columns).reshape(rows, columns)
    if wrap:
        index = np.column_stack([index, index[:, :1]])
    corners = (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    return [tuple(face) for face in np.stack(corners, -1).reshape(-1, 4).tolist()]


def joined(pieces: Sequence[Mesh]) -> Mesh:
    """One mesh of several; vertices that coincide stay apart, so that edges between the pieces stay sharp."""
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    faces = [
        tuple(corner + start for corner in face)
        for piece, start in zip(pieces, starts.tolist(), strict=False)
        for face in piece.faces
    ]
    return Mesh(
        np.concatenate([piece.vertices for piece in pieces]), np.concatenate([piece.normals for piece in pieces]), faces
    )


def scaled(mesh: Mesh, factor: float) -> Mesh:
    """Enlarge about the origin."""
    return Mesh(factor * mesh.vertices, mesh.normals, mesh.faces)


def placed(
    mesh: Mesh,
    stretch: tuple[float, float, float],
    turn_deg: tuple[float, float, float],
    offset: tuple[float, float, float],
) -> Mesh:
    """Stretch along the axes, turn about X, then Y, then Z, and move; normals by the inverse transpose."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.radians(turn_deg)):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[first, first] = turn[second, second] = np.cos(angle)
        turn[first, second], turn[second, first] = -np.sin(angle), np.sin(angle)
        matrix = turn @ matrix
    normals = mesh.normals / np.array(stretch) @ matrix.T
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return Mesh(mesh.vertices * np.array(stretch) @ matrix.T + np.array(offset), normals, mesh.faces)


def deformed(mesh: Mesh, deformation: Deformation) -> Mesh:
    """Displace along the normals: x + a·h(x)·n(x), with a smooth random field h of unit variance over all space.

    Normals turn as those of the polygons do, so that they stay exact where nothing moves. Where vertices coincide at
    a crease, both move along their mean normal and no gap opens.
    """
    if not deformation.amplitude:
        return mesh
    heights = deformation.amplitude * displacement_field(mesh.vertices, deformation)
    moved = mesh.vertices + heights[:, None] * _shared_normals(mesh)
    turned = mesh.normals + polygon_normals(moved, mesh.faces) - polygon_normals(mesh.vertices, mesh.faces)
    return Mesh(moved, turned / np.linalg.norm(turned, axis=-1, keepdims=True), mesh.faces)


def displacement_field(points: Float[np.ndarray, "P 3"], deformation: Deformation) -> Float[np.ndarray, "P"]:
    """h(x) = √(2/N) Σ cos(2π k·x/λ + φ), unit directions k with lengths from ½ to 1½, all drawn from the seed."""
    random = np.random.default_rng(deformation.seed)
    directions = random.normal(size=(WAVES, 3))
    directions *= (random.uniform(0.5, 1.5, WAVES) / np.linalg.norm(directions, axis=-1))[:, None]
    phases = random.uniform(0, 2 * np.pi, WAVES)
    waves = np.cos(2 * np.pi / deformation.wavelength * points @ directions.T + phases)
    return np.sqrt(2 / WAVES) * waves.sum(-1)


def _shared_normals(mesh: Mesh) -> Float[np.ndarray, "P 3"]:
    """The normals, averaged over vertices that lie at the same point."""
    cell = SAME_POINT * np.abs(mesh.vertices).max()
    _, group = np.unique(np.rint(mesh.vertices / cell), axis=0, return_inverse=True)
    total = np.zeros((group.max() + 1, 3))
    np.add.at(total, group.reshape(-1), mesh.normals)
    mean = total[group.reshape(-1)]
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    return np.where(length > 1e-9, mean / np.maximum(length, 1e-9), mesh.normals)
