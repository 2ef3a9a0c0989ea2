"""What a recipe may put before the camera: shapes, their materials, and parts that join both."""

import math
from dataclasses import dataclass
from typing import Annotated

from shinypartial.core.trajectory import Seed, limits
from shinypartial.io.records import Share, Text

Coordinate = Annotated[float, limits(-1e3, 1e3)]
Length = Annotated[float, limits(1e-3, 1e3)]
Component = Annotated[float, limits(-1.0, 1.0)]
Edges = Annotated[int, limits(3, 4096)]


@dataclass(frozen=True)
class Material:
    """Parameters of Blender's Principled shader; the default is a perfect mirror."""

    base_color: tuple[Share, Share, Share] = (1.0, 1.0, 1.0)
    metallic: Share = 1.0
    roughness: Share = 0.0


@dataclass(frozen=True)
class SurfaceOfRevolution:
    """A smooth surface: a cubic spline through profile points (radius, z), turned about the Z axis."""

    profile: tuple[tuple[Coordinate, Coordinate], ...]
    """At least three points from bottom to top along the outside, so that the surface faces outward."""
    kind: str = "surface_of_revolution"
    offset_z: Coordinate = 0.0
    """Added to every z of the profile."""
    segments: Edges = 256
    """Faces around the axis."""
    rings: Annotated[int, limits(2, 4096)] = 320
    """Faces along the profile."""
    creases: tuple[Annotated[int, limits(1, 10_000)], ...] = ()
    """Numbers of inner profile points, counted from 0 and rising, where the surface has a sharp edge."""

    @property
    def extent(self) -> float:
        """Largest distance of a profile point from the origin."""
        return max(math.hypot(radius, z + self.offset_z) for radius, z in self.profile)


@dataclass(frozen=True)
class Sphere:
    """A sphere about the origin."""

    kind: str = "sphere"
    radius: Length = 1.0
    segments: Edges = 256
    rings: Annotated[int, limits(2, 4096)] = 128

    @property
    def extent(self) -> float:
        """The radius."""
        return self.radius


@dataclass(frozen=True)
class Plane:
    """A flat rectangle about the origin."""

    kind: str = "plane"
    size: tuple[Length, Length] = (1.6, 1.6)
    """Width (horizontal) and height."""
    normal: tuple[Component, Component, Component] = (0.0, -1.0, 0.0)
    """Direction that the front faces; need not be unit."""

    @property
    def extent(self) -> float:
        """Half the diagonal."""
        return math.hypot(*self.size) / 2


@dataclass(frozen=True)
class Panes:
    """Panes side by side in a rectangle about the origin, each tilted by chance and bulged as a paraboloid."""

    kind: str = "panes"
    size: tuple[Length, Length] = (1.6, 1.2)
    """Width (horizontal) and height of the rectangle."""
    normal: tuple[Component, Component, Component] = (0.0, -1.0, 0.0)
    """Direction that the front faces; need not be unit."""
    count: tuple[Annotated[int, limits(1, 100)], Annotated[int, limits(1, 100)]] = (4, 3)
    """Panes along width and height."""
    gap: Annotated[float, limits(0.0, 1e3)] = 0.0
    """Width of the bars that are left free between panes."""
    tilt_deg: Annotated[float, limits(0.0, 30.0)] = 0.5
    """Largest tilt about either side, drawn evenly from both signs."""
    bulge: Annotated[float, limits(0.0, 1.0)] = 0.004
    """How far the middle of a pane stands out over the middles of its sides."""
    seed: Seed = 0
    """Of the tilts, and of which panes bulge inward."""

    @property
    def extent(self) -> float:
        """Half the diagonal, and what tilts and bulges add to it at most."""
        largest = max(side / number for side, number in zip(self.size, self.count, strict=True))
        return math.hypot(*self.size) / 2 + self.bulge + largest * math.tan(math.radians(self.tilt_deg))


