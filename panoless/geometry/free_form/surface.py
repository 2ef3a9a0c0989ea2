"""A closed surface as the zero level of a tricubic uniform B-spline φ, negative inside, over a box."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from panoless.environment.surroundings import FAR, Surroundings
from panoless.first_surface.mesh import TriangleMesh
from panoless.kernels.level_set import empty_cells, evaluate, first_hits, nearest_approach
from shinypartial.core.camera import Similarity

NEAREST = 6
"""Vertices whose tangent planes give the distance from a mesh."""
LEAF = 64
"""Vertices in a leaf of the tree that is searched; most nodes are far from all, where large leaves are faster."""
LEAST_SLOPE = 0.3
"""Lower bound of ‖∇φ‖ where it is divided by."""
NODE = 1.0
"""The coefficient with index 0 has its peak so many cells before the first knot."""
POINTS_AT_ONCE = 1 << 17


@dataclass(frozen=True)
class Hits:
    """Where rays of unit direction meet a surface: distance in the normalized frame, infinite for a miss, the places
    there in cells, and φ with its derivatives in cells (see `panoless.kernels.level_set`).
    """

    distance: Float[np.ndarray, "P"]
    places: Float[np.ndarray, "P 3"]
    derivatives: Float[np.ndarray, "P 10"]

    @property
    def met(self) -> Bool[np.ndarray, "P"]:
        """Which rays meet the surface, or come near to it."""
        return np.isfinite(self.distance)

    @property
    def normals(self) -> Float[np.ndarray, "P 3"]:
        """Unit normals ∇φ/‖∇φ‖; zero for a miss."""
        gradient = self.derivatives[:, 1:4]
        return gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)

    def facing(self, directions: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """cos θ between the normals and rays of those directions; zero for a miss."""
        found: Float[np.ndarray, "P"] = -(self.normals * directions).sum(1)
        return found


@dataclass(frozen=True)
class LevelSet:
    """φ(x) = h Σ c_ijk B(u − i) B(v − j) B(w − k) with (u, v, w) = (x − low)/h + 1 and h the `spacing`.

    Knots begin at `low`, in the normalized frame. Coefficients are in cells, so ∇φ is their spline's slope by places.
    """

    low: Float[np.ndarray, "3"]
    spacing: float
    coefficients: Float[np.ndarray, "A B C"]
    surroundings: Surroundings = FAR
    """What it stands in."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """How many coefficients there are along x, y and z."""
        rows, columns, layers = self.coefficients.shape
        return rows, columns, layers

    @property
    def extent(self) -> Float[np.ndarray, "3"]:
        """Sides of the box, in the normalized frame."""
        return (np.array(self.shape) - 3) * self.spacing

    @property
    def cells(self) -> int:
        """Along the longest side of the box."""
        return max(self.shape) - 3

    def places(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Points of the normalized frame, in cells."""
        return (points - self.low) / self.spacing

    def points(self, places: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """The inverse of `places`."""
        return places * self.spacing + self.low

    def nodes(self) -> Float[np.ndarray, "A B C 3"]:
        """Where the coefficients have their peaks, in cells."""
        axes = [np.arange(count) - NODE for count in self.shape]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1)

    def at_nodes(self) -> Float[np.ndarray, "A B C"]:
        """φ at the nodes, in cells: (c₋₁ + 4 c₀ + c₁)/6 along each axis; c itself at the outermost."""
        value = self.coefficients
        for axis in range(3):
            line = np.moveaxis(value, axis, 0)
            inner = (line[:-2] + 4 * line[1:-1] + line[2:]) / 6
            value = np.moveaxis(np.concatenate([line[:1], inner, line[-1:]]), 0, axis)
        return value

    def hits(
        self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], *, leaving: bool = False
    ) -> Hits:
        """Where rays of unit direction meet the surface first; those `leaving` it start on it."""
        starts = self.places(origins)
        distance = first_hits(self.coefficients, starts, directions, leaving=leaving, empty=self._empty)
        return self._along(starts, directions, distance)

    def hits_at(
        self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], distance: Float[np.ndarray, "P"]
    ) -> Hits:
        """The same where the distance is known already, infinite for a miss."""
        return self._along(self.places(origins), directions, distance / self.spacing)

    def meets(self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, "P"]:
        """Whether rays of unit direction meet the surface."""
        return np.isfinite(first_hits(self.coefficients, self.places(origins), directions, empty=self._empty))

    def meets_again(
        self, places: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]
    ) -> Bool[np.ndarray, "P"]:
        """Whether rays that leave the surface at places in cells meet it again."""
        return np.isfinite(first_hits(self.coefficients, places, directions, leaving=True, empty=self._empty))

    def nearest(self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]) -> Hits:
        """Where φ is least along rays of unit direction; an infinite distance for those that miss the box."""
        starts = self.places(origins)
        return self._along(
            starts, directions, nearest_approach(self.coefficients, starts, directions, empty=self._empty)
        )

    @cached_property
    def _empty(self) -> Int[np.ndarray, "a b c"]:
        return empty_cells(self.coefficients)

    def _along(
        self, starts: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], distance: Float[np.ndarray, "P"]
    ) -> Hits:
        met = np.isfinite(distance)
        places = starts + np.where(met, distance, 0.0)[:, None] * directions
        places[~met] = 0.0
        derivatives = evaluate(self.coefficients, places)
        derivatives[~met] = 0.0
        return Hits(distance * self.spacing, places, derivatives)

    def resampled(self, cells: int) -> "LevelSet":
        """The same function on a grid of so many cells along the longest side of the box."""
        spacing = float(self.extent.max()) / cells
        shape = np.ceil(self.extent / spacing - 1e-9).astype(int) + 3
        empty = replace(self, spacing=spacing, coefficients=np.zeros(shape))
        points = empty.points(empty.nodes().reshape(-1, 3))
        places = np.clip(self.places(points), 0, np.array(self.shape) - 3.0)
        value = evaluate(self.coefficients, places)[:, 0] * (self.spacing / spacing)
        return empty.interpolating(value.reshape(empty.shape))

    def scaled(self, factor: float) -> "LevelSet":
        """The surface and what it stands in, so many times as large."""
        around = self.surroundings.scaled(factor)
        return LevelSet(self.low * factor, self.spacing * factor, self.coefficients, around)

    def taken_back(self, common: Similarity) -> "LevelSet":
        """The surface in a world from which a similarity was taken back, on the same grid."""
        points = common(self.points(self.nodes().reshape(-1, 3)))
        places = np.clip(self.places(points), 0, np.array(self.shape) - 3.0)
        value = evaluate(self.coefficients, places)[:, 0] / common.scale
        return self.interpolating(value.reshape(self.shape))

    def interpolating(self, values: Float[np.ndarray, "A B C"]) -> "LevelSet":
        """The spline with these values, in cells, at the nodes."""
        from scipy.ndimage import spline_filter

        return replace(self, coefficients=np.ascontiguousarray(spline_filter(values, 3, mode="mirror")))

    def mesh(self, points_a_cell: int = 2) -> tuple[TriangleMesh, Float[np.ndarray, "V 3"]]:
        """Marching cubes on the spline, vertices moved onto φ = 0 along ∇φ, and the exact unit normals there."""
        from skimage.measure import marching_cubes

        steps = (np.array(self.shape) - 3) * points_a_cell
        axes = [np.arange(count + 1) / points_a_cell for count in steps]
        places = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        parts = [places[start : start + POINTS_AT_ONCE] for start in range(0, len(places), POINTS_AT_ONCE)]
        values = np.concatenate([evaluate(self.coefficients, part)[:, 0] for part in parts]).reshape(steps + 1)
        vertices, triangles, _, _ = marching_cubes(values, 0.0)
        vertices = vertices.astype(np.float64) / points_a_cell
        for _ in range(4):
            found = evaluate(self.coefficients, vertices)
            gradient = found[:, 1:4]
            step = found[:, :1] * gradient / np.maximum((gradient**2).sum(1), LEAST_SLOPE**2)[:, None]
            vertices = vertices - np.clip(step, -0.5, 0.5)
        normals = evaluate(self.coefficients, vertices)[:, 1:4]
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return TriangleMesh(self.points(vertices), triangles.astype(np.int64)), normals


