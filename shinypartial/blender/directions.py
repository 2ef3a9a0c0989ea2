"""Where light leaves a perfect mirror to: paths through a grid of points in every pixel, traced by Cycles itself.

A perfect mirror's path has no chance in it, so one sample through the center of a sub-pixel determines all about that
path. A scene beside the main one shares its meshes and materials; its world shines with the number of bounces and the
direction in place of light, and everything that is no perfect mirror shines with a mark.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from shinypartial.blender.materials import add_depth_pass, is_perfect_mirror, make_mark_material
from shinypartial.blender.objects import BODY, parts_of, props_of
from shinypartial.blender.output import add_passes, set_file, set_single_sample
from shinypartial.blender.passes import (
    ALPHA_CHANNEL,
    COLOR_CHANNELS,
    DEPTH_CHANNEL,
    NORMAL_CHANNELS,
    PASSES,
    read_passes,
    stacked,
)
from shinypartial.blender.region import Region, set_border
from shinypartial.core.camera import Camera
from shinypartial.scene import BlendFile, SceneSpec

DIRECTIONS = "directions"
#: Points per pixel and axis; odd, so that one is the pixel's center.
GRID = 3
#: Share of the object's area that must mirror perfectly; below, the paths would be traced for little.
LEAST_MIRROR_SHARE = 0.5
#: The world's color is BOUNCE_STEP · bounces + ½ + direction/2: no two numbers of bounces overlap.
BOUNCE_STEP = 4
#: Radiance of what is no perfect mirror, above every color of the world.
MARK = 100.0
LEAST_MARKED = 0.9 * MARK
MISSED, LOST, MARKED = 0, -1, -2


@dataclass(frozen=True)
class MirrorPaths:
    """One path through each point of the grid, within a region of the image.

    `bounces` counts the reflections before the path leaves to `directions_world`; it is MISSED where the object isn't
    seen, LOST where no light arrives at all, and MARKED where the path meets something that is no perfect mirror;
    directions are zero in these three cases. `meets_scene` is whether the first mirror ray meets object or props.
    """

    bounces: Int[np.ndarray, "h w"]
    directions_world: Float[np.ndarray, "h w 3"]
    normals_world: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    meets_scene: Bool[np.ndarray, "h w"]


def mirrors_enough(bpy: Any, spec: SceneSpec) -> bool:
    """Whether the object is mostly a perfect mirror of a far world for a pinhole, so that paths are worth tracing."""
    if isinstance(spec.object, BlendFile) or not spec.mirrors_directions:
        return False
    if BOUNCE_STEP * (spec.render.max_bounces + 1) > LEAST_MARKED:  # Their numbers would be taken for marks.
        return False
    mesh = bpy.context.scene.objects[BODY].data
    area, number = np.empty(len(mesh.polygons), np.float32), np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("area", area)
    mesh.polygons.foreach_get("material_index", number)
    perfect = np.array([is_perfect_mirror(part.material or spec.material) for part in parts_of(spec)])
    return bool(area[perfect[number]].sum() >= LEAST_MIRROR_SHARE * area.sum())


def assemble_directions(bpy: Any, spec: SceneSpec) -> None:
    """Add the scene to the open one; at most as many reflections are followed as there."""
    main = bpy.context.scene
    scene = bpy.data.scenes.new(DIRECTIONS)
    set_single_sample(scene, main, spec.render.max_bounces)
    set_file(scene)
    add_passes(scene)
    mark = make_mark_material(bpy, MARK)
    add_depth_pass(mark)
    materials = [part.material or spec.material for part in parts_of(spec)]
    for original in (main.objects[BODY], *props_of(main)):
        copy = bpy.data.objects.new(f"{DIRECTIONS} {original.name}", original.data)
        scene.collection.objects.link(copy)
        copy.is_holdout = original.is_holdout
        known = materials if original.name == BODY else [None] * len(copy.material_slots)
        for slot, material in zip(copy.material_slots, known, strict=True):
            if not is_perfect_mirror(material):
                slot.link = "OBJECT"
                slot.material = mark
    scene.world = _direction_world(bpy)
    scene.camera = main.camera


def render_directions(bpy: Any, path: Path, region: Region, camera: Camera) -> MirrorPaths:
    """Trace the paths of the camera's present view; arrays are GRID times as large as the region."""
    scene = bpy.data.scenes[DIRECTIONS]
    scene.render.resolution_x, scene.render.resolution_y = GRID * camera.width, GRID * camera.height
    set_border(scene, region, camera)
    scene.render.use_crop_to_border = True
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True, scene=DIRECTIONS)
    passes = read_passes(path, PASSES)
    hit = passes[ALPHA_CHANNEL] > 0.5
    color = stacked(passes, COLOR_CHANNELS)
    bounces, marked = _bounces(color[..., 0])
    # Behind a mark that the camera sees, the color of the mirror ray is added to it.
    first = np.where(marked, color[..., 0] - MARK, color[..., 0])
    bounces = np.where(hit, np.where(marked, MARKED, bounces), MISSED)
    code = color - (BOUNCE_STEP * np.maximum(bounces, 0)[..., None] + np.float32(0.5))
    return MirrorPaths(
        bounces,
        np.where((bounces > 0)[..., None], 2 * code, 0).astype(np.float32),
        stacked(passes, NORMAL_CHANNELS),
        passes[DEPTH_CHANNEL],
        hit & (_bounces(first)[0] != 1),
    )


def _bounces(color: Float[np.ndarray, "h w"]) -> tuple[Int[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Their number, or LOST, by one channel of the world's color; and where that is a mark's."""
    number = np.floor_divide(color + np.float32(1e-3), BOUNCE_STEP).astype(np.int32)
    return np.where(number == 0, LOST, number), color > LEAST_MARKED


def _direction_world(bpy: Any) -> Any:
    """Light that determines its direction and how many reflections led to it."""
    world = bpy.data.worlds.new(DIRECTIONS)
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    bounces, direction = nodes.new("ShaderNodeMath"), nodes.new("ShaderNodeVectorMath")
    bounces.operation = direction.operation = "MULTIPLY_ADD"
    # At the world, the depth of the path is one more than its reflections.
    links.new(nodes.new("ShaderNodeLightPath").outputs["Ray Depth"], bounces.inputs[0])
    bounces.inputs[1].default_value, bounces.inputs[2].default_value = BOUNCE_STEP, 0.5 - BOUNCE_STEP
    links.new(nodes.new("ShaderNodeTexCoord").outputs["Generated"], direction.inputs[0])
    direction.inputs[1].default_value = (0.5, 0.5, 0.5)
    links.new(bounces.outputs["Value"], direction.inputs[2])
    background = nodes.new("ShaderNodeBackground")
    links.new(direction.outputs["Vector"], background.inputs["Color"])
    links.new(background.outputs["Background"], nodes.new("ShaderNodeOutputWorld").inputs["Surface"])
    world.cycles.sampling_method = "NONE"
    return world
