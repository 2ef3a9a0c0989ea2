# SPDX-License-Identifier: GPL-3.0-or-later
"""The tab PanoLess of the 3D viewport's sidebar, and the progress in the status bar."""

from textwrap import wrap

import bpy

from .build import ground_of, photograph_cameras
from .light import PREFIX
from .running import active, begun_folder

#: Letters that fit into the sidebar's usual width.
WIDTH = 36


class Side:
    """A panel of the tab."""

    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "PanoLess"


def paragraph(layout: bpy.types.UILayout, text: str, icon: str = "NONE") -> None:
    """Text in as many lines as it takes."""
    column = layout.column(align=True)
    for line in (part for each in text.splitlines() for part in wrap(each, WIDTH)):
        column.label(text=line, icon=icon)
        icon = "BLANK1" if icon != "NONE" else icon


def draw_progress(layout: bpy.types.UILayout) -> bool:
    """A bar and Cancel while a job runs; whether one does."""
    job = active()
    if job is None:
        return False
    row = layout.row(align=True)
    row.progress(factor=job.share, type="BAR", text=job.text)
    row.operator("panoless.cancel", text="", icon="CANCEL")
    return True


def draw_status(self: bpy.types.Header, _context: bpy.types.Context) -> None:
    """At the end of the status bar."""
    draw_progress(self.layout)


class PANOLESS_PT_light(Side, bpy.types.Panel):
    """Where the light comes from."""

    bl_idname, bl_label = "PANOLESS_PT_light", "Light"

    def draw(self, context: bpy.types.Context) -> None:
        """Buttons, progress, what came out."""
        layout, settings = self.layout, context.scene.panoless
        column = layout.column(align=True)
        column.operator("panoless.light", icon="LIGHT_SUN")
        column.operator("panoless.import_prediction", icon="IMPORT")
        if not draw_progress(layout) and begun_folder(context.scene) is not None:
            layout.operator("panoless.continue_run", icon="PLAY")
        if PREFIX not in bpy.data.worlds:
            layout.operator("panoless.example", icon="EXPERIMENTAL")
            return
        layout.use_property_split, layout.use_property_decorate = True, False
        column = layout.column()
        column.prop(settings, "strength")
        column.prop(settings, "rotation")
        column.prop(settings, "unseen")
        if settings.unseen == "COLOR":
            column.prop(settings, "unseen_color")
        if settings.verdict:
            paragraph(layout, settings.verdict, "INFO")


class PANOLESS_PT_insert(Side, bpy.types.Panel):
    """Objects of one's own in a photograph."""

    bl_idname, bl_label = "PANOLESS_PT_insert", "Photographs"

    def draw(self, context: bpy.types.Context) -> None:
        """Which photograph, and what is put into it."""
        row = self.layout.row(align=True)
        row.operator("panoless.photograph", text="", icon="TRIA_LEFT").step = "PREVIOUS"
        row.operator("panoless.photograph").step = "NEAREST"
        row.operator("panoless.photograph", text="", icon="TRIA_RIGHT").step = "NEXT"
        camera = context.scene.camera
        if camera is not None and camera in photograph_cameras(context.scene):
            self.layout.label(text=camera.name, icon="CAMERA_DATA")
        self.layout.operator("panoless.insert", icon="SHADING_RENDERED")
        if ground_of(context.scene) is not None:
            self.layout.prop(context.scene.panoless, "ground_gloss")


class PANOLESS_PT_benchmark(Side, bpy.types.Panel):
    """A dataset with truth of the open file."""

    bl_idname, bl_label, bl_options = "PANOLESS_PT_benchmark", "Benchmark", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Settings, the button, the score."""
        layout, settings = self.layout, context.scene.panoless
        layout.use_property_split, layout.use_property_decorate = True, False
        column = layout.column()
        names = "arc", "facing", "views", "tests", "resolution", "samples", "noise", "world"
        for name in names:
            column.prop(settings, f"bench_{name}")
        layout.operator("panoless.benchmark", icon="RENDER_RESULT")
        if settings.score:
            paragraph(layout, settings.score)


CLASSES = (PANOLESS_PT_light, PANOLESS_PT_insert, PANOLESS_PT_benchmark)
