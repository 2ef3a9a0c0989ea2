"""What a perturbed copy will hold: which views remain, with which cameras, and what was drawn for each.

Each draw has a generator of its own, named by the seed, by what is drawn and by the frame's place in the source. So one
option doesn't change the draws of another, and a copy that is continued is the same as one made at once.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import Camera
from shinypartial.core.errors import InputError
from shinypartial.dataset.crossing import look_at_point
from shinypartial.dataset.perturb.options import CameraErrors, Perturbation, ViewChoice, check_options
from shinypartial.dataset.perturb.picture import cropped_camera, shrunk_camera
from shinypartial.dataset.perturb.sensor import undistorted_pixels
from shinypartial.dataset.read import read_view
from shinypartial.dataset.schema import Dataset, Frame
from shinypartial.dataset.subset import directions_from

#: A camera that stands on the limit of the arc is within it.
ANGLE_SLACK_RAD = 1e-9


@dataclass(frozen=True)
class PlannedView:
    """A training view that remains: its place in the source, the camera that the copy states, and its draws."""

    source: Frame
    index: int
    camera: Camera
    stops: Float[np.ndarray, "3"]
    empty_mask: bool
    drawn: dict[str, Any] = field(default_factory=dict)
    """What the manifest says about it."""


@dataclass(frozen=True)
class Plan:
    """A perturbed copy before anything is written."""

    options: Perturbation
    views: tuple[PlannedView, ...]
    turn: Float[np.ndarray, "3 3"] | None
    """Rotation of the world; None when it stays."""
    crop_px: int
    """What is cut off every picture on the left."""


def generator(seed: int, what: str, index: int = 0) -> np.random.Generator:
    """The generator of one draw."""
    return np.random.default_rng([seed, zlib.crc32(what.encode()), index])


def make_plan(dataset: Dataset, options: Perturbation) -> Plan:
    """Choose views, draw errors and derive cameras; pictures are read only where `views.cut` requires their masks.

    Raises InputError for values out of range, when too few views are there to choose from, and for a distortion that
    folds the picture.
    """
    check_options(options)
    frames = dataset.train
    chosen = choose_views(frames, options.views)
    scale = options.views.object_scale
    extents = [_extent(frames[i], options.views) for i in chosen] if options.views.cut else []
    crop_px = _crop_px([frames[i] for i in chosen], extents, options.views) if extents else 0
    turn = _world_turn(options)
    poses, drawn_poses = _poses(frames, options, turn)
    empty = set(generator(options.seed, "empty").permutation(chosen)[: round(options.masks.empty * len(chosen))])
    views = []
    for place, index in enumerate(chosen):
        camera = shrunk_camera(frames[index].camera, scale)
        if options.sensor.k1:
            undistorted_pixels(camera, options.sensor.k1)
        camera = cropped_camera(camera, crop_px) if crop_px else camera
        stops, drawn_stops = _stops(options, index)
        drawn = drawn_poses[index] | drawn_stops | ({"mask": "empty"} if index in empty else {})
        extent = extents[place] if extents else None
        if extent is not None:
            margin, size = extent
            drawn["cut"] = round(float(np.clip((crop_px - margin) / size, 0, 1)), 4)
        camera = with_wrong_lens(replace(camera, camera_to_world=poses[index]), options.cameras)
        views.append(PlannedView(frames[index], index, camera, stops, index in empty, drawn))
    return Plan(options, tuple(views), turn, crop_px)


def choose_views(frames: Sequence[Frame], options: ViewChoice) -> list[int]:
    """Places of the views that remain: first those within the arc, then as many of them as are kept, in their order."""
    places = np.arange(len(frames))
    if options.arc_deg is not None:
        directions = directions_from(look_at_point([frame.camera for frame in frames]), frames)
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        middle = np.arctan2(np.sin(azimuth).mean(), np.cos(azimuth).mean())
        aside = np.abs((azimuth - middle + np.pi) % (2 * np.pi) - np.pi)
        places = places[aside <= np.radians(options.arc_deg) / 2 + ANGLE_SLACK_RAD]
        if not len(places):
            raise InputError(
                expected=f"a training camera within {options.arc_deg:g}° of azimuth about their middle",
                found=f"the nearest one {np.degrees(aside.min()):.1f}° aside",
                remedy="Raise --views.arc-deg.",
            )
    keep = len(places) if options.keep is None else options.keep
    if keep > len(places):
        raise InputError(
            expected=f"--views.keep of at most {len(places)}, the training views that are there",
            found=str(keep),
            remedy="Lower it, or leave it out.",
        )
    return places[((np.arange(keep) + 0.5) * len(places) / keep).astype(int)].tolist()


def with_wrong_lens(camera: Camera, errors: CameraErrors) -> Camera:
    """The camera with a wrong focal length and principal point."""
    right, down = errors.principal_point_px
    fx, fy = errors.focal_factor * camera.fx, errors.focal_factor * camera.fy
    return replace(camera, fx=fx, fy=fy, cx=camera.cx + right, cy=camera.cy + down)


def _world_turn(options: Perturbation) -> Float[np.ndarray, "3 3"] | None:
    from scipy.spatial.transform import Rotation

    if not (any(options.world.turn_deg) or options.world.random_turn):
        return None
    turn = Rotation.from_rotvec(options.world.turn_deg, degrees=True)
    if options.world.random_turn:
        turn = Rotation.from_quat(generator(options.seed, "world").standard_normal(4)) * turn
    return turn.as_matrix()


def _poses(
    frames: Sequence[Frame], options: Perturbation, turn: Float[np.ndarray, "3 3"] | None
) -> tuple[list[np.ndarray], list[dict[str, Any]]]:
    """Pose of every training view of the source with its errors, and these errors: R' = T R exp(v), c' = T (c + R t).

    v and t are drawn in the camera's axes, T is the turn of the world.
    """
    errors = options.cameras
    center = look_at_point([frame.camera for frame in frames]) if errors.position_sigma else np.zeros(3)
    poses, drawn = [], []
    for index, frame in enumerate(frames):
        pose, record = frame.camera.camera_to_world.copy(), {}
        rotation = pose[:3, :3].copy()
        if errors.rotation_deg or errors.rotation_sigma_deg:
            error = _rotation_error(errors, options.seed, index)
            record["rotation_deg"] = np.degrees(error.as_rotvec()).tolist()
            pose[:3, :3] = rotation @ error.as_matrix()
        if errors.position_sigma:
            sigma = errors.position_sigma * np.linalg.norm(pose[:3, 3] - center)
            shift = sigma * generator(options.seed, "position", index).standard_normal(3)
            record["shift"] = shift.tolist()
            pose[:3, 3] += rotation @ shift
        if turn is not None:
            pose[:3] = turn @ pose[:3]
        poses.append(pose)
        drawn.append(record)
    return poses, drawn


def _rotation_error(errors: CameraErrors, seed: int, index: int) -> Any:
    from scipy.spatial.transform import Rotation

    axis = generator(seed, "rotation axis", index).standard_normal(3)
    fixed = Rotation.from_rotvec(errors.rotation_deg * axis / np.linalg.norm(axis), degrees=True)
    vector = errors.rotation_sigma_deg * generator(seed, "rotation", index).standard_normal(3)
    return fixed * Rotation.from_rotvec(vector, degrees=True)


def _stops(options: Perturbation, index: int) -> tuple[Float[np.ndarray, "3"], dict[str, Any]]:
    """By how many stops the channels of a view are brighter, and what the manifest says about it."""
    exposure = options.sensor.exposure_sigma_stops * generator(options.seed, "exposure", index).standard_normal()
    balance = options.sensor.white_balance_sigma_stops
    channels = balance * generator(options.seed, "white balance", index).standard_normal(3)
    drawn = {"exposure_stops": exposure} if options.sensor.exposure_sigma_stops else {}
    return exposure + channels, drawn | ({"white_balance_stops": channels.tolist()} if balance else {})


def _extent(frame: Frame, options: ViewChoice) -> tuple[float, float] | None:
    """Pixels from the left side to the object, and the object's size from there on; None for an empty mask."""
    inside = read_view(frame).alpha >= 0.5
    columns, width = np.flatnonzero(inside.any(0)), inside.shape[1]
    if not len(columns):
        return None
    ends = (np.array([columns[0], columns[-1] + 1]) - width / 2) * options.object_scale + width / 2
    return float(ends[0]), float(ends[1] - ends[0])


def _crop_px(frames: Sequence[Frame], extents: Sequence[tuple[float, float] | None], options: ViewChoice) -> int:
    lines = [margin + options.cut * size for margin, size in filter(None, extents)]
    smallest = min(frame.camera.width for frame in frames)
    if not lines or round(np.mean(lines)) >= smallest:
        raise InputError(
            expected="masks and pictures that --views.cut leaves something of",
            found="empty masks" if not lines else f"{round(np.mean(lines))} of {smallest} pixels to cut",
            remedy="Lower --views.cut, or repair the masks of the source.",
        )
    return round(np.mean(lines))
