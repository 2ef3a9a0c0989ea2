"""Camera paths confined to one hemisphere, or all around, and which of their views are for training."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import numpy as np
from jaxtyping import Float
from msgspec import Meta

from shinypartial.core.camera import Camera, look_at
from shinypartial.core.errors import InputError

PathKind = Literal["arc", "plus", "golden_spiral", "zigzag", "diamond", "around"]
PATHS = get_args(PathKind)
#: The path that no hemisphere holds.
AROUND: PathKind = "around"
#: The paths that `sweeps` shapes.
SWEPT_PATHS = ("arc", "zigzag", "diamond")
Placement = Literal["interleaved", "random"]
PLACEMENTS = get_args(Placement)
GOLDEN_ANGLE_RAD = math.pi * (3 - math.sqrt(5))
#: Multiples of the inverse golden ratio, modulo 1, stay far apart: one phase of the interleaving for each seed.
PHASE_STEP = (math.sqrt(5) - 1) / 2
#: At this angle from its middle a camera on the plane of the plus is 5.8 times as far away.
LARGEST_PLUS_ANGLE_DEG = 80.0
#: The cosine of 90° comes out at 6e-17, not at zero.
SMALLEST_HEIGHT = 1e-12


def limits(low: float, high: float) -> Meta:
    """The closed range of a number, to stand at its field: `Annotated[float, limits(0, 1)]`."""
    return Meta(ge=low, le=high)


Coordinate = Annotated[float, limits(-1e6, 1e6)]
AzimuthDeg = Annotated[float, limits(-89.9, 89.9)]
ElevationDeg = Annotated[float, limits(-85.0, 85.0)]
ViewCount = Annotated[int, limits(1, 100_000)]
Seed = Annotated[int, limits(0, 2**31 - 1)]


@dataclass(frozen=True)
class CameraPath:
    """A path on the side of the object that is photographed; all cameras look at one point."""

    path: PathKind = "arc"
    """Kind of path: `arc`, `plus`, `golden_spiral`, `zigzag`, `diamond`, or `around` the object from all sides."""
    radius: Annotated[float, limits(1e-3, 1e6)] = 3.2
    """Distance from the target in scene units; for `plus` that of its middle, from which the lines lead away."""
    target: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    """World point that every camera looks at."""
    facing_azimuth_deg: Annotated[float, limits(-360.0, 360.0)] = -90.0
    """Azimuth of the hemisphere's axis, from +X toward +Y: the side of the object that is photographed."""
    azimuth_deg: tuple[AzimuthDeg, AzimuthDeg] = (-75.0, 75.0)
    """First and last azimuth relative to the facing one; `around` takes all."""
    elevation_deg: tuple[ElevationDeg, ElevationDeg] = (-10.0, 50.0)
    """First and last elevation from the horizon."""
    sweeps: Annotated[int, limits(1, 10_000)] = 5
    """Number of arcs, strokes of the zigzag or nested diamonds; the other paths have none."""
    lens_mm: Annotated[float, limits(1.0, 10_000.0)] = 50.0
    """Focal length."""
    sensor_mm: Annotated[float, limits(1.0, 1000.0)] = 36.0
    """Width of the square sensor."""
    train: ViewCount = 100
    """Number of training views."""
    test: ViewCount = 200
    """Number of test views."""
    placement: Placement = "interleaved"
    """Training views spread evenly along the path (`interleaved`) or drawn by chance (`random`)."""
    seed: Seed = 0
    """Seed of the draw; for `interleaved` it chooses the view that is first."""
    f_number: Annotated[float, limits(0.01, 1000.0)] | None = None
    """Focal length over the diameter of the aperture, for a scene unit of one meter; a pinhole when not given."""
    focus_distance: Annotated[float, limits(1e-3, 1e6)] | None = None
    """Depth of the plane that is sharp, in scene units; that of the target when not given."""
    motion_deg: Annotated[float, limits(0.0, 30.0)] = 0.0
    """Angle around the vertical through the target by which the camera moves during the exposure."""

    @property
    def is_ideal(self) -> bool:
        """Whether each picture is taken from a single point."""
        return self.f_number is None and self.motion_deg == 0


@dataclass(frozen=True)
class Trajectory:
    """Cameras of both splits in the order of the path, and the open hemisphere about `target` that holds them all."""

    train: tuple[Camera, ...]
    test: tuple[Camera, ...]
    hemisphere_axis: Float[np.ndarray, "3"] | None
    """None for cameras from all sides."""
    target: Float[np.ndarray, "3"]


