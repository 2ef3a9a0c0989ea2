"""Cameras of a dataset for other programs: a COLMAP model as text, or nerfstudio's transforms.json."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import Camera, opencv_to_opengl
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset, Frame
from shinypartial.dataset.write import intrinsics_of
from shinypartial.io.files import write_json, write_text


def export_cameras(dataset: Dataset, output: Path, to: Literal["colmap", "nerf"]) -> list[Path]:
    """Write the cameras of all views to a folder and return the files.

    COLMAP: cameras.txt, images.txt and an empty points3D.txt; names of images are paths from the dataset's folder, such
    as `train/r_000.png`. nerfstudio: transforms.json, whose paths lead from the output folder to the pictures.
    Raises InputError where such a file is already.
    """
    names = {"colmap": ("cameras.txt", "images.txt", "points3D.txt"), "nerf": ("transforms.json",)}[to]
    files = [output / name for name in names]
    existing = next((path for path in files if path.exists()), None)
    if existing:
        raise InputError(
            expected=f"a folder without {existing.name} at {output}", found="one", remedy="Choose another --output."
        )
    frames = (*dataset.train, *dataset.test)
    if to == "nerf":
        write_json(files[0], _nerf_content(frames, output))
    else:
        for path, text in zip(files, _colmap_texts(frames, dataset.root), strict=True):
            write_text(path, text)
    return files


def _nerf_content(frames: Sequence[Frame], output: Path) -> dict[str, object]:
    entries = []
    for frame in frames:
        entry = {
            "file_path": _from(output, _picture(frame)),
            "transform_matrix": opencv_to_opengl(frame.camera.camera_to_world).tolist(),
            **intrinsics_of(frame.camera),
        }
        mask = frame.mask or (frame.alpha_png if frame.alpha_png.exists() else None)
        entries.append(entry if mask is None else {**entry, "mask_path": _from(output, mask)})
    return {"camera_model": "OPENCV", "frames": entries}


def _from(folder: Path, path: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()


def _picture(frame: Frame) -> Path:
    """The picture that other programs can read, where there is one beside the EXR."""
    return frame.png if frame.png.exists() else frame.photograph


def _colmap_texts(frames: Sequence[Frame], root: Path) -> tuple[str, str, str]:
    """Contents of cameras.txt, images.txt and points3D.txt: one PINHOLE camera for each set of intrinsics."""
    cameras: dict[tuple[float, ...], int] = {}
    images = []
    for number, frame in enumerate(frames, 1):
        one = frame.camera
        intrinsics = one.width, one.height, one.fx, one.fy, one.cx, one.cy
        camera = cameras.setdefault(intrinsics, len(cameras) + 1)
        pose = " ".join(f"{value:.17g}" for value in (*_quaternion(one), *one.world_to_camera[:3, 3]))
        # The second line lists points in the image: none.
        images.append(f"{number} {pose} {camera} {_from(root, _picture(frame))}\n\n")
    lines = [
        f"{number} PINHOLE {' '.join(f'{value:.17g}' for value in values)}\n" for values, number in cameras.items()
    ]
    return "".join(lines), "".join(images), "# no points\n"


def _quaternion(camera: Camera) -> Float[np.ndarray, "4"]:
    """(w, x, y, z) of the rotation from the world to the camera, w ≥ 0."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(camera.world_to_camera[:3, :3]).as_quat()
    return np.array([w, x, y, z]) * (1 if w >= 0 else -1)
