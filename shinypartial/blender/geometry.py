"""Meshes with exact vertex normals, made from the recipe's shapes (numpy only)."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from shinypartial.scene import Plane, Sphere, SurfaceOfRevolution


@dataclass(frozen=True)
class Mesh:
    """Polygons with one outward unit normal a vertex; a face lists its vertices counterclockwise from outside."""

    vertices: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]
    faces: list[tuple[int, ...]]


@dataclass(frozen=True)
class Outline:
    """Samples of a profile curve from bottom to top: (radius, z) and the outward normal in that half-plane."""

    points: Float[np.ndarray, "P 2"]
    normals: Float[np.ndarray, "P 2"]


def make_mesh(shape: SurfaceOfRevolution | Sphere | Plane) -> Mesh:
    """Mesh of any shape that a recipe may name."""
    if isinstance(shape, Plane):
        return _plane(shape)
    outline = sphere_outline(shape) if isinstance(shape, Sphere) else spline_outline(shape, shape.rings + 1)
    return _revolve(outline, shape.segments)


def spline_outline(surface: SurfaceOfRevolution, count: int) -> Outline:
    """Evaluate the profile at `count` equal steps of accumulated chord length.

    The cubic spline has no curvature at its ends, except that it meets the axis horizontally, so that the surface has
    a normal there.
    """
    from scipy.interpolate import CubicSpline

    knots = np.array(surface.profile, dtype=np.float64)
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    free, level = (2, 0.0), (1, 0.0)
    height_ends = tuple(level if knots[end, 0] == 0 else free for end in (0, -1))
    radius = CubicSpline(chord, knots[:, 0], bc_type=(free, free))
    height = CubicSpline(chord, knots[:, 1] + surface.offset_z, bc_type=height_ends)
    at = np.linspace(0, chord[-1], count)
    normals = np.stack([height(at, 1), -radius(at, 1)], -1)
    points = np.stack([np.maximum(radius(at), 0), height(at)], -1)
    return Outline(points, normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def sphere_outline(sphere: Sphere) -> Outline:
    """A half circle from the south pole to the north pole."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, sphere.rings + 1)
    normals = np.stack([np.cos(latitude), np.sin(latitude)], -1)
    normals[[0, -1], 0] = 0
    return Outline(sphere.radius * normals, normals)


def _revolve(outline: Outline, segments: int) -> Mesh:
    """Turn an outline about Z; a point on the axis becomes a single vertex with triangles around it."""
    azimuth = 2 * np.pi * np.arange(segments) / segments
    circle = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    vertices: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    rows: list[np.ndarray] = []
    for (radius, z), (outward, upward) in zip(outline.points, outline.normals, strict=True):
        ring = circle if radius > 0 else np.zeros((1, 2))
        start = sum(len(ring) for ring in vertices)
        rows.append(start + np.arange(segments) % len(ring))
        vertices.append(np.column_stack([radius * ring, np.full(len(ring), z)]))
        normals.append(np.column_stack([outward * ring, np.full(len(ring), upward)]))
    faces = [face for below, above in pairwise(rows) for face in _band(below, above)]
    unit = np.concatenate(normals)
    return Mesh(np.concatenate(vertices), unit / np.linalg.norm(unit, axis=-1, keepdims=True), faces)


def _band(below: np.ndarray, above: np.ndarray) -> list[tuple[int, ...]]:
    """Faces between two rings; a corner that is repeated at a pole is dropped."""
    quads = np.stack([below, np.roll(below, -1), np.roll(above, -1), above], -1).tolist()
    return [tuple(dict.fromkeys(quad)) for quad in quads]


def _plane(plane: Plane) -> Mesh:
    """A rectangle with one side horizontal (along +X when the plane itself is horizontal)."""
    normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
    side = np.cross([0.0, 0.0, 1.0], normal)
    side = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(side) < 1e-9 else side / np.linalg.norm(side)
    up = np.cross(normal, side)
    half_width, half_height = plane.size[0] / 2, plane.size[1] / 2
    corners = [(-half_width, -half_height), (half_width, -half_height), (half_width, half_height)]
    corners.append((-half_width, half_height))
    return Mesh(np.array([x * side + y * up for x, y in corners]), np.tile(normal, (4, 1)), [(0, 1, 2, 3)])
