"""What a recipe may put before the camera: shapes, their materials, and parts that join both."""

import math
from dataclasses import dataclass, field

from shinypartial.core.trajectory import limits


@dataclass(frozen=True)
class Material:
    """Parameters of Blender's Principled shader; the default is a perfect mirror."""

    base_color: tuple[float, float, float] = field(default=(1.0, 1.0, 1.0), metadata=limits(0.0, 1.0))
    metallic: float = field(default=1.0, metadata=limits(0.0, 1.0))
    roughness: float = field(default=0.0, metadata=limits(0.0, 1.0))


@dataclass(frozen=True)
class SurfaceOfRevolution:
    """A smooth surface: a cubic spline through profile points (radius, z), turned about the Z axis."""

    profile: tuple[tuple[float, float], ...] = field(metadata=limits(-1e3, 1e3))
    """At least three points from bottom to top along the outside, so that the surface faces outward."""
    kind: str = "surface_of_revolution"
    offset_z: float = field(default=0.0, metadata=limits(-1e3, 1e3))
    """Added to every z of the profile."""
    segments: int = field(default=256, metadata=limits(3, 4096))
    """Faces around the axis."""
    rings: int = field(default=320, metadata=limits(2, 4096))
    """Faces along the profile."""
    creases: tuple[int, ...] = field(default=(), metadata=limits(1, 10_000))
    """Numbers of inner profile points, counted from 0 and rising, where the surface has a sharp edge."""

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
class Frame:
    """A molding with flat faces around a rectangle about the origin, with mitered corners."""

    profile: tuple[tuple[float, float], ...] = field(metadata=limits(-1e3, 1e3))
    """At least two points (outward from the rectangle's edge, forward along the normal), from the inside outward."""
    kind: str = "frame"
    size: tuple[float, float] = field(default=(1.6, 1.6), metadata=limits(1e-3, 1e3))
    """Width (horizontal) and height of the rectangle that it surrounds."""
    normal: tuple[float, float, float] = field(default=(0.0, -1.0, 0.0), metadata=limits(-1.0, 1.0))
    """Direction that the front faces; need not be unit."""

    @property
    def extent(self) -> float:
        """Largest distance of a corner from the origin."""
        width, height = self.size
        return max(math.hypot(width / 2 + out, height / 2 + out, forward) for out, forward in self.profile)


@dataclass(frozen=True)
class Tube:
    """A tube along a smooth curve (a cubic spline through points) whose ends are open."""

    path: tuple[tuple[float, float, float], ...] = field(metadata=limits(-1e3, 1e3))
    """At least three points."""
    radii: tuple[float, ...] = field(metadata=limits(1e-4, 1e3))
    """Radius at each point, in the plane in which the curve bends."""
    kind: str = "tube"
    flatness: float = field(default=1.0, metadata=limits(0.01, 100.0))
    """Extent across that plane, as a multiple of the radius."""
    closed: bool = False
    """Whether the last point joins the first."""
    segments: int = field(default=48, metadata=limits(3, 4096))
    """Faces around the curve."""
    rings: int = field(default=160, metadata=limits(2, 4096))
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
    seed: int = field(default=0, metadata=limits(0, 2**31 - 1))
    """Determines the curve and how thick the form is along it."""
    harmonics: int = field(default=2, metadata=limits(1, 8))
    """Waves of the curve around its length: 1 is a ring."""
    radius: float = field(default=1.0, metadata=limits(1e-3, 1e3))
    """Distance of its farthest point from the origin."""
    thickness: float = field(default=0.35, metadata=limits(0.05, 1.0))
    """Radius of the form around the curve, in units of the curve's own radius."""
    variation: float = field(default=0.4, metadata=limits(0.0, 0.9))
    """By which share the thickness varies along the curve."""
    resolution: int = field(default=96, metadata=limits(8, 512))
    """Cells per side of the grid in which the surface is found."""

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
    seed: int = field(default=0, metadata=limits(0, 2**31 - 1))
    """Determines axes and coefficients, which fall with the square of the degree."""
    degree: int = field(default=4, metadata=limits(2, 16))
    """Highest degree: about the number of bumps around the form."""
    variation: float = field(default=0.08, metadata=limits(0.0, 0.2))
    """Root mean square of the radius about its mean, as a share of it."""
    radius: float = field(default=1.0, metadata=limits(1e-3, 1e3))
    """Distance of its farthest point from the origin."""
    segments: int = field(default=512, metadata=limits(3, 4096))
    """Faces around the Z axis."""
    rings: int = field(default=256, metadata=limits(2, 4096))
    """Faces from pole to pole."""

    @property
    def extent(self) -> float:
        """The radius."""
        return self.radius


