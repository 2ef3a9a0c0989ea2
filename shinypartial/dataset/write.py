"""Write a dataset folder frame by frame; what is there already is kept, so a killed run continues."""

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from shinypartial.core.camera import Camera, opencv_to_opengl
from shinypartial.core.color import to_display
from shinypartial.core.conventions import FACES
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions, latlong_to_cube, sample_latlong
from shinypartial.dataset.schema import (
    CHECKSUMS,
    COLOR_CHANNELS,
    DEPTH_CHANNEL,
    ENVIRONMENT_CUBE,
    ENVIRONMENT_INVERSE_DISTANCE,
    ENVIRONMENT_LATLONG,
    ENVIRONMENT_LATLONG_Y_UP,
    FORMAT,
    FORMAT_VERSION,
    INVERSE_DISTANCE_CHANNEL,
    LICENSES,
    MANIFEST,
    NORMAL_CHANNELS,
    SELF_REFLECTION_CHANNEL,
    BallEvidence,
    Frame,
    Statement,
    View,
)
from shinypartial.io.files import PARTIAL_PREFIX, read_table, sha256_of, write_json, write_text
from shinypartial.io.images import read_exr_rgb, write_exr, write_exr_rgb, write_png
from shinypartial.io.records import write_record


def make_frames(
    root: Path, split: str, cameras: Sequence[Camera], name: Callable[[int], str] = "r_{:03d}".format
) -> tuple[Frame, ...]:
    """Frames of a split of a dataset at `root`, named by their numbers."""
    stems = [root / split / name(i) for i in range(len(cameras))]
    return tuple(Frame(f"{split}/{stem.name}", camera, stem) for stem, camera in zip(stems, cameras, strict=True))


def begun_recipe(root: Path) -> Any:
    """The recipe that the manifest of a folder states, as it stands there; None where there is none."""
    manifest = root / MANIFEST
    return read_table(manifest, "the manifest").get("recipe") if manifest.exists() else None


def claim_folder(root: Path, recipe: dict[str, Any], generator: dict[str, Any], format_minor: int = 0) -> bool:
    """Make `root` the folder of this recipe; return whether an earlier run had begun it.

    `format_minor` says what the frames will hold beyond the first version: see `schema.FORMAT_MINOR`.

    Raises InputError when the folder belongs to another recipe or holds something else.
    """
    manifest_path = root / MANIFEST
    if manifest_path.exists():
        begun = begun_recipe(root)
        if begun != recipe:
            known = begun if isinstance(begun, dict) else {}
            different = sorted(key for key in {*recipe, *known} if recipe.get(key) != known.get(key))
            raise InputError(
                expected=f"an output folder that is new or belongs to the same recipe, at {root}",
                found=f"a dataset of another recipe (different: {', '.join(different)})",
                remedy="Choose another --output, or delete that folder.",
            )
        return True
    if root.exists() and (not root.is_dir() or any(not _is_partial(path) for path in root.iterdir())):
        raise InputError(
            expected=f"a new or empty output folder at {root}",
            found="files that are not a dataset",
            remedy="Choose another --output.",
        )
    root.mkdir(parents=True, exist_ok=True)
    versions = {"format": FORMAT, "format_version": FORMAT_VERSION, "format_minor": format_minor}
    write_json(manifest_path, {**versions, "complete": False, "recipe": recipe, "generator": generator})
    return False


def _is_partial(path: Path) -> bool:
    """A run that is killed while it writes its first file leaves nothing else."""
    return path.name.startswith(PARTIAL_PREFIX)


def is_written(frame: Frame) -> bool:
    """Whether every file of the frame is there (each is written whole, the EXR last)."""
    return all(path.exists() for path in frame.files)


def is_rendered(frame: Frame) -> bool:
    """Whether the frame is written with all that Blender knows, self-reflection included."""
    return is_written(frame) and frame.self_png.exists()


def write_view(frame: Frame, view: View) -> None:
    """Write the EXR and the 8-bit companions of one frame."""
    if view.normals_world is None or view.depth is None:
        raise ValueError("a rendered view has normals and depth")
    alpha = np.clip(view.alpha, 0, 1)
    write_png(frame.png, display_rgba(view.radiance, alpha))
    write_png(frame.alpha_png, encode_unit(alpha))
    write_png(frame.normal_png, encode_normals(view.normals_world))
    if view.self_reflection is not None:
        write_png(frame.self_png, encode_unit(view.self_reflection))
    write_exr(frame.exr, exr_channels(view))


def exr_channels(view: View) -> dict[str, np.ndarray]:
    """Channels of the EXR of a view, as far as the view has them."""
    rgba = np.concatenate([view.radiance, np.clip(view.alpha, 0, 1)[..., None]], -1)
    half = np.clip(rgba, -65504, 65504).astype(np.float16)
    channels = {name: half[..., i] for i, name in enumerate(COLOR_CHANNELS)}
    if view.normals_world is not None:
        channels |= {name: view.normals_world[..., i].astype(np.float32) for i, name in enumerate(NORMAL_CHANNELS)}
    if view.depth is not None:
        channels[DEPTH_CHANNEL] = view.depth.astype(np.float32)
    if view.self_reflection is not None:
        channels[SELF_REFLECTION_CHANNEL] = view.self_reflection.astype(np.float16)
    return channels


