"""Closed organic forms as level sets of a smooth function (numpy; marching cubes from scikit-image)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from shinypartial.core.errors import InputError
from shinypartial.core.mesh import Mesh
from shinypartial.scene import Blob, SoftBalls

BALLS = 96
#: Newton steps from the cells' edges onto the level set; each about squares the error.
NEWTON_STEPS = 4
#: Cells per side in which the outer bounds of listed balls are sought.
COARSE_CELLS = 64


@dataclass(frozen=True)
class _Balls:
    """The field f(x) = Σ w exp(−|x − c|²/r²) − 1, positive inside; balls overlap so that their level set is smooth."""

    centers: Float[np.ndarray, "K 3"]
    radii: Float[np.ndarray, "K"]
    weights: Float[np.ndarray, "K"]

    def field(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """Value at each point."""
        return self._shares(points).sum(-1) - 1.0

    def gradient(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Gradient at each point; it points inward."""
        shares = -2 * self._shares(points) / self.radii**2
        return shares.sum(-1, keepdims=True) * points - shares @ self.centers

    def _shares(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P K"]:
        squares = np.sum(points**2, -1)[:, None] - 2 * points @ self.centers.T + np.sum(self.centers**2, -1)
        return self.weights * np.exp(-squares / self.radii**2)


def blob_mesh(blob: Blob) -> Mesh:
    """Triangles of the level set, each vertex and normal exact, with the farthest vertex at the blob's radius."""
    balls = _balls_along_curve(blob)
    return _level_set(balls, _farthest(balls), blob.resolution, blob.radius, blob.refinements)


def soft_balls_mesh(shape: SoftBalls) -> Mesh:
    """The same of the balls that a recipe lists, refined: see the shape for their field."""
    *centers, radii, strengths = np.array(shape.balls, dtype=np.float64).T
    balls = _Balls(np.stack(centers, -1), radii, np.e * strengths)
    axis = np.linspace(-(reach := _farthest(balls)), reach, COARSE_CELLS + 1)
    inside = np.argwhere(_sampled(balls, axis) > 0)
    if not len(inside):
        raise InputError(
            expected="soft balls that hold some of each other or of themselves together",
            found="none of which a surface is left",
            remedy="Give them more strength, or weaken those of negative strength.",
        )
    nearer = np.abs(axis[inside]).max() + 2 * (axis[1] - axis[0])
    return _level_set(balls, nearer, shape.resolution, shape.radius, shape.refinements)


def _farthest(balls: _Balls) -> float:
    """A coordinate that no point of the level set exceeds."""
    return float(np.abs(balls.centers).max() + 2.5 * balls.radii.max())


def _sampled(balls: _Balls, axis: Float[np.ndarray, "L"]) -> Float[np.ndarray, "L L L"]:
    return np.stack([balls.field(_layer(x, axis)).reshape(len(axis), len(axis)) for x in axis])


def _level_set(balls: _Balls, reach: float, resolution: int, radius: float, refinements: int) -> Mesh:
    """Marching cubes, then Newton steps onto the level set; centered and scaled, with the gradient's normals."""
    from skimage.measure import marching_cubes

    axis = np.linspace(-reach, reach, resolution + 1)
    vertices, faces, *_ = marching_cubes(_sampled(balls, axis).astype(np.float32), 0.0)
    points = _onto(balls, vertices.astype(np.float64) * (axis[1] - axis[0]) - reach)
    for _ in range(refinements):
        points, faces = _divided(points, faces)
        points = _onto(balls, points)
    normals = -balls.gradient(points)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    points -= (points.max(0) + points.min(0)) / 2
    points *= radius / np.linalg.norm(points, axis=-1).max()
    return Mesh(points, normals, _facing_outward(points, normals, faces))


def _onto(balls: _Balls, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Newton's steps along the gradient onto the level set."""
    for _ in range(NEWTON_STEPS):
        gradient = balls.gradient(points)
        points = points - (balls.field(points) / np.maximum(np.sum(gradient**2, -1), 1e-12))[:, None] * gradient
    return points


def _divided(points: Float[np.ndarray, "P 3"], faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each triangle as four, through the middles of its edges."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), -1)
    unique, number = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = len(points) + number.reshape(3, -1)
    a, b, c = faces.T
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([points, points[unique].mean(1)]), np.concatenate([np.stack(each, -1) for each in corners])


def _balls_along_curve(blob: Blob) -> _Balls:
    """A ring of radius 1 about Y, bent by a few random waves in all three coordinates, and balls of varying size."""
    random = np.random.default_rng(blob.seed)
    turn = 2 * np.pi * np.arange(BALLS) / BALLS
    centers = np.stack([np.cos(turn), np.zeros(BALLS), np.sin(turn)], -1)
    for wave in range(1, blob.harmonics + 1):
        phase = wave * turn[:, None] + random.uniform(0, 2 * np.pi, 3)
        centers += random.normal(0, 0.45 / wave, 3) * np.cos(phase) * [1.0, 1.6, 1.0]
    swing = np.cos(turn + random.uniform(0, 2 * np.pi)) + np.cos(2 * turn + random.uniform(0, 2 * np.pi))
    radii = blob.thickness * (1 + blob.variation * swing / 2)
    # Along a straight row of equal balls at this spacing, the level set lies one radius away from it.
    spacing = np.linalg.norm(centers - np.roll(centers, 1, 0), axis=-1).mean()
    weight = float(np.e * spacing / (blob.thickness * np.sqrt(np.pi)))
    return _Balls(centers - centers.mean(0), radii, np.full(BALLS, weight))


def _layer(x: float, axis: Float[np.ndarray, "L"]) -> Float[np.ndarray, "P 3"]:
    y, z = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([np.full_like(y, x), y, z], -1).reshape(-1, 3)


def _facing_outward(
    points: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"], faces: np.ndarray
) -> list[tuple[int, ...]]:
    """Triangles in the order of their normals; slivers that Newton's steps have collapsed are left out."""
    a, b, c = points[faces].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    outward = np.sum(cross * normals[faces].mean(1), -1)
    kept = np.linalg.norm(cross, axis=-1) > 1e-12
    turned = np.where((outward < 0)[:, None], faces[:, ::-1], faces)
    return [tuple(face) for face in turned[kept].tolist()]
