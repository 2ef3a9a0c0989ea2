"""What a reader of a layout finds, and the interface of all readers."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float

from shinypartial.conversion.layouts import Axis, Grid
from shinypartial.conversion.outside import to_world
from shinypartial.core.camera import Camera

#: The directions of a map's middle, of what lies a quarter of its width to the right, and of its first row.
MapAxes = tuple[Axis, Axis, Axis]


@dataclass(frozen=True)
class Shot:
    """A photograph with the files of its ground truth."""

    name: str
    camera: Camera
    picture: Path
    mask: Path
    gamma: float | None = None
    """Codes are 255 x^(1/gamma) of linear light x; None: they are read as other pictures are."""
    normals: Callable[[], Float[np.ndarray, "H W 3"]] | None = None
    """World normals, zero where the object is not."""


@dataclass(frozen=True)
class Found:
    """All photographs of an object, and the light around it."""

    train: tuple[Shot, ...]
    test: tuple[Shot, ...]
    environment: Callable[[], Float[np.ndarray, "H 2*H 3"]] | None
    """Linear radiance as a lat-long map of the world."""
    cameras: tuple[Path, ...]
    """The files that the cameras were read from: they distinguish one capture from another."""
    left_out: tuple[str, ...] = ()
    """What is missing, with the reason of each."""


class Reader(Protocol):
    """Finds the photographs in a folder of one layout."""

    def __call__(self, folder: Path, axes: MapAxes | None) -> Found:
        """`axes` of the stored map in place of those that the layout has. Raises InputError for other folders."""


def map_in_world(
    colors: Float[np.ndarray, "H 2*H 3"], axes: MapAxes, to_world_axes: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "H 2*H 3"]:
    """A stored lat-long map whose texels tile the sphere, as the dataset's; a rotation takes its axes to the world."""
    forward, right, up = ((float(x), float(y), float(z)) for x, y, z in np.array(axes) @ to_world_axes.T)
    return to_world(colors, Grid(forward, right, up, rows=(0.5, 0.5), columns=(0.5, 0.5)))
