"""Blender shows the light of a prediction from where it came, in a mirror too, and reads the GLB as the surface."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shinypartial.blender.mirror_scene import write_mirror_scene
from shinypartial.blender.runtime import import_blender, quiet
from shinypartial.conversion.convert import convert
from shinypartial.core.sphere import latlong_directions
from shinypartial.io.images import read_exr_rgb, write_exr_rgb
from shinypartial.prediction.format import PredictionInfo, write_environment_map, write_info
from shinypartial.prediction.surface import surface_of
from tests.shinypartial.conversion.test_surface import write_ply
from tests.support.polyhedra import wavy_patch

pytest.importorskip("bpy")

#: Colors of the world along +X, −X, +Y, −Y, +Z, −Z.
AXES = np.concatenate([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]]
COLORS = np.array([[1.0, 0, 0], [0, 1, 1], [0, 1, 0], [1, 0, 1], [0, 0, 1], [40, 40, 0]])
#: Half a texel about a pole Blender blends the first row of a map with the last, so that no look goes straight there.
ASIDE = np.array([0.1, -0.06, 0.08])
#: Relative. The world is exact in half precision; what remains are lookups between texels and float32.
TOLERANCE = 2e-3


def six_colors(height: int = 64) -> np.ndarray:
    """A world of six flat colors, each about an axis."""
    return COLORS[np.argmax(latlong_directions(height) @ AXES.T, -1)].astype(np.float32)


def ball(folder: Path, radius: float = 1.0, rows: int = 48) -> None:
    """A sphere as a PLY with its exact normals."""
    polar, azimuth = np.meshgrid(
        np.pi * (np.arange(rows + 1)) / rows, np.pi * np.arange(2 * rows) / rows, indexing="ij"
    )
    normals = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    index = np.arange(polar.size).reshape(polar.shape)
    after = np.roll(index, -1, 1)
    faces = np.stack([index[:-1], index[1:], after[1:], after[:-1]], -1).reshape(-1, 4)
    write_ply(folder / "ball.ply", radius * normals.reshape(-1, 3), faces, normals.reshape(-1, 3))


@pytest.fixture
def prediction(tmp_path: Path) -> Path:
    write_environment_map(tmp_path / "p", six_colors())
    write_info(tmp_path / "p", PredictionInfo("m", "none", "", {}, {}, {}, {}, 0))
    return tmp_path / "p"


def reopened(path: Path) -> Any:
    bpy = import_blender()
    with quiet():
        bpy.ops.wm.open_mainfile(filepath=str(path))
    return bpy


def seen_along(bpy: Any, direction: np.ndarray, start: np.ndarray, folder: Path) -> np.ndarray:
    """What a narrow camera at `start` sees in a direction, as Blender itself points cameras."""
    from mathutils import Vector

    scene = bpy.context.scene
    camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    camera.data.angle = np.radians(2.0)
    camera.location = start
    camera.rotation_euler = Vector(direction).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(camera)
    scene.camera, scene.cycles.samples = camera, 4
    scene.render.resolution_x = scene.render.resolution_y = 4
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(folder / "seen.exr")
    with quiet():
        bpy.ops.render.render(write_still=True)
    return read_exr_rgb(folder / "seen.exr").mean((0, 1))


def test_a_camera_sees_the_light_of_its_direction(prediction: Path, tmp_path: Path) -> None:
    """The .blend and its world are moved before they are opened."""
    convert(prediction, ("blender",), tmp_path / "made")
    assert {path.name for path in (tmp_path / "made").iterdir()} == {"scene.blend", "world.exr"}
    (tmp_path / "made").rename(tmp_path / "moved")
    bpy = reopened(tmp_path / "moved" / "scene.blend")
    for axis, color in zip(AXES, COLORS, strict=True):
        np.testing.assert_allclose(
            seen_along(bpy, axis + ASIDE, np.zeros(3), tmp_path), color, rtol=TOLERANCE, atol=TOLERANCE
        )


def test_a_mirror_ball_shows_the_light_behind_the_camera(prediction: Path, tmp_path: Path) -> None:
    """Seen along an axis the middle of the ball mirrors the camera's own side; and 45° beside it, the light across."""
    ball(prediction)
    convert(prediction, ("blender",), tmp_path / "made")
    bpy = reopened(tmp_path / "made" / "scene.blend")
    for axis, color in zip(AXES, COLORS, strict=True):
        np.testing.assert_allclose(
            seen_along(bpy, -axis, 5 * axis + ASIDE, tmp_path), color, rtol=TOLERANCE, atol=TOLERANCE
        )
    for axis, color in zip(AXES, np.roll(COLORS, 2, 0), strict=True):
        across = np.roll(axis, -1)  # +Y sees, in the normal between +Y and +X, the light of +X.
        start = 5 * axis + (axis + across) / np.sqrt(2)
        np.testing.assert_allclose(seen_along(bpy, -axis, start, tmp_path), color, rtol=TOLERANCE, atol=TOLERANCE)


