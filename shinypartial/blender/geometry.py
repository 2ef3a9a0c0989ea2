"""Meshes with exact vertex normals, made from the recipe's shapes (numpy only)."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float

from shinypartial.blender.closed_forms import harmonic_mesh, ring_mesh, superquadric_mesh
from shinypartial.blender.mesh import Outline, grid_faces, joined, placed
from shinypartial.blender.organic import blob_mesh, soft_balls_mesh
from shinypartial.core.mesh import Mesh
from shinypartial.scene import (
    Blob,
    Frame,
    Panes,
    Part,
    Plane,
    RadialHarmonics,
    Ring,
    Shape,
    SoftBalls,
    Sphere,
    Superquadric,
    SurfaceOfRevolution,
    Tube,
)

#: Squares per side of a plane that is to be deformed: bumps of a tenth of its width take 25 of them.
DEFORMED_PLANE_DIVISIONS = 256
#: Squares per side of a pane.
PANE_DIVISIONS = 16


def make_part(part: Part, *, fine: bool = False) -> Mesh:
    """Mesh of a part's shape, stretched, turned and moved."""
    return placed(make_mesh(part.shape, fine=fine), part.stretch, part.turn_deg, part.offset)


def make_mesh(shape: Shape, *, fine: bool = False) -> Mesh:
    """Mesh of any shape that a recipe may name; `fine` divides flat faces too, so that they can be deformed."""
    if isinstance(shape, Plane):
        return _plane(shape, DEFORMED_PLANE_DIVISIONS if fine else 1)
    if isinstance(shape, Panes):
        return _panes(shape)
    if isinstance(shape, Frame):
        return _frame(shape)
    if isinstance(shape, Tube):
        return _tube(shape)
    if isinstance(shape, Blob):
        return blob_mesh(shape)
    if isinstance(shape, SoftBalls):
        return soft_balls_mesh(shape)
    if isinstance(shape, Ring):
        return ring_mesh(shape)
    if isinstance(shape, RadialHarmonics):
        return harmonic_mesh(shape, _sphere(1.0, shape.segments, shape.rings))
    if isinstance(shape, Superquadric):
        return superquadric_mesh(shape, _sphere(1.0, shape.segments, shape.rings))
    if isinstance(shape, Sphere):
        return _sphere(shape.radius, shape.segments, shape.rings)
    return joined([_revolve(piece, shape.segments) for piece in profile_outlines(shape)])


def profile_outlines(surface: SurfaceOfRevolution) -> list[Outline]:
    """The smooth pieces of a profile between its creases; `rings` are dealt to them by length, at least one each."""
    ends = (0, *surface.creases, len(surface.profile) - 1)
    lengths = [_chord(surface.profile[first : last + 1])[-1] for first, last in pairwise(ends)]
    counts = [max(1, round(surface.rings * length / sum(lengths))) for length in lengths]
    return [
        _spline_piece(surface.profile[first : last + 1], surface.offset_z, count + 1)
        for (first, last), count in zip(pairwise(ends), counts, strict=True)
    ]


