"""A user's own Blender file: the named object is the mask, the rest stands around it, and mistakes are named."""

from pathlib import Path

import numpy as np
import pytest

from shinypartial.blender.render import RenderedView, open_renderer
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.core.errors import InputError
from shinypartial.core.trajectory import plan_cameras
from shinypartial.scene import BlendFile, SceneSpec, find_scene, override, parse_scene

bpy = pytest.importorskip("bpy")

RED = (0.8, 0.0, 0.0)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A red ball of radius 4 away from the origin under a modifier, a floor close below, a lamp and a hidden ball."""
    path = tmp_path_factory.mktemp("user") / "mine.blend"
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_uv_sphere_add(radius=2, location=(10, 20, 30), segments=32, ring_count=16)
    ball = bpy.context.object
    ball.name, ball.scale = "Ball", (2, 2, 2)
    ball.modifiers.new("smooth", "SUBSURF").render_levels = 1
    material = bpy.data.materials.new("red")
    shader = material.node_tree.nodes.get("Principled BSDF")
    shader.inputs["Base Color"].default_value = (*RED, 1)
    shader.inputs["Metallic"].default_value = 1
    shader.inputs["Roughness"].default_value = 0
    ball.data.materials.append(material)
    bpy.ops.mesh.primitive_plane_add(size=60, location=(10, 20, 25))
    bpy.context.object.name = "Floor"
    bpy.ops.mesh.primitive_uv_sphere_add(radius=6, location=(10, 20, 30))
    bpy.context.object.name, bpy.context.object.hide_render = "Hidden", True
    bpy.ops.object.light_add(type="SUN")
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def render(spec: SceneSpec) -> RenderedView:
    small = override(spec, resolution=32, samples=16, train=1, test=1, elevation_deg=(0.0, 0.0))
    with open_renderer(small) as renderer:
        return renderer.render(plan_cameras(small.camera, 32).train[0])


def test_the_named_object_fills_the_unit_sphere_and_keeps_its_material(file: Path) -> None:
    spec = find_scene(str(file), "Ball")
    view = render(spec)
    # Disk of a unit sphere seen from 3.2: π (50/36 · 32)²/(3.2² − 1) pixels; the polygons take 2 % of it away.
    expected = np.pi * (50 / 36 * 32) ** 2 / (spec.camera.radius**2 - 1)
    assert view.alpha.sum() == pytest.approx(expected, rel=0.05)
    solid = (view.alpha > SOLID_ALPHA) & (view.self_reflection == 0)
    # Away from grazing angles the mirror is red.
    facing = view.radiance[solid]
    assert np.median(facing[:, 1] / facing[:, 0]) < 0.2


def test_other_objects_hide_nothing_from_the_mask_but_are_mirrored(file: Path) -> None:
    """The floor, a quarter radius below, is seen by the lower half of the ball and nowhere in the mask."""
    view = render(find_scene(str(file), "Ball"))
    solid = view.alpha > SOLID_ALPHA
    lower, upper = view.normals_world[..., 2] < -0.3, view.normals_world[..., 2] > 0.8
    assert view.self_reflection[solid & lower].mean() > 0.95
    assert view.self_reflection[solid & upper].mean() == 0


def test_options_replace_the_materials(file: Path) -> None:
    spec = find_scene(str(file), "Ball")
    assert spec.material is None
    green = render(override(spec, base_color=(0.0, 0.8, 0.0)))
    solid = (green.alpha > SOLID_ALPHA) & (green.self_reflection == 0)
    assert np.median(green.radiance[solid][:, 0] / green.radiance[solid][:, 1]) < 0.2


def test_it_can_be_deformed(file: Path) -> None:
    spec = find_scene(str(file), "Ball")
    plain, bumpy = render(spec), render(override(spec, deformation=0.03))
    both = (plain.alpha > SOLID_ALPHA) & (bumpy.alpha > SOLID_ALPHA)
    assert np.sum(plain.normals_world * bumpy.normals_world, -1)[both].mean() < 0.998


def test_the_recipe_names_the_file_by_its_content(file: Path) -> None:
    spec = find_scene(str(file), "Ball")
    assert isinstance(spec.object, BlendFile)
    recipe = spec.recipe()
    assert recipe["object"]["path"] == "mine.blend"
    assert len(recipe["object"].pop("sha256")) == 64
    assert parse_scene(recipe, "the manifest").object.object == "Ball"


def test_mistakes_are_named(file: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--object NAME"):
        find_scene(str(file))
    with pytest.raises(InputError, match="not there"):
        find_scene(str(tmp_path / "none.blend"), "Ball")
    with pytest.raises(InputError, match="only"):
        find_scene("vase", "Ball")
    with pytest.raises(InputError, match=r"named Bal.*Ball, Floor"):
        render(find_scene(str(file), "Bal"))
    (tmp_path / "broken.blend").write_bytes(b"no file of Blender's")
    with pytest.raises(InputError, match="a Blender file at"):
        render(find_scene(str(tmp_path / "broken.blend"), "Ball"))
