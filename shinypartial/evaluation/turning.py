"""The surface of a prediction as a picture that turns: its shape, the errors of its normals, and its confidence."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from shinypartial.core.camera import Camera, project
from shinypartial.core.conventions import PIXEL_CENTER
from shinypartial.dataset.schema import View
from shinypartial.evaluation.masks import solid_mask
from shinypartial.evaluation.pictures import VISIBILITY, Scale, normal_picture, scalar_picture
from shinypartial.io.files import atomic_write
from shinypartial.metrics.angular import normal_errors_deg
from shinypartial.prediction.surface import PredictedSurface, surface_of

TURNING = "surface.webp"
#: Points on the surface, and pixels along the sides of a panel: enough that no gap shows.
POINTS, PANEL_PX = 60_000, 220
FRAMES, FRAME_MS, WEBP_QUALITY = 24, 150, 60
#: The camera looks down by this angle.
ELEVATION_DEG = 20.0
#: A point is what a pixel sees if their depths differ by less than this share of the object.
DEPTH_SHARE = 0.03
#: Where a dataset has no depth, the nearest point hides others within squares of so many pixels.
COVERED_PX = 2
#: Errors of good fits are below a degree: the scale ends where that of pictures begins to count.
SURFACE_ERROR = Scale("angular error", "magma", 0.0, 5.0, "°")
#: Offsets of the pixels that a point fills.
ROWS, COLUMNS = (each.ravel() for each in np.mgrid[:3, :3])
BACKGROUND = np.uint8(20)


@dataclass(frozen=True)
class SurfacePoints:
    """Points spread evenly over a surface, with unit normals and what else is known of each."""

    points: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]
    confidence: Float[np.ndarray, "P"] | None
    """In [0, 1]; None where the method states none."""

    @classmethod
    def spread(cls, surface: PredictedSurface, count: int = POINTS) -> "SurfacePoints":
        """Points drawn by area, with the values of the corners mixed; the same ones in every run."""
        triangles, confidence = surface.triangles, surface.confidence
        corners = surface.vertices[triangles]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        generator = np.random.default_rng(0)
        places = (np.arange(count) + generator.random(count)) / count * areas.sum()
        chosen = triangles[np.searchsorted(np.cumsum(areas), places).clip(max=len(triangles) - 1)]
        root, other = np.sqrt(generator.random(count)), generator.random(count)
        shares = np.stack([1 - root, root * (1 - other), root * other], 1)
        mixed = (surface.normals[chosen] * shares[..., None]).sum(1)
        mixed /= np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-12)
        sure = None if confidence is None else (confidence[chosen] * shares).sum(1)
        return cls((surface.vertices[chosen] * shares[..., None]).sum(1), mixed, sure)


def errors_on_surface(surface: SurfacePoints, views: Iterable[tuple[Camera, View]]) -> Float[np.ndarray, "P"]:
    """Angular error (degrees) of each point's normal against the true normals of the pixels that see it: the mean over
    views; NaN where none does.

    A pixel sees a point that lies within it, faces it and has the true depth there; the least depth of all points where
    the dataset has none.
    """
    size = float(np.ptp(surface.points, axis=0).max())
    summed, count = np.zeros(len(surface.points)), np.zeros(len(surface.points))
    for camera, view in views:
        if view.normals_world is None:
            continue
        x, y, depth = project(camera, surface.points).T
        with np.errstate(invalid="ignore"):
            inside = (depth > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
            inside &= ((camera.position_world - surface.points) * surface.normals).sum(1) > 0
        seen = np.flatnonzero(inside)
        rows, columns = y[seen].astype(int), x[seen].astype(int)
        first = _least_depth(rows, columns, depth[seen], camera) if view.depth is None else view.depth[rows, columns]
        kept = solid_mask(view)[rows, columns] & (np.abs(first - depth[seen]) < DEPTH_SHARE * size)
        seen = seen[kept]
        errors = normal_errors_deg(surface.normals[seen], _normals_at(view.normals_world, x[seen], y[seen]))
        summed[seen] += errors
        count[seen] += 1
    return np.where(count > 0, summed / np.maximum(count, 1), np.nan)


def _normals_at(
    normals: Float[np.ndarray, "H W 3"], x: Float[np.ndarray, "P"], y: Float[np.ndarray, "P"]
) -> Float[np.ndarray, "P 3"]:
    """Mixed from the four nearest pixels, those without a normal left out: across a pixel it may turn by degrees."""
    from scipy.ndimage import map_coordinates

    places = (y - PIXEL_CENTER, x - PIXEL_CENTER)
    mixed = np.stack([map_coordinates(each, places, order=1, mode="nearest") for each in np.moveaxis(normals, 2, 0)], 1)
    return mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-12)


def _least_depth(
    rows: Int[np.ndarray, "P"], columns: Int[np.ndarray, "P"], depth: Float[np.ndarray, "P"], camera: Camera
) -> Float[np.ndarray, "P"]:
    cells = rows // COVERED_PX * (camera.width // COVERED_PX + 1) + columns // COVERED_PX
    least = np.full(cells.max(initial=0) + 1, np.inf)
    np.minimum.at(least, cells, depth)
    return least[cells]


def turning_panels(surface: SurfacePoints, errors_deg: Float[np.ndarray, "P"] | None) -> list[UInt8[np.ndarray, "P 3"]]:
    """Colors of the points, a panel each: normals as (n + 1)/2, errors where there are any, confidence where stated."""
    panels = [normal_picture(surface.normals[None])]
    if errors_deg is not None:
        panels.append(scalar_picture(errors_deg[None], SURFACE_ERROR, ~np.isnan(errors_deg)[None]))
    if surface.confidence is not None:
        panels.append(scalar_picture(surface.confidence[None], VISIBILITY))
    return [panel[0] for panel in panels]


def turning_frames(
    surface: SurfacePoints, panels: list[UInt8[np.ndarray, "P 3"]], frames: int = FRAMES, side: int = PANEL_PX
) -> list[UInt8[np.ndarray, "S W 3"]]:
    """One turn about +Z, seen from a little above without perspective; panels side by side."""
    center = (surface.points.max(0) + surface.points.min(0)) / 2
    away = surface.points - center
    scale = 0.47 * side / max(float(np.linalg.norm(away, axis=1).max()), 1e-12)
    down = np.radians(ELEVATION_DEG)
    found = []
    for angle in np.arange(frames) * (2 * np.pi / frames):
        across = np.array([-np.sin(angle), np.cos(angle), 0.0])
        toward = np.array([np.cos(angle) * np.cos(down), np.sin(angle) * np.cos(down), np.sin(down)])
        up = np.cross(toward, across)
        order = np.argsort(away @ toward, kind="stable")
        columns = (away @ across * scale + side / 2).astype(int)[order]
        rows = (side / 2 - away @ up * scale).astype(int)[order]
        picture = np.full((side + 2, side + 2, len(panels), 3), BACKGROUND)
        colors = np.stack(panels, 1)[order]
        # A point fills nine pixels; of those that fall on one pixel the last, the nearest, stays.
        picture[np.repeat(rows, 9) + np.tile(ROWS, len(rows)), np.repeat(columns, 9) + np.tile(COLUMNS, len(rows))] = (
            np.repeat(colors, 9, axis=0)
        )
        found.append(picture[1:-1, 1:-1].transpose(0, 2, 1, 3).reshape(side, -1, 3))
    return found


def write_turning(path: Path, prediction: Path, views: Iterable[tuple[Camera, View]]) -> None:
    """Write the surface with its errors in these views; nothing where the method exported none."""
    surface = surface_of(prediction)
    if surface is None:
        return
    points = SurfacePoints.spread(surface)
    errors = errors_on_surface(points, views)
    panels = turning_panels(points, None if np.isnan(errors).all() else errors)
    write_frames(path, turning_frames(points, panels))


def write_frames(path: Path, frames: list[UInt8[np.ndarray, "S W 3"]]) -> None:
    """Write an animated WebP that runs for ever."""
    from PIL import Image

    first, *others = [Image.fromarray(frame) for frame in frames]
    with atomic_write(path) as temporary:
        first.save(
            temporary, "WEBP", save_all=True, append_images=others, duration=FRAME_MS, loop=0, quality=WEBP_QUALITY
        )
