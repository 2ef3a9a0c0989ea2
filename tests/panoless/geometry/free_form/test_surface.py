"""Level sets from meshes."""

import numpy as np
import pytest
from skimage.measure import marching_cubes

from panoless.first_surface.mesh import TriangleMesh
from panoless.geometry.free_form.surface import level_set_of

RADIUS = 0.7


def ball_and_fold(at: float) -> TriangleMesh:
    """The mesh of a ball, and a tiny tetrahedron beside it that is turned inside out, as folds of hulls are."""
    axis = np.linspace(-1, 1, 49)
    distance = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), axis=-1) - RADIUS
    vertices, triangles, _, _ = marching_cubes(distance, 0.0, spacing=(axis[1] - axis[0],) * 3)
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) * 0.02 + [at, 0, 0]
    inward = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    mesh = TriangleMesh(
        np.concatenate([vertices - 1, corners]), np.concatenate([triangles, inward + len(vertices)]).astype(np.int64)
    )
    volume = np.linalg.det((vertices - 1)[triangles]).sum()
    return (
        mesh if volume > 0 else TriangleMesh(mesh.vertices, np.concatenate([triangles[:, ::-1], mesh.triangles[-4:]]))
    )


@pytest.mark.parametrize("at", [0.73, 0.77])
def test_a_fold_of_the_mesh_puts_nothing_inside_that_is_far_from_it(at: float) -> None:
    """By the nearest vertex alone, a corner of the box as wide as the ball would be inside."""
    surface = level_set_of(ball_and_fold(at), 40, 0.175)
    values, radius = surface.at_nodes().ravel(), np.linalg.norm(surface.points(surface.nodes().reshape(-1, 3)), axis=1)
    assert (values[radius > at + 0.1] > 0).all()
    assert (values[radius < RADIUS - 0.05] < 0).all()
