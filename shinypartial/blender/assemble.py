"""Build the Blender scene of a recipe; nothing is left to defaults that touch radiance."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.blender.geometry import make_mesh
from shinypartial.blender.runtime import choose_device, studio_light
from shinypartial.errors import InputError
from shinypartial.images import read_exr_rgb
from shinypartial.scene import FileWorld, Material, Render, SceneSpec, StudioWorld
from shinypartial.trajectory import Arc

DEPTH_PASS = "z_depth"
BOUNCES = 16
LOWEST_RADIANCE = -1e-3


def assemble(bpy: Any, spec: SceneSpec) -> str:
    """Replace whatever is open by the scene of the recipe; return the device that will render it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    device = choose_device(bpy)
    _set_sampling(scene, spec.render)
    _set_output(scene, spec.render)
    scene.world = _make_world(bpy, spec.world)
    body = bpy.data.objects.new("object", _make_mesh(bpy, spec))
    scene.collection.objects.link(body)
    scene.camera = _make_camera(bpy, spec.camera)
    scene.collection.objects.link(scene.camera)
    return device


def world_file(world: StudioWorld | FileWorld) -> Path:
    """The EXR file of a recipe's world."""
    return Path(world.path) if isinstance(world, FileWorld) else studio_light(world.name)


def world_radiance(world: StudioWorld | FileWorld) -> Float[np.ndarray, "H W 3"]:
    """The lat-long map that lights the scene: the file times the strength, in the world frame.

    Lossy compression leaves values a hair below zero in Blender's own maps; they become zero.
    """
    path = world_file(world)
    radiance = read_exr_rgb(path)
    height, width = radiance.shape[:2]
    if width != 2 * height or not np.isfinite(radiance).all() or radiance.min() < LOWEST_RADIANCE:
        raise InputError(
            expected=f"a finite lat-long map ≥ 0, twice as wide as high, in {path}",
            found=f"{width}×{height}, lowest value {radiance.min():.4g}, highest {radiance.max():.4g}",
            remedy="Use another world, or export this one as a 2:1 map without NaN, infinity or negative values.",
        )
    return np.maximum(radiance, 0) * np.float32(world.strength)


def _set_sampling(scene: Any, render: Render) -> None:
    """Unbiased path tracing: no denoiser, no clamping, no adaptive sampling, and a pixel is its area average."""
    cycles = scene.cycles
    cycles.samples, cycles.seed = render.samples, render.seed
    cycles.use_animated_seed = cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.time_limit = 0
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    cycles.light_sampling_threshold = cycles.blur_glossy = 0
    cycles.caustics_reflective = True
    cycles.max_bounces = cycles.glossy_bounces = cycles.diffuse_bounces = BOUNCES
    cycles.pixel_filter_type = "BOX"
    cycles.filter_width = 1.0
    cycles.film_exposure = 1.0
    scene.render.film_transparent = True
    scene.render.use_persistent_data = True
    scene.render.dither_intensity = 0


def _set_output(scene: Any, render: Render) -> None:
    """Square image and linear passes in one uncompressed float EXR; the view transform doesn't touch those."""
    scene.display_settings.display_device = "sRGB"
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x = scene.render.resolution_y = render.resolution
    scene.render.resolution_percentage = 100
    scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1
    scene.render.use_compositing = scene.render.use_sequencer = False
    image = scene.render.image_settings
    image.media_type = "MULTI_LAYER_IMAGE"  # Must come first: it decides which formats are allowed.
    image.file_format = "OPEN_EXR_MULTILAYER"
    image.color_depth, image.exr_codec = "32", "NONE"
    layer = scene.view_layers[0]
    layer.use_pass_normal = True
    depth = layer.aovs.add()
    depth.name, depth.type = DEPTH_PASS, "VALUE"


def _make_world(bpy: Any, spec: StudioWorld | FileWorld) -> Any:
    world = bpy.data.worlds.new("world")
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    texture = nodes.new("ShaderNodeTexEnvironment")
    texture.image = bpy.data.images.load(str(world_file(spec).resolve()))
    texture.image.colorspace_settings.name = "Non-Color"  # The numbers in the file are the radiance.
    texture.projection, texture.interpolation = "EQUIRECTANGULAR", "Linear"
    # Light is sampled by a map as fine as the image; the automatic choice costs a second and gains nothing.
    world.cycles.sampling_method = "MANUAL"
    world.cycles.sample_map_resolution = min(texture.image.size[0], 8192)
    background = nodes.new("ShaderNodeBackground")
    background.inputs["Strength"].default_value = spec.strength
    output = nodes.new("ShaderNodeOutputWorld")
    links.new(texture.outputs["Color"], background.inputs["Color"])
    links.new(background.outputs["Background"], output.inputs["Surface"])
    return world


def _make_mesh(bpy: Any, spec: SceneSpec) -> Any:
    """The shape with its exact vertex normals, interpolated across faces, and its material."""
    shape = make_mesh(spec.object)
    mesh = bpy.data.meshes.new("object")
    mesh.from_pydata(shape.vertices.tolist(), [], shape.faces)
    mesh.shade_smooth()
    # The attribute holds float normals; normals_split_custom_set would round them to 16 bits.
    attribute = mesh.attributes.new("custom_normal", "FLOAT_VECTOR", "POINT")
    attribute.data.foreach_set("vector", shape.normals.astype(np.float32).ravel())
    mesh.materials.append(_make_material(bpy, spec.material))
    return mesh


def _make_material(bpy: Any, spec: Material) -> Any:
    """The Principled shader, and the z-depth of every sample as a pass.

    Blender's own depth pass keeps one random sample of each pixel, which may miss the object; this pass is averaged
    over the pixel as color is.
    """
    material = bpy.data.materials.new("material")
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    shader = nodes.new("ShaderNodeBsdfPrincipled")
    shader.inputs["Base Color"].default_value = (*spec.base_color, 1)
    shader.inputs["Metallic"].default_value = spec.metallic
    shader.inputs["Roughness"].default_value = spec.roughness
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(shader.outputs["BSDF"], output.inputs["Surface"])
    depth = nodes.new("ShaderNodeOutputAOV")
    depth.aov_name = DEPTH_PASS
    links.new(nodes.new("ShaderNodeCameraData").outputs["View Z Depth"], depth.inputs["Value"])
    return material


def _make_camera(bpy: Any, spec: Arc) -> Any:
    camera = bpy.data.cameras.new("camera")
    camera.type, camera.sensor_fit = "PERSP", "HORIZONTAL"
    camera.lens, camera.sensor_width = spec.lens_mm, spec.sensor_mm
    camera.clip_start, camera.clip_end = 1e-3 * spec.radius, 1e3 * spec.radius
    camera.dof.use_dof = False
    return bpy.data.objects.new("camera", camera)
