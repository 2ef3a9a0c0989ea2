"""Scene recipes: `blender_scenes/NAME/scene.toml` read into frozen dataclasses, strictly.

`shapes`, `room`, `ground`, `spec` and `film` say what a recipe may hold and in which range, `check` refuses values that
contradict each other, and `recipes` finds, loads and varies scenes. The same checks hold for values that the command
line overrides.
Imports io and core; never dataset, blender or bpy.
"""

from shinypartial.scene.film import FilmSpec, Phone, Photographs
from shinypartial.scene.ground import Ground
from shinypartial.scene.recipes import (
    FILMS,
    SCENES,
    film_names,
    find_scene,
    from_blend_file,
    load_film,
    load_scene,
    older_recipe,
    override,
    parse_scene,
    scene_names,
    variant_name,
)
from shinypartial.scene.room import Room
from shinypartial.scene.shapes import (
    Assembly,
    BlendFile,
    Blob,
    Frame,
    Material,
    Panes,
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
    Operator,
    Render,
    SceneSpec,
    StudioWorld,
)

__all__ = [
    "DEVELOPMENT",
    "FILMS",
    "HELD_OUT",
    "SCENES",
    "SPLITS",
    "STUDIO_LIGHTS",
    "Assembly",
    "BlendFile",
    "Blob",
    "Deformation",
    "FileWorld",
    "FilmSpec",
    "Frame",
    "Ground",
    "Material",
    "Operator",
    "Panes",
    "Part",
    "Phone",
    "Photographs",
    "Plane",
    "RadialHarmonics",
    "Render",
    "Ring",
    "Room",
    "SceneSpec",
    "Shape",
    "SoftBalls",
    "Sphere",
    "StudioWorld",
    "Superquadric",
    "SurfaceOfRevolution",
    "Tube",
    "film_names",
    "find_scene",
    "from_blend_file",
    "load_film",
    "load_scene",
    "older_recipe",
    "override",
    "parse_scene",
    "scene_names",
    "variant_name",
]
