"""Camera paths confined to one hemisphere, and the spread of training views along them."""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from shinypartial.camera import Camera, look_at
from shinypartial.errors import InputError


def limits(low: float, high: float) -> dict[str, tuple[float, float]]:
    """Metadata of a number in a recipe (or of each number in a tuple): the closed range that is allowed."""
    return {"limits": (low, high)}


@dataclass(frozen=True)
class Arc:
    """Parallel arcs of constant elevation, walked back and forth, all looking at one point."""

    path: str = field(default="arc", metadata={"choices": ("arc",)})
    """Kind of path; `arc` is the only one."""
    radius: float = field(default=3.2, metadata=limits(1e-3, 1e6))
    """Distance from the target in scene units."""
    target: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), metadata=limits(-1e6, 1e6))
    """World point that every camera looks at."""
    facing_azimuth_deg: float = field(default=-90.0, metadata=limits(-360.0, 360.0))
    """Azimuth of the middle of the arcs, from +X toward +Y: the side of the object that is photographed."""
    azimuth_deg: tuple[float, float] = field(default=(-75.0, 75.0), metadata=limits(-89.9, 89.9))
    """First and last azimuth relative to the facing one."""
    elevation_deg: tuple[float, float] = field(default=(-10.0, 50.0), metadata=limits(-85.0, 85.0))
    """Elevation from the horizon of the first and last arc."""
    sweeps: int = field(default=5, metadata=limits(1, 10_000))
    """Number of arcs."""
    lens_mm: float = field(default=50.0, metadata=limits(1.0, 10_000.0))
    """Focal length."""
    sensor_mm: float = field(default=36.0, metadata=limits(1.0, 1000.0))
    """Width of the square sensor."""
    train: int = field(default=100, metadata=limits(1, 100_000))
    """Number of training views, spread evenly along the path."""
    test: int = field(default=200, metadata=limits(1, 100_000))
    """Number of test views."""


@dataclass(frozen=True)
class Trajectory:
    """Cameras of both splits in the order of the path, and the axis of the open hemisphere that holds them all."""

    train: tuple[Camera, ...]
    test: tuple[Camera, ...]
    hemisphere_axis: Float[np.ndarray, "3"]


def arc(spec: Arc, resolution: int) -> Trajectory:
    """Place the cameras of an arc path; images are square with `resolution` pixels a side.

    The views are dealt to the sweeps as evenly as possible; within a sweep they are evenly spaced in angle, both ends
    included, and every second sweep runs backward. Raises InputError when a camera leaves the open hemisphere.
    """
    count = spec.train + spec.test
    positions = np.array(spec.target) + spec.radius * unit_vectors(arc_angles_deg(spec, count))
    focal = spec.lens_mm / spec.sensor_mm * resolution
    middle = resolution / 2
    cameras = tuple(
        Camera(look_at(position, np.array(spec.target)), focal, focal, middle, middle, resolution, resolution)
        for position in positions
    )
    axis = hemisphere_axis(spec)
    check_hemisphere(cameras, axis, np.array(spec.target))
    chosen = train_indices(spec.train, count)
    train = tuple(cameras[i] for i in chosen)
    test = tuple(cameras[i] for i in range(count) if i not in chosen)
    return Trajectory(train, test, axis)


def arc_angles_deg(spec: Arc, count: int) -> Float[np.ndarray, "V 2"]:
    """World azimuth and elevation of `count` cameras along the path."""
    elevations = _spread(spec.elevation_deg, spec.sweeps)
    angles = []
    for sweep, indices in enumerate(np.array_split(np.arange(count), spec.sweeps)):
        azimuths = spec.facing_azimuth_deg + _spread(spec.azimuth_deg, len(indices))
        forward = azimuths if sweep % 2 == 0 else azimuths[::-1]
        angles.append(np.stack([forward, np.full(len(indices), elevations[sweep])], -1))
    return np.concatenate(angles)


def _spread(ends: tuple[float, float], count: int) -> Float[np.ndarray, "V"]:
    """Evenly spaced values from end to end; a single one lies in the middle."""
    return np.linspace(*ends, count) if count > 1 else np.full(count, sum(ends) / 2)


def unit_vectors(angles_deg: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "... 3"]:
    """Unit vectors of azimuth (from +X toward +Y) and elevation (from the horizon) in degrees."""
    azimuth, elevation = np.moveaxis(np.radians(angles_deg), -1, 0)
    horizontal = np.cos(elevation)
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation)], -1)


def train_indices(train: int, count: int) -> frozenset[int]:
    """Positions of the training views among all: the middles of `train` equal shares (100 of 300: every third)."""
    return frozenset(math.floor((i + 0.5) * count / train) for i in range(train))


def hemisphere_axis(spec: Arc) -> Float[np.ndarray, "3"]:
    """Horizontal unit vector toward the middle of the arcs; the cameras must lie on that side of the target."""
    return unit_vectors(np.array([spec.facing_azimuth_deg, 0.0]))


def check_hemisphere(cameras: tuple[Camera, ...], axis: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> None:
    """Raise InputError unless (position − target)·axis > 0 for every camera."""
    heights = np.array([(camera.position_world - target) @ axis for camera in cameras])
    outside = np.flatnonzero(heights <= 0)
    if outside.size:
        raise InputError(
            expected="every camera within the open hemisphere that its arc faces",
            found=f"{outside.size} of {len(cameras)} outside, first number {outside[0]} at {heights[outside[0]]:.3g}",
            remedy="Narrow azimuth_deg to less than ±90 about facing_azimuth_deg.",
        )
