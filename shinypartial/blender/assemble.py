"""Build the Blender scene of a recipe; nothing is left to defaults that touch radiance."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.blender.cameras import add_camera
from shinypartial.blender.geometry import make_mesh
from shinypartial.blender.ground import add_ground
from shinypartial.blender.materials import environment_color, make_room_material
from shinypartial.blender.objects import mesh_of, place_objects
from shinypartial.blender.output import add_passes, set_file
from shinypartial.blender.runtime import choose_device, studio_light
from shinypartial.blender.self_reflection import assemble_probe
from shinypartial.io.images import read_light
from shinypartial.scene import FileWorld, Render, Room, SceneSpec, Sphere, StudioWorld

ROOM = "room"


def assemble(bpy: Any, spec: SceneSpec) -> str:
    """Replace whatever is open by the scene of the recipe; return the device that will render it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    device = choose_device(bpy)
    _set_sampling(scene, spec.render)
    _set_output(scene, spec.render)
    place_objects(bpy, scene, spec)
    _surround(bpy, scene, spec)
    if spec.ground:
        add_ground(bpy, scene, spec.ground, spec.render.exposure)
    add_camera(bpy, scene, spec)
    assemble_probe(bpy)
    return device


def world_file(world: StudioWorld | FileWorld) -> Path:
    """The EXR file of a recipe's world."""
    return Path(world.path) if isinstance(world, FileWorld) else studio_light(world.name)


def world_radiance(world: StudioWorld | FileWorld, exposure: float = 0.0) -> Float[np.ndarray, "H W 3"]:
    """The lat-long map that lights the scene: the file times the strength times 2^exposure, in the world frame."""
    return read_light(world_file(world)) * np.float32(world.strength * 2.0**exposure)


def _set_sampling(scene: Any, render: Render) -> None:
    """Unbiased path tracing: no denoiser, no clamping, no adaptive sampling, and a pixel is its area average."""
    cycles = scene.cycles
    cycles.samples, cycles.seed = render.samples, render.seed
    cycles.use_animated_seed = cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.time_limit = 0
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    cycles.light_sampling_threshold = cycles.blur_glossy = 0
    cycles.caustics_reflective = True
    cycles.max_bounces = cycles.glossy_bounces = cycles.diffuse_bounces = render.max_bounces
    cycles.pixel_filter_type = "BOX"
    cycles.filter_width = 1.0
    cycles.film_exposure = 1.0
    scene.render.film_transparent = True
    scene.render.use_persistent_data = True
    scene.render.dither_intensity = 0


def _set_output(scene: Any, render: Render) -> None:
    """Square image, and linear passes in one file."""
    scene.display_settings.display_device = "sRGB"
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x = scene.render.resolution_y = render.resolution
    scene.render.resolution_percentage = 100
    scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1
    set_file(scene)
    add_passes(scene)


def _surround(bpy: Any, scene: Any, spec: SceneSpec) -> None:
    """Light from infinitely far, or from the walls of a room that cameras see through."""
    scene.world = bpy.data.worlds.new("world")
    if spec.room is None:
        light_from_afar(bpy, scene.world, world_file(spec.world), spec.light_factor)
        return
    image = _radiance_image(bpy, world_file(spec.world))
    _background(scene.world, spec.light_factor).inputs["Color"].default_value = (0, 0, 0, 1)
    mesh = _room_mesh(bpy, spec.room)
    mesh.materials.append(make_room_material(bpy, image, spec.light_factor))
    room = bpy.data.objects.new(ROOM, mesh)
    room.visible_camera = False
    scene.collection.objects.link(room)


def light_from_afar(bpy: Any, world: Any, path: Path, strength: float) -> Any:
    """Make a world infinitely far that shows a lat-long file times the strength; return the image."""
    image, background = _radiance_image(bpy, path), _background(world, strength)
    nodes, links = world.node_tree.nodes, world.node_tree.links
    links.new(environment_color(nodes, links, image), background.inputs["Color"])
    # Light is sampled by a map as fine as the image; the automatic choice costs a second and gains nothing.
    world.cycles.sampling_method = "MANUAL"
    world.cycles.sample_map_resolution = min(image.size[0], 8192)
    return image


def _radiance_image(bpy: Any, path: Path) -> Any:
    image = bpy.data.images.load(str(path.resolve()))
    image.colorspace_settings.name = "Non-Color"  # The numbers in the file are the radiance.
    return image


def _background(world: Any, strength: float) -> Any:
    """The only shader of a world, linked to its output."""
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    background, output = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
    background.inputs["Strength"].default_value = strength
    links.new(background.outputs["Background"], output.inputs["Surface"])
    return background


def _room_mesh(bpy: Any, room: Room) -> Any:
    if room.shape == "sphere":
        return mesh_of(bpy, "room", make_mesh(Sphere(radius=room.distance)))
    mesh = bpy.data.meshes.new("room")
    corners = np.array(list(product((-1, 1), repeat=3))) * room.half_sizes
    walls = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    mesh.from_pydata(corners.tolist(), [], walls)
    return mesh
