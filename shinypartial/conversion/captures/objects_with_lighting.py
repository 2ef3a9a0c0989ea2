"""Captures of Objects with Lighting (Ummenhofer et al. 2024): pictures, masks and cameras in `inputs`, and the light.

Pictures hold 255 x^(1/2.2) of linear light. There are no normals, and the objects' other photographs are in other
light, so that every eighth picture is set aside as a test view.
"""

import re
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from shinypartial.conversion.captures.base import Found, MapAxes, Shot, map_in_world
from shinypartial.conversion.layouts import X, Z
from shinypartial.core.camera import Camera, check_pose
from shinypartial.core.errors import InputError
from shinypartial.io.images import read_picture, unit_values

INPUTS, GAMMA, TEST_EVERY = "inputs", 2.2, 8
#: The map in the world's axes where there is one; else the stored one, which the matrix takes the world to.
TURNED_MAP, STORED_MAP, WORLD_TO_MAP = "env_512_rotated.hdr", "env.hdr", "world_to_env.txt"
MAP_AXES: MapAxes = (X, (0, -1, 0), Z)


def read_objects_with_lighting(folder: Path, axes: MapAxes | None) -> Found:
    """Views of an object in one light, and that light."""
    inputs = folder / INPUTS if (folder / INPUTS).is_dir() else folder
    numbers = sorted(match[1] for path in inputs.glob("camera_*.txt") if (match := re.search(r"_(\d+)$", path.stem)))
    if not numbers:
        raise InputError(
            expected=f"camera_0000.txt and so on in {folder / INPUTS}",
            found="none",
            remedy="Name the folder of an object that holds `inputs`.",
        )
    cameras = tuple(inputs / f"camera_{number}.txt" for number in numbers)
    shots = [_shot(inputs, number, path) for number, path in zip(numbers, cameras, strict=True)]
    train = tuple(shot for index, shot in enumerate(shots) if index % TEST_EVERY)
    left_out = ["normals: the layout has none"]
    turn = _map_rotation(inputs.parent)
    if turn is None:
        left_out.append(f"environment: neither {TURNED_MAP} nor {STORED_MAP} with {WORLD_TO_MAP} in {inputs.parent}")
        return Found(train, tuple(shots[::TEST_EVERY]), None, cameras, tuple(left_out))
    environment = partial(_environment, *turn, axes or MAP_AXES)
    return Found(train, tuple(shots[::TEST_EVERY]), environment, cameras, tuple(left_out))


def _shot(inputs: Path, number: str, camera: Path) -> Shot:
    picture, mask = (inputs / f"{kind}_{number}.png" for kind in ("image", "mask"))
    for path in (picture, mask):
        if not path.is_file():
            raise InputError(expected=f"a picture at {path}", found="no such file", remedy="Download the object again.")
    return Shot(f"image_{number}", _camera(camera), picture, mask, GAMMA)


def _camera(path: Path) -> Camera:
    """Row by row K, R and t, x_camera = R x_world + t in OpenCV's axes, then width and height."""
    values = _numbers(path)
    if len(values) < 23:
        raise InputError(
            expected=f"K, R, t, width and height in {path}",
            found=f"{len(values)} numbers",
            remedy="Download the file again.",
        )
    intrinsics, rotation, shift = values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:21]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ shift
    check_pose(pose, path.name)
    (fx, _, cx), (_, fy, cy) = intrinsics[:2]
    return Camera(pose, float(fx), float(fy), float(cx), float(cy), int(values[21]), int(values[22]))


def _numbers(path: Path) -> Float[np.ndarray, "N"]:
    try:
        return np.array(path.read_text(encoding="utf-8").split(), dtype=np.float64)
    except ValueError as error:
        raise InputError(expected=f"numbers in {path}", found=str(error), remedy="Download the file again.") from None


def _map_rotation(folder: Path) -> tuple[Path, Float[np.ndarray, "3 3"]] | None:
    """The file of the map, and what takes the world's directions to its own."""
    if (folder / TURNED_MAP).is_file():
        return folder / TURNED_MAP, np.eye(3)
    if not (folder / STORED_MAP).is_file() or not (folder / WORLD_TO_MAP).is_file():
        return None
    values = _numbers(folder / WORLD_TO_MAP)
    if len(values) not in (9, 16):
        raise InputError(
            expected=f"a 3×3 or 4×4 matrix in {folder / WORLD_TO_MAP}",
            found=f"{len(values)} numbers",
            remedy="Download the file again.",
        )
    pose = np.eye(4)
    side = int(np.sqrt(len(values)))
    pose[:3, :3] = values.reshape(side, side)[:3, :3]
    check_pose(pose, WORLD_TO_MAP)
    return folder / STORED_MAP, pose[:3, :3]


def _environment(path: Path, rotation: Float[np.ndarray, "3 3"], axes: MapAxes) -> Float[np.ndarray, "H 2*H 3"]:
    return map_in_world(unit_values(read_picture(path))[..., :3], axes, rotation.T)
