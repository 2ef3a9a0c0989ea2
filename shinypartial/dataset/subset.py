"""Partial Shiny Blender: the cameras of a 360° dataset near the crossing of their path, split again.

The images are copied as they are, so that the new folder has the layout of the old one. A run that is killed
continues when it is started again, and a folder that holds anything else is refused.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.core.errors import InputError
from shinypartial.core.trajectory import Trajectory, unit_vectors
from shinypartial.dataset.camera_plot import CAMERA_PLOT, plot_cameras
from shinypartial.dataset.crossing import angles_rad, find_crossings, look_at_point
from shinypartial.dataset.derived import Job, licenses_of, open_source, write_derived
from shinypartial.dataset.schema import SPLITS, Dataset, Frame
from shinypartial.io.files import read_json, sha256_of, write_json

#: Share of the kept cameras that is for training, in percent, as Partial Shiny Blender has it.
TRAIN_PERCENT = 40


@dataclass(frozen=True)
class SubsetOptions:
    """Which cameras are kept and how they are split."""

    around: tuple[float, float] | None = None
    """Azimuth (from +X toward +Y) and elevation of the middle in degrees; where the path crosses itself by default."""
    radius_deg: float = 90.0
    """Cameras whose direction from the object is less than this away from the middle are kept. 90, the largest
    value, keeps the whole open hemisphere about the crossing."""
    seed: int = 0
    """Seed of the new split: 40 % of the kept cameras for training, 60 % for testing."""


@dataclass(frozen=True)
class Selection:
    """What is kept of a dataset: frames of both new splits and of neither, about which direction from which point."""

    train: tuple[Frame, ...]
    test: tuple[Frame, ...]
    dropped: tuple[Frame, ...]
    center: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]

    @property
    def trajectory(self) -> Trajectory:
        """The kept cameras."""
        train, test = (tuple(frame.camera for frame in frames) for frames in (self.train, self.test))
        return Trajectory(train, test, self.axis, self.center)


@dataclass(frozen=True)
class Subset:
    """What a run of `make_subset` did."""

    root: Path
    selection: Selection
    copied: int
    """Number of files that were not there before."""
    without_normals: tuple[str, ...] = ()
    """New splits in which only some views had normals: theirs are left out, since scores need all or none."""


def select(dataset: Dataset, options: SubsetOptions) -> Selection:
    """Choose the cameras near the crossing and split them: pooled, then drawn by chance, in the order of the source.

    Raises InputError when the path doesn't cross itself exactly once (and `around` is not given), or when fewer than
    two cameras are near.
    """
    _check_options(options)
    frames = (*dataset.train, *dataset.test)
    center = look_at_point([frame.camera for frame in frames])
    directions = directions_from(center, frames)
    axis = unit_vectors(np.array(options.around)) if options.around else _only_crossing(dataset, center)
    near = angles_rad(directions, axis) < np.radians(options.radius_deg)
    kept = [frame for frame, is_near in zip(frames, near, strict=True) if is_near]
    if len(kept) < 2:
        raise InputError(
            expected=f"at least two cameras within {options.radius_deg:g}° of {describe(axis)}",
            found=f"{len(kept)} of {len(frames)}",
            remedy="Raise --radius-deg, or name another point with --around.",
        )
    training = set(np.random.default_rng(options.seed).permutation(len(kept))[: train_count(len(kept))].tolist())
    train = tuple(frame for i, frame in enumerate(kept) if i in training)
    test = tuple(frame for i, frame in enumerate(kept) if i not in training)
    dropped = tuple(frame for frame, is_near in zip(frames, near, strict=True) if not is_near)
    return Selection(train, test, dropped, center, axis)


def train_count(kept: int) -> int:
    """40 % of the kept cameras, rounded to the nearest whole number."""
    return (TRAIN_PERCENT * kept + 50) // 100


def directions_from(center: Float[np.ndarray, "3"], frames: Sequence[Frame]) -> Float[np.ndarray, "V 3"]:
    """Unit directions from the center to the cameras."""
    offsets = np.stack([frame.camera.position_world - center for frame in frames])
    lengths = np.linalg.norm(offsets, axis=-1, keepdims=True)
    if lengths.min() < 1e-9:
        raise InputError(
            expected="cameras at some distance from the point that they look at",
            found=f"{frames[int(lengths.argmin())].name} at that point",
            remedy="Correct its transform_matrix.",
        )
    return offsets / lengths


def describe(direction: Float[np.ndarray, "3"]) -> str:
    """A direction in words: azimuth and elevation in degrees."""
    radians = np.array([np.arctan2(direction[1], direction[0]), np.arcsin(np.clip(direction[2], -1, 1))])
    azimuth, elevation = np.degrees(radians).round(1) + 0.0  # The sum makes −0 a plain zero.
    return f"azimuth {azimuth:.1f}° elevation {elevation:.1f}°"


def _check_options(options: SubsetOptions) -> None:
    if not 0 < options.radius_deg <= 90:
        raise InputError(
            expected="--radius-deg above 0 and at most 90, which is a hemisphere",
            found=f"{options.radius_deg}",
            remedy="Correct that value.",
        )
    if options.around and not (np.isfinite(options.around).all() and abs(options.around[1]) <= 90):
        raise InputError(
            expected="--around with an azimuth and an elevation from −90 to 90, in degrees",
            found=f"{options.around[0]} {options.around[1]}",
            remedy="Correct these values.",
        )
    if options.seed < 0:
        raise InputError(expected="--seed from 0 on", found=str(options.seed), remedy="Correct that value.")


def _only_crossing(dataset: Dataset, center: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Where the path of the larger split crosses itself; that of the other one, when only it does so exactly once."""
    report = []
    for split in sorted(SPLITS, key=lambda name: -len(dataset.split(name))):
        frames = dataset.split(split)
        if not frames:
            continue
        crossings = find_crossings(directions_from(center, frames))
        if len(crossings) == 1:
            return crossings[0]
        places = f" ({'; '.join(map(describe, crossings[:4]))}{'; …' if len(crossings) > 4 else ''})"
        report.append(f"{len(crossings)} crossings in {split}{places if crossings else ''}")
    raise InputError(
        expected=f"the camera path of the train or the test split in {dataset.root} to cross itself once",
        found=", ".join(report),
        remedy="Name the middle of the part to keep: --around AZIMUTH ELEVATION.",
    )


