"""Captures of Stanford-ORB (Kuang et al. 2023): `blender_HDR/NAME` or `blender_LDR/NAME`, and `ground_truth/NAME`.

The capture holds transforms and pictures as NeRF-synthetic has them, with masks beside them. The ground truth holds,
for each test view, what a mirror ball showed in the camera's axes, and normals of the scanned object.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from shinypartial.conversion.captures.base import Found, MapAxes, Shot, map_in_world
from shinypartial.core.camera import ray_directions_world
from shinypartial.core.conventions import OPENGL_OPENCV
from shinypartial.core.errors import InputError
from shinypartial.dataset.plain import TOLERATED_SHARE
from shinypartial.dataset.schema import SPLITS, Frame
from shinypartial.dataset.transforms import read_frames
from shinypartial.io.images import EXR, read_exr_rgb

GROUND_TRUTH, MAPS, NORMALS = "ground_truth", "env_map", "surface_normal"
#: Of the camera, in its OpenGL axes (skylibs' lat-long): the middle looks along −z, +x lies to its right, +y on top.
MAP_AXES: MapAxes = ((0, 0, -1), (1, 0, 0), (0, 1, 0))


def read_stanford_orb(folder: Path, axes: MapAxes | None) -> Found:
    """Views of a capture, its light as the median over the maps of its test views, and normals of these views."""
    truth = folder.resolve().parent.parent / GROUND_TRUTH / folder.resolve().name
    train, test = (_shots(folder, split) for split in SPLITS)
    left_out = []
    maps = [(shot, path) for shot in test if (path := truth / MAPS / f"{shot.name}{EXR}").is_file()]
    if not maps:
        left_out.append(f"environment: no {truth / MAPS}/*{EXR}")
    files = [truth / NORMALS / f"{shot.name}.npy" for shot in test]
    missing = [path for path in files if not path.is_file()]
    if missing or not files:
        left_out.append(f"normals: no {missing[0] if missing else truth / NORMALS}")
    else:
        rotations = _to_world([_stored_normals(path, shot) for path, shot in zip(files, test, strict=True)], test)
        if rotations is None:
            left_out.append(f"normals: those of {truth / NORMALS} face away from the cameras in any axes")
        else:
            test = tuple(
                replace(shot, normals=partial(_turned_normals, path, shot, rotation))
                for path, shot, rotation in zip(files, test, rotations, strict=True)
            )
    environment = partial(_environment, maps, axes or MAP_AXES) if maps else None
    cameras = tuple(path for split in SPLITS if (path := folder / f"transforms_{split}.json").exists())
    return Found(train, test, environment, cameras, tuple(left_out))


def _shots(folder: Path, split: str) -> tuple[Shot, ...]:
    frames, _, errors = read_frames(folder, split)
    if errors:
        raise errors[0]
    return tuple(Shot(frame.stem.name, frame.camera, frame.photograph, _mask(folder, split, frame)) for frame in frames)


def _mask(folder: Path, split: str, frame: Frame) -> Path:
    path = folder / f"{split}_mask" / f"{frame.stem.name}.png"
    if not path.is_file():
        raise InputError(
            expected=f"the mask of {frame.name} at {path}",
            found="no such file",
            remedy="Name a capture below blender_HDR or blender_LDR.",
        )
    return path


def _environment(maps: Sequence[tuple[Shot, Path]], axes: MapAxes) -> Float[np.ndarray, "H 2*H 3"]:
    """The median of the maps in the world: the photographer, who stands elsewhere in each, goes."""
    turned = []
    for shot, path in maps:
        opengl_to_world = (shot.camera.camera_to_world @ OPENGL_OPENCV)[:3, :3]
        turned.append(map_in_world(read_exr_rgb(path), axes, opengl_to_world))
    return np.median(turned, 0).astype(np.float32)


def _stored_normals(path: Path, shot: Shot) -> Float[np.ndarray, "H W 3"]:
    """As unit vectors, zero where they are zero, not finite or far from unit."""
    try:
        stored = np.load(path)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(
            expected=f"an array of normals at {path}", found=str(error), remedy="Download the file again."
        ) from None
    size = (shot.camera.height, shot.camera.width, 3)
    if stored.shape != size or stored.dtype.kind != "f":
        raise InputError(
            expected=f"floating-point normals of shape {size} in {path}",
            found=f"shape {stored.shape} of type {stored.dtype}",
            remedy="Download the file again; pictures and ground truth belong to one size.",
        )
    length = np.linalg.norm(np.nan_to_num(stored), axis=-1, keepdims=True)
    return np.where(length > 0.5, np.nan_to_num(stored) / np.maximum(length, 0.5), 0)


def _to_world(
    normals: Sequence[Float[np.ndarray, "_ _ 3"]], shots: Sequence[Shot]
) -> list[Float[np.ndarray, "3 3"]] | None:
    """What turns the stored normals of each view into the world's axes; None where nothing does.

    Visible surfaces face their camera: it determines whether vectors are in axes of the world or of the camera, and
    whether these are OpenGL's or OpenCV's.
    """
    poses = [shot.camera.camera_to_world[:3, :3] for shot in shots]
    candidates = ([np.eye(3)] * len(poses), [pose @ OPENGL_OPENCV[:3, :3] for pose in poses], poses)
    shares = []
    for rotations in candidates:
        facing = [
            (np.sum(stored @ rotation.T * ray_directions_world(shot.camera), -1) < 0)[stored.any(-1)]
            for stored, rotation, shot in zip(normals, rotations, shots, strict=True)
        ]
        together = np.concatenate(facing)
        shares.append(float(together.mean()) if len(together) else 0.0)
    best = int(np.argmax(shares))
    return candidates[best] if shares[best] > 1 - TOLERATED_SHARE else None


def _turned_normals(path: Path, shot: Shot, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "H W 3"]:
    return _stored_normals(path, shot) @ rotation.T
