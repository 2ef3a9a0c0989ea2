"""Meshes: outward faces that agree with the exact normals, closed where they should be, smooth at the axis."""

import numpy as np
import pytest

from shinypartial.blender.geometry import Mesh, make_mesh, spline_outline
from shinypartial.scene import Plane, Sphere, SurfaceOfRevolution, load_scene


def face_normals(mesh: Mesh) -> np.ndarray:
    corners = np.array([face[:3] for face in mesh.faces])
    a, b, c = mesh.vertices[corners].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


SHAPES = {
    "vase": load_scene("vase").object,
    "sphere": Sphere(radius=2.0, segments=64, rings=32),
    "plane": Plane(normal=(0.3, -1.0, 0.2)),
    "floor": Plane(normal=(0.0, 0.0, 1.0)),
    "cone": SurfaceOfRevolution(profile=((1.0, 0.0), (0.6, 0.4), (0.2, 0.8)), segments=64),
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())
def test_faces_turn_the_way_the_normals_point(shape: SurfaceOfRevolution | Sphere | Plane) -> None:
    mesh = make_mesh(shape)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-12)
    corners = np.array([mesh.normals[list(face)].mean(0) for face in mesh.faces])
    assert (np.sum(corners * face_normals(mesh), -1) > 0.9).all()


def test_a_sphere_is_closed_and_its_normals_are_its_points() -> None:
    mesh = make_mesh(SHAPES["sphere"])
    np.testing.assert_allclose(mesh.vertices, 2 * mesh.normals, atol=1e-12)
    edges = {frozenset((a, b)) for face in mesh.faces for a, b in zip(face, (*face[1:], face[0]), strict=True)}
    assert len(mesh.vertices) - len(edges) + len(mesh.faces) == 2, "Euler's formula of a closed surface."


def test_the_spline_goes_through_its_points_and_is_level_at_the_axis() -> None:
    vase = load_scene("vase").object
    outline = spline_outline(vase, 20_001)
    for radius, z in vase.profile:
        distance = np.hypot(outline.points[:, 0] - radius, outline.points[:, 1] - z - vase.offset_z).min()
        assert distance < 1e-4  # half the spacing of the samples
    np.testing.assert_allclose(outline.normals[0], [0, -1], atol=1e-12)
    assert (outline.points[1:, 0] > 0).all()


def test_spline_normals_are_perpendicular_to_the_curve() -> None:
    outline = spline_outline(load_scene("vase").object, 20_001)
    tangents = np.gradient(outline.points, axis=0)[1:-1]
    tangents /= np.linalg.norm(tangents, axis=-1, keepdims=True)
    # Central differences at this spacing are good to 2e-6; the knots, where the third derivative jumps, to 1e-4.
    assert np.abs(np.sum(tangents * outline.normals[1:-1], -1)).max() < 1e-4


def test_a_plane_has_its_size_and_a_level_side() -> None:
    mesh = make_mesh(Plane(size=(2.0, 3.0), normal=(0.3, -1.0, 0.2)))
    sides = np.diff(mesh.vertices, axis=0)
    np.testing.assert_allclose(np.linalg.norm(sides, axis=-1), [2, 3, 2])
    assert sides[0, 2] == pytest.approx(0)
