"""Open a dataset folder, ours or a plain NeRF-synthetic one, and read its views."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from shinypartial.core.camera import Camera, check_pose, opengl_to_opencv
from shinypartial.core.color import srgb_to_linear
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import (
    COLOR_CHANNELS,
    DEPTH_CHANNEL,
    ENVIRONMENT_LATLONG,
    FORMAT,
    FORMAT_VERSION,
    MANIFEST,
    NORMAL_CHANNELS,
    SELF_REFLECTION_CHANNEL,
    SPLITS,
    Dataset,
    Frame,
    View,
)
from shinypartial.io.files import newest_folder, read_json
from shinypartial.io.images import read_exr, read_exr_rgb, read_png, stack_channels

DEFAULT_FOLDER = Path("datasets")
DISTORTION_FIELDS = ("k1", "k2", "k3", "k4", "p1", "p2")


def newest_dataset(parent: Path = DEFAULT_FOLDER) -> Path:
    """The dataset below `parent` that was completed last."""
    return newest_folder(
        parent,
        "transforms_train.json",
        "a dataset",
        "Make one: `shinypartial generate --scene vase`, or name a folder.",
    )


def open_dataset(root: Path) -> Dataset:
    """Read manifest and cameras; images are read one by one with `read_view`.

    Raises InputError for a missing folder, transforms that are missing or broken, and poses that are not rigid.
    """
    if not root.is_dir():
        raise InputError(
            expected=f"a dataset folder at {root}",
            found="a file" if root.exists() else "nothing there",
            remedy="Check the path, or make one: `shinypartial generate --scene vase`.",
        )
    manifest = _read_manifest(root / MANIFEST) if (root / MANIFEST).exists() else {}
    if manifest.get("complete") is False:
        raise InputError(
            expected=f"a complete dataset in {root}",
            found="one whose generation has not ended",
            remedy="Wait for it, or run the command that makes it again: it continues where it stopped.",
        )
    train, test = (_read_frames(root, split) for split in SPLITS)
    return Dataset(root, manifest, train, test)


def _read_manifest(path: Path) -> dict[str, Any]:
    manifest = read_json(path, "the manifest")
    fields = manifest if isinstance(manifest, dict) else {}
    if fields.get("format") != FORMAT or fields.get("format_version") != FORMAT_VERSION:
        raise InputError(
            expected=f"{path} with format {FORMAT} version {FORMAT_VERSION}",
            found=f"{fields.get('format')} version {fields.get('format_version')}",
            remedy="Use the version of shinypartial that made the folder, or generate it again.",
        )
    return fields


def _read_frames(root: Path, split: str) -> tuple[Frame, ...]:
    path = root / f"transforms_{split}.json"
    if split == "test" and not path.exists():
        return ()
    transforms = read_json(path, f"the cameras of the {split} split")
    frames = transforms.get("frames") if isinstance(transforms, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(
            expected=f"a non-empty list `frames` in {path}", found="none", remedy="Restore the file of the dataset."
        )
    refuse_distortion(transforms, path)
    first = image_stem(root, frames[0], path)
    width, height = image_size(transforms, first)
    return tuple(read_entry(root, entry, transforms, width, height, path) for entry in frames)


def refuse_distortion(transforms: dict[str, Any], path: Path) -> None:
    """Raise InputError when transforms describe a lens with distortion."""
    distorted = [name for name in DISTORTION_FIELDS if transforms.get(name)]
    if distorted:
        raise InputError(
            expected=f"undistorted pinhole images in {path}",
            found=f"lens distortion ({', '.join(distorted)} not zero)",
            remedy="Undistort the images (for example with COLMAP's image_undistorter) and remove these fields.",
        )


def image_stem(root: Path, entry: Any, path: Path) -> Path:
    """Where the images of a frame lie, without extension; `path` names the transforms in messages."""
    name = entry.get("file_path") if isinstance(entry, dict) else None
    if not isinstance(name, str):
        raise InputError(
            expected=f"`file_path` for every frame of {path}",
            found=repr(name),
            remedy="Restore the file of the dataset.",
        )
    stem = root / name
    return stem.with_suffix("") if stem.suffix.lower() in (".png", ".exr") else stem


def image_size(transforms: dict[str, Any], stem: Path) -> tuple[int, int]:
    """Width and height in pixels: those of the transforms, else those of the picture."""
    if "w" in transforms and "h" in transforms:
        try:
            return int(transforms["w"]), int(transforms["h"])
        except (TypeError, ValueError):
            raise InputError(
                expected=f"the image size w, h in pixels for {stem}",
                found=f"{transforms['w']!r}, {transforms['h']!r}",
                remedy="Correct w and h of the transforms.",
            ) from None
    image = read_png(stem.with_name(stem.name + ".png"))
    return image.shape[1], image.shape[0]


def read_entry(root: Path, entry: Any, transforms: dict[str, Any], width: int, height: int, path: Path) -> Frame:
    """The frame of an entry of `frames`; raises InputError for a pose that isn't rigid and for bad intrinsics."""
    stem = image_stem(root, entry, path)
    name = f"{path.stem.removeprefix('transforms_')}/{stem.name}"
    try:
        pose = np.array(entry["transform_matrix"], dtype=np.float64)
        if "fl_x" in transforms:
            fx = float(transforms["fl_x"])
        else:
            fx = 0.5 * width / math.tan(0.5 * float(transforms["camera_angle_x"]))
        fy = float(transforms.get("fl_y", fx))
        cx, cy = float(transforms.get("cx", width / 2)), float(transforms.get("cy", height / 2))
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(
            expected=f"transform_matrix (4×4) and camera_angle_x or fl_x for {name} in {path}",
            found=f"{type(error).__name__}: {error}",
            remedy="Restore the file of the dataset.",
        ) from None
    check_pose(pose, name)
    if not all(map(math.isfinite, (fx, fy, cx, cy))) or fx <= 0 or fy <= 0:
        raise InputError(
            expected=f"positive finite focal lengths in {path}",
            found=f"fx {fx}, fy {fy}",
            remedy="Correct the intrinsics.",
        )
    return Frame(name, Camera(opengl_to_opencv(pose), fx, fy, cx, cy, width, height), stem)


