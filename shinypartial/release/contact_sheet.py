"""One picture of a dataset: some training views with normals and self-reflection, and the environment."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from shinypartial.core.color import to_display
from shinypartial.core.sphere import latlong_to_directions, sample_latlong
from shinypartial.dataset.read import read_view
from shinypartial.dataset.schema import CONTACT_SHEET, Frame, View
from shinypartial.evaluation.pictures import normal_picture
from shinypartial.io.images import write_jpeg

VIEWS = 6
TILE = 160
JPEG_QUALITY = 85
#: Shown where the object sees itself, and over what share of the picture's own color.
MARK = np.array([255, 64, 160])
MARK_SHARE = 0.7

Picture = UInt8[np.ndarray, "H W 3"]
Tile = UInt8[np.ndarray, "T T 3"]


def write_contact_sheet(root: Path, frames: Sequence[Frame], environment: Float[np.ndarray, "H W 3"]) -> None:
    """Write `contact_sheet.jpg`: columns are training views spread over the path, rows are picture, normals,
    and self-reflection in pink; the environment runs below them all.
    """
    chosen = [frames[i] for i in sorted({*np.linspace(0, len(frames) - 1, VIEWS).round().astype(int).tolist()})]
    columns = [np.concatenate(_tiles(read_view(frame))) for frame in chosen]
    sheet = np.concatenate(columns, 1)
    width = max(sheet.shape[1], 3 * TILE)
    padding = np.zeros((sheet.shape[0], width - sheet.shape[1], 3), np.uint8)
    whole = np.concatenate([np.concatenate([sheet, padding], 1), _panorama(environment, width)])
    write_jpeg(root / CONTACT_SHEET, whole, JPEG_QUALITY)


def _tiles(view: View) -> tuple[Tile, ...]:
    picture = to_display(view.radiance)
    normals = np.zeros_like(view.radiance) if view.normals_world is None else view.normals_world
    marked = picture if view.self_reflection is None else _mark(picture, view.self_reflection)
    return tuple(_resized(each) for each in (picture, normal_picture(normals), marked))


def _mark(picture: Picture, mask: Float[np.ndarray, "H W"]) -> Picture:
    share = MARK_SHARE * mask[..., None]
    gray = np.repeat(picture.mean(-1, keepdims=True), 3, -1)
    return ((1 - share) * gray + share * MARK).astype(np.uint8)


def _resized(picture: Picture) -> Tile:
    """Fitted into a square tile, averaged over area."""
    from PIL import Image

    height, width = picture.shape[:2]
    scale = TILE / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    tile = np.zeros((TILE, TILE, 3), np.uint8)
    tile[: size[1], : size[0]] = np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))
    return tile


def _panorama(environment: Float[np.ndarray, "H W 3"], width: int) -> UInt8[np.ndarray, "h w 3"]:
    """The band within ±30° of the horizon, where a whole panorama fits the sheet's width."""
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, np.linspace(1 / 3, 2 / 3, width // 6))
    return to_display(sample_latlong(environment, latlong_to_directions(np.stack([u, v], -1))))
