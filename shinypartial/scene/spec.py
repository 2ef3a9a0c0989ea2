"""What a whole recipe holds: object, surroundings, world, camera path and sampling."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from shinypartial.core.trajectory import CameraPath, Seed, limits
from shinypartial.io.files import sha256_of
from shinypartial.io.records import Text
from shinypartial.scene.ground import Ground
from shinypartial.scene.room import Room, RoomShape
from shinypartial.scene.shapes import Assembly, BlendFile, Length, Material, Part, Shape

FORMAT_VERSION = 1
#: What a scene may be used for: anything is chosen by its scores, or nothing ever is.
DEVELOPMENT, HELD_OUT = "development", "held-out"
Split = Literal["development", "held-out"]
SPLITS = get_args(Split)
StudioLight = Literal["city", "courtyard", "forest", "interior", "night", "studio", "sunrise", "sunset"]
STUDIO_LIGHTS = get_args(StudioLight)


@dataclass(frozen=True, kw_only=True)
class World:
    """How strong the light is and how far away; infinitely far where neither kind of distance is given."""

    strength: Annotated[float, limits(0.0, 1e4)] = 1.0
    distance: Annotated[float, limits(1e-3, 1e6)] | None = None
    """From the origin to the nearest wall of the room that carries the map, in scene units."""
    distance_radii: Annotated[float, limits(1.0, 1e6)] | None = None
    """The same in object radii, `SceneSpec.extent`."""
    room: RoomShape = "sphere"
    """Shape of the room about the origin."""
    proportions: tuple[Length, Length, Length] = (1.6, 1.3, 1.0)
    """Of a box along X, Y and Z; the nearest walls are those of the shortest side."""


@dataclass(frozen=True)
class StudioWorld(World):
    """One of the eight CC0 environment maps that Blender brings along."""

    name: StudioLight
    kind: str = "studiolight"


@dataclass(frozen=True)
class FileWorld(World):
    """A linear lat-long EXR in the world frame (+Z up, image center along +X)."""

    path: Text
    """Relative to the folder of scene.toml, or absolute."""
    license: Text
    """License of the file, copied into the dataset."""
    source: Text
    """Where the file comes from, copied into the dataset."""
    kind: str = "file"


@dataclass(frozen=True)
class Operator:
    """Who holds the camera: an upright figure with the camera before its eyes, which only reflections show.

    The head is a sphere about the camera, the body an ellipsoid below it.
    """

    height: Length
    """From the feet to the top of the head, in scene units."""
    radiance: Annotated[float, limits(0.0, 1e4)] = 0.02
    """Gray light that the figure gives off everywhere alike; `Render.exposure` multiplies it as it does the world's."""

    @property
    def head_radius(self) -> float:
        """A fourteenth of the height."""
        return self.height / 14

    @property
    def body_radii(self) -> tuple[float, float]:
        """Half the width of the body, a seventh of the figure's height, and half of its length up to the head."""
        return self.height / 7, self.height / 2 - self.head_radius


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
    operator: Operator | None = None
    ground: Ground | None = None
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

    @property
    def room(self) -> Room | None:
        """The room that carries the world; None where light comes from infinitely far."""
        world = self.world
        distance = world.distance if world.distance_radii is None else world.distance_radii * self.extent
        return None if distance is None else Room(world.room, distance, world.proportions)

    def inverse_distance(self, directions: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """1/D from the origin to walls or ground in unit directions; zero where light comes from infinitely far."""
        found = np.zeros(len(directions)) if self.room is None else self.room.inverse_distance(directions)
        if self.ground:
            meets, points = self.ground.seen_from_origin(directions)
            found[meets] = np.maximum(found[meets], 1 / np.linalg.norm(points, axis=-1))
        return found

    @property
    def mirrors_directions(self) -> bool:
        """Whether what a perfect mirror shows depends on direction alone, and a pixel on one point of view."""
        near = self.room or self.operator or self.ground
        return near is None and self.camera.is_ideal

    def recipe(self) -> dict[str, Any]:
        """The specification as JSON holds it; files are named by their content, so that they may move."""
        content = json.loads(json.dumps(dataclasses.asdict(self)))
        for key, part in (("world", self.world), ("object", self.object)):
            if isinstance(part, FileWorld | BlendFile):
                path = Path(part.path)
                content[key] |= {"path": path.name, "sha256": sha256_of(path)}
        return content
