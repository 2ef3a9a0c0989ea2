# SPDX-License-Identifier: GPL-3.0-or-later
"""World nodes that show a recovered light: strength, rotation, and what stands in for directions nobody saw."""

from pathlib import Path

import bpy
import numpy as np

from .program import Problem

PREFIX, WALLS, STRENGTH = "PanoLess", "PanoLess walls", "Strength"
FILLED, BLURRED, SEEN, CONFIDENCE = "light_filled.exr", "light_blurred.exr", "seen.png", "confidence.png"
UNSEEN = [
    ("FILLED", "Filled", "Continued smoothly from what was seen"),
    ("BLURRED", "Blurred", "What was hardly seen is blurred"),
    ("GRAY", "Gray", "The mean of what was seen, without a color"),
    ("COLOR", "Color", "A color that shows what nobody saw"),
]
#: Places among the sockets of a Mix node, which has one of each name for every kind of data.
MIX_FIRST, MIX_SECOND, MIX_RESULT = 6, 7, 2
#: Rows of the world's map for sampling; Blender's own choice is slow for large ones.
LARGEST_MAP = 8192


def load_image(path: Path, name: str, *, pack: bool = True) -> bpy.types.Image:
    """An image whose numbers are taken as they are, inside the .blend; Problem where it can't be read."""
    if old := bpy.data.images.get(name):
        bpy.data.images.remove(old)
    try:
        image = bpy.data.images.load(str(path))
    except RuntimeError:
        raise Problem(f"{path} can't be read. Import the prediction again") from None
    image.name, image.colorspace_settings.name = name, "Non-Color"
    if not image.size[0]:  # Reads the file.
        bpy.data.images.remove(image)
        raise Problem(f"{path} is no picture. Import the prediction again")
    if pack:
        image.pack()
    return image


def load_light(folder: Path) -> None:
    """Load the pictures that `light_nodes` shows."""
    for name in (FILLED, BLURRED, SEEN, CONFIDENCE):
        load_image(folder / name, image_name(name)).use_fake_user = True


def image_name(name: str) -> str:
    """Blender's name of a picture."""
    return f"{PREFIX} {name}"


def make_world(scene: bpy.types.Scene) -> bpy.types.World:
    """Give the scene a world of the loaded light, infinitely far."""
    world = bpy.data.worlds.get(PREFIX) or bpy.data.worlds.new(PREFIX)
    if world.node_tree is None:  # Before Blender 5.
        world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    color = light_nodes(world.node_tree, nodes.new("ShaderNodeTexCoord").outputs["Generated"])
    background = nodes.new("ShaderNodeBackground")
    background.name, background.location = STRENGTH, (-100, 0)
    links.new(color, background.inputs["Color"])
    links.new(background.outputs["Background"], nodes.new("ShaderNodeOutputWorld").inputs["Surface"])
    nodes["World Output"].location = (100, 0)
    world.cycles.sampling_method = "MANUAL"
    world.cycles.sample_map_resolution = min(bpy.data.images[image_name(FILLED)].size[0], LARGEST_MAP)
    scene.world = world
    return world


def light_nodes(tree: bpy.types.NodeTree, direction: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Nodes that look the light up in a direction; the color, before the strength."""

    def add(kind: str, name: str, x: int, y: int) -> bpy.types.Node:
        node = tree.nodes.new(kind)
        node.name, node.label, node.location = name, name, (x, y)
        return node

    direction.node.location = (-1100, 0)
    turn, mix = add("ShaderNodeMapping", "Rotation", -900, 0), add("ShaderNodeMix", "Unseen", -350, 0)
    turn.vector_type = "TEXTURE"  # Turns the light, not the directions in which it is looked up.
    tree.links.new(direction, turn.inputs["Vector"])
    for y, (label, name) in enumerate((("Light", FILLED), ("Seen", SEEN))):
        texture = add("ShaderNodeTexEnvironment", label, -700, -300 * y)
        texture.image, texture.interpolation = bpy.data.images[image_name(name)], "Linear"
        tree.links.new(turn.outputs["Vector"], texture.inputs["Vector"])
    mix.data_type = "RGBA"
    tree.links.new(tree.nodes["Light"].outputs["Color"], mix.inputs[MIX_SECOND])
    return mix.outputs[MIX_RESULT]


def mean_gray(light: bpy.types.Image, seen: bpy.types.Image) -> tuple[float, float, float]:
    """The mean of the light over seen directions, by solid angle, the same in all channels."""

    def pixels(image: bpy.types.Image) -> np.ndarray:
        flat = np.empty(len(image.pixels), np.float32)
        image.pixels.foreach_get(flat)
        return flat.reshape(image.size[1], image.size[0], -1)

    radiance, share = pixels(light)[..., :3].mean(-1), pixels(seen)[..., 0]
    rows, columns = radiance.shape
    share = share[np.arange(rows) * len(share) // rows][:, np.arange(columns) * share.shape[1] // columns]
    weight = share * np.sin(np.pi * (np.arange(rows) + 0.5) / rows)[:, None]
    gray = float((weight * radiance).sum() / max(weight.sum(), 1e-6))
    return gray, gray, gray


def update_light(scene: bpy.types.Scene) -> None:
    """Apply the settings of the scene to its world and to near walls, which show the same light."""
    settings, images = scene.panoless, bpy.data.images
    blurred, seen = (images.get(image_name(name)) for name in (BLURRED, SEEN))
    light = images.get(image_name(FILLED))
    if light is None or blurred is None or seen is None:
        return
    for owner in (bpy.data.worlds.get(PREFIX), bpy.data.materials.get(WALLS)):
        tree = owner and owner.node_tree
        if not tree or not {"Light", "Seen", "Unseen", "Rotation", STRENGTH} <= set(tree.nodes.keys()):
            continue  # None, or somebody else's by now.
        mix = tree.nodes["Unseen"]
        tree.nodes[STRENGTH].inputs["Strength"].default_value = settings.strength
        tree.nodes["Rotation"].inputs["Rotation"].default_value = (0, 0, settings.rotation)
        tree.nodes["Light"].image = blurred if settings.unseen == "BLURRED" else light
        for link in list(mix.inputs[0].links):
            tree.links.remove(link)
        mix.inputs[0].default_value = 1.0
        if settings.unseen in ("GRAY", "COLOR"):
            tree.links.new(tree.nodes["Seen"].outputs["Color"], mix.inputs[0])
            color = mean_gray(light, seen) if settings.unseen == "GRAY" else settings.unseen_color
            mix.inputs[MIX_FIRST].default_value = (*color, 1)
