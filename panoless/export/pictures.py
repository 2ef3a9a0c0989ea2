"""Pictures of a prediction: the parts of a rendered view, the recovered environment, and a sheet that sums it up."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from panoless.capture.masks import without_specks
from panoless.export.render import Decomposition
from panoless.kernels.constants import ALPHA_FLOOR
from shinypartial.core.color import to_display
from shinypartial.dataset.read import read_whole_view
from shinypartial.dataset.schema import Frame
from shinypartial.io.picture_sheet import TILE_PX, write_picture_sheet

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


def environment_picture(
    environment: Float[np.ndarray, "H W 3"], visibility: Float[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W 3"]:
    """A map in display colors; directions whose visibility is zero, where it is filled, are hatched in gray."""
    rows, columns = np.indices(visibility.shape)
    stripes = (rows + columns) // max(len(visibility) // HATCHING, 1) % 2
    return np.where((visibility > 0)[..., None], to_display(environment), HATCH_COLORS[stripes][..., None])


def write_decomposition(
    path: Path,
    frame: Frame,
    parts: Decomposition,
    environment: UInt8[np.ndarray, "H W 3"],
    visibility: Float[np.ndarray, "H W"],
) -> None:
    """Write the sheet of a prediction: a photograph and the normals found in it, both around the object, and beside
    them the recovered environment and its visibility, white for 1.
    """
    view, color, shown = read_whole_view(frame)
    window = object_window(without_specks(view.alpha))
    pictures = {
        "photograph": to_display(color * shown[..., None])[window],
        "recovered environment (hatched: not seen)": environment,
        "recovered normals": normal_picture(parts)[window],
        "visibility: how well each direction was seen": np.rint(255 * visibility).astype(np.uint8),
    }
    write_picture_sheet(path, pictures, widths=(TILE_PX, 2 * TILE_PX))


def object_window(alpha: Float[np.ndarray, "H W"]) -> tuple[slice, slice]:
    """Rows and columns around the object with a twelfth of margin; of the whole picture where it shows none."""
    rows, columns = (np.nonzero(alpha.max(axis) > ALPHA_FLOOR)[0] for axis in (1, 0))
    if len(rows) == 0:
        rows, columns = (np.arange(size) for size in alpha.shape)
    margin = max(len(rows), len(columns)) // 12
    top, left = (max(0, int(places[0]) - margin) for places in (rows, columns))
    return slice(top, int(rows[-1]) + 1 + margin), slice(left, int(columns[-1]) + 1 + margin)
