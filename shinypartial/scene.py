"""Scene recipes: `blender_scenes/NAME/scene.toml` read into frozen dataclasses, strictly.

The same checks hold for values that the command line overrides. May import trajectory and the core below it; never
dataset, blender or bpy.
"""

import dataclasses
import json
import math
import tomllib
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from shinypartial.errors import InputError
from shinypartial.files import sha256_of
from shinypartial.trajectory import Arc, limits

SCENES = Path(__file__).resolve().parents[1] / "blender_scenes"
RECIPE = "scene.toml"
FORMAT_VERSION = 1
STUDIO_LIGHTS = ("city", "courtyard", "forest", "interior", "night", "studio", "sunrise", "sunset")


@dataclass(frozen=True)
class SurfaceOfRevolution:
    """A smooth surface: a cubic spline through profile points (radius, z), turned about the Z axis."""

    profile: tuple[tuple[float, float], ...] = field(metadata=limits(-1e3, 1e3))
    """At least three points from bottom to top, so that the surface faces outward."""
    kind: str = "surface_of_revolution"
    offset_z: float = field(default=0.0, metadata=limits(-1e3, 1e3))
    """Added to every z of the profile."""
    segments: int = field(default=256, metadata=limits(3, 4096))
    """Faces around the axis."""
    rings: int = field(default=320, metadata=limits(2, 4096))
    """Faces along the profile."""

    @property
    def extent(self) -> float:
        """Largest distance of a profile point from the origin."""
        return max(math.hypot(radius, z + self.offset_z) for radius, z in self.profile)


@dataclass(frozen=True)
class Sphere:
    """A sphere about the origin."""

    kind: str = "sphere"
    radius: float = field(default=1.0, metadata=limits(1e-3, 1e3))
    segments: int = field(default=256, metadata=limits(3, 4096))
    rings: int = field(default=128, metadata=limits(2, 4096))

    @property
    def extent(self) -> float:
        """The radius."""
        return self.radius


@dataclass(frozen=True)
class Plane:
    """A flat rectangle about the origin."""

    kind: str = "plane"
    size: tuple[float, float] = field(default=(1.6, 1.6), metadata=limits(1e-3, 1e3))
    """Width (horizontal) and height."""
    normal: tuple[float, float, float] = field(default=(0.0, -1.0, 0.0), metadata=limits(-1.0, 1.0))
    """Direction that the front faces; need not be unit."""

    @property
    def extent(self) -> float:
        """Half the diagonal."""
        return math.hypot(*self.size) / 2


@dataclass(frozen=True)
class Material:
    """Parameters of Blender's Principled shader; the default is a perfect mirror."""

    base_color: tuple[float, float, float] = field(default=(1.0, 1.0, 1.0), metadata=limits(0.0, 1.0))
    metallic: float = field(default=1.0, metadata=limits(0.0, 1.0))
    roughness: float = field(default=0.0, metadata=limits(0.0, 1.0))


@dataclass(frozen=True)
class StudioWorld:
    """One of the eight CC0 environment maps that Blender brings along."""

    name: str = field(metadata={"choices": STUDIO_LIGHTS})
    kind: str = "studiolight"
    strength: float = field(default=1.0, metadata=limits(0.0, 1e4))


@dataclass(frozen=True)
class FileWorld:
    """A linear lat-long EXR in the world frame (+Z up, image center along +X)."""

    path: str
    """Relative to the folder of scene.toml, or absolute."""
    license: str
    """License of the file, copied into the dataset."""
    source: str
    """Where the file comes from, copied into the dataset."""
    kind: str = "file"
    strength: float = field(default=1.0, metadata=limits(0.0, 1e4))


@dataclass(frozen=True)
class Render:
    """How Cycles samples an image; a pixel is the average over its area."""

    samples: int = field(default=16, metadata=limits(1, 65536))
    """Samples per pixel."""
    resolution: int = field(default=800, metadata=limits(4, 16384))
    """Pixels per side."""
    seed: int = field(default=0, metadata=limits(0, 2**31 - 1))
    """Seed of the sampling pattern."""