def _chord(points: tuple[tuple[float, float], ...]) -> Float[np.ndarray, "P"]:
    steps = np.linalg.norm(np.diff(np.array(points, dtype=np.float64), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _spline_piece(points: tuple[tuple[float, float], ...], offset_z: float, count: int) -> Outline:
    """A cubic spline through the points, evaluated at `count` equal steps of accumulated chord length.

    It has no curvature at its ends, except that it meets the axis horizontally, so that the surface has a normal
    there. Two points make a straight line, which may meet the axis at any angle.
    """
    from scipy.interpolate import CubicSpline

    knots, chord = np.array(points, dtype=np.float64), _chord(points)
    at = np.linspace(0, chord[-1], count)
    free, level = (2, 0.0), (1, 0.0)
    straight = len(points) == 2
    height_ends = tuple(level if knots[end, 0] == 0 and not straight else free for end in (0, -1))
    radius = CubicSpline(chord, knots[:, 0], bc_type=(free, free))
    height = CubicSpline(chord, knots[:, 1] + offset_z, bc_type=height_ends)
    normals = np.stack([height(at, 1), -radius(at, 1)], -1)
    samples = np.stack([np.maximum(radius(at), 0), height(at)], -1)
    samples[[0, -1], 0] = knots[[0, -1], 0]  # An end on the axis is there exactly, so that it becomes one vertex.
    return Outline(samples, normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def _sphere(radius: float, segments: int, rings: int) -> Mesh:
    """A half circle from the south pole to the north pole, turned about Z."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    normals = np.stack([np.cos(latitude), np.sin(latitude)], -1)
    normals[[0, -1], 0] = 0
    return _revolve(Outline(radius * normals, normals), segments)


def _revolve(outline: Outline, segments: int) -> Mesh:
    """Turn an outline about Z; a point on the axis becomes a single vertex with triangles around it."""
    azimuth = 2 * np.pi * np.arange(segments) / segments
    circle = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    vertices: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    rows: list[np.ndarray] = []
    start = 0
    for (radius, z), (outward, upward) in zip(outline.points, outline.normals, strict=True):
        on_axis = radius <= 0
        ring = np.zeros((1, 2)) if on_axis else circle
        rows.append(start + np.arange(segments) % len(ring))
        start += len(ring)
        vertices.append(np.column_stack([radius * ring, np.full(len(ring), z)]))
        # On the axis of a cone the mean of the normals around it is the axis itself.
        up = np.sign(upward) if on_axis else upward
        normals.append(np.column_stack([outward * ring, np.full(len(ring), up)]))
    faces = [face for below, above in pairwise(rows) for face in _band(below, above)]
    unit = np.concatenate(normals)
    return Mesh(np.concatenate(vertices), unit / np.linalg.norm(unit, axis=-1, keepdims=True), faces)


def _band(below: np.ndarray, above: np.ndarray) -> list[tuple[int, ...]]:
    """Faces between two rings; a corner that is repeated at a pole is dropped."""
    quads = np.stack([below, np.roll(below, -1), np.roll(above, -1), above], -1).tolist()
    return [tuple(dict.fromkeys(quad)) for quad in quads]


def _upright_axes(normal: tuple[float, float, float]) -> Float[np.ndarray, "3 3"]:
    """Rows: a horizontal side (+X when the plane itself is horizontal), up, and the unit normal."""
    front = np.array(normal) / np.linalg.norm(normal)
    side = np.cross([0.0, 0.0, 1.0], front)
    side = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(side) < 1e-9 else side / np.linalg.norm(side)
    return np.stack([side, np.cross(front, side), front])


def _plane(plane: Plane, divisions: int) -> Mesh:
    """A rectangle with one side horizontal, cut into divisions² rectangles."""
    axes = _upright_axes(plane.normal)
    x, y = np.meshgrid(*(size * (np.arange(divisions + 1) / divisions - 0.5) for size in plane.size))
    vertices = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3) @ axes
    faces = grid_faces(divisions + 1, divisions + 1)
    return Mesh(vertices, np.tile(axes[2], (len(vertices), 1)), faces)


def _panes(panes: Panes) -> Mesh:
    """Over each pane h(x, y) = a x + b y + s (1 − x²/X² − y²/Y²), with the half sides X and Y; normals (−∇h, 1)."""
    axes, random, pieces = _upright_axes(panes.normal), np.random.default_rng(panes.seed), list[Mesh]()
    size, count = np.array(panes.size), np.array(panes.count)
    half = (size / count - panes.gap) / 2
    x, y = (each.ravel() for each in np.meshgrid(*(side * np.linspace(-1, 1, PANE_DIVISIONS + 1) for side in half)))
    for column, row in np.ndindex(*panes.count):
        middle = ((np.array([column, row]) + 0.5) / count - 0.5) * size
        a, b = np.tan(np.radians(random.uniform(-panes.tilt_deg, panes.tilt_deg, 2)))
        rise = panes.bulge * random.choice([-1.0, 1.0])
        height = a * x + b * y + rise * (1 - (x / half[0]) ** 2 - (y / half[1]) ** 2)
        slopes = a - 2 * rise * x / half[0] ** 2, b - 2 * rise * y / half[1] ** 2
        normals = np.stack([-slopes[0], -slopes[1], np.ones_like(x)], 1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        vertices = np.stack([middle[0] + x, middle[1] + y, height], 1)
        pieces.append(Mesh(vertices @ axes, normals @ axes, grid_faces(PANE_DIVISIONS + 1, PANE_DIVISIONS + 1)))
    return joined(pieces)


def _frame(frame: Frame) -> Mesh:
    """Flat faces between neighboring profile points, on each of the four sides."""
    axes = _upright_axes(frame.normal)
    half = np.array(frame.size) / 2
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    pieces = []
    for inner, outer in pairwise(frame.profile):
        for i in range(4):
            pair = corners[[i, (i + 1) % 4]]
            near, far = (
                np.column_stack([pair * (half + out), np.full(2, forward)]) @ axes for out, forward in (inner, outer)
            )
            quad = np.stack([far[0], far[1], near[1], near[0]])
            normal = np.cross(quad[1] - quad[0], quad[3] - quad[0])
            pieces.append(Mesh(quad, np.tile(normal / np.linalg.norm(normal), (4, 1)), [(0, 1, 2, 3)]))
    return joined(pieces)


def _tube(tube: Tube) -> Mesh:
    """Rings of ellipses across the curve, carried along it without twist; normals from the surface's derivatives."""
    from scipy.interpolate import CubicSpline

    points, radii = np.array(tube.path, dtype=np.float64), np.array(tube.radii)
    if tube.closed:
        points, radii = np.concatenate([points, points[:1]]), np.append(radii, radii[0])
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    ends = "periodic" if tube.closed else "natural"
    center, radius = CubicSpline(chord, points, bc_type=ends), CubicSpline(chord, radii, bc_type=ends)
    at = np.linspace(0, chord[-1], tube.rings + 1)
    tangents = center(at, 1)
    tangents /= np.linalg.norm(tangents, axis=-1, keepdims=True)
    side, across = _carried_axes(tangents, _bending_plane_normal(points))
    angle = 2 * np.pi * np.arange(tube.segments) / tube.segments
    cos, sin = np.cos(angle)[None, :, None], np.sin(angle)[None, :, None]
    side, across = side[:, None], tube.flatness * across[:, None]
    scale = np.maximum(radius(at), 1e-6)[:, None, None]
    vertices = center(at)[:, None] + scale * (cos * side + sin * across)
    around = scale * (cos * across - sin * side)
    along = np.gradient(vertices, at, axis=0, edge_order=2)
    if tube.closed:
        along[[0, -1]] = ((vertices[1] - vertices[-2]) / (2 * at[1]))[None]
    normals = np.cross(around, along)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    faces = grid_faces(tube.rings + 1, tube.segments, wrap=True)
    return Mesh(vertices.reshape(-1, 3), normals.reshape(-1, 3), faces)


def _bending_plane_normal(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "3"]:
    """The direction in which the points of a curve are spread least."""
    return np.linalg.svd(points - points.mean(0))[2][-1]


def _carried_axes(
    tangents: Float[np.ndarray, "P 3"], first: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Two unit vectors across each tangent; the second starts near `first` and is carried along without twist."""
    carried, across = first, []
    for tangent in tangents:
        carried = carried - (carried @ tangent) * tangent
        carried = carried / np.linalg.norm(carried)
        across.append(carried)
    second = np.stack(across)
    return np.cross(second, tangents), second
