"""A captured dataset beside its truth: both in one world, and how far cameras and masks are off.

What photographs determine has a gauge: cameras that structure from motion finds are right up to a similarity, those
from a board in the board's own world, and those about a ball of radius 1 up to a rotation about its center.
Poses are moved, pictures and masks stay as they are.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import Camera, Similarity
from shinypartial.core.conventions import PIXEL_CENTER
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset, read_statement, read_view
from shinypartial.dataset.schema import MANIFEST, SPLITS, Dataset, Frame
from shinypartial.dataset.subset import files_of
from shinypartial.dataset.write import write_transforms
from shinypartial.io.files import copy_or_link, folder_lock, write_json
from shinypartial.io.records import write_record

GaugeKind = Literal["board", "ball", "similarity", "same"]
ALIGNMENT = "alignment.json"
#: Camera centers that span less than this share of their distance from the world's origin determine no scale.
LEAST_SPREAD = 1e-6
FEWEST_CAMERAS = 2
#: Of rotation and scale in turn, which then stand still to the last digits.
ROUNDS = 20


@dataclass(frozen=True)
class Alignment:
    """Errors of a captured dataset after its gauge is taken out, view by view."""

    gauge: GaugeKind
    scale: float
    """Length of the truth's world over that of the captured one; 1 where a board gives meters."""
    views: tuple[str, ...]
    rotation_deg: tuple[float, ...]
    """Angle between the captured and the true orientation."""
    distance_share: tuple[float, ...]
    """How far the camera is off, as a share of its true distance from the object's center, the origin."""
    focal_share: float
    """Captured focal length over the true one, less 1; with pictures of another size, by angle of view."""
    mask_overlap: tuple[float, ...]
    """Intersection over union of captured and true mask."""

    def summary(self) -> str:
        """Medians and worst values in a line."""
        turn, share = (np.array(each) for each in (self.rotation_deg, self.distance_share))
        return (
            f"{len(self.views)} views by {self.gauge}: turned by {np.median(turn):.3f}° (at most {turn.max():.3f}°), "
            f"moved by {np.median(share):.3%} of the distance (at most {share.max():.3%}), "
            f"focal length {self.focal_share:+.3%}, "
            f"masks overlap by {np.median(self.mask_overlap):.3f} (at least {min(self.mask_overlap):.3f})"
        )


def similarity(captured: Float[np.ndarray, "V 4 4"], true: Float[np.ndarray, "V 4 4"]) -> Similarity:
    """The one that brings captured camera-to-world poses nearest to the true ones.

    Least squares of what is left of the turns, and of the shifts over the median true distance d from the origin, where
    the object is: Σ ‖R Aᵢ − Bᵢ‖²/2 + ‖s R xᵢ + t − yᵢ‖²/d², with rotations A and centers x of the captured cameras, B
    and y of the true ones. For a scale s that is an orthogonal Procrustes problem (Schönemann 1966), and for R the
    scale is that of Umeyama (1991). Centers alone leave the turn about a line open on which they almost stand.
    Raises InputError for fewer than two, and for centers at one place, which determine no scale.
    """
    ours, theirs = (poses[:, :3, 3] - poses[:, :3, 3].mean(0) for poses in (captured, true))
    distance = np.median(np.linalg.norm(true[:, :3, 3], axis=1)) if len(true) else 1.0
    spread = np.linalg.norm(ours, axis=1).max(initial=0.0)
    if len(captured) < FEWEST_CAMERAS or spread <= LEAST_SPREAD * np.abs(captured[:, :3, 3]).max():
        raise InputError(
            expected="captured cameras in at least two places",
            found=f"{len(captured)}" + (" in one place" if len(captured) >= FEWEST_CAMERAS else ""),
            remedy="Capture frames from several sides.",
        )
    by_turns = _common_turn(captured, true)
    by_centers = theirs.T @ ours / distance**2
    scale = float(np.linalg.norm(theirs) / np.linalg.norm(ours))
    for _ in range(ROUNDS):
        rotation = _nearest_rotation(by_turns + 2 * scale * by_centers)
        scale = float(np.sum(theirs * (ours @ rotation.T)) / np.sum(ours**2))
    return Similarity(scale, rotation, true[:, :3, 3].mean(0) - scale * rotation @ captured[:, :3, 3].mean(0))


def about_ball(captured: Float[np.ndarray, "V 4 4"], true: Float[np.ndarray, "V 4 4"], radius: float) -> Similarity:
    """From a world with the ball's center at its origin and radius 1: the scale is the true radius, nothing shifts.

    The rotation leaves least of the turns: Σ ‖R Aᵢ − Bᵢ‖² over the poses' rotations, A captured and B true. One view is
    enough.
    """
    return Similarity(radius, _nearest_rotation(_common_turn(captured, true)), np.zeros(3))


def _common_turn(captured: Float[np.ndarray, "V 4 4"], true: Float[np.ndarray, "V 4 4"]) -> Float[np.ndarray, "3 3"]:
    """Σ Bᵢ Aᵢᵀ of the rotations, captured A and true B."""
    common: np.ndarray = np.einsum("vij,vkj->ik", true[:, :3, :3], captured[:, :3, :3])
    return common