@dataclass(frozen=True)
class Frame:
    """A molding with flat faces around a rectangle about the origin, with mitered corners."""

    profile: tuple[tuple[Coordinate, Coordinate], ...]
    """At least two points (outward from the rectangle's edge, forward along the normal), from the inside outward."""
    kind: str = "frame"
    size: tuple[Length, Length] = (1.6, 1.6)
    """Width (horizontal) and height of the rectangle that it surrounds."""
    normal: tuple[Component, Component, Component] = (0.0, -1.0, 0.0)
    """Direction that the front faces; need not be unit."""

    @property
    def extent(self) -> float:
        """Largest distance of a corner from the origin."""
        width, height = self.size
        return max(math.hypot(width / 2 + out, height / 2 + out, forward) for out, forward in self.profile)


@dataclass(frozen=True)
class Tube:
    """A tube along a smooth curve (a cubic spline through points) whose ends are open."""

    path: tuple[tuple[Coordinate, Coordinate, Coordinate], ...]
    """At least three points."""
    radii: tuple[Annotated[float, limits(1e-4, 1e3)], ...]
    """Radius at each point, in the plane in which the curve bends."""
    kind: str = "tube"
    flatness: Annotated[float, limits(0.01, 100.0)] = 1.0
    """Extent across that plane, as a multiple of the radius."""
    closed: bool = False
    """Whether the last point joins the first."""
    segments: Edges = 48
    """Faces around the curve."""
    rings: Annotated[int, limits(2, 4096)] = 160
    """Faces along the curve."""

    @property
    def extent(self) -> float:
        """Largest distance from the origin, with a tenth to spare for what the spline does between points."""
        thickest = max(self.radii) * max(1.0, self.flatness)
        return 1.1 * max(math.hypot(*point) for point in self.path) + thickest


@dataclass(frozen=True)
class Blob:
    """A closed organic form without any symmetry: a level set of soft balls along a seeded closed curve in space."""

    kind: str = "blob"
    seed: Seed = 0
    """Determines the curve and how thick the form is along it."""
    harmonics: Annotated[int, limits(1, 8)] = 2
    """Waves of the curve around its length: 1 is a ring."""
    radius: Length = 1.0
    """Distance of its farthest point from the origin."""
    thickness: Annotated[float, limits(0.05, 1.0)] = 0.35
    """Radius of the form around the curve, in units of the curve's own radius."""
    variation: Annotated[float, limits(0.0, 0.9)] = 0.4
    """By which share the thickness varies along the curve."""
    resolution: Annotated[int, limits(8, 512)] = 96
    """Cells per side of the grid in which the surface is found."""
    refinements: Annotated[int, limits(0, 3)] = 0
    """How often each triangle is divided into four on the level set."""

    @property
    def extent(self) -> float:
        """The radius."""
        return self.radius


@dataclass(frozen=True)
class RadialHarmonics:
    """A closed smooth form whose radius is 1 + h(d) in direction d, h a seeded sum of harmonics of low degree.

    h(d) = Σ c P(d·u): Legendre polynomials P of degree 2 to `degree` about seeded axes u, scaled to the root mean
    square `variation`. The whole is then enlarged so that its farthest point lies at `radius`.
    """

    kind: str = "radial_harmonics"
    seed: Seed = 0
    """Determines axes and coefficients, which fall with the square of the degree."""
    degree: Annotated[int, limits(2, 16)] = 4
    """Highest degree: about the number of bumps around the form."""
    variation: Annotated[float, limits(0.0, 0.2)] = 0.08
    """Root mean square of the radius about its mean, as a share of it."""
    radius: Length = 1.0
    """Distance of its farthest point from the origin."""
    segments: Edges = 512
    """Faces around the Z axis."""
    rings: Annotated[int, limits(2, 4096)] = 256
    """Faces from pole to pole."""

    @property
    def extent(self) -> float:
        """The radius."""
        return self.radius


@dataclass(frozen=True)
class Superquadric:
    """A rounded box (|x/a|^p + |y/b|^p)^(q/p) + |z/c|^q = 1 with half sizes a, b, c, twisted about the Z axis."""

    kind: str = "superquadric"
    size: tuple[Length, Length, Length] = (1.2, 1.2, 1.2)
    """Full sizes along X, Y and Z: 2a, 2b, 2c."""
    exponents: tuple[Annotated[float, limits(2.0, 12.0)], Annotated[float, limits(2.0, 12.0)]] = (4.0, 4.0)
    """p of horizontal and q of vertical sections: 2 is an ellipse, more is nearer to a box with rounded edges."""
    twist_deg: Annotated[float, limits(-720.0, 720.0)] = 0.0
    """By how much the top is turned against the bottom; sections between in proportion to their height."""
    segments: Edges = 768
    """Faces around the Z axis."""
    rings: Annotated[int, limits(2, 4096)] = 384
    """Faces from pole to pole."""

    @property
    def extent(self) -> float:
        """Half the diagonal of the box that holds it."""
        return math.hypot(*self.size) / 2


