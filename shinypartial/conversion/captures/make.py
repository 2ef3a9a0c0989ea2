"""The dataset folder of a capture: photographs and masks as they are, cameras, light and normals in our conventions."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from shinypartial.conversion.captures.base import MapAxes, Shot
from shinypartial.conversion.captures.registry import READERS
from shinypartial.conversion.layouts import AxisName, CaptureLayout
from shinypartial.core.color import to_display
from shinypartial.core.errors import InputError
from shinypartial.dataset.derived import Job, write_derived
from shinypartial.dataset.schema import SPLITS, Frame
from shinypartial.dataset.write import (
    begun_recipe,
    encode_normals,
    environment_files,
    write_environment,
    write_transforms,
)
from shinypartial.io.files import sha256_of_files
from shinypartial.io.images import EXR, read_png, write_png


@dataclass(frozen=True)
class ImportedCapture:
    """What was written."""

    train: int
    test: int
    left_out: tuple[str, ...]


def named_axes(names: tuple[AxisName, AxisName, AxisName]) -> MapAxes:
    """Unit vectors by their names; InputError unless they are perpendicular."""
    vectors = [float(f"{name[0]}1") * np.eye(3)["XYZ".index(name[1])] for name in names]
    if abs(np.linalg.det(vectors)) < 1:
        raise InputError(
            expected="three axes of different letters, such as +X -Y +Z", found=" ".join(names), remedy="Correct them."
        )
    forward, right, up = ((float(x), float(y), float(z)) for x, y, z in vectors)
    return forward, right, up


def import_capture(
    layout: CaptureLayout, folder: Path, output: Path, axes: MapAxes | None = None, *, link: bool = False
) -> ImportedCapture:
    """Write the dataset folder `output`, or finish what an earlier run began there.

    `axes` are the directions that the stored map has in its middle, right of it and on top, where the layout's are
    wrong. `link` makes hard links in place of copies. Raises InputError for folders that are not of the layout.
    """
    if not folder.is_dir():
        raise InputError(expected=f"a folder at {folder}", found="none", remedy="Name the folder of one capture.")
    if folder.resolve() in (output.resolve(), *output.resolve().parents):
        raise InputError(
            expected=f"an output folder apart from the source {folder}", found=str(output), remedy="Change --output."
        )
    found = READERS[layout](folder, axes)
    views = {"train": found.train, "test": found.test}
    frames = {split: [_frame(output, split, shot) for shot in views[split]] for split in SPLITS}

    def finish() -> dict[str, Any]:
        for split in SPLITS:
            if frames[split]:
                write_transforms(output, split, frames[split])
        return {split: len(frames[split]) for split in SPLITS}

    jobs = [
        job
        for split in SPLITS
        for shot, frame in zip(views[split], frames[split], strict=True)
        for job in _jobs(shot, frame, link)
    ]
    if found.environment is not None:
        light = found.environment
        jobs.append(Job(environment_files(output), lambda: write_environment(output, light())))
    source = {
        "layout": layout,
        "name": folder.resolve().name,
        "cameras": sha256_of_files(found.cameras),
        "pictures": sorted({shot.picture.suffix for split in SPLITS for shot in views[split]}),
    }
    recipe = _as_begun(output, {"import_of": source, "map_axes": axes and list(map(list, axes))})
    licenses = [{"asset": "images and ground truth", "license": "that of the source", "source": layout}]
    write_derived(output, licenses, recipe, jobs, "Importing", finish)
    return ImportedCapture(len(found.train), len(found.test), found.left_out)


def _as_begun(output: Path, recipe: dict[str, Any]) -> dict[str, Any]:
    """The recipe without what distinguishes sources of one name, where the version that began the folder stated
    none."""
    earlier = recipe | {"import_of": {key: recipe["import_of"][key] for key in ("layout", "name")}}
    return earlier if begun_recipe(output) == earlier else recipe


def _frame(output: Path, split: str, shot: Shot) -> Frame:
    stem = output / split / shot.name
    mask = stem.with_name(f"{shot.name}_mask{shot.mask.suffix}")
    return Frame(f"{split}/{shot.name}", shot.camera, stem, mask=mask)


def _jobs(shot: Shot, frame: Frame, link: bool) -> Iterator[Job]:
    assert frame.mask is not None
    yield Job.copy(shot.mask, frame.mask, link)
    picture = frame.exr if shot.picture.suffix == EXR else frame.stem.with_name(shot.name + shot.picture.suffix)
    if shot.gamma is None:
        yield Job.copy(shot.picture, picture, link)
    else:
        yield Job((picture,), partial(_recode, shot.picture, picture, shot.gamma))
    if shot.normals is not None:
        normals = shot.normals
        yield Job((frame.normal_png,), lambda: write_png(frame.normal_png, encode_normals(normals())))


def _recode(source: Path, target: Path, gamma: float) -> None:
    """8-bit codes 255 x^(1/gamma) to sRGB's."""
    linear = (np.arange(256) / 255) ** gamma
    write_png(target, to_display(linear)[read_png(source)[..., :3]])
