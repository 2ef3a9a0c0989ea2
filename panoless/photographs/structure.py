"""Poses from what stands around the object, by pycolmap: SIFT, matching and incremental structure from motion."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from panoless.photographs.frames import Frames, Photograph
from panoless.photographs.models import poses_of, pycolmap_module
from panoless.photographs.options import CaptureOptions
from panoless.photographs.posed import LEVEL, Poses, as_rows
from shinypartial.core.camera import Similarity
from shinypartial.core.errors import InputError
from shinypartial.io.images import read_png, write_png

SEED = 0
REMEDY = (
    "Put textured things, such as newspaper, or a printed board (`panoless board`) under the object and around it, "
    "lock the focus, and move by small steps; or find poses with another program and give --colmap."
)


def poses_from_structure(
    frames: Frames, folder: Path, masks: dict[str, Path], work: Path, options: CaptureOptions
) -> Poses:
    """Poses of the frames in the largest model that hangs together; what masks mark is left out.

    The world has no known unit. Its +z leads away from the ground, at which z is 0, or along the cameras' mean upward
    direction where no ground is found. Raises InputError when nothing matches.
    """
    colmap = pycolmap_module()
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    database = work / "database.db"
    colmap.set_random_seed(SEED)
    names = [f"{photograph.name}.png" for photograph in frames.photographs]
    reader = colmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    if masks:
        _write_outsides(masks, frames, work / "masks")
        reader.mask_path = str(work / "masks")
    one_size = len({(photograph.width, photograph.height) for photograph in frames.photographs}) == 1
    mode = colmap.CameraMode.SINGLE if one_size else colmap.CameraMode.PER_IMAGE
    colmap.extract_features(database, folder, image_names=names, camera_mode=mode, reader_options=reader)
    if len(names) <= options.exhaustive_frames:
        colmap.match_exhaustive(database)
    else:
        pairing = colmap.SequentialPairingOptions(overlap=options.neighbors, loop_detection=False)
        colmap.match_sequential(database, pairing_options=pairing)
    mapping = colmap.IncrementalPipelineOptions(random_seed=SEED)
    models = colmap.incremental_mapping(database, folder, work, options=mapping)
    if not models:
        raise InputError(
            expected="photographs whose surroundings match",
            found=f"no two of {len(names)} frames that fit together",
            remedy=REMEDY,
        )
    model = max(models.values(), key=lambda one: one.num_reg_images())
    in_frames = Frames(tuple(_as_frame(photograph) for photograph in frames.photographs))
    return upright_world(poses_of(model, in_frames, "structure from motion", options))


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
