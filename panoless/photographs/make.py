"""Photographs to a dataset folder, stage by stage: frames, poses, masks, cameras."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from panoless.photographs.board import poses_from_board, recognized_board
from panoless.photographs.frames import Frames, block_means, make_frames, source_files
from panoless.photographs.ground import GIVE_MASKS, ground_masks
from panoless.photographs.hull import nearest_point
from panoless.photographs.masks import (
    CHECK_MASKS,
    MORE_HINTS,
    Hint,
    Masks,
    find_masks,
    given_mask,
    masks_beside,
    overlaps_of,
)
from panoless.photographs.models import find_model, find_transforms, read_colmap, read_transforms
from panoless.photographs.options import CaptureOptions
from panoless.photographs.posed import PosedView, Poses, without_the_rest
from panoless.photographs.segmenter import Segmented, segment
from panoless.photographs.stage import stage
from panoless.photographs.structure import REMEDY, poses_from_structure
from shinypartial.core.board import BOARDS, Paper
from shinypartial.core.errors import InputError
from shinypartial.core.trajectory import Trajectory
from shinypartial.dataset.camera_plot import plot_cameras
from shinypartial.dataset.schema import Frame, Statement
from shinypartial.dataset.write import write_transforms
from shinypartial.io.files import folder_lock, sha256_of
from shinypartial.io.images import read_as_stored, read_png, read_upright, to_bytes, unit_values, write_png
from shinypartial.io.picture_sheet import write_picture_sheet
from shinypartial.io.progress import Progress
from shinypartial.io.records import write_record
from shinypartial.io.threads import in_threads

#: What the stages found, beside the dataset proper.
WORK = "capture"
SHEET_PICTURES = 12


@dataclass(frozen=True)
class Request:
    """What is to be made of which photographs."""

    source: Path
    """A folder of photographs, or a video."""
    output: Path
    colmap: Path | None = None
    board: Paper | Literal["none"] | None = None
    """By its paper; None: looked for, where no other program says where the cameras were."""
    square_mm: float | None = None
    """As measured on the print; None for what was meant to be printed."""
    masks: Path | None = None
    segmenter: Path | None = None
    """An ONNX model; see `panoless.photographs.segmenter`."""
    hints: Mapping[str, Hint] = field(default_factory=dict)
    """Rectangles and clicks by name of the photograph."""
    upright: bool = True
    options: CaptureOptions = CaptureOptions()


@dataclass(frozen=True)
class Captured:
    """What was made."""

    frames: Frames
    poses: Poses
    masks: Masks

    def summary(self) -> list[str]:
        """What was measured, in a line a stage."""
        blurs = [one.blur for one in self.frames.photographs]
        views, lens = self.poses.views, self.poses.views[0].lens
        errors = [view.error_px for view in views if view.error_px is not None]
        left_out = f", none for {', '.join(self.poses.left_out)}" if self.poses.left_out else ""
        within = f", {np.median(errors):.2f} px off in the median view" if errors else ""
        stated = [each for view in views if (each := view.pose_covariance) is not None]
        turns = [np.degrees(np.sqrt(np.trace(each[:3, :3]))) for each in stated]
        within += f", sure to {np.median(turns):.2g}° there" if turns else ""
        sure = f" ± {self.poses.focal_error:.2%}" if self.poses.focal_error is not None else ""
        return [
            f"Frames: {len(blurs)}, blur {np.median(blurs):.2f} in the median frame",
            f"Poses: {len(views)} by {self.poses.origin}{within}{left_out}",
            f"Lens: focal length {lens.fx:.1f} px{sure}, k1 {lens.k1:.4f}",
            f"Masks: {self.masks.origin}, {np.median(self.masks.overlaps):.1%} overlap with their hull in the median",
        ]


def capture(request: Request) -> Captured:
    """Make the dataset folder; stages that were done with the same input are not done again.

    Raises InputError for options that exclude each other, for whatever photographs, poses or masks lack, and for an
    output folder that holds other things.
    """
    check_options(request)
    files = source_files(request.source)
    check_output(request.output)
    with folder_lock(request.output):
        work = request.output / WORK
        pictures = work / "frames"
        frames = _frames(request, files, pictures, work)
        poses, masks_of_frames = _poses(request, frames, pictures, work)
        masks = _masks(request, frames, poses, masks_of_frames, work)
        train = request.output / "train"
        listed = [
            Frame(f"train/{view.name}", view.camera, train / view.name, pose_covariance=view.pose_covariance)
            for view in poses.views
        ]
        write_transforms(
            request.output, "train", listed, statement=Statement(poses.focal_error, masks.sigma_px, poses.ground)
        )
    return Captured(frames, poses, masks)


def check_options(request: Request) -> None:
    """Raise InputError where two options each say how poses or masks are found, and for a square without a side."""
    if request.square_mm is not None and not 0 < request.square_mm < float("inf"):
        raise InputError(
            expected="--square-mm above 0",
            found=f"{request.square_mm:g}",
            remedy="Measure five squares of the print and give a fifth of that, in millimeters.",
        )
    board = None if request.board == "none" else request.board
    hints = request.hints and "--box or --clicks"
    for what, options in (
        ("poses", (request.colmap and "--colmap", board and "--board")),
        ("masks", (request.masks and "--masks", request.segmenter and "--segmenter", hints)),
    ):
        named = [option for option in options if option]
        if len(named) > 1:
            raise InputError(
                expected=f"one option that says where {what} come from",
                found=" beside ".join(named),
                remedy="Leave out all but one of them.",
            )


def check_output(output: Path) -> None:
    """Raise InputError unless the folder is new or empty, or of an earlier capture."""
    if output.exists() and (not output.is_dir() or any(output.iterdir())) and not (output / WORK).is_dir():
        raise InputError(
            expected=f"a new or empty output folder at {output}, or one of an earlier capture",
            found="other files",
            remedy="Choose another --output.",
        )


def _frames(request: Request, files: list[Path], pictures: Path, work: Path) -> Frames:
    stamps = [[str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns] for file in files]
    given = {"files": stamps, "upright": request.upright, "options": write_record(request.options)}

    def work_on() -> Frames:
        shutil.rmtree(pictures, ignore_errors=True)
        found = make_frames(files, pictures, request.upright, request.options)
        chosen = found.photographs[:: -(-len(found.photographs) // SHEET_PICTURES)]
        sheet = {f"{one.name}  blur {one.blur:.2f}": read_png(pictures / f"{one.name}.png")[..., :3] for one in chosen}
        write_picture_sheet(work / "frames.jpg", sheet)
        return found

    return stage(work, "frames", given, Frames, work_on)


def _poses(request: Request, frames: Frames, pictures: Path, work: Path) -> tuple[Poses, dict[str, Path]]:
    """Poses, and the masks that are given, in the size of the frames: those that options name come first, then those of
    transforms.json, then a folder beside the source.
    """
    drawn = None if request.board is None or request.board == "none" else BOARDS[request.board]
    model = request.colmap or (None if drawn else find_model(request.source))
    transforms = None if drawn or model else find_transforms(request.source)
    if not (request.board or model or transforms):
        drawn = recognized_board(frames, pictures)
    board = drawn and replace(drawn, square_mm=drawn.square_mm if request.square_mm is None else request.square_mm)
    read, named = read_transforms(transforms, frames) if transforms else (None, {})
    names = [one.name for one in frames.photographs]
    if request.segmenter or request.hints:
        named = {}
    elif folder := request.masks or (None if named else masks_beside(request.source, names)):
        named = {name: given_mask(folder, name) for name in names}
    if request.segmenter:
        masks = _segmented(request.segmenter, request, frames, pictures, work)
    else:
        masks = _masks_of_frames(request, frames, named, work / "given")
    given = {
        "frames": sha256_of(work / "frames.json"),
        "board": write_record(board) if board else None,
        "model": [[str(path), path.stat().st_mtime_ns] for path in _model_files(model)] if model else None,
        "transforms": sha256_of(transforms) if transforms else None,
        "masks": {name: sha256_of(path) for name, path in masks.items()},
    }

    def work_on() -> Poses:
        if board:
            found, remedy = poses_from_board(board, frames, pictures), "Show the board in each frame."
        elif model:
            found = read_colmap(model, frames)
            remedy = "Names of pictures must be those that the model knows."
        elif read:
            found, remedy = read, "Names of pictures must be those of file_path."
        else:
            found, remedy = poses_from_structure(frames, pictures, masks, work / "structure"), REMEDY
        poses = without_the_rest(found, frames, remedy)
        cameras = tuple(view.camera for view in poses.views)
        target = nearest_point(cameras)
        side = np.mean([camera.position_world for camera in cameras], axis=0) - target
        axis = side / max(float(np.linalg.norm(side)), 1e-12)
        plot_cameras(work / "poses.png", Trajectory(cameras, (), axis, target))
        return poses

    return stage(work, "poses", given, Poses, work_on), masks


def _model_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*") if path.suffix in (".txt", ".bin"))


def _segmented(model: Path, request: Request, frames: Frames, pictures: Path, work: Path) -> dict[str, Path]:
    """Masks by a model; like given ones they leave the object out of structure from motion."""
    given = {
        "frames": sha256_of(work / "frames.json"),
        "model": sha256_of(model) if model.is_file() else None,
        "options": write_record(request.options),
    }
    folder = work / "segmented"
    found = stage(
        work, "segmented", given, Segmented, lambda: segment(model, frames, pictures, folder, request.options)
    )
    return {name: folder / f"{name}.png" for name in found.names}


def _masks_of_frames(request: Request, frames: Frames, named: Mapping[str, Path], folder: Path) -> dict[str, Path]:
    """Given masks, turned and averaged as their photographs were; InputError for other sizes."""
    written = {}
    for one in frames.photographs:
        if one.name not in named:
            continue
        image = (read_upright if request.upright else read_as_stored)(named[one.name])
        mask = to_bytes(image[..., -1] if image.shape[2] == 4 else image[..., 0])
        if mask.shape != (one.full_height, one.full_width):
            raise InputError(
                expected=f"a mask of {one.full_width}×{one.full_height} pixels for {one.name}",
                found=f"{mask.shape[1]}×{mask.shape[0]} in {named[one.name]}",
                remedy="Make masks in the size of the photographs.",
            )
        written[one.name] = folder / f"{one.name}.png"
        write_png(written[one.name], block_means(mask, one.side))
    return written


def _masks(request: Request, frames: Frames, poses: Poses, given_masks: dict[str, Path], work: Path) -> Masks:
    train = request.output / "train"
    given = {
        "poses": sha256_of(work / "poses.json"),
        "hints": {name: write_record(hint) for name, hint in request.hints.items()},
        "masks": {name: sha256_of(path) for name, path in given_masks.items()},
    }

    def work_on() -> Masks:
        shutil.rmtree(train, ignore_errors=True)
        own, remedy, is_found = True, CHECK_MASKS, True
        cameras = {view.name: view.camera for view in poses.views}
        given = bool(given_masks or request.hints)

        def undistort(view: PosedView) -> bool:
            """Whether the picture has an alpha channel; a mask of its own replaces it."""
            picture = view.lens.undistorted(read_png(work / "frames" / f"{view.name}.png"))
            write_png(train / f"{view.name}.png", picture[..., :3] if given else picture, quick=True)
            return picture.shape[2] == 4

        progress = Progress("undistorting", len(poses.views))
        for alpha in in_threads(undistort, poses.views):
            own = own and alpha
            progress.advance()
        if given_masks:
            is_found = request.segmenter is not None
            origin = f"the model {request.segmenter.name}" if request.segmenter else "files"
            for view in poses.views:
                if view.name not in given_masks:
                    raise _no_mask(view)
                mask = view.lens.undistorted(read_png(given_masks[view.name])[..., 0])
                write_png(train / f"{view.name}_alpha.png", mask)
        elif request.hints:
            origin, remedy = f"hints in {', '.join(request.hints)}", MORE_HINTS
            sides = {one.name: one.side for one in frames.photographs}
            hints = {name: hint.scaled(sides.get(name, 1)) for name, hint in request.hints.items()}
            for name, mask in find_masks(cameras, train, hints).items():
                write_png(train / f"{name}_alpha.png", mask)
        elif own or poses.ground is None:
            origin, is_found = "alpha channels", False
        else:
            origin, remedy = "what moves against the ground", GIVE_MASKS
            found = ground_masks(cameras, train, poses.ground, work / "ground.png")
            for name, mask in found.items():
                write_png(train / f"{name}_alpha.png", mask)
        masks = {view.name: _written_mask(train, view) for view in poses.views}
        judged = {name: (cameras[name], mask) for name, mask in masks.items()}
        overlaps = overlaps_of(judged, remedy)
        _write_mask_sheet(work / "masks.jpg", train, masks, dict(zip(masks, overlaps, strict=True)))
        return Masks(origin, tuple(masks), overlaps, contour_sigma_px(masks, overlaps) if is_found else 0.0)

    return stage(work, "masks", given, Masks, work_on)


def contour_sigma_px(masks: Mapping[str, np.ndarray], overlaps: Sequence[float]) -> float:
    """How far contours are off, in pixels: of a disk of area A, whose edge is off by σ in the mean, (1 − o) √(A/π)/2
    of the overlap o; the median over views.
    """
    radii = [float(np.sqrt(mask.sum() / np.pi)) for mask in masks.values()]
    return float(np.median([(1 - each) * radius / 2 for each, radius in zip(overlaps, radii, strict=True)]))


def _no_mask(view: PosedView) -> InputError:
    return InputError(
        expected=f"a mask of the object in {view.name}",
        found="none",
        remedy=GIVE_MASKS,
    )


def _written_mask(train: Path, view: PosedView) -> np.ndarray:
    companion = train / f"{view.name}_alpha.png"
    if companion.exists():
        return unit_values(read_png(companion)[..., 0])
    picture = read_png(train / f"{view.name}.png")
    if picture.shape[2] != 4:
        raise _no_mask(view)
    return unit_values(picture[..., 3])


def _write_mask_sheet(path: Path, train: Path, masks: dict[str, np.ndarray], overlaps: dict[str, float]) -> None:
    """Views that agree least with the others come first: the object as it is, what lies around it dark."""
    worst = sorted(masks, key=lambda name: overlaps[name])[:SHEET_PICTURES]
    sheet = {}
    for name in worst:
        shade = 0.25 + 0.75 * masks[name][..., None]
        picture = read_png(train / f"{name}.png")[..., :3] * shade + 60 * (1 - masks[name][..., None])
        sheet[f"{name}  overlap {overlaps[name]:.1%}"] = picture.astype(np.uint8)
    write_picture_sheet(path, sheet)