def read_view(frame: Frame) -> View:
    """Read one view: from the EXR where there is one, else from the RGBA PNG.

    Raises InputError when the image is missing, truncated, of the wrong size, without a mask, or holds NaN.
    """
    view = _read_exr_view(frame) if frame.exr.exists() else _read_png_view(frame)
    arrays = {
        "radiance": view.radiance,
        "alpha": view.alpha,
        "normals": view.normals_world,
        "depth": view.depth,
        "self-reflection": view.self_reflection,
    }
    for what, array in arrays.items():
        if array is not None and not np.isfinite(array).all():
            raise InputError(
                expected=f"finite {what} in {frame.name}",
                found=f"{int((~np.isfinite(array)).sum())} NaN or infinite values",
                remedy="Delete the image and make it again.",
            )
    return view


def require_normals(frame: Frame, view: View) -> Float[np.ndarray, "H W 3"]:
    """Ground-truth normals of a frame's view; raises InputError when it has none though others of its dataset do."""
    if view.normals_world is None:
        raise InputError(
            expected=f"normals in {frame.name}, as in the first training view",
            found="none",
            remedy="Generate the dataset again.",
        )
    return view.normals_world


def _read_exr_view(frame: Frame) -> View:
    channels = read_exr(frame.exr)
    if "A" not in channels:
        raise _missing_mask(frame, frame.exr)
    rgba = stack_channels(channels, COLOR_CHANNELS, frame.exr)
    _check_size(frame, rgba)
    has_normals = all(name in channels for name in NORMAL_CHANNELS)
    normals = stack_channels(channels, NORMAL_CHANNELS, frame.exr) if has_normals else None
    depth = channels[DEPTH_CHANNEL].astype(np.float32) if DEPTH_CHANNEL in channels else None
    self_reflection = channels.get(SELF_REFLECTION_CHANNEL)
    return View(
        rgba[..., :3],
        rgba[..., 3],
        normals,
        depth,
        high_dynamic_range=True,
        self_reflection=None if self_reflection is None else self_reflection.astype(np.float32),
    )


def _read_png_view(frame: Frame) -> View:
    image = read_png(frame.png)
    _check_size(frame, image)
    if image.shape[2] == 4:
        alpha = image[..., 3].astype(np.float32) / 255
    elif frame.alpha_png.exists():
        alpha = _companion(frame, frame.alpha_png)[..., 0].astype(np.float32) / 255
    else:
        raise _missing_mask(frame, frame.png)
    color = np.repeat(image, 3, 2) if image.shape[2] == 1 else image[..., :3]
    radiance = srgb_to_linear(color.astype(np.float32) / 255) * alpha[..., None]
    normals = None
    if frame.normal_png.exists():
        stored = _companion(frame, frame.normal_png)
        if stored.shape[2] < 3:
            raise InputError(
                expected=f"three channels in {frame.normal_png}",
                found="a gray picture",
                remedy="Restore it, or remove it.",
            )
        decoded = stored[..., :3].astype(np.float32) * (2 / 255) - 1
        length = np.linalg.norm(decoded, axis=-1, keepdims=True)
        normals = np.where((length > 0.5) & (alpha[..., None] > 0), decoded / np.maximum(length, 1e-6), 0)
    return View(radiance, alpha, None if normals is None else normals.astype(np.float32), None, False)


def _check_size(frame: Frame, image: np.ndarray) -> None:
    if image.shape[:2] != (frame.camera.height, frame.camera.width):
        raise InputError(
            expected=f"{frame.camera.width}×{frame.camera.height} pixels for {frame.name}, as its transforms say",
            found=f"{image.shape[1]}×{image.shape[0]}",
            remedy="Render the frame again or correct w and h.",
        )


def _companion(frame: Frame, path: Path) -> UInt8[np.ndarray, "H W C"]:
    image = read_png(path)
    if image.shape[:2] != (frame.camera.height, frame.camera.width):
        raise InputError(
            expected=f"{path.name} in the size of {frame.name}",
            found=f"{image.shape[1]}×{image.shape[0]}",
            remedy="Remake it.",
        )
    return image


def _missing_mask(frame: Frame, path: Path) -> InputError:
    return InputError(
        expected=f"a mask for {frame.name}: an alpha channel in {path.name} or the file {frame.alpha_png.name}",
        found="neither",
        remedy="Segment the object and save RGBA images with straight alpha.",
    )


def read_environment(dataset: Dataset) -> Float[np.ndarray, "H W 3"]:
    """Ground-truth environment as a linear lat-long map in the world frame."""
    return read_exr_rgb(dataset.root / ENVIRONMENT_LATLONG)
