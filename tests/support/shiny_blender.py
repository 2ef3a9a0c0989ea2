"""A 360° dataset of the mirror sphere in the layout of Shiny Blender, whose camera path is a loop that crosses itself.

The path is a figure eight on the sphere: azimuth A sin t, elevation B sin 2t, crossing at azimuth and elevation zero.
As in the original: no `val` split, twice as many test as training views, numbers without leading zeros,
`camera_angle_x` alone, and `_normal.png`, `_alpha.png` and `_disp.tiff` beside each image.
"""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import Camera, look_at, opencv_to_opengl
from shinypartial.core.color import linear_to_srgb
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import Dataset, View
from shinypartial.dataset.write import encode_normals, encode_unit
from shinypartial.io.files import write_json
from shinypartial.io.images import write_png
from tests.support.synthetic_dataset import CAMERA_DISTANCE, FIELD_OF_VIEW_RAD, render_sphere

AZIMUTH_REACH_DEG = 150.0
ELEVATION_REACH_DEG = 60.0


def loop_directions(count: int, start: float = 0.0) -> Float[np.ndarray, "V 3"]:
    """Unit directions of a figure eight that crosses itself once, at +X; `start` ∈ [0, 1) says where it begins."""
    turn = 2 * np.pi * (np.arange(count) / count + start)
    azimuth = math.radians(AZIMUTH_REACH_DEG) * np.sin(turn)
    elevation = math.radians(ELEVATION_REACH_DEG) * np.sin(2 * turn)
    horizontal = np.cos(elevation)
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation)], -1)


def loop_cameras(count: int, resolution: int, turned_deg: float = 0.0) -> list[Camera]:
    """Cameras on the loop, turned about +Z, in the order of the path."""
    angle = math.radians(turned_deg)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    focal = 0.5 * resolution / math.tan(0.5 * FIELD_OF_VIEW_RAD)
    middle = resolution / 2
    return [
        Camera(
            look_at(CAMERA_DISTANCE * turn @ each, np.zeros(3)), focal, focal, middle, middle, resolution, resolution
        )
        for each in loop_directions(count, start=0.1)
    ]


def make_shiny_blender_dataset(root: Path, count: int = 60, resolution: int = 16, turned_deg: float = 0.0) -> Dataset:
    """Render `count` views, every third one for training, and open the folder."""
    cameras = loop_cameras(count, resolution, turned_deg)
    for split, chosen in (("train", cameras[1::3]), ("test", [c for i, c in enumerate(cameras) if i % 3 != 1])):
        entries = []
        for i, camera in enumerate(chosen):
            _write_images(root / split, f"r_{i}", render_sphere(camera))
            pose = opencv_to_opengl(camera.camera_to_world).tolist()
            entries.append({"file_path": f"./{split}/r_{i}", "rotation": 0.0314, "transform_matrix": pose})
        write_json(root / f"transforms_{split}.json", {"camera_angle_x": FIELD_OF_VIEW_RAD, "frames": entries})
    return open_dataset(root)


def _write_images(folder: Path, name: str, view: View) -> None:
    from PIL import Image

    straight = np.clip(view.radiance / np.maximum(view.alpha, 1e-6)[..., None], 0, 1)
    rgba = encode_unit(np.concatenate([linear_to_srgb(straight), view.alpha[..., None]], -1))
    write_png(folder / f"{name}.png", rgba)
    write_png(folder / f"{name}_normal.png", encode_normals(view.normals_world))
    write_png(folder / f"{name}_alpha.png", encode_unit(view.alpha))
    disparity = np.where(view.depth > 0, 1 / np.maximum(view.depth, 1e-6), 0).astype(np.float32)
    Image.fromarray(disparity).save(folder / f"{name}_disp.tiff")