@dataclass(frozen=True)
class SceneSpec:
    """Everything that determines a dataset: object, material, world, camera path and sampling."""

    name: str
    title: str
    provenance: str
    license: str
    object: SurfaceOfRevolution | Sphere | Plane
    world: StudioWorld | FileWorld
    material: Material = Material()
    camera: Arc = Arc()
    render: Render = Render()
    format: int = field(default=FORMAT_VERSION, metadata=limits(FORMAT_VERSION, FORMAT_VERSION))

    def recipe(self) -> dict[str, Any]:
        """The specification as JSON holds it; a world file is named by its content, so that it may move."""
        content = json.loads(json.dumps(dataclasses.asdict(self)))
        if isinstance(self.world, FileWorld):
            path = Path(self.world.path)
            content["world"] |= {"path": path.name, "sha256": sha256_of(path)}
        return content


def scene_names() -> list[str]:
    """Names of the scenes that come with the repository."""
    return sorted(path.parent.name for path in SCENES.glob(f"*/{RECIPE}"))


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
            remedy=f"Correct --scene, or add {SCENES / scene / RECIPE}.",
        )
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(
            expected=f"{path} to be TOML", found=str(error), remedy="Correct the file; blender_scenes/README.md helps."
        ) from None
    spec = parse_scene(table, str(path))
    if not isinstance(spec.world, FileWorld):
        return spec
    world = path.parent / spec.world.path
    if world.suffix.lower() != ".exr" or not world.is_file():
        raise InputError(
            expected=f"`world.path` of {path} to name an EXR file",
            found=f"{world}, which is {'of another kind' if world.is_file() else 'not there'}",
            remedy="Correct the path; it is relative to the folder of scene.toml.",
        )
    return dataclasses.replace(spec, world=dataclasses.replace(spec.world, path=str(world)))


def override(
    spec: SceneSpec,
    *,
    resolution: int | None = None,
    samples: int | None = None,
    train: int | None = None,
    test: int | None = None,
) -> SceneSpec:
    """Replace what is given and check everything again."""
    table = dataclasses.asdict(spec)
    for section, key, value in (
        ("render", "resolution", resolution),
        ("render", "samples", samples),
        ("camera", "train", train),
        ("camera", "test", test),
    ):
        if value is not None:
            table[section][key] = value
    return parse_scene(table, f"the scene {spec.name} with the options given")


def parse_scene(table: dict[str, Any], source: str) -> SceneSpec:
    """Build a SceneSpec from nested tables; `source` names their origin in messages."""
    spec = _parse_table(SceneSpec, table, _Place(source, ""))
    place = _Place(source, "")
    if isinstance(spec.object, SurfaceOfRevolution):
        _check_profile(spec.object, place.below("object").below("profile"))
    if isinstance(spec.object, Plane) and math.hypot(*spec.object.normal) < 1e-6:
        raise place.below("object").below("normal").error("a direction", "a vector of length zero")
    for key in ("azimuth_deg", "elevation_deg"):
        low, high = getattr(spec.camera, key)
        if low > high:
            raise place.below("camera").below(key).error("first value ≤ second value", f"[{low}, {high}]")
    if spec.camera.radius <= spec.object.extent + math.hypot(*spec.camera.target):
        found = f"{spec.camera.radius}, but the object reaches {spec.object.extent:.3g} from the origin"
        raise place.below("camera").below("radius").error("cameras outside the object", found)
    return spec


