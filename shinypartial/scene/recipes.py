"""Find scenes, load them, and vary them as the command line states."""

import tomllib
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from shinypartial.core.errors import InputError
from shinypartial.core.trajectory import SWEPT_PATHS
from shinypartial.io.records import read_record
from shinypartial.scene.check import Place, check_scene
from shinypartial.scene.film import FilmSpec
from shinypartial.scene.shapes import BlendFile, Material
from shinypartial.scene.spec import DEVELOPMENT, HELD_OUT, STUDIO_LIGHTS, FileWorld, SceneSpec, World

#: Inside an installed wheel, or those of the checkout.
_INSTALLED = Path(__file__).resolve().parents[1] / "data/blender_scenes"
SCENES = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).resolve().parents[2] / "blender_scenes"
FILMS = SCENES / "films"
RECIPE = "scene.toml"
BLEND = ".blend"
#: Keys of a recipe that the first datasets don't have, and what they mean there.
ADDED_KEYS = {
    "max_bounces": 16,
    "stretch": [1.0, 1.0, 1.0],
    "turn_deg": [0.0, 0.0, 0.0],
    "offset": [0.0, 0.0, 0.0],
    "distance_radii": None,
    "room": "sphere",
    "proportions": [1.6, 1.3, 1.0],
    "operator": None,
    "ground": None,
    "f_number": None,
    "focus_distance": None,
    "motion_deg": 0.0,
    "photographs": None,
}


def scene_names(split: str | None = None) -> list[str]:
    """Names of the scenes that come with the repository; only those of a split (`SPLITS`) where one is named."""
    names = sorted(path.parent.name for path in SCENES.glob(f"*/{RECIPE}"))
    return [name for name in names if split is None or load_scene(name).split == split]


def find_scene(scene: str, object_name: str | None = None) -> SceneSpec:
    """A scene by name, by the path of its scene.toml, or by that of a Blender file and the name of an object in it.

    Raises InputError as `load_scene` and `from_blend_file` do, and for an object's name that nothing needs.
    """
    if scene.lower().endswith(BLEND):
        return from_blend_file(Path(scene), object_name)
    if object_name is not None:
        raise InputError(
            expected="--object with a .blend file only",
            found=f"--object {object_name} with the scene {scene}",
            remedy="Leave it out: a recipe says itself what its object is.",
        )
    return load_scene(scene)


def load_scene(scene: str) -> SceneSpec:
    """Read a scene by name, or by the path of its scene.toml.

    Raises InputError, naming file and key, for an unknown scene, broken TOML, and values that are missing, unknown,
    of the wrong type, not finite or out of range.
    """
    by_path = scene.endswith(".toml")
    path = Path(scene) if by_path else SCENES / scene / RECIPE
    if not by_path and scene not in scene_names():
        raise InputError(
            expected=f"one of the scenes {', '.join(scene_names()) or '(none found)'}, or the path of a {RECIPE}",
            found=f"'{scene}'",
            remedy=f"Correct --scene, or give the path of a {RECIPE} of your own.",
        )
    return _with_files(parse_scene(_read_toml(path), str(path)), path)


def film_names() -> list[str]:
    """Names of the films that come with the repository."""
    return sorted(path.stem for path in FILMS.glob("*.toml"))


def load_film(film: str) -> FilmSpec:
    """Read a film by name, or by the path of its TOML file; its tables are `scene`, `hand`, `phone` and `photographs`.

    Raises InputError as `load_scene` does, and for a hand or a phone that is wrong.
    """
    path = Path(film) if film.endswith(".toml") else FILMS / f"{film}.toml"
    if not path.is_file():
        raise InputError(
            expected=f"one of the films {', '.join(film_names()) or '(none found)'}, or the path of a .toml file",
            found=f"'{film}'",
            remedy="Correct --scene.",
        )
    spec = read_record(FilmSpec, _read_toml(path), str(path))
    check_scene(spec.scene, Place(str(path)).below("scene"))
    return replace(spec, scene=_with_files(spec.scene, path))


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            expected=f"{path} to be TOML",
            found=str(error),
            remedy="Correct the file; docs/how-to/add-a-scene.md helps.",
        ) from None