def make_subset(source: Path, root: Path, options: SubsetOptions, *, link: bool = False) -> Subset:
    """Write the subset of the dataset `source` to the folder `root`, or finish what an earlier run began there.

    `link` makes hard links in place of copies. Raises InputError when the path doesn't cross itself, when the source
    can't be read or when the folder holds something else.
    """
    dataset = open_source(source, root, shared_names=True)
    selection = select(dataset, options)
    contents = {split: _renamed(dataset, split, getattr(selection, split)) for split in SPLITS}
    without_normals = tuple(split for split in SPLITS if _has_some_normals(getattr(selection, split)))
    files = [pair for split in SPLITS for pair in _copies(root, split, getattr(selection, split))]

    def finish() -> dict[str, Any]:
        for split in SPLITS:
            write_json(root / f"transforms_{split}.json", contents[split])
        plot_cameras(root / CAMERA_PLOT, selection.trajectory)
        return _statistics(selection)

    jobs = [Job.copy(old, new, link) for old, new in files]
    title, recipe = "Linking" if link else "Copying", _recipe(dataset, selection, options)
    num_files = write_derived(root, licenses_of(dataset), recipe, jobs, title, finish)
    return Subset(root, selection, num_files, without_normals)


def _recipe(dataset: Dataset, selection: Selection, options: SubsetOptions) -> dict[str, Any]:
    """What determines the subset; the source is named by its content, so that it may move."""
    transforms = [dataset.root / f"transforms_{split}.json" for split in SPLITS]
    return {
        "subset_of": {"name": dataset.name, **{path.name: sha256_of(path) for path in transforms if path.exists()}},
        "around": "crossing" if options.around is None else list(options.around),
        "radius_deg": options.radius_deg,
        "seed": options.seed,
        "train_percent": TRAIN_PERCENT,
        # Rounded, because linear algebra differs in the last digits between machines.
        "camera": {"target": selection.center.round(9).tolist()},
        "hemisphere_axis": selection.axis.round(9).tolist(),
    }


