"""Rules of a plain folder: the layout of Shiny Blender and NeRF-synthetic, which holds pictures and cameras.

Original folders have no manifest; a subset of one has a manifest that says so. What isn't there violates no rule,
but can't be scored either.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.core.camera import ray_directions_world
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import read_view
from shinypartial.dataset.schema import CHECKSUMS, ENVIRONMENT_LATLONG, LICENSES, MANIFEST, Frame, View
from shinypartial.dataset.transforms import read_frames
from shinypartial.dataset.violations import Violation, mask_violations, violation_of
from shinypartial.io.images import read_picture, read_png

RESTORE = "Restore the file from the original dataset."
DISPARITY_SUFFIX = "_disp.tiff"
LEVEL_TOLERANCE = 1
#: Rounding to 8 bits changes a length by up to √3/255; at creases a pixel holds the mean of several normals.
UNIT_TOLERANCE = 0.05
#: Interpolated normals may turn a little away from the ray.
FACING_TOLERANCE = 0.1
#: Creases and silhouettes are a small share; normals in another frame or encoding are wrong nearly everywhere.
TOLERATED_SHARE = 0.1
#: What the recipe of a folder names that was made of another one, and the command that made it. A lit copy also keeps
#: what the recipe of its source names, so the first that is there counts.
DERIVED = {
    "lit_copy_of": "find-light",
    "perturbation_of": "perturb",
    "import_of": "import-dataset",
    "subset_of": "subset",
}


def is_plain(root: Path, manifest: dict[str, Any]) -> bool:
    """Whether a folder promises no more than the plain layout does.

    By its manifest one that was made of another folder; else a folder without any file of a rendered set.
    """
    if (root / MANIFEST).exists():
        return made_by(manifest) is not None
    rendered = (CHECKSUMS, LICENSES, ENVIRONMENT_LATLONG.parent)
    return (root / "transforms_train.json").exists() and not any((root / name).exists() for name in rendered)


def made_by(manifest: dict[str, Any]) -> str | None:
    """The command that made a folder of another one, and so makes it again; None for any other folder."""
    return next((command for word, command in DERIVED.items() if _has_recipe(manifest, word)), None)


def is_perturbed(manifest: dict[str, Any]) -> bool:
    """Whether a folder is a worse copy of another: its training views contradict each other on purpose."""
    return _has_recipe(manifest, "perturbation_of")


def is_imported(manifest: dict[str, Any]) -> bool:
    """Whether a folder holds photographs of a public set, which have masks in files of their own."""
    return _has_recipe(manifest, "import_of")


def _has_recipe(manifest: dict[str, Any], word: str) -> bool:
    recipe = manifest.get("recipe")
    return isinstance(recipe, dict) and word in recipe


def read_plain_frames(root: Path, split: str) -> tuple[list[Frame], int, list[Violation]]:
    """The frames whose camera can be read, how many are listed, and what is wrong with `transforms_SPLIT.json`."""
    try:
        frames, count, errors = read_frames(root, split)
    except InputError as error:
        frames, count, errors = [], 0, [error]
    return frames, count, [violation_of(f"transforms_{split}.json", error, error.remedy) for error in errors]


def check_plain_frame(root: Path, frame: Frame) -> Iterator[Violation]:
    """Every violation in a frame without an EXR."""
    photograph = frame.photograph
    name = _name(root, photograph)
    if not photograph.is_file():
        yield Violation(name, "the file is missing", RESTORE)
        return
    try:
        view = read_view(frame)
    except InputError as error:
        yield violation_of(name, error, error.remedy)
        return
    yield from mask_violations(name, view.alpha > 0, "Leave the frame out.", "Accept it, or leave it out.")
    solid = view.alpha > SOLID_ALPHA
    if frame.alpha_png.exists():
        yield from _check_alpha(root, frame, view)
    if frame.normal_png.exists() and solid.any():
        yield from _check_normals(root, frame, solid)
    disparity = frame.stem.with_name(frame.stem.name + DISPARITY_SUFFIX)
    if disparity.exists():
        yield from _check_disparity(_name(root, disparity), disparity, solid)


def check_perturbed_frame(root: Path, frame: Frame) -> Iterator[Violation]:
    """A training view of a perturbed copy needs only to be readable: what it shows is wrong on purpose."""
    try:
        read_view(frame)
    except InputError as error:
        yield violation_of(_name(root, frame.photograph), error, error.remedy)


def _name(root: Path, path: Path) -> str:
    return (path.relative_to(root) if path.is_relative_to(root) else path).as_posix()


def _check_alpha(root: Path, frame: Frame, view: View) -> Iterator[Violation]:
    name = _name(root, frame.alpha_png)
    try:
        levels = read_png(frame.alpha_png)[..., 0].astype(np.float64)
    except InputError as error:
        yield violation_of(name, error, RESTORE)
        return
    if levels.shape != view.alpha.shape:
        yield Violation(
            name, f"{levels.shape[1]}×{levels.shape[0]} pixels, other than {frame.photograph.name}", RESTORE
        )
        return
    difference = np.abs(levels - 255.0 * view.alpha)
    wrong = int((difference > LEVEL_TOLERANCE + 1e-3).sum())
    if wrong:
        problem = (
            f"{wrong} pixels differ from the alpha of {frame.photograph.name} by up to {difference.max():.0f} of 255"
        )
        yield Violation(name, problem, RESTORE)


def _check_normals(root: Path, frame: Frame, solid: Bool[np.ndarray, "H W"]) -> Iterator[Violation]:
    """Unit world normals that face the camera, but at creases and silhouettes; `read_view` has judged the file."""
    name = _name(root, frame.normal_png)
    decoded: Float[np.ndarray, "P 3"] = read_png(frame.normal_png)[solid][:, :3] * (2 / 255) - 1
    facing = (decoded * ray_directions_world(frame.camera)[solid]).sum(-1)
    found = {
        "normals that are not unit vectors after 2 · rgb / 255 − 1": np.abs(np.linalg.norm(decoded, axis=-1) - 1)
        > UNIT_TOLERANCE,
        "normals that face away from the camera: are they in the world's axes?": facing > FACING_TOLERANCE,
    }
    for what, wrong in found.items():
        if wrong.mean() > TOLERATED_SHARE:
            remedy = "Restore the file, or remove all of that split: normals are then not scored."
            yield Violation(name, f"{wrong.mean():.0%} of the object's pixels have {what}", remedy)


def _check_disparity(name: str, path: Path, solid: Bool[np.ndarray, "H W"]) -> Iterator[Violation]:
    """Finite on the object, with one channel or several. Nothing here reads it otherwise."""
    try:
        values = read_picture(path)
    except InputError as error:
        yield violation_of(name, error, RESTORE)
        return
    if values.shape[:2] != solid.shape:
        yield Violation(name, f"an array of shape {values.shape}, other than the picture's size", RESTORE)
        return
    infinite = int((~np.isfinite(values[solid])).sum())
    if infinite:
        yield Violation(name, f"{infinite} values on the object are NaN or infinite", RESTORE)


def check_normals_of_split(split: str, frames: Sequence[Frame]) -> Iterator[Violation]:
    """Scores need the normals of every view of a split or of none."""
    lacking = [frame for frame in frames if not _has_normals(frame)]
    if 0 < len(lacking) < len(frames):
        remedy = f"Restore them, or remove every `*_normal.png` of {split}: normals are then not scored."
        problem = f"{len(lacking)} of {len(frames)} views have no normals, {lacking[0].name} for one"
        yield Violation(split, problem, remedy)


def _has_normals(frame: Frame) -> bool:
    return frame.normal_png.exists() or (frame.exr.exists() and frame.mask is None)


def what_is_absent(root: Path, train: Sequence[Frame], test: Sequence[Frame]) -> str | None:
    """One line: what a plain folder lacks, and which scores it can't give for that reason; None when nothing."""
    absent, unscored = [], []
    if not (root / ENVIRONMENT_LATLONG).exists():
        absent.append("ground-truth environment")
        unscored += ["environment", "visibility"]
    if not all(map(_has_normals, train)):
        absent.append("normals of the training views")
        unscored.append("coverage")
    if not test:
        absent.append("test views")
        unscored += ["normals", "renders"]
    elif not all(map(_has_normals, test)):
        absent.append("normals of the test views")
        unscored.append("normals")
    return f"Plain layout without {_listed(absent)}: can't score {_listed(unscored)}." if absent else None


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