def plan_cameras(spec: CameraPath, resolution: int) -> Trajectory:
    """Place the cameras of a path; images are square with `resolution` pixels a side.

    Raises InputError when a camera leaves the open hemisphere about the facing direction, or looks straight down or up.
    """
    count = spec.train + spec.test
    target, axis = np.array(spec.target), None if spec.path == AROUND else hemisphere_axis(spec)
    positions = target + path_offsets(spec, count)
    if axis is not None:
        check_hemisphere(positions - target, axis)
    focal = spec.lens_mm / spec.sensor_mm * resolution
    middle = resolution / 2
    cameras = [
        Camera(look_at(position, target), focal, focal, middle, middle, resolution, resolution)
        for position in positions
    ]
    chosen = train_indices(spec)
    train = tuple(cameras[i] for i in sorted(chosen))
    test = tuple(cameras[i] for i in range(count) if i not in chosen)
    return Trajectory(train, test, axis, target)


def path_offsets(spec: CameraPath, count: int) -> Float[np.ndarray, "V 3"]:
    """Positions of `count` cameras relative to the target, in the order of the path."""
    if spec.path == "plus":
        return plus_offsets(spec, count)
    angles = {
        "arc": arc_angles_deg,
        "golden_spiral": golden_spiral_angles_deg,
        "zigzag": zigzag_angles_deg,
        "diamond": diamond_angles_deg,
        "around": around_angles_deg,
    }[spec.path](spec, count)
    return spec.radius * unit_vectors(angles + np.array([spec.facing_azimuth_deg, 0.0]))


def arc_angles_deg(spec: CameraPath, count: int) -> Float[np.ndarray, "V 2"]:
    """Parallel arcs of constant elevation, walked back and forth: azimuth from the facing one, and elevation.

    The views are dealt to the arcs as evenly as possible; within an arc they are evenly spaced in angle, both ends
    included, and every second arc runs backward.
    """
    elevations = _spread(spec.elevation_deg, spec.sweeps)
    angles = []
    for sweep, indices in enumerate(np.array_split(np.arange(count), spec.sweeps)):
        azimuths = _spread(spec.azimuth_deg, len(indices))
        forward = azimuths if sweep % 2 == 0 else azimuths[::-1]
        angles.append(np.stack([forward, np.full(len(indices), elevations[sweep])], -1))
    return np.concatenate(angles)


