"""Poses from what stands around the object, by pycolmap: SIFT, matching and incremental structure from motion."""

import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from panoless.photographs.frames import Frames, Photograph
from panoless.photographs.mapping import Job
from panoless.photographs.models import poses_of, pycolmap_module
from panoless.photographs.posed import LEVEL, Poses, as_rows
from shinypartial.core.camera import Similarity
from shinypartial.core.errors import InputError
from shinypartial.io.files import write_json
from shinypartial.io.images import read_png, write_png
from shinypartial.io.progress import Progress
from shinypartial.io.records import write_record

EXHAUSTIVE_FRAMES = 60
"""Up to so many frames, all pairs are matched; else neighbors in time."""
NEIGHBORS = 12
"""So many neighbors, where frames are matched with these."""

REMEDY = (
    "Put textured things, such as newspaper, or a printed board (`panoless board`) under the object and around it, "
    "lock the focus, and move by small steps; or find poses with another program and give --colmap."
)
PROGRAM = (sys.executable, "-m", "panoless.photographs.mapping")
FEATURES, PLACING = "finding features", "placing cameras"
#: What COLMAP says of its steps, by the name of the stage: the step and of how many, where it says that.
STEPS = {
    FEATURES: re.compile(r"Processed file \[(\d+)/(\d+)\]"),
    "matching frames": re.compile(r"Processing (?:image|block) \[(\d+)/(\d+)(?:, (\d+)/(\d+))?\]"),
    PLACING: re.compile(r"Registering image #\d+ \(num_reg_frames=(\d+)\)"),
}


def poses_from_structure(
    frames: Frames,
    folder: Path,
    masks: dict[str, Path],
    work: Path,
    program: Sequence[str] = PROGRAM,
) -> Poses:
    """Poses of the frames in the largest model that hangs together; what masks mark is left out.

    The world has no known unit. Its +z leads away from the ground, at which z is 0, or along the cameras' mean upward
    direction where no ground is found. `program` is given the file of a `Job`. Raises InputError when nothing matches,
    and when the program crashes.
    """
    colmap = pycolmap_module()
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    names = tuple(f"{photograph.name}.png" for photograph in frames.photographs)
    if masks:
        _write_outsides(masks, frames, work / "masks")
    job = Job(
        frames=folder.resolve(),
        names=names,
        masks=(work / "masks").resolve() if masks else None,
        one_camera=len({(photograph.width, photograph.height) for photograph in frames.photographs}) == 1,
        neighbors=None if len(names) <= EXHAUSTIVE_FRAMES else NEIGHBORS,
        work=work.resolve(),
        model=(work / "model").resolve(),
    )
    write_json(work / "job.json", write_record(job))
    _run(program, work / "job.json", work / "log.txt", len(names))
    if not job.model.exists():
        raise InputError(
            expected="photographs whose surroundings match",
            found=f"no two of {len(names)} frames that fit together",
            remedy=REMEDY,
        )
    model = colmap.Reconstruction(str(job.model))
    in_frames = Frames(tuple(_as_frame(photograph) for photograph in frames.photographs))
    return upright_world(poses_of(model, in_frames, "structure from motion"))


def _run(program: Sequence[str], job: Path, log: Path, frames: int) -> None:
    """Run the program to its end with a line of progress a stage; what stops this process ends it."""
    last = ""
    progress = {FEATURES: Progress(FEATURES, frames)}
    with (
        log.open("w", encoding="utf-8") as kept,
        subprocess.Popen(
            [*program, str(job)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        ) as process,
    ):
        assert process.stderr is not None
        try:
            for line in process.stderr:
                kept.write(line)
                last = line.strip() or last
                for stage, pattern in STEPS.items():
                    if said := pattern.search(line):
                        step, total = _step_of([int(number) for number in said.groups() if number], frames)
                        bar = progress.setdefault(stage, Progress(stage, total))
                        if step > bar.done:
                            bar.advance(steps=step - bar.done)
            code = process.wait()
        finally:
            process.kill()
    if code:
        raise InputError(
            expected="structure from motion that runs to its end",
            found=f"a crash of COLMAP ({signal.Signals(-code).name if code < 0 else f'exit code {code}'}: {last})",
            remedy="Run the same line again. If it happens again, put the printed board of `panoless board` under the "
            f"object, or find poses with another program and give --colmap. Its log is {log}.",
        )
    if PLACING in progress:
        progress[PLACING].advance(steps=progress[PLACING].total - progress[PLACING].done)


def _step_of(said: list[int], frames: int) -> tuple[int, int]:
    """The step and the number of steps: of all frames, of a row, or of a square of blocks."""
    if len(said) == 1:
        return said[0], frames
    if len(said) == 2:
        return said[0], said[1]
    row, rows, column, columns = said
    return (row - 1) * columns + column, rows * columns


def _as_frame(photograph: Photograph) -> Photograph:
    """A frame as a picture of its own, which it is to COLMAP."""

    return replace(photograph, side=1, full_width=photograph.width, full_height=photograph.height)


def _write_outsides(masks: dict[str, Path], frames: Frames, folder: Path) -> None:
    """What COLMAP may look at: 255 outside of the object."""
    for photograph in frames.photographs:
        if photograph.name in masks:
            mask = read_png(masks[photograph.name])[..., -1]
            write_png(folder / f"{photograph.name}.png.png", np.where(mask > 0, 0, 255).astype(np.uint8))


def upright_world(poses: Poses) -> Poses:
    """The same cameras in a world whose ground is z = 0; without a ground, their mean upward direction is +z."""
    up = -np.mean([np.array(view.camera_to_world)[:3, 1] for view in poses.views], axis=0)
    shift, ground = np.zeros(3), None
    if poses.ground is not None:
        up, shift[2] = np.array(poses.ground.normal), -poses.ground.offset
        ground = LEVEL
    turn = Similarity(1.0, turned_up(up / np.linalg.norm(up)), shift)
    views = []
    for view in poses.views:
        covariance = view.pose_covariance
        turned = None if covariance is None else as_rows(turn.pose_covariance(covariance))
        pose = as_rows(turn.pose(np.array(view.camera_to_world)))
        views.append(replace(view, camera_to_world=pose, covariance=turned))
    return replace(poses, views=tuple(views), ground=ground)


def turned_up(up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation that takes a unit vector to +z, its own x-axis staying as far as it can."""
    across = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = across - up * (across @ up)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])
