"""What every scene that is rendered here has in common: its engine and the file that its passes go to."""

from typing import Any

from shinypartial.blender.materials import DEPTH_PASS

#: The narrowest filter that Cycles has: the ray goes through the pixel's center.
CENTER_FILTER_WIDTH = 0.01


def set_file(scene: Any, bits: int = 32) -> None:
    """Linear passes in one uncompressed EXR of float (32) or half precision (16); no view transform touches those."""
    scene.render.use_compositing = scene.render.use_sequencer = False
    image = scene.render.image_settings
    image.media_type = "MULTI_LAYER_IMAGE"  # Must come first: it decides which formats are allowed.
    image.file_format = "OPEN_EXR_MULTILAYER"
    image.color_depth, image.exr_codec = str(bits), "NONE"


def add_passes(scene: Any) -> None:
    """Normals and the depth that materials give out; Blender's own depth, a random sample's, is left out."""
    layer = scene.view_layers[0]
    layer.use_pass_normal, layer.use_pass_z = True, False
    depth = layer.aovs.add()
    depth.name, depth.type = DEPTH_PASS, "VALUE"


def set_single_sample(scene: Any, main: Any, bounces: int) -> None:
    """One sample through the center of each pixel, on the device of the main scene."""
    cycles = scene.cycles
    scene.render.engine, cycles.device = main.render.engine, main.cycles.device
    cycles.samples, cycles.seed = 1, main.cycles.seed
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0
    cycles.light_sampling_threshold = 0
    cycles.max_bounces = cycles.glossy_bounces = bounces
    cycles.diffuse_bounces = 0
    cycles.pixel_filter_type, cycles.filter_width = "BOX", CENTER_FILTER_WIDTH
    scene.render.film_transparent = True
    scene.render.use_persistent_data = True
    scene.render.resolution_percentage = 100