def display_rgba(radiance: Float[np.ndarray, "H W 3"], alpha: Float[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 4"]:
    """8-bit picture of premultiplied radiance: sRGB of straight color clipped to [0, 1], and alpha."""
    straight = np.where(alpha[..., None] > 0, radiance / np.maximum(alpha, 1e-6)[..., None], 0)
    return np.concatenate([to_display(straight), encode_unit(alpha)[..., None]], -1)


def encode_unit(values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """8-bit code of values, clipped to [0, 1]: round(255 x)."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


def encode_normals(normals: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit code of unit vectors: round(255 (n + 1)/2)."""
    return encode_unit((normals + 1) / 2)


def write_transforms(
    root: Path,
    split: str,
    frames: Sequence[Frame],
    ball: BallEvidence | None = None,
    statement: Statement | None = None,
) -> None:
    """Write `transforms_SPLIT.json` with OpenGL poses, as NeRF-synthetic and nerfstudio readers expect.

    Intrinsics of the first frame stand for all; frames that differ from it have their own. Extensions of pictures and
    masks that are files of their own are named, and covariances of poses stated, where frames have them.
    """
    shared = intrinsics_of(frames[0].camera)
    entries = []
    for frame in frames:
        own = intrinsics_of(frame.camera)
        entry: dict[str, Any] = {
            "file_path": f"./{split}/{frame.stem.name}{frame.suffix}",
            "transform_matrix": opencv_to_opengl(frame.camera.camera_to_world).tolist(),
        }
        if frame.pose_covariance is not None:
            entry["pose_covariance"] = frame.pose_covariance.tolist()
        if frame.mask is not None:
            entry["mask_path"] = Path(os.path.relpath(frame.mask, root)).as_posix()
        entries.append(entry if own == shared else {**entry, **own})
    stated = {} if ball is None else {"ball": write_record(ball)}
    if statement is not None:
        stated |= {name: value for name, value in write_record(statement).items() if value is not None}
    write_json(root / f"transforms_{split}.json", {**shared, **stated, "frames": entries})


def intrinsics_of(camera: Camera) -> dict[str, float]:
    """Field of view (rad), focal lengths, principal point and size (px) by their names in `transforms_SPLIT.json`."""
    return {
        "camera_angle_x": 2 * math.atan(camera.width / (2 * camera.fx)),
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
    }


def environment_files(root: Path) -> tuple[Path, ...]:
    """What `write_environment` writes, in this order."""
    cube = (root / ENVIRONMENT_CUBE / f"{name}.exr" for name in FACES)
    return (root / ENVIRONMENT_LATLONG, *cube, root / ENVIRONMENT_LATLONG_Y_UP)


LEAST_CUBE = 8
"""Texels along a face side at least."""


def write_environment(root: Path, latlong: Float[np.ndarray, "H W 3"], cube_resolution: int = 256) -> None:
    """Write the ground-truth environment as lat-long, cubemap and the tagged Y-up lat-long.

    The other two are resampled from the lat-long map as it is stored, so that all three agree. Faces of a cubemap have
    `cube_resolution` texels a side at most, and no more than half of the map's rows, which are as wide.
    """
    write_exr_rgb(root / ENVIRONMENT_LATLONG, latlong)
    stored = read_exr_rgb(root / ENVIRONMENT_LATLONG)
    side = min(cube_resolution, max(len(stored) // 2, LEAST_CUBE))
    for name, face in zip(FACES, latlong_to_cube(stored, side), strict=True):
        write_exr_rgb(root / ENVIRONMENT_CUBE / f"{name}.exr", face)
    write_exr_rgb(root / ENVIRONMENT_LATLONG_Y_UP, latlong_to_y_up(stored), y_up_environment=True)


def write_inverse_distance(root: Path, inverse_distance: Float[np.ndarray, "H W"]) -> None:
    """Write 1/D of every direction from the origin to the surroundings, a map like the lat-long one of radiance."""
    write_inverse_distance_map(root / ENVIRONMENT_INVERSE_DISTANCE, inverse_distance)


def write_inverse_distance_map(path: Path, inverse_distance: Float[np.ndarray, "H W"]) -> None:
    """Write the one channel of such a map."""
    write_exr(path, {INVERSE_DISTANCE_CHANNEL: inverse_distance.astype(np.float32)})


def latlong_to_y_up(latlong: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """The same environment in the frame of the EXR `envmap` attribute: +Y up, image center along +Z (ImfEnvmap.h).

    The worlds are related by the usual rotation about X: (x, y, z) with +Z up is (x, z, −y) with +Y up.
    """
    # On the tagged pixel grid, what our grid calls forward, left and up is +Z, +X and +Y.
    forward, left, up = np.moveaxis(latlong_directions(latlong.shape[0]), -1, 0)
    return sample_latlong(latlong, np.stack([left, -forward, up], -1)).astype(latlong.dtype)


def is_complete(root: Path) -> bool:
    """Whether the dataset was completed and every file that its list of checksums names is still there."""
    listing = root / CHECKSUMS
    if not listing.is_file():
        return False
    lines = listing.read_text(encoding="utf-8", errors="replace").removesuffix("\n").split("\n")
    return all((root / line.partition("  ")[2]).is_file() for line in lines)


def complete_dataset(root: Path, licenses: list[dict[str, str]], statistics: dict[str, Any]) -> None:
    """Write licenses, mark the manifest complete and list every file's SHA-256."""
    write_json(root / LICENSES, licenses)
    manifest = read_table(root / MANIFEST, "the manifest")
    write_json(root / MANIFEST, {**manifest, "complete": True, "statistics": statistics})
    files = sorted(path for path in root.rglob("*") if path.is_file() and path.name != CHECKSUMS)
    lines = [f"{sha256_of(path)}  {path.relative_to(root).as_posix()}" for path in files]
    write_text(root / CHECKSUMS, "\n".join(lines) + "\n")
