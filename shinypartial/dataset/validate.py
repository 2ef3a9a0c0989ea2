"""Check every rule of the dataset format and name each violation."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import Camera, check_pose, opengl_to_opencv
from shinypartial.core.conventions import FACES
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_to_cube
from shinypartial.dataset.plain import (
    check_normals_of_split,
    check_perturbed_frame,
    check_plain_frame,
    is_imported,
    is_perturbed,
    is_plain,
    made_by,
    read_plain_frames,
    what_is_absent,
)
from shinypartial.dataset.read import open_dataset, read_inverse_distance_map, require_dataset_folder
from shinypartial.dataset.schema import (
    CHECKSUMS,
    ENVIRONMENT_CUBE,
    ENVIRONMENT_INVERSE_DISTANCE,
    ENVIRONMENT_LATLONG,
    ENVIRONMENT_LATLONG_Y_UP,
    FORMAT,
    FORMAT_VERSION,
    LICENSES,
    MANIFEST,
    SPLITS,
    Dataset,
    Frame,
)
from shinypartial.dataset.validate_frame import check_frame
from shinypartial.dataset.violations import REMAKE, Violation, violation_of
from shinypartial.dataset.write import latlong_to_y_up
from shinypartial.io.files import read_json, sha256_of
from shinypartial.io.images import has_envmap_tag, read_exr_rgb, require_latlong
from shinypartial.io.progress import Progress

RESTORE = "Restore the file from the released dataset, or generate the dataset again."
CONTINUE = "Run the `shinypartial generate` that began the folder again: it continues where it stopped."
ANGLE_TOLERANCE_RAD = 1e-6
#: The lat-long and the cube are each rounded to half precision (relative 5e-4).
RADIANCE_TOLERANCE = 2e-3


def validate(root: Path, progress: bool = False) -> list[Violation]:
    """Every violation of the format, warnings last; empty when there is none.

    Fewer rules hold for a plain folder (`plain.is_plain`): `unscored` says what it lacks. Raises InputError when
    there is no such folder.
    """
    require_dataset_folder(root)
    original = is_plain(root, {})
    manifest, violations = ({}, []) if original else _check_manifest(root)
    plain = original or is_plain(root, manifest)
    frames = []
    for split in SPLITS:
        found, problems = (_check_plain_split if plain else _check_transforms)(root, split, manifest)
        frames += found
        violations += problems
    counter = Progress("Validating", len(frames)) if progress and frames else None
    minor = manifest.get("format_minor", 0)
    complete = isinstance(minor, int) and minor >= 1
    for frame in frames:
        if is_perturbed(manifest) and frame.name.startswith("train/"):
            violations += check_perturbed_frame(root, frame)
        elif plain and (is_imported(manifest) or not frame.exr.exists()):
            violations += check_plain_frame(root, frame)
        else:
            violations += check_frame(root, frame, self_reflection=complete)
        if counter:
            counter.advance()
    if not plain or (root / ENVIRONMENT_LATLONG).exists():
        violations += [*_check_environment(root), *_check_inverse_distance(root, manifest)]
    if not original:
        violations += [*_check_licenses(root), *_check_checksums(root)]
    if maker := made_by(manifest):
        again = f"`shinypartial {maker}`"
        violations = [
            replace(each, remedy=each.remedy.replace("`shinypartial generate`", again)) for each in violations
        ]
    return sorted(violations, key=lambda each: each.warning)


def unscored(root: Path) -> str | None:
    """One line on what a sound folder in the plain layout lacks and can't be scored on; None for a rendered dataset."""
    dataset = open_dataset(root)
    return what_is_absent(root, dataset.train, dataset.test) if is_plain(root, dataset.manifest) else None


