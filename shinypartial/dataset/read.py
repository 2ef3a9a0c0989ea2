"""Open a dataset folder, ours or a plain NeRF-synthetic one, and read its views."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Num

from shinypartial.core.color import LINEAR_OF_CODES, srgb_to_linear
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import (
    BACKGROUND,
    COLOR_CHANNELS,
    DEPTH_CHANNEL,
    ENVIRONMENT_INVERSE_DISTANCE,
    ENVIRONMENT_LATLONG,
    FORMAT,
    FORMAT_VERSION,
    INVERSE_DISTANCE_CHANNEL,
    MANIFEST,
    NORMAL_CHANNELS,
    SELF_REFLECTION_CHANNEL,
    SPLITS,
    BallEvidence,
    Dataset,
    Frame,
    Statement,
    View,
)
from shinypartial.dataset.transforms import read_frames
from shinypartial.io.files import newest_folder, read_json, read_table, sha256_of_files
from shinypartial.io.images import (
    EXR,
    read_exr,
    read_exr_rgb,
    read_picture,
    read_png,
    require_latlong,
    stack_channels,
    unit_values,
)
from shinypartial.io.records import read_record

DEFAULT_FOLDER = Path("datasets")


def newest_dataset(parent: Path = DEFAULT_FOLDER) -> Path:
    """The dataset below `parent` that was completed last."""
    return newest_folder(
        parent,
        "transforms_train.json",
        "a dataset",
        "Make one: `shinypartial generate --scene vase`, or name a folder.",
    )


def open_dataset(root: Path, *, shared_names: bool = False) -> Dataset:
    """Read manifest and cameras; images are read one by one with `read_view`.

    Predictions of test views are distinguished by file name, which two may have in common only with `shared_names`.
    Raises InputError for a missing folder, transforms that are missing or broken, and poses that are not rigid.
    """
    require_dataset_folder(root)
    manifest = _read_manifest(root / MANIFEST) if (root / MANIFEST).exists() else {}
    if manifest.get("complete") is False:
        raise InputError(
            expected=f"a complete dataset in {root}",
            found="one whose generation has not ended",
            remedy="Wait for it, or run the command that makes it again: it continues where it stopped.",
        )
    splits = []
    for split in SPLITS:
        frames, _, errors = read_frames(root, split)
        if errors:
            raise errors[0]
        splits.append(tuple(frames))
    dataset = Dataset(root, manifest, *splits)
    if not shared_names:
        _require_own_names(dataset)
    return dataset


def _require_own_names(dataset: Dataset) -> None:
    names = Counter(frame.name for frame in dataset.test)
    shared = [name for name, count in names.items() if count > 1]
    if shared:
        raise InputError(
            expected=f"test views of different file names in {dataset.root}, by which predictions are distinguished",
            found=f"{names[shared[0]]} views named {shared[0]}",
            remedy="Rename the pictures and correct transforms_test.json; `shinypartial subset` renames views, too.",
        )


def require_dataset_folder(root: Path) -> None:
    """Raise InputError where there is no folder."""
    if not root.is_dir():
        raise InputError(
            expected=f"a dataset folder at {root}",
            found="a file" if root.exists() else "nothing there",
            remedy="Check the path, or make one: `shinypartial generate --scene vase`.",
        )


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


@dataclass(frozen=True)
class _Photograph:
    """A picture as it was decoded: linear RGB or RGBA, the color premultiplied by an alpha channel or not; and the
    channels of an EXR.
    """

    color: Float[np.ndarray, "H W C"]
    premultiplied: bool
    channels: dict[str, np.ndarray]


def read_view(frame: Frame) -> View:
    """Read one view: from the EXR where there is one, else from a photograph of another format.

    Its mask is the file that the transforms name, else the alpha channel, else the companion `_alpha.png`. Raises
    InputError when the image is missing, truncated, of the wrong size, without a mask, or holds NaN.
    """
    return _view_of(frame, _read_photograph(frame))


def read_whole_view(frame: Frame) -> tuple[View, Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W"]]:
    """A view, the straight linear color of its photograph also beyond the mask, and the share of each pixel that this
    covers.

    That is alpha where the alpha channel is the mask: then nothing lies behind the object. It is 1 where the mask is a
    file of its own.
    """
    photograph = _read_photograph(frame)
    color = photograph.color
    shown = color[..., 3] if color.shape[2] == 4 else np.ones_like(color[..., 0])
    straight = color[..., :3] / np.where(photograph.premultiplied & (shown > 0), shown, 1)[..., None]
    if frame.mask is not None:
        shown = (shown > 0).astype(np.float32)
    return _view_of(frame, photograph), np.where(shown[..., None] > 0, straight, 0), shown


def _read_photograph(frame: Frame) -> _Photograph:
    path = frame.photograph
    if path.suffix.lower() == EXR:
        channels = read_exr(path)
        if "A" not in channels and frame.mask is None:
            raise _missing_mask(frame, path)
        names = COLOR_CHANNELS if "A" in channels else COLOR_CHANNELS[:3]
        photograph = _Photograph(stack_channels(channels, names, path), True, channels)
    else:
        photograph = _Photograph(*_linear_color(read_picture(path)), {})
    if photograph.color.shape[:2] != (frame.camera.height, frame.camera.width):
        raise InputError(
            expected=f"{frame.camera.width}×{frame.camera.height} pixels for {frame.name}, as its transforms say",
            found=f"{photograph.color.shape[1]}×{photograph.color.shape[0]}",
            remedy="Correct w and h; a picture of another size than the others has its own in its frame.",
        )
    return photograph


def _view_of(frame: Frame, photograph: _Photograph) -> View:
    """Cut out by its mask, with the ground truth that lies in the same file or in companions."""
    radiance, alpha = _cut_out(frame, photograph)
    channels = photograph.channels
    if not channels:
        view = View(radiance, alpha, _companion_normals(frame, alpha), None, photograph.premultiplied)
    else:
        has_normals = all(name in channels for name in NORMAL_CHANNELS)
        normals = (
            stack_channels(channels, NORMAL_CHANNELS, frame.photograph)
            if has_normals
            else _companion_normals(frame, alpha)
        )
        depth = channels[DEPTH_CHANNEL].astype(np.float32) if DEPTH_CHANNEL in channels else None
        self_reflection = channels.get(SELF_REFLECTION_CHANNEL)
        mask = None if self_reflection is None else self_reflection.astype(np.float32)
        view = View(radiance, alpha, normals, depth, high_dynamic_range=True, self_reflection=mask)
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


def photographs_hash(dataset: Dataset) -> str:
    """SHA-256 of the training cameras and of every file that training views are read from."""
    files = (dataset.root / "transforms_train.json", *_training_files(dataset))
    return sha256_of_files(path for path in files if path.is_file())


def _training_files(dataset: Dataset) -> Iterator[Path]:
    for frame in dataset.train:
        yield from (frame.photograph, frame.alpha_png)
        if frame.mask is not None:
            yield frame.mask


def require_normals(frame: Frame, view: View) -> Float[np.ndarray, "H W 3"]:
    """Ground-truth normals of a frame's view; raises InputError when it has none though others of its dataset do."""
    if view.normals_world is None:
        raise InputError(
            expected=f"normals in {frame.name}, as in the first training view",
            found="none",
            remedy="Generate the dataset again.",
        )
    return view.normals_world


