"""The sheet below the object and the board on it, as light that reflections show."""

from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.blender.materials import image_of, make_printed_material
from shinypartial.scene import Ground

GROUND = "ground"
#: How far a sheet lies below the board on it, as a share of its side: no ray meets both at once.
SHEET_BELOW = 2e-4


def add_ground(bpy: Any, scene: Any, ground: Ground, exposure: float) -> None:
    """Link the sheet and, where there is one, the board; cameras see through both."""
    height = ground.height
    if ground.printed is not None:
        _add(bpy, scene, "board", ground.print_texture(), ground.printed.size_m, height, exposure, exact=True)
        height -= SHEET_BELOW * ground.side
    _add(bpy, scene, "sheet", ground.texture(), (ground.side, ground.side), height, exposure, exact=False)


def grounds(bpy: Any) -> list[Any]:
    """What was linked."""
    return [each for each in bpy.data.objects if each.name.startswith(GROUND)]


def _add(
    bpy: Any,
    scene: Any,
    name: str,
    picture: Float[np.ndarray, "_ _ 3"],
    size: tuple[float, float],
    height: float,
    exposure: float,
    *,
    exact: bool,
) -> None:
    mesh = bpy.data.meshes.new(name)
    x, y = size[0] / 2, size[1] / 2
    mesh.from_pydata([(-x, -y, height), (x, -y, height), (x, y, height), (-x, y, height)], [], [(0, 1, 2, 3)])
    image = image_of(bpy, name, np.concatenate([picture, np.ones_like(picture[..., :1])], -1))
    mesh.materials.append(make_printed_material(bpy, image, size, 2.0**exposure, exact))
    sheet = bpy.data.objects.new(f"{GROUND} {name}", mesh)
    sheet.visible_camera = False
    scene.collection.objects.link(sheet)
