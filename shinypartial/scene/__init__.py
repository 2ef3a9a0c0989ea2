"""Scene recipes: `blender_scenes/NAME/scene.toml` read into frozen dataclasses, strictly.

`shapes` and `spec` say what a recipe may hold, `tables` reads nested tables into them, `check` refuses values that
contradict each other, and `recipes` finds, loads and varies scenes. The same checks hold for values that the command
line overrides. May import trajectory and the core below it; never dataset, blender or bpy.
"""

from shinypartial.scene.recipes import (
    SCENES,
    find_scene,
    from_blend_file,
    load_scene,
    older_recipe,
    override,
    parse_scene,
    scene_names,
    variant_name,
)
from shinypartial.scene.shapes import (
    Assembly,
    BlendFile,
    Blob,
    Frame,
    Material,
    Part,
    Plane,
    RadialHarmonics,
    Ring,
    Shape,
    SoftBalls,
    Sphere,
    Superquadric,
    SurfaceOfRevolution,
    Tube,
)
from shinypartial.scene.spec import (
    DEVELOPMENT,
    HELD_OUT,
    SPLITS,
    STUDIO_LIGHTS,
    Deformation,
    FileWorld,
    Render,
    SceneSpec,
    StudioWorld,
)

__all__ = [
    "DEVELOPMENT",
    "HELD_OUT",
    "SCENES",
    "SPLITS",
    "STUDIO_LIGHTS",
    "Assembly",
    "BlendFile",
    "Blob",
    "Deformation",
    "FileWorld",
    "Frame",
    "Material",
    "Part",
    "Plane",
    "RadialHarmonics",
    "Render",
    "Ring",
    "SceneSpec",
    "Shape",
    "SoftBalls",
    "Sphere",
    "StudioWorld",
    "Superquadric",
    "SurfaceOfRevolution",
    "Tube",
    "find_scene",
    "from_blend_file",
    "load_scene",
    "older_recipe",
    "override",
    "parse_scene",
    "scene_names",
    "variant_name",
]
