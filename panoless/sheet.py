"""A mirror that bends: a plane with an outline and a smooth height over it, and what a camera sees of it.

Like `plane` and `lathe`, it needs no blending: rays are intersected with the surface itself.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from panoless.cubemap import Rays
from panoless.kernels.cpu.sheet import first_hits
from panoless.kernels.rasterize import RasterCamera
from panoless.lathe import mirrored, pixel_rays
from panoless.plane import Plane, projected_coverage
from panoless.shading import SurfaceBuffers
from panoless.views import TrainView, pose_of

ORDERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
"""Derivatives along u and v: height, slopes, bending."""
STEPS_A_CELL = 4
"""Straight pieces of the mirror's edge, for its coverage: cubic pieces are this smooth to a thousandth of a pixel."""
CLEAR_PX = 1.0
"""A mirrored ray has to pass the frame at least this far away: pixels are no points."""


@dataclass(frozen=True)
class SheetHits:
    """Where rays of camera depth 1 meet a sheet: depth (infinite for misses), plane coordinates and slopes there."""

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


@dataclass(frozen=True)
class Sheet:
    """x(u, v) = plane point (u, v) + h(u, v) n, with h a uniform cubic B-spline of M × N coefficients.

    The coefficient of row i and column j has its peak at `low` + spacing·(i − 1, j − 1), in plane coordinates. Within
    the knots h is the spline, beyond them it goes on straight. The plane is that of the frame: the mirror's edge lies
    at h over the outline, a rim at the plane's rim height.
    """

    plane: Plane
    low: Float[np.ndarray, "2"]
    spacing: float
    coefficients: Float[np.ndarray, "M N"]

    @property
    def numbers(self) -> int:
        """How many numbers it is made of: those of the plane and its outline, and the coefficients."""
        return self.plane.numbers + self.coefficients.size

    @property
    def frame(self) -> Float[np.ndarray, "3 3"]:
        """Rows t_u, t_v, n: rotates the normalized frame into the axes of the plane."""
        return np.stack([self.plane.tangent_u, self.plane.tangent_v, self.plane.normal])

    def basis(self, places: Float[np.ndarray, "P 2"]) -> tuple[Int[np.ndarray, "P 16"], Float[np.ndarray, "6 P 16"]]:
        """Which coefficients act at plane coordinates, and by how much on h, h_u, h_v, h_uu, h_uv and h_vv there."""
        rows, columns = self.coefficients.shape
        place = (places - self.low) / self.spacing
        cell = np.clip(np.floor(place), 0, [rows - 4, columns - 4]).astype(np.int64)
        along_u, along_v = (_cubic_basis((place - cell)[:, axis]) for axis in (0, 1))
        row, column = (cell[:, axis, None] + np.arange(4) for axis in (0, 1))
        index = (row[:, :, None] * columns + column[:, None]).reshape(-1, 16)
        weights = [(along_u[i][:, :, None] * along_v[j][:, None]) / self.spacing ** (i + j) for i, j in ORDERS]
        return index, np.stack(weights).reshape(6, -1, 16)

    def heights(self, places: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "6 P"]:
        """h, h_u, h_v, h_uu, h_uv and h_vv at plane coordinates."""
        index, weights = self.basis(places)
        return (weights * self.coefficients.ravel()[index]).sum(2)

    def quadrilaterals(self) -> tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, "F 4"]]:
        """Points in the normalized frame, over a grid of the outline's box, and the faces within the outline."""
        low, high = self.plane.outline.min(0), self.plane.outline.max(0)
        steps = np.ceil(STEPS_A_CELL * (high - low) / self.spacing).astype(np.int64)
        u, v = (np.linspace(low[axis], high[axis], steps[axis] + 1) for axis in (0, 1))
        places = np.stack(np.meshgrid(u, v, indexing="ij"), -1).reshape(-1, 2)
        index = np.arange(len(places)).reshape(steps + 1)
        faces = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1).reshape(-1, 4)
        within = _depth_inside(places[faces].mean(1), self.plane.outline) > 0
        return self.plane.points(places) + self.heights(places)[0][:, None] * self.plane.normal, faces[within]

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

    def hits(self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]) -> SheetHits:
        """Where rays meet the front of the sheet, also beside its outline."""
        starts, ways = origins @ self.frame.T - [*self.low, self.plane.offset], directions @ self.frame.T
        distance, slopes = first_hits(starts / self.spacing, ways / self.spacing, self.coefficients / self.spacing)
        places = (starts + np.where(np.isfinite(distance), distance, 0.0)[:, None] * ways)[:, :2] + self.low
        return SheetHits(distance, places, slopes)


def flat_sheet(plane: Plane, cells: int) -> Sheet:
    """A sheet without height, of that many cells along the longer side of the outline."""
    low, extent = plane.outline.min(0), np.ptp(plane.outline, 0)
    spacing = float(extent.max()) / cells
    rows, columns = (int(np.ceil(length / spacing - 1e-9)) + 3 for length in extent)
    return Sheet(plane, low, spacing, np.zeros((rows, columns)))


@dataclass(frozen=True)
class Sightings:
    """Pixels of a view (flat indices) that see the environment by way of a sheet, and how."""

    pixels: Int[Tensor, "P"]
    ways: Float[np.ndarray, "P 3"]
    """Rays of camera depth 1, in the axes of the plane."""
    hits: SheetHits
    outgoing: Float[np.ndarray, "P 3"]
    """Unit, in the normalized frame."""