def _check_plain_split(root: Path, split: str, manifest: dict[str, Any]) -> tuple[list[Frame], list[Violation]]:
    frames, listed, violations = read_plain_frames(root, split)
    problems = [*_set_problems(frames, listed, split, manifest)]
    if manifest and not (
        is_perturbed(manifest) or is_imported(manifest)
    ):  # Originals are photographed from all around.
        problems += _hemisphere_problems(frames, manifest)
    file = f"transforms_{split}.json"
    return frames, [
        *violations,
        *(Violation(file, each, RESTORE) for each in problems),
        *check_normals_of_split(split, frames),
    ]


def _check_manifest(root: Path) -> tuple[dict[str, Any], list[Violation]]:
    try:
        manifest = read_json(root / MANIFEST, "the manifest")
    except InputError as error:
        return {}, [violation_of(MANIFEST, error, RESTORE)]
    if not isinstance(manifest, dict):
        return {}, [Violation(MANIFEST, "expected a table at the top", RESTORE)]
    violations = []
    if (manifest.get("format"), manifest.get("format_version")) != (FORMAT, FORMAT_VERSION):
        found = f"{manifest.get('format')} version {manifest.get('format_version')}"
        violations.append(Violation(MANIFEST, f"expected {FORMAT} version {FORMAT_VERSION}, found {found}", RESTORE))
    if manifest.get("complete") is not True:
        violations.append(Violation(MANIFEST, "the dataset is not complete", CONTINUE))
    for key in ("recipe", "generator"):
        if not isinstance(manifest.get(key), dict) or not manifest[key]:
            violations.append(Violation(MANIFEST, f"`{key}` is missing: how the dataset was made", RESTORE))
            manifest[key] = {}
    if not isinstance(manifest.get("statistics", {}), dict):
        violations.append(Violation(MANIFEST, "`statistics` is not a table", RESTORE))
        manifest["statistics"] = {}
    return manifest, violations


def _check_transforms(root: Path, split: str, manifest: dict[str, Any]) -> tuple[list[Frame], list[Violation]]:
    """The frames whose camera can be read, and what is wrong with the file."""
    file = f"transforms_{split}.json"
    try:
        content = read_json(root / file, f"the cameras of the {split} split")
    except InputError as error:
        return [], [violation_of(file, error, RESTORE)]
    entries = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        return [], [Violation(file, "`frames` is not a list with at least one frame", RESTORE)]
    problems = list(_intrinsics_problems(content))
    if problems:  # Without intrinsics the images can't be judged.
        return [], [Violation(file, problem, RESTORE) for problem in problems]
    frames = []
    for i, entry in enumerate(entries):
        problem = _entry_problem(entry, split)
        if problem:
            problems.append(f"frame {i}: {problem}")
        else:
            frames.append(_make_frame(root, entry, content))
    problems += [*_set_problems(frames, len(entries), split, manifest), *_hemisphere_problems(frames, manifest)]
    return frames, [Violation(file, problem, RESTORE) for problem in problems]


def _set_problems(frames: list[Frame], listed: int, split: str, manifest: dict[str, Any]) -> Iterator[str]:
    """What is wrong with the frames of a split together."""
    names = [frame.name for frame in frames]
    yield from (f"{name} is listed twice" for name in sorted({name for name in names if names.count(name) > 1}))
    count = manifest.get("statistics", {}).get(split, listed)
    if count != listed:
        yield f"expected {count} frames as {MANIFEST} says, found {listed}"


def _intrinsics_problems(content: dict[str, Any]) -> Iterator[str]:
    for key in ("camera_angle_x", "fl_x", "fl_y", "cx", "cy", "w", "h"):
        value = content.get(key)
        number = isinstance(value, int if key in "wh" else int | float) and not isinstance(value, bool)
        if value is None or not number or not 0 < value < math.inf:
            yield f"expected `{key}` to be a positive {'whole ' if key in 'wh' else ''}number, found {value!r}"
            return
    angle = 2 * math.atan(content["w"] / (2 * content["fl_x"]))
    if abs(angle - content["camera_angle_x"]) > ANGLE_TOLERANCE_RAD:
        yield f"camera_angle_x is {content['camera_angle_x']}, but w and fl_x make it {angle}"
    if content["cx"] >= content["w"] or content["cy"] >= content["h"]:
        yield "the principal point (cx, cy) lies outside the picture"