def _statistics(selection: Selection) -> dict[str, Any]:
    """Counts, which source frame each new one is (in order), and which ones were left out."""
    return {
        "train": len(selection.train),
        "test": len(selection.test),
        "crossing": describe(selection.axis),
        "kept": {split: [frame.name for frame in getattr(selection, split)] for split in SPLITS},
        "dropped": [frame.name for frame in selection.dropped],
    }


def _renamed(dataset: Dataset, split: str, frames: Sequence[Frame]) -> dict[str, Any]:
    """Content of `transforms_SPLIT.json`: everything as in the source, but `file_path`."""
    present = [name for name in SPLITS if dataset.split(name)]
    tables = {name: read_json(dataset.root / f"transforms_{name}.json", "the cameras") for name in present}
    shared = {name: {key: value for key, value in table.items() if key != "frames"} for name, table in tables.items()}
    _require_one_camera(dataset, shared)
    entries = {
        frame.stem: entry
        for name in tables
        for frame, entry in zip(dataset.split(name), tables[name]["frames"], strict=True)
    }
    renamed = []
    for i, frame in enumerate(frames):
        mask = {} if frame.mask is None else {"mask_path": f"./{split}/{_mask_name(frame.mask, i)}"}
        renamed.append(entries[frame.stem] | {"file_path": f"./{split}/r_{i}{frame.suffix}"} | mask)
    return {**shared[present[0]], "frames": renamed}


def _require_one_camera(dataset: Dataset, shared: dict[str, dict[str, Any]]) -> None:
    """Splits are pooled, so their intrinsics must agree; fields that say nothing about them may differ."""
    found = {}
    for name in shared:
        camera = dataset.split(name)[0].camera
        found[name] = np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy])
    first, last = found[next(iter(found))], found[list(found)[-1]]
    if np.allclose(first, last, rtol=1e-6, atol=0):
        return
    values = list(shared.values())
    keys = sorted(key for key in {*values[0], *values[-1]} if values[0].get(key) != values[-1].get(key))
    text = ", ".join(f"{v[0]:g}×{v[1]:g} pixels with fx {v[2]:g} in {name}" for name, v in found.items())
    raise InputError(
        expected=f"both splits of {dataset.root} to share their intrinsics, since they are pooled",
        found=text + (f" (different: {', '.join(keys)})" if keys else ""),
        remedy="Make the images of both splits with one camera, or split them by hand.",
    )


def _has_some_normals(frames: Sequence[Frame]) -> bool:
    """Whether frames of both kinds were pooled, such as test views with normals and training views without."""
    return 0 < sum(frame.normal_png.exists() for frame in frames) < len(frames)


def _copies(root: Path, split: str, frames: Sequence[Frame]) -> list[tuple[Path, Path]]:
    """Source and destination of every image and companion (`r_0.png`, `r_0_normal.png`, `r_0_disp.tiff` …).

    Normals that only some of the frames have are left out.
    """
    pairs = []
    dropped = {frame.normal_png for frame in frames} if _has_some_normals(frames) else set()
    for i, frame in enumerate(frames):
        end = len(frame.stem.name)
        kept = [path for path in files_of(frame) if path not in dropped]
        pairs += [(path, root / split / f"r_{i}{path.name[end:]}") for path in kept]
        if frame.mask is not None:
            pairs.append((frame.mask, root / split / _mask_name(frame.mask, i)))
    return pairs


def files_of(frame: Frame) -> list[Path]:
    """The photograph and all that lies beside it under the same name; InputError when it isn't there."""
    name = frame.stem.name
    here = sorted(frame.stem.parent.iterdir()) if frame.stem.parent.is_dir() else []
    files = [path for path in here if path.name.startswith((f"{name}.", f"{name}_")) and path.is_file()]
    if frame.photograph not in files:
        raise InputError(
            expected=f"the image of {frame.name} at {frame.photograph}",
            found="no such file",
            remedy="Restore it, or remove the frame from the transforms.",
        )
    return files


def all_files_of(frame: Frame) -> list[Path]:
    """Those, and its mask where that is a file of another name."""
    return [*files_of(frame), *([] if frame.mask is None else [frame.mask])]


def _mask_name(mask: Path, index: int) -> str:
    return f"r_{index}_mask_path{mask.suffix}"
