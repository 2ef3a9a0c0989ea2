"""A film, or photographs, and the truth: the scene's views by a hand, what stands around the object, and what the phone
makes of both.

A run that is killed at any moment continues when it is started again.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from shinypartial.blender.runtime import check_blender
from shinypartial.blender.video import write_video
from shinypartial.blender.worker_pool import WorkerPool
from shinypartial.core.camera import Camera, opencv_to_opengl
from shinypartial.core.errors import InputError
from shinypartial.core.handheld import handheld_poses
from shinypartial.core.trajectory import Trajectory, plan_cameras
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import Frame
from shinypartial.dataset.write import intrinsics_of
from shinypartial.generate.dataset import Shots, generate, render_frames
from shinypartial.generate.recording import exif_tags, moments, recorded_mask, recorded_picture
from shinypartial.io.files import folder_lock, link_or_copy, read_json, remove_partial_files, write_json
from shinypartial.io.images import write_jpeg, write_png
from shinypartial.io.records import write_record
from shinypartial.scene import FilmSpec, older_recipe

RECIPE, VIDEO, TRUTH = "film.json", "film.mp4", "truth"
DEFAULT_FOLDER = Path("films")
FRAMES, MASKS, KNOWN = "frames", "masks", "known"
#: As frames of a video are named by those who take them out of it.
FRAME_NAME = "frame_{:05d}"
JPEG_QUALITY = 95
#: Boxes leave a margin of this share of their size around the object, as one draws them by hand.
BOX_MARGIN = 0.06


@dataclass(frozen=True)
class Filmed:
    """What a run of `film` did."""

    root: Path
    recorded: int
    kept: int
    boxes: dict[str, tuple[int, int, int, int]]
    """Rectangles about the object in the first, the middle and the last frame: left, top, right, bottom."""


def film(spec: FilmSpec, root: Path) -> Filmed:
    """Make a film in the folder `root`, or finish what an earlier run began there.

    Raises InputError when the folder holds something else or Blender can't run.
    """
    truth = root / TRUTH
    trajectory = plan_film(spec)
    _check_folder(spec, root)
    check_blender()
    with folder_lock(root):
        parts = {"hand": spec.hand, "phone": spec.phone, "photographs": spec.photographs}
        further = {"film": {key: write_record(part) for key, part in parts.items() if part}}
        write_json(root / RECIPE, {"complete": False, "recipe": spec.recipe()})
        remove_partial_files(root)
        generate(spec.scene, truth, Shots(trajectory, partial(_name, len(spec.shot_stops)), further))
        frames = open_dataset(truth).train
        missing = [frame for frame in frames if not _is_recorded(root, frame)]
        if missing:
            _record(spec, root, frames, missing)
        if missing or not (root / KNOWN / "transforms.json").exists():
            _write_known(spec, root, frames)
        if spec.photographs is None and (missing or not (root / VIDEO).exists()):
            pictures = [_picture(root, frame) for frame in frames]
            write_video(pictures, root / VIDEO, spec.size, spec.phone.frames_per_second, spec.phone.quality)
        boxes = {frames[i].stem.name: _box(root, frames[i]) for i in sorted({0, len(frames) // 2, len(frames) - 1})}
        write_json(root / RECIPE, {"complete": True, "recipe": spec.recipe(), "boxes": boxes})
    return Filmed(root, len(missing), len(frames) - len(missing), boxes)


def plan_film(spec: FilmSpec) -> Trajectory:
    """Cameras of the hand along the scene's path, one a picture, and steady ones along the same path.

    All pictures are as wide as the film.
    """
    scene = spec.scene
    steady = plan_cameras(scene.camera, scene.render.resolution)
    width, height = spec.size
    focal = scene.camera.lens_mm / scene.camera.sensor_mm * width

    def camera(pose: np.ndarray) -> Camera:
        return Camera(pose, focal, focal, width / 2, height / 2, width, height)

    hand = np.repeat(handheld_poses(scene.camera, spec.hand, scene.camera.train), len(spec.shot_stops), axis=0)
    if spec.photographs:
        random = np.random.default_rng(spec.hand.seed)
        hand[:, :3, 3] += spec.photographs.bracket_sway * scene.camera.radius * random.normal(size=(len(hand), 3))
    return Trajectory(
        tuple(map(camera, hand)),
        tuple(camera(each.camera_to_world) for each in steady.test),
        steady.hemisphere_axis,
        steady.target,
    )


def _name(shots: int, index: int) -> str:
    """Pose, and exposure where there are several."""
    pose, shot = divmod(index, shots)
    return FRAME_NAME.format(pose) + (f"_{shot}" if shots > 1 else "")


def _check_folder(spec: FilmSpec, root: Path) -> None:
    begun = read_json(root / RECIPE, "the film's recipe") if (root / RECIPE).exists() else None
    known = begun.get("recipe") if isinstance(begun, dict) else None
    others = root.exists() and (not root.is_dir() or any(not path.name.startswith(".") for path in root.iterdir()))
    if older_recipe(known) != older_recipe(spec.recipe()) and (others or known is not None):
        raise InputError(
            expected=f"an output folder that is new or holds the same film, at {root}",
            found="another film" if known else "other files",
            remedy="Choose another --output, or delete that folder.",
        )


def _picture(root: Path, frame: Frame) -> Path:
    return root / FRAMES / f"{frame.stem.name}.jpg"


def _mask(root: Path, frame: Frame) -> Path:
    return root / MASKS / f"{frame.stem.name}.png"


def _is_recorded(root: Path, frame: Frame) -> bool:
    return _picture(root, frame).exists()


def _record(spec: FilmSpec, root: Path, frames: tuple[Frame, ...], missing: list[Frame]) -> None:
    """Backdrop, object before it, phone; the picture is the last file of a frame."""
    of_frame = dict(zip((frame.name for frame in frames), moments(spec), strict=True))

    def make(pool: WorkerPool, frame: Frame) -> None:
        backdrop = pool.render_backdrop(frame.camera, frame.name)
        view = read_view(frame)
        radiance = view.radiance + (1 - view.alpha[..., None]) * backdrop
        moment = of_frame[frame.name]
        picture = recorded_picture(radiance.astype(np.float32), frame.camera, spec.phone, moment)
        write_png(_mask(root, frame), recorded_mask(view.alpha.astype(np.float32), frame.camera, spec.phone))
        exif = exif_tags(frame.camera, spec.photographs, moment) if spec.photographs else {}
        write_jpeg(_picture(root, frame), picture, JPEG_QUALITY, exif)

    render_frames(spec.scene, missing, len(frames), make, "Filming")


def _write_known(spec: FilmSpec, root: Path, frames: tuple[Frame, ...]) -> None:
    """The frames with true cameras, lens and masks, as nerfstudio has them: what a perfect capture would find.

    Of a bracket it has the shot whose exposure is nearest to that of the truth.
    """
    entries = []
    shots = spec.shot_stops
    for frame in frames[int(np.argmin(np.abs(shots))) :: len(shots)]:
        name = frame.stem.name
        link_or_copy(_picture(root, frame), root / KNOWN / "images" / f"{name}.jpg")
        pose = opencv_to_opengl(frame.camera.camera_to_world).tolist()
        mask = f"../{MASKS}/{name}.png"
        entries.append({"file_path": f"images/{name}.jpg", "mask_path": mask, "transform_matrix": pose})
    lens = {"camera_model": "OPENCV", "k1": spec.phone.k1, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    write_json(root / KNOWN / "transforms.json", {**intrinsics_of(frames[0].camera), **lens, "frames": entries})


def _box(root: Path, frame: Frame) -> tuple[int, int, int, int]:
    """A rectangle about the object in the recorded frame, with a margin."""
    from shinypartial.io.images import read_png

    rows, columns = np.nonzero(read_png(_mask(root, frame))[..., 0] > 127)
    if not len(rows):
        return (0, 0, frame.camera.width, frame.camera.height)
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()]) + 1
    margin = np.ceil(BOX_MARGIN * (high - low)).astype(int)
    left, top = np.maximum(low - margin, 0).tolist()
    right, bottom = np.minimum(high + margin, [frame.camera.width, frame.camera.height]).tolist()
    return left, top, right, bottom
