"""The part of the image where the object can appear; Cycles leaves the rest out and every pixel inside as it was."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import Camera, project

#: Pixels kept around the projected vertices.
MARGIN_PX = 2
#: Added to borders, so that rounding errors don't cost a pixel.
TRUNCATED_PX = 0.1
SMALLEST_DEPTH = 1e-6


@dataclass(frozen=True)
class Region:
    """Whole pixels from (left, top) up to but without (right, bottom)."""

    left: int
    top: int
    right: int
    bottom: int


def image_region(camera: Camera, vertices_world: Float[np.ndarray, "P 3"]) -> Region:
    """The smallest region with a margin that holds every projected vertex, so everything that they span.

    The whole image where a vertex lies beside or behind the camera. Where nothing is seen, the pixels nearest to it.
    """
    whole = Region(0, 0, camera.width, camera.height)
    if not len(vertices_world):
        return whole
    pixels = project(camera, vertices_world)
    if pixels[:, 2].min() < SMALLEST_DEPTH:
        return whole
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels[:, :2].min(0)) - MARGIN_PX, 0, size - 1).astype(int)
    high = np.clip(np.ceil(pixels[:, :2].max(0)) + MARGIN_PX, low + 1, size).astype(int)
    return Region(*low.tolist(), *high.tolist())


def set_border(scene: Any, region: Region, camera: Camera) -> None:
    """Let Blender render that region alone; the image keeps its size and is zero outside."""
    render = scene.render
    render.use_border, render.use_crop_to_border = True, False
    # Blender truncates to whole pixels, from the bottom.
    render.border_min_x, render.border_max_x = ((x + TRUNCATED_PX) / camera.width for x in (region.left, region.right))
    low, high = camera.height - region.bottom, camera.height - region.top
    render.border_min_y, render.border_max_y = ((y + TRUNCATED_PX) / camera.height for y in (low, high))


def world_vertices(bpy: Any, body: Any) -> Float[np.ndarray, "P 3"]:
    """Vertices of an object as it is rendered, with its modifiers; none where it is no surface."""
    evaluated = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
    try:
        mesh = evaluated.to_mesh()
    except RuntimeError:
        return np.zeros((0, 3))
    local = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", local)
    evaluated.to_mesh_clear()
    matrix = np.array(evaluated.matrix_world, dtype=np.float64)
    return local.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
