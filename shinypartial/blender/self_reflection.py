"""Which pixels see the object in itself: a second scene, rendered beside the first at a fraction of its cost."""

from pathlib import Path
from typing import Any

from shinypartial.blender.materials import make_probe_material
from shinypartial.blender.objects import BODY, props_of
from shinypartial.blender.output import set_file, set_single_sample

PROBE = "probe"


def assemble_probe(bpy: Any) -> None:
    """Add a scene that shares meshes and camera with the open one, in the dark.

    There the object mirrors perfectly and shines with radiance 1 on reflected rays, as do the props: one sample
    through a pixel's center with one bounce is 1 where the mirror ray meets object or props, and 0 elsewhere. It
    goes through the same ray tracer and normals as the picture.
    """
    main = bpy.context.scene
    probe = bpy.data.scenes.new(PROBE)
    _set_sampling(main, probe)
    material = make_probe_material(bpy)
    for original in (main.objects[BODY], *props_of(main)):
        copy = bpy.data.objects.new(f"{PROBE} {original.name}", original.data)
        probe.collection.objects.link(copy)
        if not copy.material_slots:  # A prop of a user's file may have none.
            original.data.materials.append(None)
        for slot in copy.material_slots:
            slot.link = "OBJECT"
            slot.material = material
        copy.is_holdout = original.is_holdout
    probe.camera = main.camera


def render_probe(bpy: Any, path: Path) -> None:
    """Write the probe of the camera's present view; its red channel is the mask."""
    scene = bpy.data.scenes[PROBE]
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True, scene=PROBE)


def _set_sampling(main: Any, probe: Any) -> None:
    set_single_sample(probe, main, bounces=1)
    probe.render.resolution_x = main.render.resolution_x
    probe.render.resolution_y = main.render.resolution_y
    set_file(probe, bits=16)
