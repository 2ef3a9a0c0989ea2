# SPDX-License-Identifier: GPL-3.0-or-later
"""A prediction as Blender's objects: the mirror, cameras with photographs, the ground, near walls."""

from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

from .content import Content
from .light import STRENGTH, WALLS, light_nodes, load_light, make_world, update_light
from .program import Problem

MIRROR, GROUND, CAMERA = "PanoLess mirror", "PanoLess ground", "PanoLess camera"
#: The mirror as light meets it, which is in the photographs already.
MET = "PanoLess mirror met by light"
#: How far it lies below what cameras see, in radii of the object.
MET_DEPTH = 1e-3
#: Half a side of the ground, in radii of the object.
GROUND_RADII = 12.0
#: The photograph has its color; this only weighs shadows against mirrored images.
GROUND_COLOR = 0.5, 0.5, 0.5
BOUNCES = 16


def build(scene: bpy.types.Scene, content: Content) -> list[str]:
    """Replace what an earlier import made in the scene; return what is missing, a sentence each."""
    missing = []
    arrays, cameras = {name: content.arrays(f"{name}.npz") for name in ("surface", "walls")}, content.table["cameras"]
    meshes = {name: None if each is None else mesh_of(name, each) for name, each in arrays.items()}
    load_light(content.folder)  # What is damaged has been refused by now.
    make_world(scene)
    collection = _fresh_collection(scene)
    center, radius = _bounds(content)
    if meshes["surface"] is None:
        missing.append("No mesh: this surface is a cloud of points")
    else:
        _add_mirror(collection, meshes["surface"], content.table["mirror"], radius)
    if not cameras:
        missing.append("No cameras: the dataset of this prediction is not where it was")
    for one in cameras:
        _add_camera(collection, one, center, radius)
    if content.table["ground"] is not None:
        _add_ground(collection, content.table["ground"], radius)
    if meshes["walls"] is not None:
        _add_walls(collection, meshes["walls"])
    update_light(scene)
    update_ground(scene)
    settings = scene.panoless
    settings.prediction, settings.content = content.table["prediction"], str(content.folder)
    verdict = content.table["verdict"]
    settings.verdict = "" if verdict is None else f"{verdict['verdict']}: {verdict['reason']}"
    if cameras:
        show_photograph(scene, photograph_cameras(scene)[len(cameras) // 2])
    _set_render(scene)
    return missing


def photograph_cameras(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The cameras of photographs in the scene, in their order."""
    return [each for each in scene.objects if each.type == "CAMERA" and "panoless_size" in each.data]


def show_photograph(scene: bpy.types.Scene, camera: bpy.types.Object) -> None:
    """Look through a camera, with pictures of the size and the pixels of its photograph."""
    scene.camera = camera
    render = scene.render
    render.resolution_x, render.resolution_y = camera.data["panoless_size"]
    render.resolution_percentage = 100
    render.pixel_aspect_x, render.pixel_aspect_y = camera.data["panoless_aspect"]


def mirror_of(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The imported mirror."""
    return next((each for each in scene.objects if each.get("panoless") == MIRROR), None)


def ground_of(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The imported ground."""
    return next((each for each in scene.objects if each.get("panoless") == GROUND), None)


def update_ground(scene: bpy.types.Scene) -> None:
    """Apply the gloss of the scene's settings to the ground: 0 is matte, 1 mirrors as polished stone does."""
    ground, gloss = ground_of(scene), scene.panoless.ground_gloss
    for node in ground.active_material.node_tree.nodes if ground and ground.active_material else ():
        if node.type == "BSDF_PRINCIPLED":
            node.inputs["Roughness"].default_value = 1 - gloss
            node.inputs["Specular IOR Level"].default_value = gloss / 2


def object_sphere(each: bpy.types.Object) -> tuple[Vector, float]:
    """Center and radius of what bounds an object, in the world."""
    corners = [each.matrix_world @ Vector(corner) for corner in each.bound_box]
    center = sum(corners, Vector()) / len(corners)
    return center, max((corner - center).length for corner in corners)


def _bounds(content: Content) -> tuple[Vector, float]:
    """Middle and half of the diagonal of the object's box; the unit ball where nothing is known."""
    if content.table["bounds"] is None:
        return Vector(), 1.0
    low, high = map(Vector, content.table["bounds"])
    return (low + high) / 2, max((high - low).length / 2, 1e-6)


def _fresh_collection(scene: bpy.types.Scene) -> bpy.types.Collection:
    for old in [each for each in scene.collection.children if each.get("panoless")]:
        for each in [each for each in old.objects if "panoless" in each]:
            data = each.data
            bpy.data.objects.remove(each)
            if data is not None and not data.users:
                bpy.data.batch_remove([data])
        if not old.objects:
            bpy.data.collections.remove(old)
    collection = bpy.data.collections.new("PanoLess")
    collection["panoless"] = True
    scene.collection.children.link(collection)
    return collection


def _add(collection: bpy.types.Collection, kind: str, data: bpy.types.ID, name: str = "") -> bpy.types.Object:
    each = bpy.data.objects.new(name or kind, data)
    each["panoless"] = kind
    collection.objects.link(each)
    return each


def mesh_of(name: str, arrays: dict[str, np.ndarray]) -> bpy.types.Mesh:
    """A mesh of polygons, smooth, with the normals of its vertices where it has them."""
    mesh = bpy.data.meshes.new(name)
    vertices, corners, sizes = arrays["vertices"], arrays["corners"], arrays["sizes"]
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", vertices.ravel())
    mesh.loops.add(len(corners))
    mesh.loops.foreach_set("vertex_index", corners)
    mesh.polygons.add(len(sizes))
    mesh.polygons.foreach_set("loop_start", np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int32))
    mesh.update(calc_edges=True)
    if mesh.validate():
        raise Problem("The surface of this prediction is damaged. Export it again")
    mesh.shade_smooth()
    if "normals" in arrays:
        if bpy.app.version >= (4, 5, 0):  # Kept as they are; the other way rounds them.
            attribute = mesh.attributes.new("custom_normal", "FLOAT_VECTOR", "POINT")
            attribute.data.foreach_set("vector", arrays["normals"].ravel())
        else:
            mesh.normals_split_custom_set_from_vertices(arrays["normals"].tolist())
    for attribute_name in ("confidence", "seen"):
        if attribute_name in arrays:
            colors = np.repeat(arrays[attribute_name], 4).astype(np.float32)
            colors[3::4] = 1
            attribute = mesh.color_attributes.new(attribute_name, "FLOAT_COLOR", "POINT")
            attribute.data.foreach_set("color", colors)
    return mesh


def _add_mirror(collection: bpy.types.Collection, mesh: bpy.types.Mesh, stated: dict, radius: float) -> None:
    """One for cameras, and one for light: that shadows and mirrors what is inserted, but leaves no second shadow and no
    second image of itself on the ground of a photograph, which has both.
    """
    shader = _add_shader(mesh, MIRROR)
    shader.inputs["Base Color"].default_value = (*stated["base_color"], 1)
    shader.inputs["Metallic"].default_value = 1
    shader.inputs["Roughness"].default_value = stated["roughness"]
    seen, met = _add(collection, MIRROR, mesh), _add(collection, MET, mesh)
    seen.visible_glossy = seen.visible_diffuse = seen.visible_shadow = False
    met.is_shadow_catcher, met.visible_camera, met.display_type, met.hide_select = True, False, "BOUNDS", True
    met.parent = seen
    below = met.modifiers.new(MET, "DISPLACE")
    below.mid_level, below.strength = 0, -MET_DEPTH * radius


def _add_shader(mesh: bpy.types.Mesh, name: str) -> bpy.types.Node:
    """Blender's usual shader, as the material of a mesh."""
    material, nodes, links = _empty_material(name)
    shader = nodes.new("ShaderNodeBsdfPrincipled")
    links.new(shader.outputs["BSDF"], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    mesh.materials.append(material)
    return shader


def _add_camera(collection: bpy.types.Collection, one: dict, center: Vector, radius: float) -> None:
    data = bpy.data.cameras.new(f"{CAMERA} {one['name']}")
    data.type, data.sensor_fit = "PERSP", "HORIZONTAL"
    data.lens, data.sensor_width = one["lens_mm"], one["sensor_mm"]
    data.shift_x, data.shift_y = one["shift_x"], one["shift_y"]
    each = _add(collection, CAMERA, data, f"{CAMERA} {one['name']}")
    each.matrix_world = Matrix(one["matrix_world"])
    distance = (each.matrix_world.translation - center).length
    data.clip_start, data.clip_end = max(1e-3 * distance, 1e-5), 1e3 * (distance + radius)
    data.display_size = 0.1 * radius
    data["panoless_size"], data["panoless_aspect"] = [one["width"], one["height"]], list(one["pixel_aspect"])
    if Path(one["picture"]).is_file():
        image = bpy.data.images.load(one["picture"], check_existing=True)
        behind = data.background_images.new()
        behind.image, behind.frame_method, behind.alpha = image, "STRETCH", 1.0
        data.show_background_images = True


def _add_ground(collection: bpy.types.Collection, stated: dict, radius: float) -> None:
    side = GROUND_RADII * radius
    mesh = bpy.data.meshes.new(GROUND)
    mesh.from_pydata([(-side, -side, 0), (side, -side, 0), (side, side, 0), (-side, side, 0)], [], [(0, 1, 2, 3)])
    _add_shader(mesh, GROUND).inputs["Base Color"].default_value = (*GROUND_COLOR, 1)
    each = _add(collection, GROUND, mesh)
    turn = Vector((0, 0, 1)).rotation_difference(Vector(stated["normal"])).to_matrix().to_4x4()
    each.matrix_world = Matrix.Translation(stated["point"]) @ turn
    each.is_shadow_catcher, each.display_type = True, "WIRE"  # Else it hides the photograph outside of renders.
    # The map has the ground already: in reflections it is seen there, and its light comes from there.
    each.visible_glossy = each.visible_diffuse = each.visible_shadow = False


def _add_walls(collection: bpy.types.Collection, mesh: bpy.types.Mesh) -> None:
    """A light that depends on where on the walls it leaves, as seen from the world's origin."""
    material, nodes, links = _empty_material(WALLS)
    light = nodes.new("ShaderNodeEmission")
    light.name = STRENGTH
    position = nodes.new("ShaderNodeNewGeometry").outputs["Position"]
    links.new(light_nodes(material.node_tree, position), light.inputs["Color"])
    links.new(light.outputs["Emission"], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    mesh.materials.append(material)
    each = _add(collection, WALLS, mesh)
    each.visible_camera, each.display_type = False, "WIRE"
    each.hide_select = True


def _empty_material(name: str) -> tuple:
    if old := bpy.data.materials.get(name):
        bpy.data.materials.remove(old)
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # Before Blender 5.
        material.use_nodes = True
    material.node_tree.nodes.clear()
    return material, material.node_tree.nodes, material.node_tree.links


def _set_render(scene: bpy.types.Scene) -> None:
    """As photographs show it: no view transform, no clamp, reflections to the end."""
    scene.render.engine = "CYCLES"
    scene.render.film_transparent = True
    scene.view_settings.view_transform = "Standard"
    cycles = scene.cycles
    cycles.sample_clamp_indirect = cycles.blur_glossy = 0
    cycles.max_bounces = cycles.glossy_bounces = BOUNCES
