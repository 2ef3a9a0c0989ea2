"""Poses that another program has found: a model of COLMAP, or nerfstudio's transforms.json."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float

from panoless.photographs.certainty import SeenPoints
from panoless.photographs.frames import Frames, Photograph
from panoless.photographs.lens import INSTALL, Lens, lens_of_model
from panoless.photographs.posed import PosedView, Poses, as_rows, find_ground, lens_for, with_covariances
from shinypartial.core.conventions import PIXEL_CENTER
from shinypartial.core.errors import InputError
from shinypartial.dataset.transforms import ALL_CAMERAS, CAMERA_MODELS, DISTORTION_FIELDS, frames_of
from shinypartial.io.events import warn
from shinypartial.io.files import read_json
from shinypartial.io.images import PICTURE_SUFFIXES

#: Files of cameras as nerfstudio and NeRF-synthetic name them.
TRANSFORMS = (ALL_CAMERAS, "transforms_train.json")


def pycolmap_module() -> ModuleType:
    """pycolmap; InputError that names the extra where it is missing."""
    try:
        import pycolmap
    except ImportError:
        raise InputError(expected="pycolmap, for COLMAP's models", found="no such module", remedy=INSTALL) from None
    pycolmap.logging.minloglevel = 2  # Errors alone.
    return pycolmap


def find_model(source: Path) -> Path | None:
    """The folder of a COLMAP model in or beside a folder of pictures, where programs leave it."""
    parents = (source, source.parent) if source.name == "images" else (source,)
    places = [parent / place for parent in parents for place in ("sparse/0", "sparse", "colmap/sparse/0", ".")]
    return next((path for path in places if is_model(path)), None)


def find_transforms(source: Path) -> Path | None:
    """The file of cameras in a folder of pictures, or beside it."""
    places = (folder / name for folder in (source, source.parent) for name in TRANSFORMS)
    return next((path for path in places if path.exists()), None)


def is_model(folder: Path) -> bool:
    """Whether a folder holds cameras and images of COLMAP, as text or binary."""
    return any((folder / f"cameras{end}").exists() and (folder / f"images{end}").exists() for end in (".txt", ".bin"))


def read_colmap(folder: Path, frames: Frames) -> Poses:
    """Poses of the frames that a COLMAP model knows, by the names of their files; its world is kept.

    Raises InputError for a folder that is no model, and for cameras with other kinds of distortion.
    """
    return poses_of(_opened(folder), frames, f"the COLMAP model {folder}")


def read_rotations(folder: Path, files: Sequence[Path]) -> dict[Path, Float[np.ndarray, "3 3"]]:
    """World-to-camera rotations of those of the photographs that a COLMAP model has.

    Raises InputError where the folder holds no complete model.
    """
    images = {Path(image.name).stem: image for image in _opened(folder).images.values() if image.has_pose}
    return {file: images[file.stem].cam_from_world().rotation.matrix() for file in files if file.stem in images}


def _opened(folder: Path) -> Any:
    colmap = pycolmap_module()
    if not is_model(folder):
        raise InputError(
            expected=f"a COLMAP model at {folder}: cameras and images, .txt or .bin",
            found="nothing there" if not folder.exists() else "other files",
            remedy="Name the folder, usually sparse/0.",
        )
    try:
        return colmap.Reconstruction(str(folder))
    except Exception as error:
        raise InputError(
            expected=f"a complete COLMAP model at {folder}",
            found=str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__,
            remedy="Export it again; cameras, images and points3D belong together.",
        ) from None


def poses_of(model: Any, frames: Frames, origin: str) -> Poses:
    """Poses of a pycolmap reconstruction, and the ground that its points lie on."""
    images = {image.name: image for image in model.images.values() if image.has_pose}
    views, seen = [], []
    numbers = {key: index for index, key in enumerate(model.points3D)}
    places = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    for photograph in frames.photographs:
        name = listed_name(photograph, images)
        if name is None:
            continue
        image = images[name]
        camera = model.cameras[image.camera_id]
        names = [name.strip() for name in camera.params_info.split(",")]
        parameters = dict(zip(names, map(float, camera.params), strict=True))
        lens = lens_of_model(camera.model_name, parameters, camera.width, camera.height)
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        views.append(PosedView(photograph.name, lens_for(photograph, lens), as_rows(pose)))
        shown = [point for point in image.points2D if point.has_point3D()]
        which = np.array([numbers[point.point3D_id] for point in shown], dtype=np.int64)
        # COLMAP's pixel (0, 0) spans [0, 1]².
        found = np.array([point.xy for point in shown]).reshape(-1, 2) - PIXEL_CENTER
        seen.append(SeenPoints(lens, pose, which, places[which], found))
    cameras = np.array([view.camera_to_world for view in views]).reshape(-1, 4, 4)
    poses = Poses(origin, "unknown", tuple(views), ground=find_ground(places, cameras) if views else None)
    return with_covariances(poses, seen, known_points=False) if all(len(each.numbers) for each in seen) else poses


def listed_name(photograph: Photograph, names: Iterable[str]) -> str | None:
    """The name by which a program lists a photograph: of the same stem and, of several, the end of the file's path."""
    same = [name for name in names if Path(name).stem == photograph.name or Path(name).name == photograph.name]
    ends = [name for name in same if photograph.source.with_suffix("").as_posix().endswith(_bare(name))]
    return next(iter(ends or same), None)


