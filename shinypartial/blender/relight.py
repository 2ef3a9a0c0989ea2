"""An object of somebody else under several lights, seen by one camera: linear pictures with alpha."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.blender.assemble import light_from_afar
from shinypartial.blender.geometry import make_part
from shinypartial.blender.materials import make_material
from shinypartial.blender.objects import mesh_of
from shinypartial.blender.runtime import choose_device, import_blender, quiet, set_threads
from shinypartial.core.camera import front_view, look_at, opencv_to_opengl
from shinypartial.core.errors import InputError
from shinypartial.io.images import read_exr, stack_channels
from shinypartial.io.records import Count
from shinypartial.scene import Material, Part, Sphere

#: Field of view of the camera of an object that has none.
VIEW_DEG = 35.0
#: Of the default object: a mirror, a rough metal and a white matte ball side by side.
BALLS = (
    (-1.1, Material(roughness=0.0)),
    (0.0, Material(roughness=0.35, base_color=(1.0, 0.8, 0.5))),
    (1.1, Material(metallic=0.0, roughness=1.0, base_color=(0.8, 0.8, 0.8))),
)


@dataclass(frozen=True)
class PictureOptions:
    """How pictures are rendered."""

    resolution: Count = 512
    """Pixels along the width."""
    samples: Count = 64
    """Paths a pixel."""
    threads: int | None = None
    """Of the CPU; all cores where it is not given."""


def render_in_lights(
    source: Path | None, lights: Mapping[str, Path | None], options: PictureOptions = PictureOptions()
) -> dict[str, Float[np.ndarray, "H W 4"]]:
    """Linear premultiplied RGBA under each lat-long EXR; under the file's own lights where that is None.

    `source` is a .blend, .glb or .gltf; three balls where it is None. Its own camera is taken where it has one. Under
    a map, lights and world of the file are left out. What is open in Blender is replaced. Raises InputError
    for a file that can't be read and for one without a surface.
    """
    bpy, pictures = import_blender(), {}
    with tempfile.TemporaryDirectory(prefix="shinypartial-") as scratch:
        for name, light in lights.items():
            with quiet():
                _open(bpy, source)
                scene = bpy.context.scene
                scene.render.engine = "CYCLES"
                _frame(bpy, scene)
                _sample(bpy, scene, options)
                if light is not None:
                    _light_only_from(bpy, scene, light)
                path = Path(scratch) / "picture.exr"
                scene.render.filepath = str(path)
                bpy.ops.render.render(write_still=True)
            pictures[name] = stack_channels(read_exr(path), ("R", "G", "B", "A"), path).astype(np.float32)
    return pictures


def _open(bpy: Any, source: Path | None) -> None:
    """Replace what is open by the file, or by the default object."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if source is None:
        _add_balls(bpy)
        return
    try:
        if source.suffix == ".blend":
            bpy.ops.wm.open_mainfile(filepath=str(source.resolve()))
        else:
            bpy.ops.import_scene.gltf(filepath=str(source.resolve()))
    except (RuntimeError, OSError) as error:
        raise InputError(
            expected=f"a .blend, .glb or .gltf at {source}",
            found=" ".join(str(error).split()),
            remedy="Save it again, or export it as .glb.",
        ) from None


def _add_balls(bpy: Any) -> None:
    for place, material in BALLS:
        mesh = mesh_of(bpy, "ball", make_part(Part(Sphere(radius=0.5, segments=64, rings=32))))
        mesh.materials.append(make_material(bpy, material))
        ball = bpy.data.objects.new("ball", mesh)
        ball.location = (place, 0.0, 0.0)
        bpy.context.scene.collection.objects.link(ball)


def _frame(bpy: Any, scene: Any) -> None:
    """A camera that sees all surfaces, unless the file has one."""
    bpy.context.view_layer.update()
    surfaces = [each for each in scene.objects if each.type == "MESH" and not each.hide_render and len(each.bound_box)]
    if not surfaces:
        raise InputError(
            expected="an object with a surface to relight",
            found="none that is rendered",
            remedy="Name another --object.",
        )
    if scene.camera is not None:
        return
    corners = np.concatenate(
        [
            np.array(each.bound_box) @ np.array(each.matrix_world)[:3, :3].T + np.array(each.matrix_world)[:3, 3]
            for each in surfaces
        ]
    )
    position, target = front_view(corners.min(0), corners.max(0), VIEW_DEG)
    distance = float(np.linalg.norm(position - target))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.angle = np.radians(VIEW_DEG)
    camera.data.clip_start, camera.data.clip_end = 1e-3 * distance, 1e2 * distance
    camera.matrix_world = opencv_to_opengl(look_at(position, target)).T.tolist()
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.resolution_x = scene.render.resolution_y = 1024


def _sample(bpy: Any, scene: Any, options: PictureOptions) -> None:
    """Unbiased, with the shape of the file's picture."""
    choose_device(bpy)
    set_threads(bpy, options.threads)
    cycles, render = scene.cycles, scene.render
    cycles.samples, cycles.seed = options.samples, 0
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    render.resolution_y = max(round(render.resolution_y * options.resolution / render.resolution_x), 1)
    render.resolution_x, render.resolution_percentage = options.resolution, 100
    render.film_transparent = True
    render.use_compositing = render.use_sequencer = False
    render.image_settings.media_type = "IMAGE"
    render.image_settings.file_format, render.image_settings.color_mode = "OPEN_EXR", "RGBA"
    render.image_settings.color_depth, render.image_settings.exr_codec = "32", "ZIP"


def _light_only_from(bpy: Any, scene: Any, light: Path) -> None:
    for each in [each for each in bpy.data.objects if each.type == "LIGHT"]:
        bpy.data.objects.remove(each)
    scene.world = bpy.data.worlds.new("recovered")
    light_from_afar(bpy, scene.world, light, 1.0)
