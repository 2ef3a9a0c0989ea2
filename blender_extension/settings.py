# SPDX-License-Identifier: GPL-3.0-or-later
"""What the extension remembers: preferences of the person, and settings of a scene."""

from math import radians

import bpy
from bpy.props import EnumProperty, FloatProperty, FloatVectorProperty, IntProperty, StringProperty

from .build import update_ground
from .light import UNSEEN, update_light
from .program import INSTALL, Problem, Program, find, program_at

WORLDS = [
    (name, name.title(), "") for name in ("interior", "city", "courtyard", "forest", "night", "studio", "sunrise")
]


def _update(self: "SceneSettings", _context: bpy.types.Context) -> None:
    update_light(self.id_data)


def _update_ground(self: "SceneSettings", _context: bpy.types.Context) -> None:
    update_ground(self.id_data)


def _forget_version(self: "Preferences", _context: bpy.types.Context) -> None:
    self.version = ""


class Preferences(bpy.types.AddonPreferences):
    """Where `panoless` is."""

    bl_idname = __package__

    program: StringProperty(
        name="panoless",
        description="Path of the panoless command; empty: it is looked for",
        subtype="FILE_PATH",
        update=_forget_version,
    )
    version: StringProperty(options={"SKIP_SAVE"})

    def draw(self, _context: bpy.types.Context) -> None:
        """Path, version, how to install."""
        column = self.layout.column()
        row = column.row(align=True)
        row.prop(self, "program")
        row.operator("panoless.find_program", text="", icon="VIEWZOOM")
        column.label(text=self.version or "Version: press the magnifier", icon="INFO")
        row = column.row(align=True)
        row.label(text=f"To install: {INSTALL}")
        row.operator("panoless.copy_install", text="", icon="COPYDOWN")


class SceneSettings(bpy.types.PropertyGroup):
    """Saved with the .blend."""

    run_folder: StringProperty(name="Run", description="Folder of the last run, which a later session continues")
    prediction: StringProperty(name="Prediction", description="Prediction folder that was imported")
    content: StringProperty(name="Files", description="Folder of what Blender shows of the prediction")
    verdict: StringProperty(name="Verdict", description="How far the fit says that it is to be trusted")
    score: StringProperty(name="Score", description="What the last benchmark gave")
    strength: FloatProperty(name="Strength", description="Multiplies the light", default=1, min=0, update=_update)
    rotation: FloatProperty(
        name="Rotation",
        description="Turns the light about the vertical. With photographs and mirror in the scene, leave it at 0",
        subtype="ANGLE",
        update=_update,
    )
    unseen: EnumProperty(
        name="Unseen", description="What stands in for directions that nobody saw", items=UNSEEN, update=_update
    )
    unseen_color: FloatVectorProperty(
        name="Color",
        description="Of directions that nobody saw",
        subtype="COLOR",
        default=(1, 0, 1),
        min=0,
        update=_update,
    )
    ground_gloss: FloatProperty(
        name="Ground Gloss",
        description="How clearly the ground mirrors inserted objects. 0: only their shadow; 1: as polished stone",
        subtype="FACTOR",
        default=0.7,
        min=0,
        max=1,
        update=_update_ground,
    )
    bench_arc: FloatProperty(
        name="Arc",
        description="Angle in which cameras stand before the object, about the vertical",
        subtype="ANGLE",
        default=radians(150),
        min=radians(2),
        max=radians(179),
    )
    bench_facing: FloatProperty(
        name="Facing",
        description="Side of the object that is photographed: from +X toward +Y",
        subtype="ANGLE",
        default=radians(-90),
    )
    bench_views: IntProperty(name="Photographs", description="Training views", default=40, min=4, max=1000)
    bench_tests: IntProperty(name="Test Views", description="Views for scores only", default=10, min=1, max=1000)
    bench_resolution: IntProperty(
        name="Resolution", description="Pixels a side of the square pictures", default=400, min=16, max=4096
    )
    bench_samples: IntProperty(name="Samples", description="Paths a pixel", default=64, min=1, max=4096)
    bench_noise: FloatProperty(
        name="Noise", description="Standard deviation of the sensor's noise at white", default=0, min=0, max=1
    )
    bench_world: EnumProperty(
        name="World",
        description="What lights the object, where the scene's world has no EXR map",
        items=WORLDS,
    )


def preferences(context: bpy.types.Context) -> Preferences | None:
    """Those of the extension; None where its modules were registered without it."""
    addon = context.preferences.addons.get(__package__)
    return addon.preferences if addon else None


def installed(context: bpy.types.Context) -> Program:
    """The program; Problem where there is none that the extension can use."""
    stated = preferences(context)
    program = program_at(stated.program if stated else "")
    if stated:
        stated.version = f"panoless {program.version or 'of an unknown version'} at {program.path}"
    return program


class PANOLESS_OT_find_program(bpy.types.Operator):
    """Look for panoless where installers put it, and show its version"""

    bl_idname, bl_label = "panoless.find_program", "Find panoless"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Fill in the preferences."""
        stated = preferences(context)
        try:
            if stated and not stated.program and (found := find()):
                stated.program = str(found)
            program = installed(context)
        except Problem as problem:
            self.report({"ERROR"}, str(problem))
            return {"CANCELLED"}
        self.report({"INFO"}, f"panoless {program.version} at {program.path}")
        return {"FINISHED"}


class PANOLESS_OT_copy_install(bpy.types.Operator):
    """Copy the line that installs panoless, for a terminal"""

    bl_idname, bl_label = "panoless.copy_install", "Copy Install Line"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """To the clipboard."""
        context.window_manager.clipboard = INSTALL
        self.report({"INFO"}, f"Copied: {INSTALL}")
        return {"FINISHED"}


CLASSES = (Preferences, SceneSettings, PANOLESS_OT_find_program, PANOLESS_OT_copy_install)
