"""What the viewer shows, as arrays: surfaces, the sphere of the environment, ways of rays, pictures and errors."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from shinypartial.core.camera import reflect
from shinypartial.core.color import to_display
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions, sample_latlong
from shinypartial.dataset.read import read_view
from shinypartial.dataset.schema import Frame
from shinypartial.io.images import read_picture, unit_values
from shinypartial.prediction.format import (
    DESCRIPTION,
    SNAPSHOTS,
    prediction_frame,
    read_environment_map,
    read_visibility,
)
from shinypartial.prediction.surface import surface_of

Shown = Literal["light", "visibility", "light that was seen"]
Picture = Literal["photograph", "prediction", "error", "normals"]
PICTURES: tuple[Picture, ...] = ("photograph", "prediction", "error", "normals")
SHOWN: tuple[Shown, ...] = ("light", "visibility", "light that was seen")
SPHERE_ROWS = 96
"""Rows of the sphere of the environment: twice as many columns of colored vertices."""
SPHERE_RADII = 6.0
"""Radius of that sphere in radii of the surface."""
UNSEEN = np.array([40, 20, 60], np.uint8)
"""Color of directions that were not seen."""
ERROR_SCALE = 0.2
"""Mean difference of linear radiance that is drawn in the last color."""
MOST_BOUNCES = 4
LEAST_WAY = 1e-6
"""A ray leaves a surface by this share of its size before it may meet it again."""


@dataclass(frozen=True)
class Surface:
    """Triangles in world units with the normals of their vertices; without triangles a cloud of points."""

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "T 3"]

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """The middle of its box."""
        middle: np.ndarray = (self.vertices.min(0) + self.vertices.max(0)) / 2
        return middle

    @property
    def radius(self) -> float:
        """Of the ball about the center that holds it."""
        return float(np.linalg.norm(self.vertices - self.center, axis=1).max())

    def hit(
        self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
        """Where a ray meets it first, and the unit normal there, interpolated; None for a miss.

        By the test of Möller and Trumbore (1997) of all triangles.
        """
        if not len(self.triangles):
            return None
        first, second, third = self.vertices[self.triangles].transpose(1, 0, 2)
        one, other = second - first, third - first
        across = np.cross(direction, other)
        volume = (one * across).sum(1)
        inverse = np.where(np.abs(volume) > 1e-300, 1 / np.where(volume == 0, 1.0, volume), 0.0)
        away = origin - first
        u = (away * across).sum(1) * inverse
        along = np.cross(away, one)
        v = (along @ direction) * inverse
        distance = (other * along).sum(1) * inverse
        least = LEAST_WAY * self.radius
        met = (inverse != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > least)
        if not met.any():
            return None
        nearest = int(np.where(met, distance, np.inf).argmin())
        weights = np.array([1 - u[nearest] - v[nearest], u[nearest], v[nearest]])
        normal = weights @ self.normals[self.triangles[nearest]]
        return origin + distance[nearest] * direction, normal / np.linalg.norm(normal)

    def path(
        self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], reach: float
    ) -> Float[np.ndarray, "N 3"]:
        """Corners of the way of a ray: where it starts, where it is mirrored, and the point at `reach` radii in the
        direction in which it leaves; one point where it misses.
        """
        corners = [origin]
        for _ in range(MOST_BOUNCES):
            found = self.hit(corners[-1], direction)
            if found is None:
                break
            corners.append(found[0])
            direction = reflect(direction, found[1])
            direction = direction / np.linalg.norm(direction)
        if len(corners) > 1:
            corners.append(corners[-1] + reach * self.radius * direction)
        return np.stack(corners)


def read_surface(folder: Path) -> Surface | None:
    """The surface of a prediction folder, from its PLY; None where it has none."""
    found = surface_of(folder, clouds=True)
    return None if found is None else Surface(found.vertices, found.normals, found.triangles)


@dataclass(frozen=True)
class Moment:
    """A prediction folder as it is shown: the end of a fit, or a snapshot of it."""

    name: str
    surface: Surface | None
    environment: Float[np.ndarray, "H W 3"]
    visibility: Float[np.ndarray, "H W"] | None

    @classmethod
    def read(cls, folder: Path, name: str) -> "Moment":
        """From disk."""
        return cls(name, read_surface(folder), read_environment_map(folder), read_visibility(folder))


def moment_folders(prediction: Path) -> dict[str, Path]:
    """Folders of the snapshots by their iterations, earliest first, and last the prediction, `end`."""
    found = [path.parent for path in (prediction / SNAPSHOTS).glob(f"*/{DESCRIPTION}")]
    snapshots = {str(int(folder.name)): folder for folder in sorted(found) if folder.name.isdecimal()}
    return {**snapshots, "end": prediction}


@dataclass(frozen=True)
class ColoredSphere:
    """A sphere of unit radius, seen from within and from outside, with a color for every vertex."""

    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "T 3"]
    colors: UInt8[np.ndarray, "V 3"]


def environment_sphere(moment: Moment, shown: Shown) -> ColoredSphere:
    """The map on a sphere in world axes: light in display colors, visibility in gray, or both."""
    directions = latlong_directions(SPHERE_ROWS)
    light = to_display(sample_latlong(moment.environment, directions))
    if moment.visibility is not None and shown != "light":
        visibility = sample_latlong(moment.visibility[..., None], directions).clip(0, 1)
        known = np.full_like(light, 255) if shown == "visibility" else light
        light = np.rint(visibility * known + (1 - visibility) * UNSEEN).astype(np.uint8)
    index = np.arange(SPHERE_ROWS * 2 * SPHERE_ROWS).reshape(SPHERE_ROWS, -1)
    upper, lower = index[:-1], index[1:]
    beside, below = np.roll(upper, -1, 1), np.roll(lower, -1, 1)
    triangles = np.stack([np.stack([upper, lower, below], -1), np.stack([upper, below, beside], -1)])
    return ColoredSphere(directions.reshape(-1, 3), triangles.reshape(-1, 3), light.reshape(-1, 3))


def thumbnail(frame: Frame, largest: int) -> UInt8[np.ndarray, "H W 3"]:
    """The photograph of a frame over black with at most so many pixels a side; every k-th."""
    picture = read_picture(frame.png if frame.png.exists() else frame.photograph)
    image = picture[:: -(-max(picture.shape[:2]) // largest), :: -(-max(picture.shape[:2]) // largest)]
    values = unit_values(image) if image.dtype.kind == "u" else unit_values(to_display(image))
    colors = np.broadcast_to(values[..., :3], (*values.shape[:2], 3))
    alpha = values[..., 3:] if values.shape[2] == 4 else 1.0
    return np.rint(255 * colors * alpha).astype(np.uint8)


def picture_of_test(prediction: Path, frame: Frame, picture: Picture) -> UInt8[np.ndarray, "H W 3"]:
    """A test view in the browser: as photographed, as predicted, |prediction − photograph|, or the predicted normals.

    An error is the mean over channels of linear radiance, clipped to [0, 1], from black through red to white at 0.2.
    """
    if picture == "photograph":
        return to_display(read_view(frame).radiance)
    seen = read_view(prediction_frame(prediction, frame))
    if picture == "prediction":
        return to_display(seen.radiance)
    if picture == "normals":
        if seen.normals_world is None:
            raise InputError(expected=f"normals in {frame.name}", found="none", remedy="Choose another picture.")
        return np.rint(127.5 * (seen.normals_world + 1) * (seen.alpha > 0)[..., None]).clip(0, 255).astype(np.uint8)
    error = np.abs(seen.radiance.clip(0, 1) - read_view(frame).radiance.clip(0, 1)).mean(-1) / ERROR_SCALE
    return np.rint(255 * np.stack([3 * error, 3 * error - 1, 3 * error - 2], -1).clip(0, 1)).astype(np.uint8)