def plus_offsets(spec: CameraPath, count: int) -> Float[np.ndarray, "V 3"]:
    """Two straight lines that cross in a plane, first the horizontal one: offset = r (c + tan α · a + tan ε · b).

    c looks from the target to the crossing, at the middles of both angular ranges; a (horizontal) and b (upward) are
    unit vectors at right angles to it. α and ε are the angles from c that the ranges leave to either side; on each
    line the cameras are evenly spaced, both ends included. Raises InputError for angles above 80°.
    """
    azimuth, elevation = (sum(ends) / 2 for ends in (spec.azimuth_deg, spec.elevation_deg))
    vertical = 2 * ((count + 1) // 4)  # An even number, so that no two cameras meet at the crossing.
    across = math.tan(_plus_angle_rad(spec.azimuth_deg, "azimuth_deg")) * _spread((-1.0, 1.0), count - vertical)
    along = math.tan(_plus_angle_rad(spec.elevation_deg, "elevation_deg")) * _spread((-1.0, 1.0), vertical)
    world_azimuth = azimuth + spec.facing_azimuth_deg
    crossing = unit_vectors(np.array([world_azimuth, elevation]))
    rightward = unit_vectors(np.array([world_azimuth + 90.0, 0.0]))
    upward = unit_vectors(np.array([world_azimuth, elevation + 90.0]))
    lines = [across[:, None] * rightward, along[:, None] * upward]
    return spec.radius * (crossing + np.concatenate(lines))


def _plus_angle_rad(ends: tuple[float, float], key: str) -> float:
    angle = (ends[1] - ends[0]) / 2
    if angle > LARGEST_PLUS_ANGLE_DEG:
        raise InputError(
            expected=f"lines of the plus that lead at most {LARGEST_PLUS_ANGLE_DEG:g}° away from its middle",
            found=f"{key} from {ends[0]:g}° to {ends[1]:g}°, {angle:g}° to either side",
            remedy=f"Narrow {key}; toward 90° the cameras on a straight line move infinitely far away.",
        )
    return math.radians(angle)


def golden_spiral_angles_deg(spec: CameraPath, count: int) -> Float[np.ndarray, "V 2"]:
    """Each camera a golden angle on from the one before, at √((i + ½)/count) of the way out: evenly spread.

    They fill the ellipse that touches the angular ranges.
    """
    index = np.arange(count)
    outward, turn = np.sqrt((index + 0.5) / count), index * GOLDEN_ANGLE_RAD
    return _from_unit_square(spec, np.stack([outward * np.cos(turn), outward * np.sin(turn)], -1))


def zigzag_angles_deg(spec: CameraPath, count: int) -> Float[np.ndarray, "V 2"]:
    """`sweeps` slanting strokes from side to side, of steadily rising elevation."""
    upward = _spread((0.0, 1.0), count)
    stroke = upward * spec.sweeps
    sideward = 1 - np.abs(stroke % 2 - 1)
    return _from_unit_square(spec, 2 * np.stack([sideward, upward], -1) - 1)


def diamond_angles_deg(spec: CameraPath, count: int) -> Float[np.ndarray, "V 2"]:
    """`sweeps` nested diamonds from the innermost outward, cameras evenly spaced along all of them together.

    The corners of the outermost lie at the middles of the sides of the angular ranges.
    """
    sizes = np.arange(1, spec.sweeps + 1)
    ends = np.cumsum(sizes)
    length = np.arange(count) * ends[-1] / count
    ring = np.searchsorted(ends, length, side="right")
    corner = 4 * (length - (ends - sizes)[ring]) / sizes[ring]
    # |x| + |y| = 1 at every part of the way round: both are triangle waves, a quarter turn apart.
    wave = np.stack([np.abs((corner + shift) % 4 - 2) - 1 for shift in (0.0, 3.0)], -1)
    return _from_unit_square(spec, wave * (sizes[ring] / spec.sweeps)[:, None])


def around_angles_deg(spec: CameraPath, count: int) -> Float[np.ndarray, "V 2"]:
    """From the lower elevation to the higher one, a golden angle on each time, evenly over that belt of the sphere.

    The first camera stands at the facing azimuth.
    """
    low, high = np.sin(np.radians(spec.elevation_deg))
    heights = low + (high - low) * (np.arange(count) + 0.5) / count
    azimuths = np.degrees(np.arange(count) * GOLDEN_ANGLE_RAD) % 360
    return np.stack([azimuths, np.degrees(np.arcsin(heights))], -1)


def _from_unit_square(spec: CameraPath, points: Float[np.ndarray, "V 2"]) -> Float[np.ndarray, "V 2"]:
    """Stretch [−1, 1]² to the ranges of azimuth and elevation."""
    low, high = np.array([spec.azimuth_deg, spec.elevation_deg]).T
    return (low + high) / 2 + points * (high - low) / 2


def _spread(ends: tuple[float, float], count: int) -> Float[np.ndarray, "V"]:
    """Evenly spaced values from end to end; a single one lies in the middle."""
    return np.linspace(*ends, count) if count > 1 else np.full(count, sum(ends) / 2)


def unit_vectors(angles_deg: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "... 3"]:
    """Unit vectors of azimuth (from +X toward +Y) and elevation (from the horizon) in degrees."""
    azimuth, elevation = np.moveaxis(np.radians(angles_deg), -1, 0)
    horizontal = np.cos(elevation)
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation)], -1)


def train_indices(spec: CameraPath) -> frozenset[int]:
    """Positions of the training views among all.

    `interleaved`: one in each of `train` equal shares of the path (100 of 300: every third), at the same phase of each;
    seed 0 takes the middle. `random`: drawn without replacement.
    """
    count = spec.train + spec.test
    if spec.placement == "random":
        return frozenset(np.random.default_rng(spec.seed).permutation(count)[: spec.train].tolist())
    phase = (0.5 + spec.seed * PHASE_STEP) % 1.0
    return frozenset(math.floor((i + phase) * count / spec.train) for i in range(spec.train))


def hemisphere_axis(spec: CameraPath) -> Float[np.ndarray, "3"]:
    """Horizontal unit vector of the facing azimuth; the cameras must lie on that side of the target."""
    return unit_vectors(np.array([spec.facing_azimuth_deg, 0.0]))


def check_hemisphere(offsets: Float[np.ndarray, "V 3"], axis: Float[np.ndarray, "3"]) -> None:
    """Raise InputError unless (position − target)·axis > 0 for every camera, by more than rounding."""
    heights = offsets @ axis / np.linalg.norm(offsets, axis=-1)
    outside = np.flatnonzero(~(heights > SMALLEST_HEIGHT))
    if outside.size:
        raise InputError(
            expected="every camera within the open hemisphere that its path faces",
            found=f"{outside.size} of {len(heights)} outside, first number {outside[0]} at {heights[outside[0]]:.3g}",
            remedy="Narrow azimuth_deg to less than ±90 about facing_azimuth_deg (a plus that stands high: to less).",
        )
