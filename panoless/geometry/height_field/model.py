"""A mirror that bends: a plane with a boundary and a smooth height over it, and what a camera sees of it."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.capture.rays import pixel_rays, pose_of, reflect
from panoless.capture.views import TrainView
from panoless.environment.surroundings import Surroundings
from panoless.geometry.base import SurfaceBuffers, buffers_from_arrays
from panoless.geometry.plane.model import Plane
from panoless.kernels.camera import RasterCamera
from panoless.kernels.height_field import first_hits
from panoless.numeric.bspline import cubic_bsplines_at, with_halved_knots
from panoless.numeric.polygon import depth_inside, projected_coverage, with_cut_sides
from shinypartial.core.camera import Similarity

CLEAR_PX = 1.0
"""A mirrored ray has to pass the frame at least this far away (px): pixels are no points."""

ORDERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
"""Derivatives along u and v: height, slopes, bending."""
STEPS_A_CELL = 4
"""Straight pieces of the mirror's edge, for its coverage: cubic pieces are this smooth to a thousandth of a pixel."""


@dataclass(frozen=True)
class HeightFieldHits:
    """Where rays of camera depth 1 meet a height field: depth (infinite for misses), plane coordinates and slopes
    there.
    """

    distance: Float[np.ndarray, "P"]
    places: Float[np.ndarray, "P 2"]
    slopes: Float[np.ndarray, "P 2"]

    @property
    def met(self) -> Bool[np.ndarray, "P"]:
        """Which rays meet the surface."""
        return np.isfinite(self.distance)

    @property
    def normals(self) -> Float[np.ndarray, "P 3"]:
        """Unit, in the axes of the plane: (−h_u, −h_v, 1) to scale."""
        normals = np.concatenate([-self.slopes, np.ones((len(self.slopes), 1))], 1)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def normals_by_slopes(self, frame: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "P 3 2"]:
        """Derivatives of the unit normals, in the axes whose rotation into those of the plane is `frame`: with N the
        normal and n its unit vector, (1 − n nᵀ) ∂N/‖N‖.
        """
        normals, length = self.normals, np.sqrt(1 + (self.slopes**2).sum(1))[:, None, None]
        across = -np.eye(3)[:, :2] + normals[:, :, None] * normals[:, None, :2]
        return np.einsum("ji,pja->pia", frame, across / length)