def test_light_is_followed_from_mirror_to_mirror(prediction: Path, tmp_path: Path) -> None:
    """Two mirrors at 180°/8 send light back to where it came from after eight reflections."""
    cosine, sine = np.cos(np.pi / 8), np.sin(np.pi / 8)
    vertices = np.array([[r * x, r * y, z] for x, y in ((1, 0), (cosine, sine)) for r in (0, 5) for z in (-2.0, 2.0)])
    normals = np.repeat([[0.0, 1, 0], [sine, -cosine, 0]], 4, axis=0)
    write_ply(prediction / "wedge.ply", vertices, np.array([[0, 1, 3, 2], [4, 6, 7, 5]]), normals)
    convert(prediction, ("blender",), tmp_path / "made")
    bpy = reopened(tmp_path / "made" / "scene.blend")
    away, aside = np.array([np.cos(np.pi / 16), np.sin(np.pi / 16), 0]), np.array([-np.sin(np.pi / 16), 0.98, 0])
    found = seen_along(bpy, -away, 10 * away + 0.5 * aside, tmp_path)
    np.testing.assert_allclose(found, COLORS[0], rtol=TOLERANCE, atol=TOLERANCE)


def test_the_mesh_keeps_its_normals(tmp_path: Path) -> None:
    vertices, faces, normals = wavy_patch()
    write_ply(tmp_path / "patch.ply", vertices, faces, normals)
    write_exr_rgb(tmp_path / "world.exr", six_colors())
    write_mirror_scene(tmp_path / "scene.blend", tmp_path / "world.exr", surface_of(tmp_path))
    mesh = reopened(tmp_path / "scene.blend").data.meshes[0]
    found = np.array([corner.vector for corner in mesh.corner_normals])
    np.testing.assert_allclose(found, normals[[loop.vertex_index for loop in mesh.loops]], atol=1e-6)


def test_blender_reads_the_glb_as_the_surface(prediction: Path, tmp_path: Path) -> None:
    """Its importer turns Y up into Z up, so that the surface is where it was."""
    vertices, faces, normals = wavy_patch()
    write_ply(prediction / "patch.ply", vertices, faces, normals)
    convert(prediction, ("glb",), tmp_path)
    bpy = import_blender()
    with quiet():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.ops.import_scene.gltf(filepath=str(tmp_path / "surface.glb"))
    (body,) = [each for each in bpy.data.objects if each.type == "MESH"]
    turn = np.array(body.matrix_world)
    found = np.array([vertex.co for vertex in body.data.vertices]) @ turn[:3, :3].T + turn[:3, 3]
    np.testing.assert_allclose(found, vertices, atol=1e-6)
    corners = np.array([corner.vector for corner in body.data.corner_normals]) @ turn[:3, :3].T
    # Blender keeps normals of a corner in 16 bits.
    np.testing.assert_allclose(corners, normals[[loop.vertex_index for loop in body.data.loops]], atol=1e-3)
    shader = next(node for node in body.data.materials[0].node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    assert (shader.inputs["Metallic"].default_value, shader.inputs["Roughness"].default_value) == (1.0, 0.0)