def _with_files(spec: SceneSpec, path: Path) -> SceneSpec:
    """The files that a recipe names, found beside it."""
    remedy = "Correct the path; it is relative to the folder of the recipe."
    if isinstance(spec.world, FileWorld):
        file = _require(path.parent / spec.world.path, ".exr", f"`world.path` of {path} to name an EXR file", remedy)
        spec = replace(spec, world=replace(spec.world, path=str(file)))
    if isinstance(spec.object, BlendFile):
        file = _require(path.parent / spec.object.path, BLEND, f"`object.path` of {path} to name a .blend file", remedy)
        spec = replace(spec, object=replace(spec.object, path=str(file)))
    return spec


def from_blend_file(path: Path, object_name: str | None) -> SceneSpec:
    """The scene of a user's own Blender file: the named object before the default cameras, with its own materials.

    Raises InputError without a file or a name. Whether the file holds that object is found when it is opened.
    """
    file = _require(path, BLEND, "--scene to name a Blender file that exists", "Correct the path.")
    if not object_name:
        raise InputError(
            expected=f"the name of the object in {path} that reflects",
            found="no --object",
            remedy="Add --object NAME, as Blender's outliner shows it.",
        )
    table = {
        "name": path.stem,
        "title": f"{object_name} of {path.name}",
        "provenance": f"Object {object_name} of the file {path.name}.",
        "license": "that of the file",
        "split": DEVELOPMENT,
        "object": {"kind": "blend", "path": str(file), "object": object_name},
        "world": {"kind": "studiolight", "name": "interior"},
        "material": None,
    }
    return parse_scene(table, f"the scene of {path.name}")


def override(
    spec: SceneSpec,
    *,
    resolution: int | None = None,
    samples: int | None = None,
    exposure: float | None = None,
    world: str | None = None,
    surroundings_distance: float | None = None,
    surroundings_radii: float | None = None,
    surroundings_room: str | None = None,
    surroundings_proportions: tuple[float, float, float] | None = None,
    operator_height: float | None = None,
    operator_radiance: float | None = None,
    roughness: float | None = None,
    base_color: tuple[float, float, float] | None = None,
    metallic: float | None = None,
    deformation: float | None = None,
    object_scale: float | None = None,
    **camera: Any,
) -> SceneSpec:
    """Replace what is given (`camera`: fields of CameraPath) and check everything again.

    `world` is the name of a studio light or the path of an EXR file. A value of the material changes the scene's
    material; where a Blender file's own materials were kept, a mirror with that value takes their place.
    """
    table = asdict(spec)
    if world is not None:
        table["world"] = _world_table(world) | {each.name: table["world"][each.name] for each in fields(World)}
    if surroundings_distance is not None or surroundings_radii is not None:
        table["world"] |= {"distance": surroundings_distance, "distance_radii": surroundings_radii}
    if table["operator"] is None and (operator_height, operator_radiance) != (None, None):
        table["operator"] = {}
    if table["material"] is None and (roughness, base_color, metallic) != (None, None, None):
        table["material"] = asdict(Material())
    for section, key, value in (
        ("render", "resolution", resolution),
        ("render", "samples", samples),
        ("render", "exposure", exposure),
        ("world", "room", surroundings_room),
        ("world", "proportions", surroundings_proportions),
        ("operator", "height", operator_height),
        ("operator", "radiance", operator_radiance),
        ("material", "roughness", roughness),
        ("material", "base_color", base_color),
        ("material", "metallic", metallic),
        ("deformation", "amplitude", deformation),
        *(("camera", key, value) for key, value in camera.items()),
    ):
        if value is not None:
            table[section][key] = value
    if object_scale is not None:
        table["scale"] = object_scale
    source = f"the scene {spec.name} with the options given"
    if camera.get("sweeps") is not None and table["camera"]["path"] not in SWEPT_PATHS:
        found = f"{camera['sweeps']} for the path {table['camera']['path']}, which has no sweeps"
        raise Place(source, "camera.sweeps").error(f"a path among {', '.join(SWEPT_PATHS)}", found)
    return parse_scene(table, source)


