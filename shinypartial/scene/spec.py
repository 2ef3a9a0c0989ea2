"""What a whole recipe holds: object, surroundings, world, camera path and sampling."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from shinypartial.core.trajectory import CameraPath, Seed, limits
from shinypartial.io.files import sha256_of
from shinypartial.io.records import Text
from shinypartial.scene.shapes import Assembly, BlendFile, Material, Part, Shape

FORMAT_VERSION = 1
#: What a scene may be used for: anything is chosen by its scores, or nothing ever is.
DEVELOPMENT, HELD_OUT = "development", "held-out"
Split = Literal["development", "held-out"]
SPLITS = get_args(Split)
StudioLight = Literal["city", "courtyard", "forest", "interior", "night", "studio", "sunrise", "sunset"]
STUDIO_LIGHTS = get_args(StudioLight)


@dataclass(frozen=True)
class StudioWorld:
    """One of the eight CC0 environment maps that Blender brings along."""

    name: StudioLight
    kind: str = "studiolight"
    strength: Annotated[float, limits(0.0, 1e4)] = 1.0
    distance: Annotated[float, limits(1e-3, 1e6)] | None = None
    """Radius of the sphere about the origin that carries the map; infinitely far when not given."""


@dataclass(frozen=True)
class FileWorld:
    """A linear lat-long EXR in the world frame (+Z up, image center along +X)."""

    path: Text
    """Relative to the folder of scene.toml, or absolute."""
    license: Text
    """License of the file, copied into the dataset."""
    source: Text
    """Where the file comes from, copied into the dataset."""
    kind: str = "file"
    strength: Annotated[float, limits(0.0, 1e4)] = 1.0
    distance: Annotated[float, limits(1e-3, 1e6)] | None = None
    """Radius of the sphere about the origin that carries the map; infinitely far when not given."""


@dataclass(frozen=True)
class Deformation:
    """A seeded smooth displacement of the object along its normals."""

    amplitude: Annotated[float, limits(0.0, 10.0)] = 0.0
    """Root mean square of the displacement in scene units, before the object is scaled."""
    wavelength: Annotated[float, limits(1e-2, 1e3)] = 0.8
    """Typical distance between bumps in scene units."""
    seed: Seed = 0
    """Determines where the bumps lie."""


@dataclass(frozen=True)
class Render:
    """How Cycles samples an image; a pixel is the average over its area."""

    samples: Annotated[int, limits(1, 65536)] = 16
    """Samples per pixel."""
    resolution: Annotated[int, limits(4, 16384)] = 800
    """Pixels per side."""
    seed: Seed = 0
    """Seed of the sampling pattern."""
    exposure: Annotated[float, limits(-20.0, 20.0)] = 0.0
    """Photographic stops: the light of the world is multiplied by 2^exposure, in pictures and in the stored map."""
    max_bounces: Annotated[int, limits(0, 1024)] = 16
    """As Cycles counts: a path is reflected at most once more than this, and light that would need more is lost."""


@dataclass(frozen=True)
class SceneSpec:
    """Everything that determines a dataset: object, material, world, camera path and sampling."""

    name: Text
    title: Text
    provenance: Text
    license: Text
    split: Split
    """Whether constants and presets may be chosen by this scene (`development`) or never (`held-out`)."""
    object: Shape | Assembly | BlendFile
    world: StudioWorld | FileWorld
    material: Material | None = Material()
    """Of the object, but for parts that have their own. None: a Blender file's own materials."""
    props: tuple[Part, ...] = ()
    """What stands around the object: it hides it and is mirrored in it, and is no part of the mask."""
    deformation: Deformation = Deformation()
    scale: Annotated[float, limits(1e-3, 1e3)] = 1.0
    """Enlarges object and props about the origin."""
    camera: CameraPath = CameraPath()
    render: Render = Render()
    format: Annotated[int, limits(FORMAT_VERSION, FORMAT_VERSION)] = FORMAT_VERSION

    @property
    def light_factor(self) -> float:
        """What the numbers of the world's file are multiplied by to give radiance."""
        return self.world.strength * 2.0**self.render.exposure

    @property
    def extent(self) -> float:
        """Distance from the origin that the object does not exceed; displacements reach three times their RMS."""
        return self.scale * (self.object.extent + 3 * self.deformation.amplitude)

    def recipe(self) -> dict[str, Any]:
        """The specification as JSON holds it; files are named by their content, so that they may move."""
        content = json.loads(json.dumps(dataclasses.asdict(self)))
        for key, part in (("world", self.world), ("object", self.object)):
            if isinstance(part, FileWorld | BlendFile):
                path = Path(part.path)
                content[key] |= {"path": path.name, "sha256": sha256_of(path)}
        return content