def _nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation R of largest tr(RᵀM)."""
    left, _, right = np.linalg.svd(matrix)
    nearest: np.ndarray = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return nearest


def align(captured: Path, truth: Path, output: Path, gauge: GaugeKind | None = None) -> Alignment:
    """Write a copy of a captured dataset whose cameras are in the truth's world, with the truth's test cameras.

    Frames of the same name belong together. `board` shifts by the known place of the board's corner and estimates
    nothing; `ball` is for a world about a ball of radius 1; `similarity` is estimated from the poses of all cameras;
    with `same` the captured world is the truth's.
    When not given, it is `board` where the truth has a board, else `similarity`. The test views have cameras and no
    pictures.
    Raises InputError for frames that the truth doesn't know or that have no picture.
    """
    ours, theirs = open_dataset(captured), open_dataset(truth)
    pairs = _pairs(ours, theirs)
    kind = gauge or ("similarity" if theirs.board_corner is None else "board")
    found = _gauge(kind, pairs, theirs)
    moved = [_moved(frame, output, found) for frame, _ in pairs]
    copies = [files for (frame, _), new in zip(pairs, moved, strict=True) for files in _copies(frame, new)]
    with folder_lock(output):
        for old, new in copies:
            copy_or_link(old, new, False)
        result = _compare(kind, found.scale, [(new, true) for new, (_, true) in zip(moved, pairs, strict=True)])
        write_transforms(output, SPLITS[0], moved, statement=read_statement(ours).moved(found))
        if theirs.test:
            write_transforms(output, SPLITS[1], theirs.test)
        write_json(output / ALIGNMENT, write_record(result))
    return result


def _pairs(ours: Dataset, theirs: Dataset) -> list[tuple[Frame, Frame]]:
    true = {frame.stem.name: frame for frame in theirs.train}
    unknown = [frame.stem.name for frame in ours.train if frame.stem.name not in true]
    if unknown:
        raise InputError(
            expected=f"frames that {theirs.root} knows, such as {next(iter(true))}",
            found=", ".join(unknown[:3]),
            remedy="Name the truth of the film that was captured.",
        )
    return [(frame, true[frame.stem.name]) for frame in ours.train]


def _gauge(kind: GaugeKind, pairs: Sequence[tuple[Frame, Frame]], truth: Dataset) -> Similarity:
    poses = np.array([[frame.camera.camera_to_world for frame in pair] for pair in pairs])
    if kind == "similarity":
        return similarity(poses[:, 0], poses[:, 1])
    if kind == "ball":
        if truth.object_radius is None:
            raise InputError(
                expected=f"the object's radius in {truth.root / MANIFEST}",
                found="none",
                remedy="Use the truth that shinypartial film made.",
            )
        return about_ball(poses[:, 0], poses[:, 1], truth.object_radius)
    if kind == "same":
        return Similarity(1.0, np.eye(3), np.zeros(3))
    if truth.board_corner is None:
        raise InputError(
            expected=f"a board in the scene of {truth.root}",
            found="none",
            remedy="Leave out --gauge board, or film a scene that has one.",
        )
    return Similarity(1.0, np.eye(3), np.array(truth.board_corner))


def _moved(frame: Frame, output: Path, gauge: Similarity) -> Frame:
    """The frame in the new folder, beside whose picture its mask lies."""
    stem = output / SPLITS[0] / frame.stem.name
    mask = None if frame.mask is None else stem.with_name(f"{stem.name}_mask_path{frame.mask.suffix}")
    camera = frame.camera
    pose = gauge.pose(camera.camera_to_world)
    there = Camera(pose, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    stated = frame.pose_covariance
    moved = None if stated is None else gauge.pose_covariance(stated)
    return Frame(f"{SPLITS[0]}/{stem.name}", there, stem, frame.suffix, mask, moved)


def _copies(frame: Frame, new: Frame) -> Iterator[tuple[Path, Path]]:
    """Source and destination of all files of a frame."""
    for path in files_of(frame):
        yield path, new.stem.parent / path.name
    if frame.mask is not None and new.mask is not None:
        yield frame.mask, new.mask


def _compare(kind: GaugeKind, scale: float, pairs: Sequence[tuple[Frame, Frame]]) -> Alignment:
    from scipy.spatial.transform import Rotation

    turns, shares, focals, overlaps = [], [], [], []
    for new, true in pairs:
        ours, theirs = new.camera, true.camera
        turn = ours.camera_to_world[:3, :3].T @ theirs.camera_to_world[:3, :3]
        turns.append(float(np.degrees(Rotation.from_matrix(turn).magnitude())))
        off = ours.position_world - theirs.position_world
        shares.append(float(np.linalg.norm(off) / np.linalg.norm(theirs.position_world)))
        focals.append(ours.fx / ours.width * theirs.width / theirs.fx - 1)
        overlaps.append(_overlap(new, true))
    names = tuple(true.stem.name for _, true in pairs)
    return Alignment(kind, scale, names, tuple(turns), tuple(shares), float(np.median(focals)), tuple(overlaps))


def _overlap(new: Frame, true: Frame) -> float:
    """Of masks, the true one looked up where the captured pinhole's pixels look."""
    ours, theirs = new.camera, true.camera
    mask, truth = read_view(new).alpha >= 0.5, read_view(true).alpha >= 0.5
    row, column = np.indices(mask.shape) + PIXEL_CENTER
    x = np.floor((column - ours.cx) / ours.fx * theirs.fx + theirs.cx).astype(int)
    y = np.floor((row - ours.cy) / ours.fy * theirs.fy + theirs.cy).astype(int)
    within = (x >= 0) & (y >= 0) & (x < theirs.width) & (y < theirs.height)
    there = within & truth[np.where(within, y, 0), np.where(within, x, 0)]
    union = np.count_nonzero(mask | there)
    return np.count_nonzero(mask & there) / union if union else 1.0