@dataclass(frozen=True)
class HeightField:
    """x(u, v) = plane point (u, v) + h(u, v) n, with h a uniform cubic B-spline of M × N coefficients.

    The coefficient of row i and column j has its peak at `low` + spacing·(i − 1, j − 1), in plane coordinates. Within
    the knots h is the spline, beyond them it goes on straight. The plane is that of the frame: the mirror's edge lies
    at h over the boundary, a frame at the plane's frame height.
    """

    plane: Plane
    low: Float[np.ndarray, "2"]
    spacing: float
    coefficients: Float[np.ndarray, "M N"]
    clearance: float = 0.0
    """Mirrored rays have to pass the boundary at this height over the plane, if it is above that of the frame: a round
    rim is higher than silhouettes determine.
    """

    @property
    def surroundings(self) -> Surroundings:
        """What the plane stands in."""
        return self.plane.surroundings

    def taken_back(self, common: Similarity) -> "HeightField":
        """As it is in the world from which a motion was taken back."""
        plane = self.plane.taken_back(common)
        shift = plane.boundary[0] - self.plane.boundary[0] / common.scale
        return replace(
            self,
            plane=plane,
            low=self.low / common.scale + shift,
            spacing=self.spacing / common.scale,
            coefficients=self.coefficients / common.scale,
            clearance=self.clearance / common.scale,
        )

    @property
    def num_parameters(self) -> int:
        """How many numbers it is made of: those of the plane and its boundary, and the coefficients."""
        return self.plane.num_parameters + self.coefficients.size

    @property
    def frame(self) -> Float[np.ndarray, "3 3"]:
        """Rows t_u, t_v, n: rotates the normalized frame into the axes of the plane."""
        return np.stack([self.plane.tangent_u, self.plane.tangent_v, self.plane.normal])

    def basis(
        self, places: Float[np.ndarray, "P 2"], derivatives: int = 2
    ) -> tuple[Int[np.ndarray, "P 16"], Float[np.ndarray, "K P 16"]]:
        """Which coefficients act at plane coordinates, and by how much on h, h_u, h_v, h_uu, h_uv and h_vv there, or on
        those of them that are derivatives of at most that order.
        """
        rows, columns = self.coefficients.shape
        u, v = ((places - self.low) / self.spacing).T
        row, along_u = cubic_bsplines_at(u, rows, derivatives)
        column, along_v = cubic_bsplines_at(v, columns, derivatives)
        index = (row[:, None, None] + np.arange(4)[:, None]) * columns + column[:, None, None] + np.arange(4)
        orders = [(i, j) for i, j in ORDERS if i + j <= derivatives]
        weights = np.empty((len(orders), len(u), 4, 4))
        for each, (i, j) in zip(weights, orders, strict=True):
            np.multiply(along_u[i][:, :, None], along_v[j][:, None] / self.spacing ** (i + j), out=each)
        return index.reshape(-1, 16), weights.reshape(len(orders), -1, 16)

    def heights(self, places: Float[np.ndarray, "P 2"], derivatives: int = 2) -> Float[np.ndarray, "K P"]:
        """h, h_u, h_v, h_uu, h_uv and h_vv at plane coordinates, or h and the slopes, or h alone."""
        index, weights = self.basis(places, derivatives)
        return (weights * self.coefficients.ravel()[index]).sum(2)

    def edge_basis(
        self, side: Int[np.ndarray, "P"], along: Float[np.ndarray, "P"]
    ) -> tuple[Int[np.ndarray, "P C"], Float[np.ndarray, "P C"]]:
        """Which coefficients act on the height of the mirror's edge over places on sides of the boundary, and by how
        much. The edge is straight between vertices.
        """
        index, basis = self.basis(self.plane.boundary, 0)
        ends = np.stack([side, (side + 1) % len(self.plane.boundary)], 1)
        weights = np.stack([1 - along, along], 1)[:, :, None] * basis[0][ends]
        shape = len(side), 2 * index.shape[1]
        return index[ends].reshape(shape), weights.reshape(shape)

    def joint_distance(self, places: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P"]:
        """From the nearest line across which the surface jumps: infinite."""
        return np.full(len(places), np.inf)

    def with_halved_cells(self) -> "HeightField":
        """The same surface with twice as many cells along either side."""
        finer = with_halved_knots(with_halved_knots(self.coefficients).T).T
        return replace(self, spacing=self.spacing / 2, coefficients=finer)

    def domed(self, slope: float) -> "HeightField":
        """With a dome more, of that mean slope at the boundary, where it is zero in the mean; a bowl where negative.

        Its height is slope·R/2 (1 − pᵀ A p) over places p from the boundary's middle, A⁻¹ being as their covariance
        and R² its determinant's root.
        """
        middle = self.plane.boundary.mean(0)
        away = self.plane.boundary - middle
        form = np.linalg.inv(away.T @ away)
        form /= np.einsum("pi,ij,pj->p", away, form, away).mean()
        radius = np.linalg.det(form) ** -0.25
        index = np.stack(np.meshgrid(*map(np.arange, self.coefficients.shape), indexing="ij"), -1)
        places = self.low + self.spacing * (index - 1) - middle
        dome = slope * radius / 2 * (1 - np.einsum("mni,ij,mnj->mn", places, form, places))
        return replace(self, coefficients=self.coefficients + dome)

    def quadrilaterals(self) -> tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, "F 4"]]:
        """Points in the normalized frame, over a grid of the boundary's box, and the faces within the boundary."""
        low, high = self.plane.boundary.min(0), self.plane.boundary.max(0)
        steps = np.ceil(STEPS_A_CELL * (high - low) / self.spacing).astype(np.int64)
        u, v = (np.linspace(low[axis], high[axis], steps[axis] + 1) for axis in (0, 1))
        return self.faces_over(np.stack(np.meshgrid(u, v, indexing="ij"), -1))

    def faces_over(
        self, grids: Float[np.ndarray, "*G A B 2"]
    ) -> tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, "F 4"]]:
        """Points in the normalized frame over grids of plane coordinates, and their faces within the boundary."""
        places, index = grids.reshape(-1, 2), np.arange(grids[..., 0].size).reshape(grids.shape[:-1])
        low, high = slice(None, -1), slice(1, None)
        corners = [index[..., a, b] for a, b in ((low, low), (high, low), (high, high), (low, high))]
        faces = np.stack(corners, -1).reshape(-1, 4)
        within = depth_inside(places[faces].mean(1), self.plane.boundary) > 0
        return self.plane.points(places) + self.heights(places, 0)[0][:, None] * self.plane.normal, faces[within]

    def normals_at(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Unit normals (−h_u, −h_v, 1)/‖·‖ at points of the height field, in the normalized frame."""
        slopes = self.heights(points @ self.frame[:2].T, 1)[1:]
        normals = np.stack([-slopes[0], -slopes[1], np.ones(len(points))], 1) @ self.frame
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def bending(self) -> Float[np.ndarray, "D D"]:
        """B with cᵀ B c the sum of squared second differences of the coefficients c: Σ c_uu² + 2 c_uv² + c_vv²."""
        rows, columns = (np.eye(count) for count in self.coefficients.shape)
        differences = (
            np.kron(np.diff(rows, 2, axis=0), columns),
            np.kron(rows, np.diff(columns, 2, axis=0)),
            np.sqrt(2) * np.kron(np.diff(rows, axis=0), np.diff(columns, axis=0)),
        )
        whole = np.concatenate(differences)
        return whole.T @ whole

    def tilts(self) -> Float[np.ndarray, "D 3"]:
        """An orthonormal basis of the coefficients whose height is linear: a shift and the tilts of the whole."""
        places = np.stack(np.meshgrid(*map(np.arange, self.coefficients.shape), indexing="ij"), -1).reshape(-1, 2)
        return np.linalg.qr(np.concatenate([np.ones((len(places), 1)), places], 1))[0]

    def hits(self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]) -> HeightFieldHits:
        """Where rays meet the front of the height field, also beside its boundary."""
        starts, directions_local = origins @ self.frame.T - [*self.low, self.plane.offset], directions @ self.frame.T
        distance, slopes = first_hits(
            starts / self.spacing, directions_local / self.spacing, self.coefficients / self.spacing
        )
        places = (starts + np.where(np.isfinite(distance), distance, 0.0)[:, None] * directions_local)[:, :2] + self.low
        return HeightFieldHits(distance, places, slopes)


def flat_height_field(plane: Plane, cells: int) -> HeightField:
    """A height field without height, of that many cells along the longer side of the boundary, whose sides are cut
    until they are no longer than a cell: the edge is straight between vertices.
    """
    low, extent = plane.boundary.min(0), np.ptp(plane.boundary, 0)
    spacing = float(extent.max()) / cells
    rows, columns = (int(np.ceil(length / spacing - 1e-9)) + 3 for length in extent)
    cut = replace(plane, boundary=with_cut_sides(plane.boundary, spacing))
    return HeightField(cut, low, spacing, np.zeros((rows, columns)))


@dataclass(frozen=True)
class VisibleReflections:
    """Pixels of a view (flat indices) that see the environment by way of a height field, and how."""

    pixels: Int[Tensor, "P"]
    hits: HeightFieldHits
    outgoing: Float[np.ndarray, "P 3"]
    """Where they look in the map: unit, in the normalized frame."""


def visible_reflections(
    height_field: HeightField,
    view: TrainView,
    pixels: Int[Tensor, "P"],
    clear_px: float = CLEAR_PX,
) -> VisibleReflections:
    """Those of the given pixels whose mirrored rays pass the frame, if there is one, by `clear_px` or more."""
    origins, directions = pixel_rays(view.camera, pixels.cpu().numpy())
    plane, hits = height_field.plane, height_field.hits(origins, directions)
    passed_height = max(plane.frame_height, height_field.clearance)
    directions_local = directions @ height_field.frame.T
    outgoing = reflect(directions_local, hits.normals)
    kept = hits.met & (outgoing[:, 2] > 0)
    stretch = np.linalg.norm(directions_local, axis=1) / np.maximum(-directions_local[:, 2], 1e-9)
    pixel_along = np.where(kept, hits.distance, 0.0) * stretch / view.camera.fx
    kept &= height_field.joint_distance(hits.places) > clear_px * pixel_along
    if passed_height > 0:
        distance = np.where(kept, hits.distance, 0.0)
        height = origins @ plane.normal - plane.offset + distance * directions_local[:, 2]
        rise = np.maximum(passed_height - height, 0.0) / np.where(kept, outgoing[:, 2], 1.0)
        passed = hits.places + rise[:, None] * outgoing[:, :2]
        pixel = (distance + rise) / view.camera.fx
        kept &= depth_inside(passed, plane.boundary) > clear_px * pixel
    chosen = HeightFieldHits(*(values[kept] for values in vars(hits).values()))
    outgoing = outgoing[kept] / np.linalg.norm(outgoing[kept], axis=1, keepdims=True)
    points = origins[kept] + chosen.distance[:, None] * directions[kept]
    return VisibleReflections(
        pixels[torch.from_numpy(kept).to(pixels.device)],
        chosen,
        plane.surroundings.looked_up(points, outgoing @ height_field.frame),
    )


def height_field_buffers(height_field: HeightField, camera: RasterCamera) -> SurfaceBuffers:
    """What a camera sees of a height field: alpha is the area of each pixel within the mirror's edge and the frame
    and beside bars, depth and normal those of the ray through its center.
    """
    shape, plane, (rotation, center) = (camera.height, camera.width), height_field.plane, pose_of(camera)
    alpha = np.zeros(shape)
    height_above = float(plane.normal @ center) - plane.offset
    if height_above > 0:
        alpha = projected_coverage((edge_points(height_field) - center) @ rotation.T, camera)
        if 0 < plane.frame_height < height_above:
            frame = plane.points(plane.boundary) + plane.frame_height * plane.normal
            alpha = np.minimum(alpha, projected_coverage((frame - center) @ rotation.T, camera))
        for bar in plane.bars:
            alpha = np.maximum(alpha - projected_coverage((plane.points(bar) - center) @ rotation.T, camera), 0.0)
    pixels = np.flatnonzero(alpha)
    hits = height_field.hits(*pixel_rays(camera, pixels))
    alpha.ravel()[pixels[~hits.met]] = 0
    depth, normals = np.zeros(alpha.size), np.zeros((alpha.size, 3))
    depth[pixels] = np.where(hits.met, hits.distance, 0.0)
    normals[pixels] = hits.normals @ height_field.frame @ rotation.T
    return buffers_from_arrays(alpha, depth.reshape(shape), normals.T.reshape(3, *shape), camera)


def edge_points(height_field: HeightField) -> Float[np.ndarray, "E 3"]:
    """Points of the mirror's edge in the normalized frame, closely around the boundary."""
    following, parts = np.roll(height_field.plane.boundary, -1, 0), []
    for start, end in zip(height_field.plane.boundary, following, strict=True):
        pieces = int(np.ceil(STEPS_A_CELL * np.linalg.norm(end - start) / height_field.spacing)) or 1
        parts.append(start + np.arange(pieces)[:, None] / pieces * (end - start))
    places = np.concatenate(parts)
    return height_field.plane.points(places) + height_field.heights(places, 0)[0][:, None] * height_field.plane.normal