@dataclass(frozen=True)
class Ring:
    """A torus about the Z axis whose tube may rise, fall and swell along its way around.

    At azimuth u the tube has its center at (R cos u, R sin u, b sin wu) and the radius r (1 + s cos(wu + φ)).
    """

    kind: str = "ring"
    radius: Length = 0.75
    """R, from the axis to the tube's center."""
    thickness: Length = 0.25
    """r, mean radius of the tube."""
    waves: Annotated[int, limits(0, 64)] = 0
    """w, waves on the way around; without any the ring is a plain torus."""
    bend: Annotated[float, limits(0.0, 1e3)] = 0.0
    """b, height of a wave."""
    swell: Annotated[float, limits(0.0, 0.9)] = 0.0
    """s, share by which the thickness varies."""
    phase_deg: Annotated[float, limits(-360.0, 360.0)] = 0.0
    """φ, between bend and swell."""
    segments: Edges = 256
    """Faces around the tube."""
    rings: Edges = 768
    """Faces along the ring."""

    @property
    def extent(self) -> float:
        """Largest possible distance from the origin."""
        return math.hypot(self.radius, self.bend) + self.thickness * (1 + self.swell)


@dataclass(frozen=True)
class SoftBalls:
    """A smooth form that is drawn with balls: the level set Σ s exp(1 − |x − c|²/r²) = 1, moved and scaled to fit."""

    balls: tuple[tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate], ...]
    """Center (x, y, z), radius r > 0 and strength s. Alone, a ball of strength 1 is a sphere of its radius; balls near
    one another melt together, and those of negative strength carve hollows."""
    kind: str = "soft_balls"
    radius: Length = 1.0
    """Distance of the farthest point from the origin, which is the middle of the form's bounding box."""
    resolution: Annotated[int, limits(8, 512)] = 128
    """Cells per side of the grid in which the surface is found."""
    refinements: Annotated[int, limits(0, 3)] = 1
    """How often each triangle is divided into four on the level set."""

    @property
    def extent(self) -> float:
        """The radius."""
        return self.radius


Shape = (
    SurfaceOfRevolution
    | Sphere
    | Plane
    | Panes
    | Frame
    | Tube
    | Blob
    | RadialHarmonics
    | Superquadric
    | Ring
    | SoftBalls
)


@dataclass(frozen=True)
class Part:
    """A shape that is stretched, turned and moved, with a material of its own or with the scene's."""

    shape: Shape
    material: Material | None = None
    stretch: tuple[Length, Length, Length] = (1.0, 1.0, 1.0)
    """Factors along X, Y and Z, first of all."""
    turn_deg: tuple[
        Annotated[float, limits(-360.0, 360.0)],
        Annotated[float, limits(-360.0, 360.0)],
        Annotated[float, limits(-360.0, 360.0)],
    ] = (0.0, 0.0, 0.0)
    """Rotations about X, then Y, then Z, counterclockwise."""
    offset: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    """Where the shape's origin lies, last of all."""

    @property
    def extent(self) -> float:
        """Distance from the origin that the part does not exceed."""
        return max(self.stretch) * self.shape.extent + math.hypot(*self.offset)


@dataclass(frozen=True)
class Assembly:
    """Several parts that are one object; their coordinates are the world's."""

    parts: tuple[Part, ...]
    kind: str = "assembly"

    @property
    def extent(self) -> float:
        """That of the part which reaches farthest."""
        return max(part.extent for part in self.parts)


@dataclass(frozen=True)
class BlendFile:
    """An object of a Blender file, moved and scaled so that its bounding sphere is the unit sphere."""

    path: Text
    """Absolute, or relative to the folder of scene.toml."""
    object: Text
    """Name of the object that reflects; the file's other objects stand around it as in the file."""
    kind: str = "blend"

    @property
    def extent(self) -> float:
        """One, by definition."""
        return 1.0
