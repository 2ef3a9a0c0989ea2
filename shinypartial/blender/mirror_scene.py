"""A Blender file to open: a world of light from afar, and a mirror in it."""

import errno
from pathlib import Path

from shinypartial.blender.assemble import light_from_afar
from shinypartial.blender.materials import make_material
from shinypartial.blender.objects import BODY, mesh_of
from shinypartial.blender.runtime import import_blender, quiet
from shinypartial.core.mesh import Mesh
from shinypartial.io.files import atomic_write
from shinypartial.scene import Material, Render


def write_mirror_scene(
    path: Path, world: Path, surface: Mesh | None, reflectance: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> None:
    """Write a .blend whose world shows the lat-long EXR beside it, with the surface, if any, as a mirror.

    The world's texture needs no turn: Blender's map of directions is that of the conventions. Colors are shown without
    a view transform, so that the mirror looks as in the photographs. What is open in Blender is replaced. Raises
    InputError when Blender can't be loaded.
    """
    bpy = import_blender()
    with quiet():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        scene.render.engine = "CYCLES"
        # A mirror has no noise, so that a denoiser would only smear; and its light may exceed Blender's clamp.
        scene.cycles.use_denoising, scene.cycles.sample_clamp_indirect = False, 0
        scene.cycles.max_bounces = scene.cycles.glossy_bounces = Render().max_bounces  # Blender's 4 make vessels black.
        scene.view_settings.view_transform = "Standard"
        scene.world = bpy.data.worlds.new("world")
        image = light_from_afar(bpy, scene.world, world, 1.0)
        if surface is not None:
            mesh = mesh_of(bpy, BODY, surface)
            mesh.materials.append(make_material(bpy, Material(base_color=reflectance)))
            scene.collection.objects.link(bpy.data.objects.new(BODY, mesh))
        image.filepath = f"//{world.name}"  # Beside the .blend, so that both can be moved.
        bpy.context.preferences.filepaths.save_version = 0  # Else the empty temporary file is kept as a backup.
        with atomic_write(path) as temporary:
            try:
                bpy.ops.wm.save_as_mainfile(filepath=str(temporary.resolve()), relative_remap=False, compress=True)
            except RuntimeError as error:
                raise OSError(errno.ENOSPC, f"Blender could not save ({error})", str(path)) from None