def _entry_problem(entry: Any, split: str) -> str | None:
    name = entry.get("file_path") if isinstance(entry, dict) else None
    if not isinstance(name, str):
        return f"expected `file_path` to be a text, found {name!r}"
    path = PurePosixPath(name)
    if path.suffix or path.parent != PurePosixPath(split):
        return f"expected `file_path` to be ./{split}/NAME without extension, found {name}"
    try:
        check_pose(np.array(entry.get("transform_matrix"), dtype=np.float64), name)
    except (TypeError, ValueError):
        return "`transform_matrix` is not a 4×4 matrix of numbers"
    except InputError as error:
        return f"expected {error.expected}, found {error.found}"
    return None


def _make_frame(root: Path, entry: dict[str, Any], content: dict[str, Any]) -> Frame:
    pose = opengl_to_opencv(np.array(entry["transform_matrix"], dtype=np.float64))
    camera = Camera(pose, *(content[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")))
    path = PurePosixPath(entry["file_path"])
    return Frame(path.as_posix(), camera, root / path)


def _hemisphere_problems(frames: list[Frame], manifest: dict[str, Any]) -> Iterator[str]:
    """Cameras must lie on one side of the target: that of the recipe's axis, or of their mean direction.

    A recipe whose axis is null has cameras all around.
    """
    if not frames:
        return
    recipe = manifest.get("recipe", {})
    camera = recipe.get("camera")
    target = camera.get("target", (0, 0, 0)) if isinstance(camera, dict) else (0, 0, 0)
    offsets = np.stack([frame.camera.position_world for frame in frames]) - _vector(target)
    stated = recipe.get("hemisphere_axis", offsets.mean(0))
    if stated is None:
        return
    axis = _vector(stated)
    for frame, height in zip(frames, offsets @ axis, strict=True):
        if not height > 0:
            yield f"the camera of {frame.name} lies outside the hemisphere that the recipe names"


def _vector(values: Any) -> Float[np.ndarray, "3"]:
    """Three numbers, or NaN, which no check passes, for anything else."""
    try:
        vector = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        return np.full(3, np.nan)
    return vector if vector.shape == (3,) else np.full(3, np.nan)


def _check_environment(root: Path) -> Iterator[Violation]:
    file = ENVIRONMENT_LATLONG.as_posix()
    try:
        latlong = read_exr_rgb(root / ENVIRONMENT_LATLONG)
        require_latlong(latlong, root / ENVIRONMENT_LATLONG, "radiance ≥ 0", REMAKE, lowest=0.0)
    except InputError as error:
        yield violation_of(file, error)
        return
    faces = [ENVIRONMENT_CUBE / f"{name}.exr" for name in FACES]
    maps: dict[Path, np.ndarray] = {}
    for path in (*faces, ENVIRONMENT_LATLONG_Y_UP):
        try:
            maps[path] = read_exr_rgb(root / path)
        except InputError as error:
            yield violation_of(path.as_posix(), error)
    for path in (ENVIRONMENT_LATLONG, *maps):
        expected = path == ENVIRONMENT_LATLONG_Y_UP
        if has_envmap_tag(root / path) != expected:
            problem = f"the EXR attribute `envmap`, which means +Y up, is {'missing' if expected else 'set'}"
            yield Violation(path.as_posix(), problem, REMAKE)
    yield from _check_resampled(latlong, maps, faces)


def _check_inverse_distance(root: Path, manifest: dict[str, Any]) -> Iterator[Violation]:
    """There from minor version 2 on where the recipe's world is near; of the size of the lat-long map of radiance."""
    file, path = ENVIRONMENT_INVERSE_DISTANCE.as_posix(), root / ENVIRONMENT_INVERSE_DISTANCE
    minor, world = manifest.get("format_minor", 0), manifest.get("recipe", {}).get("world")
    near = isinstance(world, dict) and any(world.get(key) is not None for key in ("distance", "distance_radii"))
    if not path.exists():
        if near and isinstance(minor, int) and minor >= 2:
            yield Violation(file, "the file is missing, though the surroundings are near", REMAKE)
        return
    if Dataset(root, manifest, (), ()).object_radius is None:
        yield Violation(MANIFEST, "`statistics.object_radius` is not a positive number", RESTORE)
    try:
        inverse, latlong = read_inverse_distance_map(path), read_exr_rgb(root / ENVIRONMENT_LATLONG)
    except InputError as error:
        yield violation_of(file, error)
        return
    if inverse.shape != latlong.shape[:2]:
        (height, width), (high, wide) = inverse.shape, latlong.shape[:2]
        yield Violation(file, f"expected {wide}×{high} texels, found {width}×{height}", REMAKE)


def _check_resampled(
    latlong: Float[np.ndarray, "H W 3"], maps: dict[Path, np.ndarray], faces: list[Path]
) -> Iterator[Violation]:
    """Cube and Y-up map must be what the lat-long map gives when it is resampled."""
    present = [path for path in faces if path in maps]
    resolution = maps[present[0]].shape[0] if present else 0
    cube = latlong_to_cube(latlong, resolution) if resolution else ()
    expected = dict(zip(faces, cube, strict=False)) | {ENVIRONMENT_LATLONG_Y_UP: latlong_to_y_up(latlong)}
    for path, found in maps.items():
        truth = expected[path]
        if found.shape != truth.shape:
            problem = f"expected {truth.shape[1]}×{truth.shape[0]} texels, found {found.shape[1]}×{found.shape[0]}"
            yield Violation(path.as_posix(), problem, REMAKE)
        elif not np.allclose(found, truth, rtol=RADIANCE_TOLERANCE, atol=1e-6):
            wrong = int((~np.isclose(found, truth, rtol=RADIANCE_TOLERANCE, atol=1e-6)).any(-1).sum())
            yield Violation(path.as_posix(), f"{wrong} texels differ from {ENVIRONMENT_LATLONG.as_posix()}", REMAKE)


def _check_licenses(root: Path) -> Iterator[Violation]:
    try:
        rows = read_json(root / LICENSES, "the licenses")
    except InputError as error:
        yield violation_of(LICENSES, error, RESTORE)
        return
    if not isinstance(rows, list) or not rows:
        yield Violation(LICENSES, "expected a list with a row for each asset", RESTORE)
        return
    for i, row in enumerate(rows):
        texts = [row.get(key) if isinstance(row, dict) else None for key in ("license", "source")]
        if not all(isinstance(text, str) and text.strip() for text in texts):
            yield Violation(LICENSES, f"row {i} does not name a license and a source", "Add what is missing.")


def _check_checksums(root: Path) -> Iterator[Violation]:
    listing = root / CHECKSUMS
    if not listing.is_file():
        yield Violation(CHECKSUMS, "the list of checksums is missing", CONTINUE)
        return
    listed: dict[str, str] = {}
    # Split at line feeds only: a damaged byte may become one of the other separators that `splitlines` knows.
    lines = listing.read_bytes().decode("utf-8", errors="replace").removesuffix("\n").split("\n")
    for number, line in enumerate(lines, 1):
        digest, separator, name = line.partition("  ")
        if len(digest) != 64 or not separator or not name:
            yield Violation(CHECKSUMS, f"line {number} is not `SHA-256  FILE`", RESTORE)
        else:
            listed[name] = digest
    present = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()} - {CHECKSUMS}
    for name in sorted(present - listed.keys()):
        yield Violation(
            name, f"the file is not listed in {CHECKSUMS}", "Delete it if it doesn't belong to the dataset."
        )
    for name in sorted(listed.keys() - present):
        yield Violation(name, f"the file is listed in {CHECKSUMS} but missing", REMAKE)
    for name in sorted(listed.keys() & present):
        if sha256_of(root / name) != listed[name]:
            yield Violation(name, f"the content has changed since {CHECKSUMS} was written", REMAKE)