@dataclass(frozen=True)
class Superquadric:
    """A rounded box (|x/a|^p + |y/b|^p)^(q/p) + |z/c|^q = 1 with half sizes a, b, c, twisted about the Z axis."""

    kind: str = "superquadric"
    size: tuple[float, float, float] = field(default=(1.2, 1.2, 1.2), metadata=limits(1e-3, 1e3))
    """Full sizes along X, Y and Z: 2a, 2b, 2c."""
    exponents: tuple[float, float] = field(default=(4.0, 4.0), metadata=limits(2.0, 12.0))
    """p of horizontal and q of vertical sections: 2 is an ellipse, more is nearer to a box with rounded edges."""
    twist_deg: float = field(default=0.0, metadata=limits(-720.0, 720.0))
    """By how much the top is turned against the bottom; sections between in proportion to their height."""
    segments: int = field(default=768, metadata=limits(3, 4096))
    """Faces around the Z axis."""
    rings: int = field(default=384, metadata=limits(2, 4096))
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
    radius: float = field(default=0.75, metadata=limits(1e-3, 1e3))
    """R, from the axis to the tube's center."""
    thickness: float = field(default=0.25, metadata=limits(1e-3, 1e3))
    """r, mean radius of the tube."""
    waves: int = field(default=0, metadata=limits(0, 64))
    """w, waves on the way around; without any the ring is a plain torus."""
    bend: float = field(default=0.0, metadata=limits(0.0, 1e3))
    """b, height of a wave."""
    swell: float = field(default=0.0, metadata=limits(0.0, 0.9))
    """s, share by which the thickness varies."""
    phase_deg: float = field(default=0.0, metadata=limits(-360.0, 360.0))
    """φ, between bend and swell."""
    segments: int = field(default=256, metadata=limits(3, 4096))
    """Faces around the tube."""
    rings: int = field(default=768, metadata=limits(3, 4096))
    """Faces along the ring."""

    @property
    def extent(self) -> float:
        """Largest possible distance from the origin."""
        return math.hypot(self.radius, self.bend) + self.thickness * (1 + self.swell)


@dataclass(frozen=True)
class SoftBalls:
    """A smooth form that is drawn with balls: the level set Σ s exp(1 − |x − c|²/r²) = 1, moved and scaled to fit."""

    balls: tuple[tuple[float, float, float, float, float], ...] = field(metadata=limits(-1e3, 1e3))
    """Center (x, y, z), radius r > 0 and strength s. Alone, a ball of strength 1 is a sphere of its radius; balls near
    one another melt together, and those of negative strength carve hollows."""
    kind: str = "soft_balls"
    radius: float = field(default=1.0, metadata=limits(1e-3, 1e3))
    """Distance of the farthest point from the origin, which is the middle of the form's bounding box."""
    resolution: int = field(default=128, metadata=limits(8, 512))
    """Cells per side of the grid in which the surface is found."""
    refinements: int = field(default=1, metadata=limits(0, 3))
    """How often each triangle is divided into four on the level set."""

    @property
    def extent(self) -> float:
        """The radius."""
        return self.radius


Shape = SurfaceOfRevolution | Sphere | Plane | Frame | Tube | Blob | RadialHarmonics | Superquadric | Ring | SoftBalls


@dataclass(frozen=True)
class Part:
    """A shape that is stretched, turned and moved, with a material of its own or with the scene's."""

    shape: Shape
    material: Material | None = None
    stretch: tuple[float, float, float] = field(default=(1.0, 1.0, 1.0), metadata=limits(1e-3, 1e3))
    """Factors along X, Y and Z, first of all."""
    turn_deg: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), metadata=limits(-360.0, 360.0))
    """Rotations about X, then Y, then Z, counterclockwise."""
    offset: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), metadata=limits(-1e3, 1e3))
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

    path: str
    """Absolute, or relative to the folder of scene.toml."""
    object: str
    """Name of the object that reflects; the file's other objects stand around it as in the file."""
    kind: str = "blend"

    @property
    def extent(self) -> float:
        """One, by definition."""
        return 1.0
