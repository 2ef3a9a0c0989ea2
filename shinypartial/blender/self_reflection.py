"""Which pixels see the object in itself: a second scene, rendered beside the first at a fraction of its cost."""

from pathlib import Path
from typing import Any

from shinypartial.blender.cameras import operators
from shinypartial.blender.materials import make_probe_material
from shinypartial.blender.objects import BODY, props_of
from shinypartial.blender.output import set_file, set_single_sample

PROBE = "probe"


def assemble_probe(bpy: Any) -> None:
    """Add a scene that shares meshes and camera with the open one, in the dark.

    There the object mirrors perfectly and shines with radiance 1 on reflected rays, as do props and operator: one
    sample through a pixel's center with one bounce is 1 where the mirror ray meets one of them, and 0 elsewhere. It
    goes through the same ray tracer and normals as the picture.
    """
    main = bpy.context.scene
    probe = bpy.data.scenes.new(PROBE)
    _set_sampling(main, probe)
    material = make_probe_material(bpy)
    for original in (main.objects[BODY], *props_of(main), *operators(bpy)):
        copy = bpy.data.objects.new(f"{PROBE} {original.name}", original.data)
        probe.collection.objects.link(copy)
        if not copy.material_slots:  # A prop of a user's file may have none.
            original.data.materials.append(None)
        for slot in copy.material_slots:
            slot.link = "OBJECT"
            slot.material = material
        copy.is_holdout, copy.visible_camera = original.is_holdout, original.visible_camera
        copy.parent = original.parent
    probe.camera = main.camera


def render_probe(bpy: Any, path: Path) -> None:
    """Write the probe of the camera's present view, as a pinhole sees it; its red channel is the mask."""
    scene = bpy.data.scenes[PROBE]
    scene.render.filepath = str(path)
    lens = scene.camera.data.dof
    had_aperture, lens.use_dof = lens.use_dof, False
    bpy.ops.render.render(write_still=True, scene=PROBE)
    lens.use_dof = had_aperture


def _set_sampling(main: Any, probe: Any) -> None:
    set_single_sample(probe, main, bounces=1)
    probe.render.resolution_x = main.render.resolution_x
    probe.render.resolution_y = main.render.resolution_y
    set_file(probe, bits=16)
