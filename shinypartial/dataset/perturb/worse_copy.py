"""Make a worse copy of a dataset: its training split is perturbed, everything that is scored against stays true.

A run that is killed continues when it is started again, and a folder that holds anything else is refused.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from shinypartial.core.camera import opencv_to_opengl
from shinypartial.core.color import to_display
from shinypartial.dataset.derived import Job, licenses_of, open_source, place_of, write_derived
from shinypartial.dataset.perturb import picture as pictures
from shinypartial.dataset.perturb.options import Perturbation, changed_options
from shinypartial.dataset.perturb.plan import Plan, PlannedView, generator, make_plan
from shinypartial.dataset.perturb.turned import (
    write_turned_environment,
    write_turned_inverse_distance,
    write_turned_normals,
    write_turned_transforms,
)
from shinypartial.dataset.schema import (
    CHECKSUMS,
    ENVIRONMENT_INVERSE_DISTANCE,
    ENVIRONMENT_LATLONG,
    Dataset,
    Frame,
    View,
)
from shinypartial.dataset.subset import all_files_of, files_of
from shinypartial.dataset.write import (
    display_rgba,
    encode_normals,
    encode_unit,
    environment_files,
    exr_channels,
    intrinsics_of,
)
from shinypartial.io.files import read_json, sha256_of, write_json
from shinypartial.io.images import EXR, write_exr, write_jpeg, write_png

TRAIN, TEST = "transforms_train.json", "transforms_test.json"
#: Photographs of these formats become PNG when they are made again, others become EXR.
EIGHT_BIT = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class PerturbedCopy:
    """What a run of `perturb` did."""

    root: Path
    plan: Plan
    written: int
    """Number of files that were not there before."""


def perturb(source: Path, root: Path, options: Perturbation, *, link: bool = False) -> PerturbedCopy:
    """Write a perturbed copy of the dataset `source` to the folder `root`, or finish what an earlier run began there.

    `link` makes hard links in place of copies for files that stay the same. Raises InputError for options out of range,
    when the source can't be read or when the folder holds something else.
    """
    dataset = open_source(source, root)
    plan = make_plan(dataset, options)
    transforms = _transforms(plan, dataset)

    def finish() -> dict[str, Any]:
        write_json(root / TRAIN, transforms)
        return _statistics(plan, dataset)

    jobs, recipe = _jobs(_Copy(dataset, root, plan, link)), _recipe(dataset, options)
    return PerturbedCopy(root, plan, write_derived(root, licenses_of(dataset), recipe, jobs, "Perturbing", finish))


@dataclass(frozen=True)
class _Copy:
    """From where to where, and how."""

    dataset: Dataset
    root: Path
    plan: Plan
    link: bool

    def place(self, path: Path) -> Path:
        """Where a file of the source has its counterpart."""
        return place_of(path, self.dataset, self.root)

    def kept(self, path: Path) -> Job:
        """A file that stays the same."""
        return Job.copy(path, self.place(path), self.link)

    def kept_frame(self, frame: Frame) -> Iterator[Job]:
        """Files of a frame that stay the same, but for normals where the world turns."""
        turn = self.plan.turn
        for path in all_files_of(frame):
            if turn is not None and path in (frame.exr, frame.normal_png):
                yield Job((self.place(path),), partial(write_turned_normals, path, self.place(path), turn))
            else:
                yield self.kept(path)


def _jobs(copy: _Copy) -> Iterator[Job]:
    """All of the copy but the training cameras, which are written last."""
    plan, source = copy.plan, copy.dataset.root
    for view in plan.views:
        yield from _rewritten(copy, view) if plan.options.changes_pictures else copy.kept_frame(view.source)
    for frame in copy.dataset.test:
        yield from copy.kept_frame(frame)
    maps = sorted(path for path in (source / ENVIRONMENT_LATLONG.parent).rglob("*") if path.is_file())
    if plan.turn is None:
        yield from map(copy.kept, [source / TEST] * bool(copy.dataset.test) + maps)
        return
    if copy.dataset.test:
        yield Job((copy.root / TEST,), partial(write_turned_transforms, source / TEST, copy.root / TEST, plan.turn))
    if (source / ENVIRONMENT_LATLONG).exists():
        yield Job(environment_files(copy.root), partial(write_turned_environment, source, copy.root, plan.turn))
    if (source / ENVIRONMENT_INVERSE_DISTANCE).exists():
        far = copy.root / ENVIRONMENT_INVERSE_DISTANCE
        yield Job((far,), partial(write_turned_inverse_distance, source, copy.root, plan.turn))


def _suffix(frame: Frame, options: Perturbation) -> str:
    """Format of a photograph that is made again."""
    if options.sensor.jpeg_quality is not None:
        return ".jpg"
    return ".png" if options.sensor.srgb8 or frame.photograph.suffix.lower() in EIGHT_BIT else EXR


def _rewritten(copy: _Copy, view: PlannedView) -> Iterator[Job]:
    """A training view made again; what lies beside it is copied unless its pixels have moved or turned.

    Then normals and self-reflection are made again, the latter where it is known, which is in an EXR alone.
    """
    options, frame = copy.plan.options, view.source
    sensor, views = options.sensor, options.views
    moved = bool(views.object_scale < 1 or views.cut or sensor.k1 or copy.plan.turn is not None)
    beside = [
        path for path in files_of(frame) if path.name.startswith(f"{frame.stem.name}_") and path != frame.alpha_png
    ]
    known = [frame.normal_png, *([frame.self_png] if frame.exr.exists() else [])]
    truth = [path for path in known if moved and path in beside]
    if not moved:
        yield from map(copy.kept, beside)
    new = Frame(frame.name, view.camera, copy.place(frame.stem))
    suffix = _suffix(frame, options)
    photographs = (new.png, new.exr) if suffix == EXR else (new.stem.with_name(new.stem.name + suffix),)
    files = (*map(copy.place, truth), new.alpha_png, *photographs)
    yield Job(files, partial(_write_frame, copy.plan, view, files))


def _write_frame(plan: Plan, planned: PlannedView, files: tuple[Path, ...]) -> None:
    """Take a view through all that makes it worse and write those files of it."""
    options, frame = plan.options, planned.source
    seed, index = options.seed, planned.index
    picture = pictures.read_uncut(frame)
    true_camera = frame.camera
    if options.views.object_scale < 1:
        picture = pictures.shrunk(picture, options.views.object_scale)
        true_camera = pictures.shrunk_camera(true_camera, options.views.object_scale)
    picture = pictures.through_lens(picture, true_camera, options.sensor)
    picture = pictures.recorded(picture, planned.stops, options.sensor, generator(seed, "noise", index))
    if plan.crop_px:
        picture = pictures.cropped(picture, plan.crop_px)
    picture = pictures.masked_wrongly(picture, options.masks, planned.empty_mask, generator(seed, "masks", index))
    view = picture.view
    if plan.turn is not None and view.normals_world is not None:
        view = replace(view, normals_world=(view.normals_world @ plan.turn.T).astype(np.float32))
    for path in files:
        if path.suffix == EXR:
            write_exr(path, exr_channels(view))
        elif path.suffix == ".jpg":
            write_jpeg(path, to_display(picture.photograph), options.sensor.jpeg_quality or 100)
        else:
            write_png(path, _png(path.stem.removeprefix(frame.stem.name), view))


def _png(ending: str, view: View) -> UInt8[np.ndarray, "H W *C"]:
    """What the PNG of a view with that ending shows."""
    match ending:
        case "_normal" if view.normals_world is not None:
            return encode_normals(view.normals_world)
        case "_self" if view.self_reflection is not None:
            return encode_unit(view.self_reflection)
        case "_alpha":
            return encode_unit(view.alpha)
        case "":
            return display_rgba(view.radiance, view.alpha)
    raise ValueError(f"the view has nothing to show in a picture that ends in {ending}")


def _transforms(plan: Plan, dataset: Dataset) -> dict[str, Any]:
    """Content of `transforms_train.json`: as in the source, but for what is perturbed."""
    content = read_json(dataset.root / TRAIN, "the cameras")
    intrinsics = [intrinsics_of(view.camera) for view in plan.views]
    as_before = intrinsics == [intrinsics_of(view.source.camera) for view in plan.views]
    alike = all(each == intrinsics[0] for each in intrinsics)
    entries = []
    for view, own in zip(plan.views, intrinsics, strict=True):
        frame, entry = view.source, dict(content["frames"][view.index])
        if not np.array_equal(view.camera.camera_to_world, frame.camera.camera_to_world):
            entry["transform_matrix"] = opencv_to_opengl(view.camera.camera_to_world).tolist()
            entry.pop("pose_covariance", None)  # What the source states of a camera says nothing of another one.
        if not as_before:
            entry = {key: value for key, value in entry.items() if key not in own} | ({} if alike else own)
        if plan.options.changes_pictures:
            entry.pop("mask_path", None)
            suffix = ".jpg" if _suffix(frame, plan.options) == ".jpg" else ".png" if frame.suffix else ""
            entry["file_path"] = entry["file_path"].removesuffix(frame.suffix) + suffix
        entries.append(entry)
    sensor = plan.options.sensor
    lens = {"k1": sensor.k1} if sensor.record_distortion else {}
    return {**content, **({} if as_before or not alike else intrinsics[0]), **lens, "frames": entries}


def _recipe(dataset: Dataset, options: Perturbation) -> dict[str, Any]:
    """What determines the copy; the source is named by its content, so that it may move."""
    known = [path for name in (CHECKSUMS, TRAIN, TEST) if (path := dataset.root / name).exists()]
    split = {} if dataset.scene_split == "unknown" else {"split": dataset.scene_split}
    return {
        "perturbation_of": {"name": dataset.name, **{path.name: sha256_of(path) for path in known}},
        **split,
        "options": changed_options(options),
        "seed": options.seed,
    }


def _statistics(plan: Plan, dataset: Dataset) -> dict[str, Any]:
    """Counts, what was drawn for each training view, which ones were left out, and what scores need of the source.

    A world that is turned is no longer parallel to that of its board, whose place is then left out.
    """
    kept = {view.index for view in plan.views}
    radius, corner = dataset.object_radius, dataset.board_corner if plan.turn is None else None
    return {
        "train": len(plan.views),
        "test": len(dataset.test),
        "dropped": [frame.name for index, frame in enumerate(dataset.train) if index not in kept],
        "drawn": {view.source.name: view.drawn for view in plan.views if view.drawn},
        **({} if plan.turn is None else {"world_turn": plan.turn.tolist()}),
        **({"crop_px": plan.crop_px} if plan.crop_px else {}),
        **({} if radius is None else {"object_radius": radius}),
        **({} if corner is None else {"board_corner": list(corner)}),
    }