def _check_profile(surface: SurfaceOfRevolution, place: "_Place") -> None:
    """Points must be distinct neighbors with radius ≥ 0; only the ends may lie on the axis."""
    if len(surface.profile) < 3:
        raise place.error("at least three points", f"{len(surface.profile)}")
    for i, (radius, _) in enumerate(surface.profile):
        inner = 0 < i < len(surface.profile) - 1
        if radius < 0 or (inner and radius == 0):
            raise place.error("radii ≥ 0, and above 0 between the ends", f"radius {radius} at point {i}")
        if i and math.dist(surface.profile[i - 1], surface.profile[i]) < 1e-9:
            raise place.error("points that differ from the one before", f"point {i} twice")


@dataclass(frozen=True)
class _Place:
    """Where in which recipe a value stands, for messages."""

    source: str
    key: str

    def below(self, key: str) -> "_Place":
        return _Place(self.source, f"{self.key}.{key}" if self.key else key)

    def error(self, expected: str, found: str) -> InputError:
        what = f"`{self.key}` of {self.source}" if self.key else self.source
        return InputError(expected=f"{what}: {expected}", found=found, remedy="Correct that value.")


def _parse_table(cls: Any, table: Any, place: _Place) -> Any:
    """Build dataclass `cls` from a table whose keys must be exactly its fields (those with defaults may miss)."""
    if not isinstance(table, dict):
        raise place.error("a table", repr(table))
    types_by_key = typing.get_type_hints(cls)
    fields = {item.name: item for item in dataclasses.fields(cls)}
    unknown = sorted(table.keys() - fields.keys())
    if unknown:
        raise place.below(unknown[0]).error(f"one of the keys {', '.join(fields)}", "an unknown key")
    values = {}
    for key, item in fields.items():
        if key in table:
            values[key] = _parse_value(types_by_key[key], table[key], item.metadata, place.below(key))
        elif item.default is dataclasses.MISSING:
            raise place.below(key).error("a value", "none")
    return cls(**values)


def _parse_value(kind: Any, value: Any, metadata: Any, place: _Place) -> Any:
    if typing.get_origin(kind) is types.UnionType:
        return _parse_union(typing.get_args(kind), value, place)
    if dataclasses.is_dataclass(kind):
        return _parse_table(kind, value, place)
    if typing.get_origin(kind) is tuple:
        return _parse_tuple(typing.get_args(kind), value, metadata, place)
    if kind is str:
        return _parse_text(value, metadata, place)
    return _parse_number(kind, value, metadata, place)


def _parse_union(options: tuple[Any, ...], value: Any, place: _Place) -> Any:
    """Choose the dataclass whose default `kind` equals the key `kind` of the table."""
    by_kind = {option.kind: option for option in options}
    kind = value.get("kind") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in by_kind:
        raise place.below("kind").error(f"one of {', '.join(by_kind)}", repr(kind))
    return _parse_table(by_kind[kind], value, place)


def _parse_tuple(items: tuple[Any, ...], value: Any, metadata: Any, place: _Place) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise place.error("a list", repr(value))
    if items[-1] is Ellipsis:
        items = items[:1] * len(value)
    if len(value) != len(items):
        raise place.error(f"{len(items)} values", f"{len(value)}")
    return tuple(
        _parse_value(item, entry, metadata, place.below(str(i)))
        for i, (item, entry) in enumerate(zip(items, value, strict=True))
    )


def _parse_text(value: Any, metadata: Any, place: _Place) -> str:
    choices = metadata.get("choices")
    if not isinstance(value, str) or not value.strip():
        raise place.error("a text that is not empty", repr(value))
    if choices and value not in choices:
        raise place.error(f"one of {', '.join(choices)}", repr(value))
    return value


def _parse_number(kind: type, value: Any, metadata: Any, place: _Place) -> int | float:
    accepted = (int,) if kind is int else (int, float)
    noun = "a whole number" if kind is int else "a number"
    if isinstance(value, bool) or not isinstance(value, accepted):
        raise place.error(noun, repr(value))
    low, high = metadata["limits"]
    if not low <= value <= high:  # also rejects NaN
        raise place.error(f"{noun} from {low:g} to {high:g}", repr(value))
    return kind(value)
