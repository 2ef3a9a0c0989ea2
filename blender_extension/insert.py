# SPDX-License-Identifier: GPL-3.0-or-later
"""An object of one's own beside the mirror: where it stands, which photograph it is seen in, how that is composed."""

import bpy
from mathutils import Matrix, Vector

from .build import ground_of, mirror_of, object_sphere, photograph_cameras, show_photograph
from .light import MIX_FIRST, MIX_RESULT, MIX_SECOND

NODES = "PanoLess over the photograph"


def stand_on_ground(scene: bpy.types.Scene, each: bpy.types.Object) -> None:
    """Move an object along the ground's normal until its lowest corner touches the ground."""
    ground = ground_of(scene)
    if ground is None:
        return
    up, point = ground.matrix_world.to_3x3() @ Vector((0, 0, 1)), ground.matrix_world.translation
    lowest = min((each.matrix_world @ Vector(corner) - point).dot(up) for corner in each.bound_box)
    each.matrix_world = Matrix.Translation(-lowest * up) @ each.matrix_world


def step_aside(scene: bpy.types.Scene, each: bpy.types.Object) -> None:
    """Where an object stands within the mirror, move it to the right of the picture until it stands beside."""
    mirror = mirror_of(scene)
    if mirror is None or scene.camera is None:
        return
    (center, radius), (place, size) = object_sphere(mirror), object_sphere(each)
    right = (scene.camera.matrix_world.to_3x3() @ Vector((1, 0, 0))).normalized()
    if (place - center).length < radius + size:
        along = (place - center).dot(right)
        each.matrix_world = Matrix.Translation((radius + size - along) * right) @ each.matrix_world


def nearest_photograph(scene: bpy.types.Scene, view: Matrix | None) -> bpy.types.Object | None:
    """The photograph whose camera looks most like a viewport (its camera-to-world matrix); the present one where no
    viewport is given.
    """
    cameras = photograph_cameras(scene)
    if not cameras or (view is None and scene.camera in cameras):
        return scene.camera if cameras else None
    if view is None:
        return cameras[len(cameras) // 2]
    forward = view.to_3x3() @ Vector((0, 0, -1))
    return max(cameras, key=lambda each: (each.matrix_world.to_3x3() @ Vector((0, 0, -1))).dot(forward))


def over_photograph(scene: bpy.types.Scene, camera: bpy.types.Object) -> bool:
    """Look through a photograph's camera and compose renders over it; False where its picture is missing."""
    show_photograph(scene, camera)
    behind = camera.data.background_images
    image = behind[0].image if behind else None
    if image is None or not image.size[0]:
        return False
    scene.render.use_compositing = True
    # What the ground loses and gains by what is inserted, as factors; renders then are of inserted objects only.
    scene.view_layers[0].cycles.use_pass_shadow_catcher = True
    tree = _empty_tree(scene)
    picture, layers = tree.nodes.new("CompositorNodeImage"), tree.nodes.new("CompositorNodeRLayers")
    scale, over = tree.nodes.new("CompositorNodeScale"), tree.nodes.new("CompositorNodeAlphaOver")
    picture.image, layers.scene = image, scene
    if "Type" in scale.inputs:  # From Blender 5 on, choices are sockets.
        scale.inputs["Type"].default_value, scale.inputs["Frame Type"].default_value = "Render Size", "Stretch"
    else:
        scale.space, scale.frame_method = "RENDER_SIZE", "STRETCH"
    tree.links.new(picture.outputs["Image"], scale.inputs["Image"])
    first, second, product = _product(tree)
    colors = [each for each in over.inputs if each.type == "RGBA"]
    back = next((each for each in colors if each.name == "Background"), colors[0])
    front = next(each for each in colors if each != back)
    tree.links.new(scale.outputs["Image"], first)
    tree.links.new(layers.outputs["Shadow Catcher"], second)
    tree.links.new(product, back)
    tree.links.new(layers.outputs["Image"], front)
    tree.links.new(over.outputs["Image"], _output(tree))
    return True


def _empty_tree(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """The compositor's nodes, without any: before Blender 5 those of the scene, from 5.3 on those of an effect."""
    if hasattr(scene, "compositor_effects"):
        effect = scene.compositor_effects.get(NODES) or scene.compositor_effects.new(name=NODES)
        effect.node_group = _fresh_group()
        return effect.node_group
    if hasattr(scene, "compositing_node_group"):
        scene.compositing_node_group = _fresh_group()
        return scene.compositing_node_group
    scene.use_nodes = True
    scene.node_tree.nodes.clear()
    return scene.node_tree


def _fresh_group() -> bpy.types.NodeTree:
    """A group of the compositor, without nodes."""
    if old := bpy.data.node_groups.get(NODES):
        bpy.data.node_groups.remove(old)
    return bpy.data.node_groups.new(NODES, "CompositorNodeTree")


def _product(tree: bpy.types.NodeTree) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket, bpy.types.NodeSocket]:
    """Two colors and their product."""
    if hasattr(bpy.types, "CompositorNodeMixRGB"):
        node = tree.nodes.new("CompositorNodeMixRGB")
        inputs, result = list(node.inputs), node.outputs[0]
    else:
        node = tree.nodes.new("ShaderNodeMix")
        node.data_type = "RGBA"
        inputs = [node.inputs[place] for place in (0, MIX_FIRST, MIX_SECOND)]
        result = node.outputs[MIX_RESULT]
    node.blend_type, inputs[0].default_value = "MULTIPLY", 1
    return inputs[1], inputs[2], result


def _output(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    if hasattr(bpy.types, "CompositorNodeComposite"):
        return tree.nodes.new("CompositorNodeComposite").inputs["Image"]
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    return tree.nodes.new("NodeGroupOutput").inputs["Image"]
