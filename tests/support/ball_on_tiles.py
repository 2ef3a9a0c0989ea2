"""A mirror ball on a sheet of colored tiles, ray traced: it knows nothing of homographies or maps."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from shinypartial.core.camera import Camera, ray_directions_world
from shinypartial.core.color import srgb_to_linear
from shinypartial.dataset.schema import Frame, GroundPlane, Statement
from shinypartial.dataset.write import write_transforms
from shinypartial.io.images import write_png
from tests.support.photographed_planes import arc

GROUND = GroundPlane((0.0, 0.0, 1.0), 0.0)
RADIUS, CENTER = 0.3, np.array([0.05, 0.0, 0.3])
CAMERAS = arc(14, 3.0, (160, 120), 260.0, (0.0, 0.0, 0.2))
TILES = np.random.default_rng(5).integers(20, 236, (400, 400, 3))
TILE = 0.09


def tiles(places: Float[np.ndarray, "*P 2"]) -> np.ndarray:
    """Codes of the sheet."""
    column, row = np.moveaxis(np.floor(places / TILE).astype(int) % 400, -1, 0)
    return TILES[row, column]


def linear_tiles(places: Float[np.ndarray, "*P 2"]) -> np.ndarray:
    """Linear radiance of the sheet."""
    return srgb_to_linear(tiles(places) / 255.0)


def seen_by(camera: Camera, ball: bool = True) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """What a pinhole sees of sheet and mirror ball, and where the ball is: the middle of each pixel."""
    directions = ray_directions_world(camera)
    origin = camera.position_world
    away = origin - CENTER
    half_b = directions @ away
    root = half_b**2 - (away @ away - RADIUS**2)
    hit = (root > 0) & ball
    distance = -half_b - np.sqrt(np.maximum(root, 0))
    normal = (origin + distance[..., None] * directions - CENTER) / RADIUS
    start = np.where(hit[..., None], origin + distance[..., None] * directions, origin)
    ray = np.where(hit[..., None], directions - 2 * (directions * normal).sum(-1, keepdims=True) * normal, directions)
    down = ray[..., 2] < -1e-3
    length = np.where(down, -start[..., 2] / np.where(down, ray[..., 2], 1), 0)
    sky = 120 + 100 * np.sin(3 * ray + [0, 1, 2])
    color = np.where(down[..., None], tiles((start + length[..., None] * ray)[..., :2]), sky)
    return color.clip(0, 255).astype(np.uint8), hit


def write_ball_on_tiles(folder: Path, lacked_px: int = 0) -> Path:
    """A dataset of it whose masks lack so many rows of pixels at the lower edge."""
    frames = []
    for number, camera in enumerate(CAMERAS):
        picture, mask = seen_by(camera)
        rows = np.nonzero(mask.any(1))[0]
        mask[rows[-1] + 1 - lacked_px :] = False
        stem = folder / "train" / f"p{number}"
        write_png(stem.with_name(f"{stem.name}.png"), picture)
        write_png(stem.with_name(f"{stem.name}_alpha.png"), mask.astype(np.uint8) * 255)
        frames.append(Frame(f"train/{stem.name}", camera, stem))
    write_transforms(folder, "train", frames, statement=Statement(0.001, 0.0, GROUND))
    return folder