def _bare(name: str) -> str:
    path = Path(name)
    return (path.with_suffix("") if path.suffix.lower() in PICTURE_SUFFIXES else path).as_posix().lstrip("./")


def read_transforms(path: Path, frames: Frames) -> tuple[Poses, dict[str, Path]]:
    """Poses and masks (`mask_path`) of nerfstudio's transforms.json, with intrinsics and distortion by frame."""
    content = read_json(path, "the cameras")
    if not isinstance(content, dict):
        raise InputError(expected=f"a table in {path}", found="something else", remedy="Export it again.")
    entries = [entry if isinstance(entry, dict) else {} for entry in content.get("frames") or []]
    plain = {**_pinhole(content), "frames": [_pinhole(entry) for entry in entries]}
    read, _, errors = frames_of(path.parent, plain, path)
    if errors:
        raise errors[0]
    known = {entry["file_path"]: (frame, {**content, **entry}) for frame, entry in zip(read, entries, strict=True)}
    views, masks, used = [], {}, set()
    for photograph in frames.photographs:
        name = listed_name(photograph, known)
        if name is None:
            continue
        used.add(name)
        frame, fields = known[name]
        camera = frame.camera
        coefficients = _distortion(fields, path)
        lens = Lens(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, **coefficients)
        views.append(PosedView(photograph.name, lens_for(photograph, lens), as_rows(camera.camera_to_world)))
        if frame.mask is not None:
            masks[photograph.name] = frame.mask
    if left_out := [name for name in known if name not in used]:
        warn(f"no photograph is read for {', '.join(left_out)} of {path}")
    return Poses(f"{path.name} of {path.parent}", "unknown", tuple(views)), masks


def _pinhole(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if name not in (*DISTORTION_FIELDS, "camera_model")}


def _distortion(fields: Mapping[str, Any], path: Path) -> dict[str, float]:
    model = fields.get("camera_model", "OPENCV")
    if fields.get("k4") or model not in CAMERA_MODELS:
        raise InputError(
            expected=f"a lens with k1, k2, k3, p1 and p2 at most in {path}",
            found=f"camera_model {model}" + (" with k4" if fields.get("k4") else ""),
            remedy="Undistort the pictures with the program that found the poses.",
        )
    found = {name: fields.get(name) or 0.0 for name in DISTORTION_FIELDS if name != "k4"}
    wrong = [name for name, value in found.items() if not isinstance(value, int | float)]
    if wrong:
        raise InputError(
            expected=f"numbers for {', '.join(wrong)} in {path}", found="something else", remedy="Export it again."
        )
    return {name: float(value) for name, value in found.items()}
