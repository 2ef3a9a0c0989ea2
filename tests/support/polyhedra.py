"""Small surfaces with known normals, and silhouettes that are not convex."""

import numpy as np

L_SHAPE = np.array([[0.0, 0], [3, 0], [3, 1], [1, 1], [1, 2], [0, 2]])


def spiral(turns: float = 1.8, corners: int = 30) -> np.ndarray:
    """A band wound about the origin, counterclockwise: most of its corners are no ears."""
    angle = 2 * np.pi * turns * np.linspace(0, 1, corners)
    ray = np.stack([np.cos(angle), np.sin(angle)], 1)
    inner, outer = (1 + angle / 8)[:, None] * ray, (1.3 + angle / 8)[:, None] * ray
    return np.concatenate([outer, inner[::-1]])


def wavy_patch(side: int = 7) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, quadrilaterals and exact normals of z = 2 + sin(x) cos(y)/2, counterclockwise from above."""
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-1, 1, side), np.linspace(0, 3, side), indexing="ij"))
    normals = np.stack([-np.cos(x) * np.cos(y) / 2, np.sin(x) * np.sin(y) / 2, np.ones(side**2)], 1)
    index = np.arange(side**2).reshape(side, side)
    faces = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1).reshape(-1, 4)
    vertices = np.stack([x, y, 2 + np.sin(x) * np.cos(y) / 2], 1)
    return vertices, faces, normals / np.linalg.norm(normals, axis=1, keepdims=True)
