"""Bring an object of a user's Blender file, and the meshes around it, into the open scene."""

from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.blender.materials import make_material
from shinypartial.blender.mesh import deformed
from shinypartial.core.errors import InputError
from shinypartial.core.mesh import Mesh
from shinypartial.scene import BlendFile, Material, SceneSpec

#: Kinds of objects that have a surface. Lights, cameras and the world of the file are not used.
SURFACES = ("MESH", "CURVE", "SURFACE", "META", "FONT")


def load_blend_object(bpy: Any, scene: Any, spec: SceneSpec) -> Any:
    """Link everything with a surface as plain meshes; return the named object.

    The file's scene is moved and scaled so that the named object's bounding sphere (about the middle of its bounding
    box) is the unit sphere, then by the recipe's scale. Modifiers are applied; objects hidden from renders stay out.
    Raises InputError for a file that Blender can't read and for an object that isn't there or has no faces.
    """
    assert isinstance(spec.object, BlendFile)
    meshes = _read_meshes(bpy, scene, spec.object)
    if spec.object.object not in meshes:
        raise InputError(
            expected=f"an object with a surface named {spec.object.object} in {spec.object.path}",
            found=f"{', '.join(sorted(meshes)) or 'none with a surface'}",
            remedy="Correct --object.",
        )
    body = meshes.pop(spec.object.object)
    vertices = _coordinates(body)
    if not len(body.polygons) or not np.isfinite(vertices).all() or np.ptp(vertices, axis=0).max() <= 0:
        raise InputError(
            expected=f"an object {spec.object.object} with faces of finite size in {spec.object.path}",
            found=f"{len(body.polygons)} faces",
            remedy="Name another object with --object, or repair this one in Blender.",
        )
    middle = (vertices.max(0) + vertices.min(0)) / 2
    factor = 1 / np.linalg.norm(vertices - middle, axis=-1).max()
    for mesh in (body, *meshes.values()):
        _set_coordinates(mesh, factor * (_coordinates(mesh) - middle))
    if spec.deformation.amplitude:
        _deform(body, spec)
    for mesh in (body, *meshes.values()):
        _set_coordinates(mesh, spec.scale * _coordinates(mesh))
    _set_materials(bpy, body, spec.material)
    for mesh in meshes.values():
        scene.collection.objects.link(bpy.data.objects.new(mesh.name, mesh))
    result = bpy.data.objects.new("object", body)
    scene.collection.objects.link(result)
    return result


def _read_meshes(bpy: Any, scene: Any, file: BlendFile) -> dict[str, Any]:
    """World-space meshes, modifiers applied, by the names of their objects; nothing else of the file stays."""
    try:
        with bpy.data.libraries.load(file.path) as (source, target):
            target.objects = list(source.objects)
    except (OSError, RuntimeError) as error:
        raise InputError(
            expected=f"a Blender file at {file.path}",
            found=" ".join(str(error).split()),
            remedy="Save it again with Blender 5.0 or older.",
        ) from None
    objects = [each for each in target.objects if each is not None]
    names = {each: each.name for each in objects}
    for each in objects:
        scene.collection.objects.link(each)
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    meshes = {}
    for each in objects:
        if each.type in SURFACES and not each.hide_render:
            mesh = bpy.data.meshes.new_from_object(each.evaluated_get(depsgraph), depsgraph=depsgraph)
            mesh.transform(each.evaluated_get(depsgraph).matrix_world)
            meshes[names[each]] = mesh
    for each in objects:
        bpy.data.objects.remove(each)
    return meshes


def _coordinates(mesh: Any) -> Float[np.ndarray, "P 3"]:
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    return flat.reshape(-1, 3).astype(np.float64)


def _set_coordinates(mesh: Any, vertices: Float[np.ndarray, "P 3"]) -> None:
    mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    mesh.update()


def _deform(mesh: Any, spec: SceneSpec) -> None:
    """Displace the vertices along their normals; normals that the file sets by hand no longer hold."""
    normals = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertex_normals.foreach_get("vector", normals)
    faces = [tuple(face.vertices) for face in mesh.polygons]
    shape = Mesh(_coordinates(mesh), normals.reshape(-1, 3).astype(np.float64), faces)
    if "custom_normal" in mesh.attributes:
        mesh.attributes.remove(mesh.attributes["custom_normal"])
    _set_coordinates(mesh, deformed(shape, spec.deformation).vertices)


def _set_materials(bpy: Any, mesh: Any, material: Material | None) -> None:
    """Keep copies of the file's materials (a mirror where it has none), or put the recipe's in their place."""
    numbers = np.zeros(len(mesh.polygons), np.int32)
    if material is None:
        mesh.polygons.foreach_get("material_index", numbers)
    kept = [] if material else list(mesh.materials)
    mesh.materials.clear()
    for each in kept or [None]:
        mesh.materials.append(each.copy() if each else make_material(bpy, material or Material()))
    mesh.polygons.foreach_set("material_index", np.minimum(numbers, len(mesh.materials) - 1))