def level_set_of(surface: TriangleMesh, cells: int, margin: float) -> LevelSet:
    """The signed distance from a closed mesh with dense vertices, on so many cells along its longest side.

    The box is wider by the `margin` at each side, as a share of that one.

    Near the mesh it is the mean distance from the tangent planes of the six nearest vertices, weighted by exp(−d/a), a
    their usual spacing; from two to four of these on the distance from the nearest vertex takes over. The sign of that
    is wrong over a wide region where the nearest vertex lies in a fold, so what can be reached from the border of the
    box without coming near to the mesh is outside.
    """
    from scipy.ndimage import label
    from scipy.spatial import cKDTree

    vertices, normals = surface.vertices, surface.vertex_normals()
    lowest, extent = vertices.min(0), np.ptp(vertices, 0)
    spacing = float(extent.max()) / cells
    shape: Int[np.ndarray, "3"] = np.ceil(extent / spacing + 2 * margin * cells - 1e-9).astype(int)
    low = lowest + extent / 2 - shape * spacing / 2
    empty = LevelSet(low, spacing, np.zeros(shape + 3))
    points = empty.points(empty.nodes().reshape(-1, 3))
    tree = cKDTree(vertices, leafsize=LEAF)
    distance, index = tree.query(points, workers=torch.get_num_threads())
    usual = float(np.median(tree.query(vertices[:: max(len(vertices) // 1000, 1)], k=2)[0][:, 1]))
    values = np.copysign(distance, ((points - vertices[index]) * normals[index]).sum(1))
    parts = label((distance > max(spacing, 2 * usual)).reshape(empty.shape))[0]
    inner = np.zeros(empty.shape, dtype=bool)
    inner[1:-1, 1:-1, 1:-1] = True
    reached = np.isin(parts, np.setdiff1d(parts[~inner], 0)).ravel()
    values[reached] = distance[reached]
    near = distance < 4 * usual
    distance, index = tree.query(points[near], k=NEAREST, workers=torch.get_num_threads())
    planes = ((points[near, None] - vertices[index]) * normals[index]).sum(2)
    weights = np.exp(-(distance - distance[:, :1]) / usual)
    share = np.clip((distance[:, 0] - 2 * usual) / (2 * usual), 0, 1)
    values[near] = share * values[near] + (1 - share) * (planes * weights).sum(1) / weights.sum(1)
    return empty.interpolating((values / spacing).reshape(empty.shape))
