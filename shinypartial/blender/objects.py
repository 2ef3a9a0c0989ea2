"""Put the object and what stands around it into the open scene."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from shinypartial.blender.blend_file import load_blend_object
from shinypartial.blender.geometry import make_part
from shinypartial.blender.materials import add_depth_pass, make_material
from shinypartial.blender.mesh import deformed, joined, scaled
from shinypartial.core.mesh import Mesh
from shinypartial.scene import Assembly, BlendFile, Material, Part, SceneSpec

BODY = "object"
PROP = "prop"


def place_objects(bpy: Any, scene: Any, spec: SceneSpec) -> None:
    """Link the object, whose name is BODY, and the props, whose names begin with PROP.

    Props are holdouts: the camera sees a hole where they are, so that they count as background and hide the object,
    while reflected rays meet them as they are.
    """
    if isinstance(spec.object, BlendFile):
        body = load_blend_object(bpy, scene, spec)
        for i, each in enumerate([each for each in scene.objects if each != body]):
            each.name = f"{PROP} {i}"
        body.name = BODY
    else:
        _link(bpy, scene, BODY, parts_of(spec), spec)
    for i, part in enumerate(spec.props):
        _link(bpy, scene, f"{PROP} of the recipe {i}", (part,), spec)
    for each in props_of(scene):
        each.is_holdout = True
    for slot in scene.objects[BODY].material_slots:
        add_depth_pass(slot.material)


def parts_of(spec: SceneSpec) -> tuple[Part, ...]:
    """Parts of a recipe's object, each of which has one material; none of a user's file."""
    if isinstance(spec.object, BlendFile):
        return ()
    return spec.object.parts if isinstance(spec.object, Assembly) else (Part(spec.object),)


def props_of(scene: Any) -> list[Any]:
    """What stands around the object."""
    return [each for each in scene.objects if each.name.startswith(PROP)]


def mesh_of(bpy: Any, name: str, shape: Mesh) -> Any:
    """A Blender mesh with the exact vertex normals, interpolated across faces."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(shape.vertices.tolist(), [], shape.faces)
    mesh.shade_smooth()
    # The attribute holds float normals; normals_split_custom_set would round them to 16 bits.
    attribute = mesh.attributes.new("custom_normal", "FLOAT_VECTOR", "POINT")
    attribute.data.foreach_set("vector", shape.normals.astype(np.float32).ravel())
    return mesh


def _link(bpy: Any, scene: Any, name: str, parts: Iterable[Part], spec: SceneSpec) -> None:
    """One Blender object of several parts, each with its own material."""
    parts = tuple(parts)
    is_body = name == BODY
    fine = is_body and spec.deformation.amplitude > 0
    pieces = [make_part(part, fine=fine) for part in parts]
    whole = joined(pieces)
    mesh = mesh_of(bpy, name, scaled(deformed(whole, spec.deformation) if is_body else whole, spec.scale))
    for part in parts:
        mesh.materials.append(make_material(bpy, part.material or spec.material or Material()))
    numbers = np.repeat(np.arange(len(pieces)), [len(piece.faces) for piece in pieces])
    mesh.polygons.foreach_set("material_index", numbers.astype(np.int32))
    scene.collection.objects.link(bpy.data.objects.new(name, mesh))
