"""Cameras of a dataset: `transforms_SPLIT.json` as NeRF-synthetic and nerfstudio write it."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from msgspec import Meta

from shinypartial.core.camera import Camera, check_pose, opengl_to_opencv
from shinypartial.core.command_line import command_line
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Frame, find_picture
from shinypartial.io.files import read_json
from shinypartial.io.images import EXR, PICTURE_SUFFIXES, picture_size
from shinypartial.io.records import Positive, Text, read_record

DISTORTION_FIELDS = ("k1", "k2", "k3", "k4", "p1", "p2")
#: nerfstudio's names of cameras that are pinholes where nothing is distorted.
CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
#: What nerfstudio and instant-ngp name the file of all cameras.
ALL_CAMERAS = "transforms.json"
UNITS = "(focal lengths, centers and sizes in pixels, angles in radians)"


@dataclass(frozen=True)
class _Intrinsics:
    """What the file gives for all frames, or a frame for itself."""

    camera_angle_x: Annotated[float, Meta(gt=0, lt=math.pi)] | None = None
    """Horizontal field of view in radians; read where there is no `fl_x`."""
    fl_x: Positive | None = None
    fl_y: Positive | None = None
    """That in x where it is not given."""
    cx: float | None = None
    cy: float | None = None
    """The middle of the picture where it is not given."""
    w: Annotated[float, Meta(ge=1)] | None = None
    h: Annotated[float, Meta(ge=1)] | None = None


@dataclass(frozen=True)
class _Entry:
    """What else an entry of `frames` says."""

    file_path: Text
    transform_matrix: Any
    mask_path: Text | None = None
    pose_covariance: Any = None


def read_frames(root: Path, split: str) -> tuple[list[Frame], int, list[InputError]]:
    """The frames of a split whose camera can be read, how many are listed, and what is wrong with the others.

    A frame that gives intrinsics itself has those in place of the file's: a focal length or an angle of view replaces
    all of that group; where its size is another, the file's focal lengths and center, which are in pixels, don't hold.
    Raises InputError when the file as a whole can't be used. Without `transforms_test.json` there are no test frames.
    """
    path = root / f"transforms_{split}.json"
    if split == "test" and not path.exists():
        return [], 0, []
    if root.is_dir() and not path.exists():
        if (root / ALL_CAMERAS).exists():
            raise InputError(
                expected=f"the cameras of the {split} split at {path}",
                found=f"{ALL_CAMERAS} of nerfstudio or instant-ngp, in which the cameras lie",
                remedy="Make a dataset with masks and without distortion of it: "
                f"`{command_line('panoless', 'capture', root)}`.",
            )
        raise InputError(
            expected=f"the cameras of the {split} split at {path}",
            found="no such file",
            remedy="Check the path of the folder; `panoless capture` finds the cameras of photographs that have none.",
        )
    return frames_of(root, read_json(path, f"the cameras of the {split} split"), path)


def frames_of(root: Path, content: Any, path: Path) -> tuple[list[Frame], int, list[InputError]]:
    """What `read_frames` returns, of the content of a file of cameras; `path` names it in messages."""
    entries = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(
            expected=f"`frames` of {path} to be a list with at least one frame",
            found="none",
            remedy="Restore the file, or write it again with a frame for each photograph.",
        )
    shared = _read_intrinsics(content, f"{path} {UNITS}")
    first_size = functools.cache(lambda: _first_size(root, entries, path))
    frames, errors = [], []
    for index, entry in enumerate(entries):
        try:
            frames.append(_read_frame(root, entry if isinstance(entry, dict) else {}, index, shared, first_size, path))
        except InputError as error:
            errors.append(error)
    return frames, len(entries), errors


def _read_intrinsics(fields: dict[str, Any], where: str) -> _Intrinsics:
    distorted = [name for name in DISTORTION_FIELDS if fields.get(name)]
    if distorted:
        raise InputError(
            expected=f"undistorted pinhole images in {where}",
            found=f"lens distortion ({', '.join(distorted)} not zero)",
            remedy="Undistort the images (`panoless capture` and COLMAP's image_undistorter do); remove these fields.",
        )
    model = "fisheye" if fields.get("is_fisheye") else fields.get("camera_model")  # instant-ngp states the former.
    if model is not None and model not in CAMERA_MODELS:
        raise InputError(
            expected=f"a pinhole as camera_model in {where}: {', '.join(CAMERA_MODELS)}",
            found=str(model),
            remedy="Undistort the images with the program that found the poses, and state its pinhole.",
        )
    return read_record(_Intrinsics, fields, where, allow_unknown=True)


def _first_size(root: Path, entries: list[Any], path: Path) -> tuple[int, int]:
    """Of the first picture that can be read: the others are judged when they are."""
    failure: InputError | None = None
    for index, entry in enumerate(entries):
        try:
            read = _read_entry(entry if isinstance(entry, dict) else {}, index, path)
            return picture_size(find_picture(*_stem_and_suffix(root, read.file_path)))
        except InputError as error:
            failure = failure or error
    assert failure is not None
    raise failure


def _read_entry(entry: dict[str, Any], index: int, path: Path) -> _Entry:
    remedy = "Restore the file, or give that frame its file_path and a 4×4 transform_matrix."
    return read_record(_Entry, entry, f"frame {index} of {path}", allow_unknown=True, remedy=remedy)


def _stem_and_suffix(root: Path, file_path: str) -> tuple[Path, str]:
    """Where the images of a frame lie, without extension, and the extension where it is named."""
    stem = root / file_path
    named = stem.suffix.lower() in (EXR, *PICTURE_SUFFIXES)
    return (stem.with_suffix(""), stem.suffix) if named else (stem, "")


def _read_frame(
    root: Path,
    entry: dict[str, Any],
    index: int,
    shared: _Intrinsics,
    first_size: Callable[[], tuple[int, int]],
    path: Path,
) -> Frame:
    read = _read_entry(entry, index, path)
    stem, suffix = _stem_and_suffix(root, read.file_path)
    name = f"{path.stem.removeprefix('transforms_')}/{stem.name}"
    own = _read_intrinsics(entry, f"{name} in {path} {UNITS}")
    try:
        pose = np.array(read.transform_matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            expected=f"transform_matrix (4×4) for {name} in {path}",
            found=str(error),
            remedy="Restore the file, or give that frame a camera-to-world matrix: four lists of four numbers.",
        ) from None
    check_pose(pose, name)
    width, height = own.w or shared.w, own.h or shared.h
    if width is None or height is None:
        width, height = first_size() if own == _Intrinsics() else picture_size(find_picture(stem, suffix))
    resized = (width, height) != (shared.w or width, shared.h or height)
    pixels = _Intrinsics() if resized else shared
    fx, fy = _focal_lengths(own, shared, pixels, width, f"{name} in {path}")
    cx = next((value for value in (own.cx, pixels.cx) if value is not None), width / 2)
    cy = next((value for value in (own.cy, pixels.cy) if value is not None), height / 2)
    camera = Camera(opengl_to_opencv(pose), fx, fy, cx, cy, int(width), int(height))
    mask = None if read.mask_path is None else root / read.mask_path
    return Frame(name, camera, stem, suffix, mask, _read_covariance(read.pose_covariance, name, path))


def _read_covariance(stored: Any, name: str, path: Path) -> Float[np.ndarray, "6 6"] | None:
    if stored is None:
        return None
    try:
        covariance = np.array(stored, dtype=np.float64)
    except (TypeError, ValueError):
        covariance = np.zeros(0)
    finite = covariance.shape == (6, 6) and np.isfinite(covariance).all()
    scales = np.sqrt(np.maximum(np.diag(covariance), 0)) if finite else np.zeros(6)
    # Radians and scene units differ by decades: definite is said of the correlations.
    if not scales.all() or np.linalg.eigvalsh((covariance + covariance.T) / np.outer(scales, scales))[0] <= 0:
        raise InputError(
            expected=f"pose_covariance of {name} in {path} to be a positive definite 6×6 matrix",
            found=f"shape {covariance.shape}" if covariance.shape != (6, 6) else "another matrix",
            remedy="Correct it, or leave it out: turn (rad, world axes), then shift (scene units).",
        )
    return (covariance + covariance.T) / 2


def _focal_lengths(
    own: _Intrinsics, shared: _Intrinsics, pixels: _Intrinsics, width: float, where: str
) -> tuple[float, float]:
    """In x and y, in pixels; `pixels` holds what the file gives in pixels, for frames of its size."""
    if own.fl_x or own.camera_angle_x:
        fx, angle, fy = own.fl_x, own.camera_angle_x, own.fl_y
    else:
        fx, angle, fy = pixels.fl_x, shared.camera_angle_x, own.fl_y or pixels.fl_y
    if fx is None and angle is not None:
        fx = 0.5 * width / math.tan(0.5 * angle)
    if fx is None:
        raise InputError(
            expected=f"camera_angle_x or fl_x for {where}",
            found="neither for pictures of this size",
            remedy="Add the focal length in pixels, or the horizontal angle of view in radians.",
        )
    return fx, fy or fx
