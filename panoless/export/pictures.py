"""Pictures of a prediction: the parts of a rendered view, the recovered environment, and a sheet that sums it up."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from panoless.capture.masks import without_specks
from panoless.export.render import Decomposition
from panoless.kernels.constants import ALPHA_FLOOR
from shinypartial.core.camera import Camera
from shinypartial.core.color import to_display
from shinypartial.dataset.read import read_whole_view
from shinypartial.dataset.schema import Frame
from shinypartial.io.picture_sheet import TILE_PX, write_picture_sheet

PICTURE_WIDTH = 1024
"""Of the picture of a map, at least."""
HATCHING = 40
"""Rows of a map over those of a stripe, of which there are two colors, where it was not seen."""
HATCH_COLORS = np.array([72, 104], np.uint8)
"""Codes of gray of its stripes."""


def decomposition_pictures(parts: Decomposition) -> dict[str, np.ndarray]:
    """The parts of a view: render, specular, albedo, normals, depth and alpha."""
    covered = parts.alpha > 0.5
    depth = parts.depth[covered]
    near, far = (float(depth.min()), float(depth.max())) if len(depth) else (0.0, 1.0)
    nearness = torch.where(covered, 1 - 0.9 * (parts.depth - near) / max(far - near, 1e-9), torch.zeros(()))
    return {
        "1-render": to_display(_pixels(parts.radiance)),
        "2-specular": to_display(_pixels(parts.specular * parts.alpha)),
        "3-albedo": to_display(_pixels(parts.albedo)),
        "4-normals": normal_picture(parts),
        "5-depth-near-is-bright": np.rint(nearness.clamp(0, 1).numpy() * 255).astype(np.uint8),
        "6-alpha": np.rint(parts.alpha.clamp(0, 1).numpy() * 255).astype(np.uint8),
    }


def normal_picture(parts: Decomposition) -> UInt8[np.ndarray, "H W 3"]:
    """(n + 1)/2 of world normals where alpha is above one half, black elsewhere."""
    covered = (parts.alpha > 0.5)[..., None].numpy()
    return np.rint((_pixels(parts.normals_world) + 1) / 2 * 255 * covered).astype(np.uint8)


def _pixels(planes: Tensor) -> np.ndarray:
    return planes.permute(1, 2, 0).contiguous().numpy()


def display_gain(environment: Float[np.ndarray, "H W 3"]) -> float:
    """By which a dark map is brightened for people: its 95th percentile is shown as 0.7 of linear light at least."""
    return max(1.0, 0.7 / max(float(np.percentile(environment.max(-1), 95)), 1e-6))


def environment_picture(
    environment: Float[np.ndarray, "H W 3"], visibility: Float[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "_ _ 3"]:
    """A map in display colors, dark ones brightened; directions whose visibility is zero, where it is filled, are
    hatched in gray.
    """
    from PIL import Image

    rows, columns = np.indices(visibility.shape)
    stripes = (rows + columns) // max(len(visibility) // HATCHING, 1) % 2
    shown = to_display(environment * display_gain(environment))
    picture = np.where((visibility > 0)[..., None], shown, HATCH_COLORS[stripes][..., None])
    if picture.shape[1] >= PICTURE_WIDTH:
        return picture
    return np.asarray(Image.fromarray(picture).resize((PICTURE_WIDTH, PICTURE_WIDTH // 2), Image.Resampling.BICUBIC))


def write_decomposition(
    path: Path,
    photograph: Float[np.ndarray, "H W 3"],
    parts: Decomposition,
    environment: UInt8[np.ndarray, "_ _ 3"],
    visibility: Float[np.ndarray, "_ _"],
) -> None:
    """Write the sheet of a prediction: a photograph around the object and the normals found in it, and beside them the
    recovered environment and its visibility, white for 1.
    """
    pictures = {
        "photograph": to_display(photograph),
        "recovered environment (hatched: not seen)": environment,
        "recovered normals": normal_picture(parts),
        "visibility: how well each direction was seen": np.rint(255 * visibility).astype(np.uint8),
    }
    write_picture_sheet(path, pictures, widths=(TILE_PX, 2 * TILE_PX))


def around_object(frame: Frame) -> tuple[Camera, Float[np.ndarray, "H W 3"]]:
    """The camera of a frame and its photograph, linear, both cut to the object with a margin."""
    view, color, shown = read_whole_view(frame)
    rows, columns = object_window(without_specks(view.alpha))
    camera, (height, width) = frame.camera, color[rows, columns].shape[:2]
    center = camera.cx - columns.start, camera.cy - rows.start
    cut = Camera(camera.camera_to_world, camera.fx, camera.fy, *center, width, height)
    return cut, (color * shown[..., None])[rows, columns]


def object_window(alpha: Float[np.ndarray, "H W"]) -> tuple[slice, slice]:
    """Rows and columns around the object with a twelfth of margin; of the whole picture where it shows none."""
    rows, columns = (np.nonzero(alpha.max(axis) > ALPHA_FLOOR)[0] for axis in (1, 0))
    if len(rows) == 0:
        rows, columns = (np.arange(size) for size in alpha.shape)
    margin = max(len(rows), len(columns)) // 12
    top, left = (max(0, int(places[0]) - margin) for places in (rows, columns))
    return slice(top, int(rows[-1]) + 1 + margin), slice(left, int(columns[-1]) + 1 + margin)
