"""Values of a recipe that are each in range but contradict one another."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from shinypartial.core.errors import InputError
from shinypartial.core.trajectory import path_offsets
from shinypartial.scene.shapes import (
    Assembly,
    BlendFile,
    Frame,
    Panes,
    Part,
    Plane,
    SoftBalls,
    SurfaceOfRevolution,
    Tube,
)
from shinypartial.scene.spec import Operator, SceneSpec, World


@dataclass(frozen=True)
class Place:
    """Where in which recipe a value stands, for messages."""

    source: str
    key: str = ""

    def below(self, key: str) -> "Place":
        """The place of one entry of the table or list that stands here."""
        return Place(self.source, f"{self.key}.{key}" if self.key else key)

    def error(self, expected: str, found: str) -> InputError:
        """What to raise for the value that stands here."""
        what = f"`{self.key}` of {self.source}" if self.key else self.source
        return InputError(expected=f"{what}: {expected}", found=found, remedy="Correct that value.")


def check_scene(spec: SceneSpec, place: Place) -> None:
    """Raise InputError, naming the value, for shapes without a surface, falling ranges and things inside others."""
    _check_object(spec, place)
    _check_parts(spec.props, place.below("props"))
    for key in ("azimuth_deg", "elevation_deg"):
        low, high = getattr(spec.camera, key)
        if low > high:
            raise place.below("camera").below(key).error("first value ≤ second value", f"[{low}, {high}]")
    reach = f"the object reaches {spec.extent:.3g} from the origin"
    if spec.camera.radius <= spec.extent + math.hypot(*spec.camera.target):
        raise (
            place.below("camera")
            .below("radius")
            .error("cameras outside the object", f"{spec.camera.radius}, but {reach}")
        )
    around = max([spec.extent, *(spec.scale * part.extent for part in spec.props)])
    _check_room(spec, around, place.below("world"))
    if spec.camera.focus_distance is not None and spec.camera.f_number is None:
        found = f"{spec.camera.focus_distance} for a pinhole"
        raise place.below("camera").below("focus_distance").error("an f_number with it", found)
    cameras = np.array(spec.camera.target) + path_offsets(spec.camera, spec.camera.train + spec.camera.test)
    if spec.ground and cameras[:, 2].min() <= spec.ground.height:
        raise place.below("ground").below("height").error("a sheet below every camera", f"{spec.ground.height}")
    if spec.operator:
        _check_operator(spec, spec.operator, around, place.below("operator"))


def _check_room(spec: SceneSpec, around: float, place: Place) -> None:
    world = spec.world
    if world.distance is not None and world.distance_radii is not None:
        raise place.below("distance").error("a distance in scene units or in object radii", "both")
    if spec.room is None and world.room != World.room:
        raise place.below("room").error("a distance of its walls", "none")
    if world.room != "box" and world.proportions != World.proportions:
        raise place.below("proportions").error('the room "box" with them', f'"{world.room}"')
    if spec.room and spec.room.distance <= around:
        key = "distance" if world.distance_radii is None else "distance_radii"
        found = f"{spec.room.distance:.3g}, but the object and what stands around it reach {around:.3g} from the origin"
        raise place.below(key).error("surroundings that enclose the object", found)


def _check_operator(spec: SceneSpec, operator: Operator, around: float, place: Place) -> None:
    """The figures at all cameras must stand inside the room and beside the object."""
    cameras = np.array(spec.camera.target) + path_offsets(spec.camera, spec.camera.train + spec.camera.test)
    width, _ = operator.body_radii
    standing = operator.height - operator.head_radius
    feet = cameras - [0.0, 0.0, standing]
    if spec.room and not spec.room.holds(np.concatenate([cameras, feet]), width):
        raise place.below("height").error("a figure that the room holds at every camera", f"{operator.height}")
    nearest = cameras - np.clip(cameras[:, 2:], 0, standing) * [0.0, 0.0, 1.0]
    if np.linalg.norm(nearest, axis=-1).min() - width <= around:
        raise place.below("height").error("a figure that stands beside the object", f"{operator.height}")


def _check_object(spec: SceneSpec, place: Place) -> None:
    below = place.below("object")
    if isinstance(spec.object, Assembly):
        if not spec.object.parts:
            raise below.below("parts").error("at least one part", "none")
        _check_parts(spec.object.parts, below.below("parts"))
    elif not isinstance(spec.object, BlendFile):
        _check_parts((Part(spec.object),), below, numbered=False)
    if spec.material is None and not isinstance(spec.object, BlendFile):
        raise place.below("material").error("a material, unless the object comes from a Blender file", "none")


def _check_gap(panes: Panes, place: Place) -> None:
    narrowest = min(side / number for side, number in zip(panes.size, panes.count, strict=True))
    if panes.gap >= narrowest:
        raise place.error(f"a gap below the width of a pane, {narrowest:g}", f"{panes.gap:g}")


def _check_parts(parts: tuple[Part, ...], place: Place, numbered: bool = True) -> None:
    for i, part in enumerate(parts):
        at = place.below(str(i)).below("shape") if numbered else place
        if isinstance(part.shape, SurfaceOfRevolution):
            _check_profile(part.shape, at)
        if isinstance(part.shape, Plane | Panes | Frame) and math.hypot(*part.shape.normal) < 1e-6:
            raise at.below("normal").error("a direction", "a vector of length zero")
        if isinstance(part.shape, Panes):
            _check_gap(part.shape, at.below("gap"))
        if isinstance(part.shape, Frame):
            _check_distinct(part.shape.profile, 2, at.below("profile"))
        if isinstance(part.shape, SoftBalls):
            _check_balls(part.shape, at.below("balls"))
        if isinstance(part.shape, Tube):
            _check_distinct(part.shape.path, 3, at.below("path"))
            if len(part.shape.radii) != len(part.shape.path):
                found = f"{len(part.shape.radii)} for {len(part.shape.path)} points"
                raise at.below("radii").error("a radius for each point of the path", found)


def _check_distinct(points: tuple[tuple[float, ...], ...], fewest: int, place: Place) -> None:
    if len(points) < fewest:
        raise place.error(f"at least {('two', 'three')[fewest - 2]} points", f"{len(points)}")
    for i, (before, point) in enumerate(pairwise(points), 1):
        if math.dist(before, point) < 1e-9:
            raise place.error("points that differ from the one before", f"point {i} twice")


def _check_balls(shape: SoftBalls, place: Place) -> None:
    """Radii must be above 0, and some ball must be solid."""
    for i, (*_, radius, _strength) in enumerate(shape.balls):
        if radius <= 0:
            raise place.below(str(i)).error("a radius above 0", f"{radius}")
    if not any(strength >= 1 for *_, strength in shape.balls):
        raise place.error("a ball of strength 1 or more", "none")


def _check_profile(surface: SurfaceOfRevolution, place: Place) -> None:
    """Points must be distinct neighbors with radius ≥ 0; only the ends may lie on the axis."""
    profile, last = place.below("profile"), len(surface.profile) - 1
    for i, (radius, _) in enumerate(surface.profile):
        if radius < 0 or (0 < i < last and radius == 0):
            raise profile.error("radii ≥ 0, and above 0 between the ends", f"radius {radius} at point {i}")
    _check_distinct(surface.profile, 3, profile)
    ends = (0, *surface.creases, last)
    if any(before >= after for before, after in pairwise(ends)):
        found = f"{list(surface.creases)}"
        raise place.below("creases").error(f"rising numbers of inner points, from 1 to {last - 1}", found)
