# SPDX-License-Identifier: GPL-3.0-or-later
"""Light from photographs of a shiny object, in Blender: buttons for an installed `panoless`, which works beside it."""

import bpy

from . import operators, panels, running, settings

CLASSES = (*settings.CLASSES, *running.CLASSES, *operators.CLASSES, *panels.CLASSES)


def register() -> None:
    """Add everything to Blender."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.panoless = bpy.props.PointerProperty(type=settings.SceneSettings)
    bpy.types.STATUSBAR_HT_header.append(panels.draw_status)


def unregister() -> None:
    """Stop what runs, and take everything away."""
    running.stop()
    bpy.types.STATUSBAR_HT_header.remove(panels.draw_status)
    del bpy.types.Scene.panoless
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