def _linear_color(image: Num[np.ndarray, "H W C"]) -> tuple[Float[np.ndarray, "H W D"], bool]:
    """Linear RGB or RGBA of a picture as stored, and whether it was linear (and premultiplied) already."""
    if image.shape[2] == 1:
        image = np.repeat(image, 3, 2)
    if image.dtype.kind == "f":
        return unit_values(image), True
    codes, rest = image[..., :3], unit_values(image[..., 3:])
    color = LINEAR_OF_CODES[codes] if image.dtype == np.uint8 else srgb_to_linear(unit_values(codes))
    return np.concatenate([color, rest], -1) if rest.size else color, False


def _companion_normals(frame: Frame, alpha: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W 3"] | None:
    """Unit normals of the picture beside a photograph, where there is one."""
    if not frame.normal_png.exists():
        return None
    stored = read_png(frame.normal_png)
    _check_companion(frame, frame.normal_png, stored)
    if stored.shape[2] < 3:
        raise InputError(
            expected=f"three channels in {frame.normal_png}",
            found="a gray picture",
            remedy="Restore it, or remove it.",
        )
    decoded = stored[..., :3].astype(np.float32) * (2 / 255) - 1
    length = np.linalg.norm(decoded, axis=-1, keepdims=True)
    normals = np.where((length > 0.5) & (alpha[..., None] > 0), decoded / np.maximum(length, 1e-6), 0)
    return normals.astype(np.float32)


def _cut_out(frame: Frame, photograph: _Photograph) -> tuple[Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W"]]:
    """Radiance premultiplied by the mask, and the mask."""
    color, premultiplied = photograph.color, photograph.premultiplied
    radiance, alpha = color[..., :3], color[..., 3] if color.shape[2] == 4 else None
    if frame.mask is None and alpha is not None:
        return (radiance if premultiplied else radiance * alpha[..., None]), alpha
    if frame.mask is None and not frame.alpha_png.exists():
        raise _missing_mask(frame, frame.photograph)
    file = frame.mask or frame.alpha_png
    mask = unit_values(read_picture(file)[..., 0])
    _check_companion(frame, file, mask)
    if premultiplied and alpha is not None:
        radiance = radiance / np.where(alpha > 0, alpha, 1)[..., None]
    return radiance * mask[..., None], mask


def _check_companion(frame: Frame, path: Path, image: Num[np.ndarray, "H W *C"]) -> None:
    if image.shape[:2] != (frame.camera.height, frame.camera.width):
        raise InputError(
            expected=f"{path.name} in the size of {frame.name}",
            found=f"{image.shape[1]}×{image.shape[0]}",
            remedy="Remake it.",
        )


def _missing_mask(frame: Frame, path: Path) -> InputError:
    return InputError(
        expected=f"a mask for {frame.name}: an alpha channel in {path.name}, a mask_path, or {frame.alpha_png.name}",
        found="none of them",
        remedy="Segment the object and save RGBA images with straight alpha.",
    )


def read_ball_evidence(dataset: Dataset) -> BallEvidence | None:
    """What a capture of a mirror ball knows of itself; None where the dataset is none."""
    path = dataset.root / "transforms_train.json"
    stated = read_table(path, "the cameras of the train split").get("ball")
    return None if stated is None else read_record(BallEvidence, stated, f"`ball` of {path}", allow_unknown=True)


def read_statement(dataset: Dataset) -> Statement:
    """What a capture knows and how sure it is, as far as the cameras of the train split state it; InputError for what
    has no meaning.
    """
    path = dataset.root / "transforms_train.json"
    table = read_table(path, "the cameras of the train split")
    known = {item.name: table[item.name] for item in fields(Statement) if item.name in table}
    found = read_record(Statement, known, str(path), allow_unknown=True, remedy="Correct it, or leave it out.")
    plane = found.ground
    if plane is not None and not plane.is_plane:
        raise InputError(
            expected=f"`ground` of {path} with a normal of length 1 and a finite offset: points x with n · x = offset",
            found=f"normal {list(plane.normal)}, offset {plane.offset}",
            remedy="Correct it, or leave `ground` out.",
        )
    return found


def read_background(dataset: Dataset) -> tuple[Float[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """What was seen past a ball: linear light as a lat-long map in the world frame, and where there is any.

    Raises InputError where the file is missing, damaged or no lat-long map.
    """
    path = dataset.root / BACKGROUND
    planes = stack_channels(read_exr(path), COLOR_CHANNELS, path)
    require_latlong(planes, path, "light past the ball", "Run `panoless capture` again.")
    return planes[..., :3], planes[..., 3] > 0.5


def read_environment(dataset: Dataset) -> Float[np.ndarray, "H W 3"]:
    """Ground-truth environment as a linear lat-long map in the world frame."""
    return read_exr_rgb(dataset.root / ENVIRONMENT_LATLONG)


def read_inverse_distance(dataset: Dataset) -> Float[np.ndarray, "H W"] | None:
    """Ground-truth 1/D of every direction from the origin, in 1/scene units, 0 for infinitely far; None if unknown."""
    path = dataset.root / ENVIRONMENT_INVERSE_DISTANCE
    return read_inverse_distance_map(path) if path.exists() else None


def read_inverse_distance_map(path: Path) -> Float[np.ndarray, "H W"]:
    """Read such a map from a file; raises InputError unless it is a finite 2:1 map ≥ 0."""
    inverse = stack_channels(read_exr(path), (INVERSE_DISTANCE_CHANNEL,), path)[..., 0]
    require_latlong(inverse, path, "1/D ≥ 0", "Export the map again: 0 stands for infinitely far.", lowest=0.0)
    return inverse
