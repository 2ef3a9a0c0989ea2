"""Shader nodes: the object's material with its depth pass, the room's light, and the probe of self-reflection."""

from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.scene import Material

DEPTH_PASS = "z_depth"


def make_material(bpy: Any, spec: Material) -> Any:
    """The Principled shader."""
    material, nodes, links = _empty(bpy, "material")
    shader = nodes.new("ShaderNodeBsdfPrincipled")
    shader.inputs["Base Color"].default_value = (*spec.base_color, 1)
    shader.inputs["Metallic"].default_value = spec.metallic
    shader.inputs["Roughness"].default_value = spec.roughness
    links.new(shader.outputs["BSDF"], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return material


def add_depth_pass(material: Any) -> None:
    """Give out the z-depth of every sample as a pass.

    Blender's own depth pass keeps one random sample of each pixel, which may miss the object; this pass is averaged
    over the pixel as color is.
    """
    nodes, links = material.node_tree.nodes, material.node_tree.links
    depth = nodes.new("ShaderNodeOutputAOV")
    depth.aov_name = DEPTH_PASS
    links.new(nodes.new("ShaderNodeCameraData").outputs["View Z Depth"], depth.inputs["Value"])


def is_perfect_mirror(spec: Material | None) -> bool:
    """Whether all light is reflected in one direction, unchanged."""
    return spec is not None and spec.base_color == (1.0, 1.0, 1.0) and spec.metallic == 1 and spec.roughness == 0


def make_probe_material(bpy: Any) -> Any:
    """A perfect mirror to the camera and a light of radiance 1 to every reflected ray."""
    material, nodes, links = _empty(bpy, "probe")
    mirror, light = _mirror_and_light(nodes, 1.0)
    choice = nodes.new("ShaderNodeMixShader")
    links.new(nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"], choice.inputs[0])
    links.new(light.outputs["Emission"], choice.inputs[1])
    links.new(mirror.outputs["BSDF"], choice.inputs[2])
    links.new(choice.outputs["Shader"], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    material.cycles.emission_sampling = "NONE"  # Reflected rays find it by themselves.
    return material


def make_mark_material(bpy: Any, radiance: float) -> Any:
    """A light of that radiance, and to the camera a perfect mirror beside."""
    material, nodes, links = _empty(bpy, "mark")
    mirror, light = _mirror_and_light(nodes, radiance)
    choice, both = nodes.new("ShaderNodeMixShader"), nodes.new("ShaderNodeAddShader")
    links.new(nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"], choice.inputs[0])
    links.new(mirror.outputs["BSDF"], choice.inputs[2])
    links.new(light.outputs["Emission"], both.inputs[0])
    links.new(choice.outputs["Shader"], both.inputs[1])
    links.new(both.outputs["Shader"], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    material.cycles.emission_sampling = "NONE"
    return material


def make_room_material(bpy: Any, image: Any, strength: float) -> Any:
    """Light that depends on where the room's wall is, as seen from the origin: the map in that direction."""
    material, nodes, links = _empty(bpy, "room")
    light = nodes.new("ShaderNodeEmission")
    light.inputs["Strength"].default_value = strength
    position = nodes.new("ShaderNodeNewGeometry").outputs["Position"]
    links.new(environment_color(nodes, links, image, position), light.inputs["Color"])
    links.new(light.outputs["Emission"], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return material


def make_light_material(bpy: Any, radiance: float) -> Any:
    """Gray light, the same from everywhere, that reflected rays find by themselves."""
    material, nodes, links = _empty(bpy, "light")
    _, light = _mirror_and_light(nodes, radiance)
    links.new(light.outputs["Emission"], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    material.cycles.emission_sampling = "NONE"
    return material


def make_printed_material(bpy: Any, image: Any, size: tuple[float, float], strength: float, exact: bool) -> Any:
    """Light of an image that is spread over a horizontal rectangle about the z axis; `exact` pixels are not mixed."""
    material, nodes, links = _empty(bpy, "print")
    light, texture = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeTexImage")
    light.inputs["Strength"].default_value = strength
    texture.image, texture.interpolation, texture.extension = image, "Closest" if exact else "Linear", "EXTEND"
    place = nodes.new("ShaderNodeVectorMath")
    place.operation = "MULTIPLY_ADD"
    links.new(nodes.new("ShaderNodeNewGeometry").outputs["Position"], place.inputs[0])
    place.inputs[1].default_value, place.inputs[2].default_value = (1 / size[0], 1 / size[1], 0), (0.5, 0.5, 0)
    links.new(place.outputs["Vector"], texture.inputs["Vector"])
    links.new(texture.outputs["Color"], light.inputs["Color"])
    links.new(light.outputs["Emission"], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return material


def image_of(bpy: Any, name: str, rgba: Float[np.ndarray, "H W 4"]) -> Any:
    """An image of Blender's, in which the first row is the lowest, of linear numbers in single precision."""
    height, width = rgba.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=True, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    image.use_half_precision = False  # It would round columns beyond 2048.
    image.pixels.foreach_set(rgba[::-1].ravel())
    image.update()
    return image


def environment_color(nodes: Any, links: Any, image: Any, direction: Any = None) -> Any:
    """The color of a lat-long image in a direction, that of the ray unless another is given; nowhere below zero."""
    texture, positive = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeVectorMath")
    texture.image = image
    texture.projection, texture.interpolation = "EQUIRECTANGULAR", "Linear"
    if direction is not None:
        links.new(direction, texture.inputs["Vector"])
    positive.operation = "MAXIMUM"
    links.new(texture.outputs["Color"], positive.inputs[0])
    return positive.outputs["Vector"]


def _mirror_and_light(nodes: Any, radiance: float) -> tuple[Any, Any]:
    """Nodes of a perfect mirror and of a white light."""
    mirror, light = nodes.new("ShaderNodeBsdfGlossy"), nodes.new("ShaderNodeEmission")
    mirror.inputs["Roughness"].default_value = 0
    mirror.inputs["Color"].default_value = (1, 1, 1, 1)
    light.inputs["Color"].default_value = (1, 1, 1, 1)
    light.inputs["Strength"].default_value = radiance
    return mirror, light


def _empty(bpy: Any, name: str) -> tuple[Any, Any, Any]:
    """A new material without nodes, its nodes and its links."""
    material = bpy.data.materials.new(name)
    material.node_tree.nodes.clear()
    return material, material.node_tree.nodes, material.node_tree.links
