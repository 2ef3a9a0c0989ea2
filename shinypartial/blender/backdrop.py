"""What stands around the object as the camera sees it: walls, ground and props, without the object."""

from pathlib import Path
from typing import Any

from shinypartial.blender.assemble import ROOM
from shinypartial.blender.ground import grounds
from shinypartial.blender.objects import BODY, props_of


def show_backdrop(bpy: Any, shown: bool) -> None:
    """Let the camera see everything but the object, or the object alone as pictures of the benchmark have it.

    Reflections stay as they are.
    """
    scene = bpy.context.scene
    if scene.render.film_transparent is not shown:
        return
    scene.render.film_transparent = not shown
    scene.objects[BODY].visible_camera = not shown
    for each in props_of(scene):
        each.is_holdout = not shown
    for each in (*grounds(bpy), *(each for each in scene.objects if each.name == ROOM)):
        each.visible_camera = shown


def set_size(bpy: Any, width: int, height: int) -> None:
    """Of the pictures of every scene, in pixels."""
    for scene in bpy.data.scenes:
        scene.render.resolution_x, scene.render.resolution_y = width, height


def render_backdrop(bpy: Any, path: Path) -> None:
    """Write the picture of the camera's present view."""
    scene = bpy.context.scene
    scene.render.use_border = False
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