def sightings(sheet: Sheet, view: TrainView, pixels: Int[Tensor, "P"]) -> Sightings:
    """Those of the given pixels whose mirrored rays pass the rim of the frame, if there is one, by a pixel or more."""
    origins, directions = pixel_rays(view.camera, pixels.cpu().numpy())
    hits, ways = sheet.hits(origins, directions), directions @ sheet.frame.T
    outgoing = mirrored(ways, hits.normals)
    kept = hits.met & (outgoing[:, 2] > 0)
    if sheet.plane.rim_height > 0:
        height = np.where(kept, (origins @ sheet.plane.normal - sheet.plane.offset) + hits.distance * ways[:, 2], 0.0)
        rise = np.maximum(sheet.plane.rim_height - height, 0.0) / np.where(kept, outgoing[:, 2], 1.0)
        passed = hits.places + rise[:, None] * outgoing[:, :2]
        pixel = np.where(kept, hits.distance + rise, 0.0) / view.camera.fx
        kept &= _depth_inside(passed, sheet.plane.outline) > CLEAR_PX * pixel
    chosen = SheetHits(*(values[kept] for values in vars(hits).values()))
    outgoing = outgoing[kept] / np.linalg.norm(outgoing[kept], axis=1, keepdims=True)
    return Sightings(pixels[torch.from_numpy(kept).to(pixels.device)], ways[kept], chosen, outgoing @ sheet.frame)


def sheet_rays(sheet: Sheet, view: TrainView, pixels: Int[Tensor, "P"]) -> Rays:
    """What pixels of a view observed of the environment."""
    seen = sightings(sheet, view, pixels)
    outgoing = torch.from_numpy(seen.outgoing).float().to(view.radiance.device)
    return Rays(outgoing, view.radiance.flatten(1)[:, seen.pixels].T.contiguous())


def sheet_buffers(sheet: Sheet, camera: RasterCamera) -> SurfaceBuffers:
    """The sheet as surfels would be seen: alpha is the area of each pixel within the mirror's edge and the rim, depth
    and normal those of the ray through its center. The three depths agree.
    """
    shape, (rotation, center) = (camera.height, camera.width), pose_of(camera)
    alpha = np.zeros(shape)
    height_above = float(sheet.plane.normal @ center) - sheet.plane.offset
    if height_above > 0:
        alpha = projected_coverage((edge_points(sheet) - center) @ rotation.T, camera)
        if 0 < sheet.plane.rim_height < height_above:
            rim = sheet.plane.points(sheet.plane.outline) + sheet.plane.rim_height * sheet.plane.normal
            alpha = np.minimum(alpha, projected_coverage((rim - center) @ rotation.T, camera))
    pixels = np.flatnonzero(alpha)
    hits = sheet.hits(*pixel_rays(camera, pixels))
    alpha.ravel()[pixels[~hits.met]] = 0
    depth, normals = np.zeros(alpha.size), np.zeros((alpha.size, 3))
    depth[pixels] = np.where(hits.met, hits.distance, 0.0)
    normals[pixels] = hits.normals @ sheet.frame @ rotation.T
    device = camera.world_to_camera.device
    covered, distance = (torch.from_numpy(image.reshape(shape)).float().to(device) for image in (alpha, depth))
    return SurfaceBuffers(
        albedo=covered.new_zeros(3, *shape),
        alpha=covered,
        raster_normals_camera=torch.from_numpy(normals.T.reshape(3, *shape)).float().to(device) * covered,
        expected_depth=distance,
        median_depth=distance,
        surface_depth=distance,
        distortion=torch.zeros_like(covered),
        in_frustum=(covered > 0).any()[None],
    )


def edge_points(sheet: Sheet) -> Float[np.ndarray, "E 3"]:
    """Points of the mirror's edge in the normalized frame, closely around the outline."""
    following, parts = np.roll(sheet.plane.outline, -1, 0), []
    for start, end in zip(sheet.plane.outline, following, strict=True):
        pieces = int(np.ceil(STEPS_A_CELL * np.linalg.norm(end - start) / sheet.spacing)) or 1
        parts.append(start + np.arange(pieces)[:, None] / pieces * (end - start))
    places = np.concatenate(parts)
    return sheet.plane.points(places) + sheet.heights(places)[0][:, None] * sheet.plane.normal


def _depth_inside(points: Float[np.ndarray, "P 2"], outline: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "P"]:
    """Distance of points from an outline, negative outside of it."""
    x, y = np.ascontiguousarray(points.T)
    squared, inside = np.full(len(points), np.inf), np.zeros(len(points), dtype=bool)
    for (x0, y0), (dx, dy) in zip(outline, np.roll(outline, -1, 0) - outline, strict=True):
        along = (((x - x0) * dx + (y - y0) * dy) / max(dx * dx + dy * dy, 1e-18)).clip(0, 1)
        squared = np.minimum(squared, (x - x0 - along * dx) ** 2 + (y - y0 - along * dy) ** 2)
        crossed = (y0 > y) != (y0 + dy > y)
        if dy:
            inside ^= crossed & (x < x0 + (y - y0) * dx / dy)
    return np.where(inside, 1.0, -1.0) * np.sqrt(squared)


def _cubic_basis(t: Float[np.ndarray, "P"]) -> list[Float[np.ndarray, "P 4"]]:
    """The four uniform cubic B-splines over a cell, t in [0, 1], and their first and second derivatives by t."""
    values = ((1 - t) ** 3 / 6, (3 * t**3 - 6 * t**2 + 4) / 6, (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6, t**3 / 6)
    slopes = (-((1 - t) ** 2) / 2, (9 * t**2 - 12 * t) / 6, (-9 * t**2 + 6 * t + 3) / 6, t**2 / 2)
    bends = (1 - t, 3 * t - 2, 1 - 3 * t, t)
    return [np.stack(each, 1) for each in (values, slopes, bends)]