def variant_name(original: SceneSpec, varied: SceneSpec) -> str:
    """A folder name that differs between variants: scene, path, resolution, and what the options changed in the scene.

    What else the camera and the sampling have is left out: the recipe in the folder keeps such runs apart.
    """
    words = [varied.name, *_changes(original.camera, varied.camera, {"path": ""}), str(varied.render.resolution)]
    before, after = original.world, varied.world
    if replace(after, **{each.name: getattr(before, each.name) for each in fields(World)}) != before:
        words.append(Path(_world_name(varied)).stem)
    for old, new, labels in (
        (before, after, {"distance": "distance", "distance_radii": "radii", "room": "", "proportions": "proportions"}),
        (original.operator, varied.operator, {"height": "operator", "radiance": "radiance"}),
        (original.camera, varied.camera, {"f_number": "f", "focus_distance": "focus", "motion_deg": "motion"}),
        (original.material or Material(), varied.material, {"base_color": "color", "metallic": "metallic"}),
        (original.material, varied.material, {"roughness": "roughness"}),
        (original.deformation, varied.deformation, {"amplitude": "deformation"}),
        (original, varied, {"scale": "scale"}),
        (original.render, varied.render, {"exposure": "exposure"}),
    ):
        words += _changes(old, new, labels)
    return "-".join(words)


def _changes(before: Any, after: Any, labels: dict[str, str]) -> list[str]:
    """A word for each of these fields that was given another value: its label and that value."""
    values = [(label, getattr(before, key, None), getattr(after, key, None)) for key, label in labels.items()]
    return [label + _word(new) for label, old, new in values if new not in (None, old)]


def _word(value: Any) -> str:
    if isinstance(value, tuple):
        return "-".join(map(_word, value))
    return value if isinstance(value, str) else f"{value:g}"


def older_recipe(recipe: Any) -> Any:
    """A recipe without the keys that later versions added and that have the values which were fixed before.

    A dataset that was begun with such a recipe is one of the same scene. `split` says nothing about its pictures.
    """
    if isinstance(recipe, dict):
        added = {"split", *(key for key, value in ADDED_KEYS.items() if recipe.get(key) == value)}
        return {key: older_recipe(value) for key, value in recipe.items() if key not in added}
    return [older_recipe(each) for each in recipe] if isinstance(recipe, list) else recipe


def parse_scene(table: dict[str, Any], source: str) -> SceneSpec:
    """Build a SceneSpec from nested tables; `source` names their origin in messages."""
    if "split" not in table:
        raise InputError(
            expected=f"`split` of {source}: whether anything may be chosen by the scores of this scene",
            found="no such key",
            remedy=f'Add the line split = "{DEVELOPMENT}", or split = "{HELD_OUT}" where nothing ever is.',
        )
    spec = read_record(SceneSpec, table, source)
    check_scene(spec, Place(source))
    return spec


def _world_name(spec: SceneSpec) -> str:
    return spec.world.path if isinstance(spec.world, FileWorld) else spec.world.name


def _world_table(world: str) -> dict[str, Any]:
    """The table of a studio light's name or of an EXR file's path."""
    if world in STUDIO_LIGHTS:
        return {"kind": "studiolight", "name": world}
    expected = f"--world to be one of {', '.join(STUDIO_LIGHTS)}, or the path of an EXR file"
    path = _require(Path(world), ".exr", expected, "Correct --world.")
    return {"kind": "file", "path": str(path), "license": "that of the file", "source": f"the file {path.name}"}


def _require(path: Path, suffix: str, expected: str, remedy: str) -> Path:
    if path.suffix.lower() != suffix or not path.is_file():
        found = f"{path}, which is {'of another kind' if path.is_file() else 'not there'}"
        raise InputError(expected=expected, found=found, remedy=remedy)
    return path
