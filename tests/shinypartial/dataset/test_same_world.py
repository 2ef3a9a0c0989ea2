"""Captured cameras in the world of their truth: a similarity is taken out, an error is not."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shinypartial.core.camera import Camera, Similarity
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset, read_statement, read_view
from shinypartial.dataset.same_world import about_ball, align, similarity
from shinypartial.dataset.schema import MANIFEST, Frame, GroundPlane, Statement
from shinypartial.dataset.write import write_transforms
from shinypartial.io.files import read_json, write_json
from shinypartial.io.images import read_png, write_jpeg, write_png
from tests.support.synthetic_dataset import make_sphere_dataset

RANDOM = np.random.default_rng(4)
WORLD = Similarity(0.3, Rotation.from_rotvec([0.4, -1.2, 0.7]).as_matrix(), np.array([3.0, -1.0, 2.0]))


def cameras(number: int, along: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> np.ndarray:
    """Poses at about 4 from the origin, spread by so much along each axis."""
    poses = np.tile(np.eye(4), (number, 1, 1))
    poses[:, :3, :3] = Rotation.random(number, random_state=RANDOM).as_matrix()
    poses[:, :3, 3] = RANDOM.normal(size=(number, 3)) * along + [0.0, 4.0, 0.0]
    return poses


def disturbed(poses: np.ndarray, turn: float, shift: float) -> np.ndarray:
    """With turns and shifts of that standard deviation."""
    moved = poses.copy()
    moved[:, :3, :3] = Rotation.from_rotvec(turn * RANDOM.normal(size=(len(poses), 3))).as_matrix() @ poses[:, :3, :3]
    moved[:, :3, 3] += shift * RANDOM.normal(size=(len(poses), 3))
    return moved


@pytest.mark.parametrize("number", [2, 7])
@pytest.mark.parametrize("along", [(1.0, 1.0, 1.0), (1.0, 0.0, 0.0)])
def test_a_similarity_is_found_again(number: int, along: tuple[float, float, float]) -> None:
    """From two cameras on, and from cameras on a line."""
    poses = cameras(number, along)
    found = similarity(poses, np.array([WORLD.pose(each) for each in poses]))
    assert found.scale == pytest.approx(WORLD.scale)
    np.testing.assert_allclose(found.rotation, WORLD.rotation, atol=1e-9)
    np.testing.assert_allclose(found.shift, WORLD.shift, atol=1e-9)


@pytest.mark.parametrize("number", [1, 2, 7])
def test_a_rotation_about_a_ball_is_found_again(number: int) -> None:
    """From one camera on. A view that turns by 0.2 against n − 1 others keeps (n − 1)/n of it."""
    poses = cameras(number)
    world = Similarity(0.06, WORLD.rotation, np.zeros(3))
    true = np.array([world.pose(each) for each in poses])
    found = about_ball(poses, true, 0.06)
    np.testing.assert_allclose(found.rotation, WORLD.rotation, atol=1e-9)
    np.testing.assert_allclose(found(poses[:, :3, 3]), true[:, :3, 3], atol=1e-9)
    true[0, :3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.2]).as_matrix() @ true[0, :3, :3]
    moved = about_ball(poses, true, 0.06).rotation @ poses[:, :3, :3]
    left = Rotation.from_matrix(np.swapaxes(true[:, :3, :3], 1, 2) @ moved)
    assert left.magnitude().max() == pytest.approx(0.2 * (number - 1) / number, rel=1e-2, abs=1e-9)


def test_no_other_similarity_leaves_less() -> None:
    """Of turns, and of shifts over the distance."""
    captured, true = cameras(9), cameras(9)
    found = similarity(captured, true)

    def left(other: Similarity) -> float:
        moved = np.array([other.pose(each) for each in captured])
        turns = np.sum((moved[:, :3, :3] - true[:, :3, :3]) ** 2) / 2
        distance = np.median(np.linalg.norm(true[:, :3, 3], axis=1))
        return turns + np.sum((moved[:, :3, 3] - true[:, :3, 3]) ** 2) / distance**2

    for size in (1e-3, 1e-1):
        for change in size * RANDOM.normal(size=(50, 7)):
            turn = Rotation.from_rotvec(change[:3]).as_matrix()
            other = Similarity(found.scale * np.exp(change[6]), turn @ found.rotation, found.shift + change[3:6])
            assert left(found) < left(other)


def test_cameras_near_a_line_tell_the_turn_about_it_by_their_own() -> None:
    """A handheld pass before an object. By centers alone the turn would be off by 0.005/(0.05 √40), 0.9°."""
    poses = cameras(40, (1.3, 0.05, 0.05))
    found = similarity(disturbed(poses, 0.002, 0.005), poses)
    assert np.degrees(Rotation.from_matrix(found.rotation).magnitude()) < 0.1


def test_cameras_in_one_place_tell_no_world() -> None:
    for poses in (np.tile(np.eye(4), (5, 1, 1)), cameras(1)):
        with pytest.raises(InputError, match="two places"):
            similarity(poses, poses)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("truth") / "data"
    make_sphere_dataset(root, resolution=32, train=6, test=2)
    return root


def captured(truth: Path, root: Path, world: Similarity, turn_deg: float = 0.0) -> Path:
    """The training views with their cameras in another world, each turned by an angle about its own x-axis."""
    dataset = open_dataset(truth)
    own = np.eye(4)
    own[:3, :3] = Rotation.from_rotvec([np.radians(turn_deg), 0, 0]).as_matrix()
    frames = []
    for frame in dataset.train:
        shutil.copytree(truth / "train", root / "train", dirs_exist_ok=True)
        old = frame.camera
        there = Camera(world.pose(old.camera_to_world) @ own, old.fx, old.fy, old.cx, old.cy, old.width, old.height)
        frames.append(Frame(frame.name, there, root / frame.name))
    write_transforms(root, "train", frames)
    return root


def test_another_world_is_no_error(truth: Path, tmp_path: Path) -> None:
    made = align(captured(truth, tmp_path / "captured", WORLD), truth, tmp_path / "aligned")
    assert (made.gauge, len(made.views)) == ("similarity", 6)
    assert made.scale == pytest.approx(1 / WORLD.scale)
    assert max(*made.rotation_deg, *made.distance_share, abs(made.focal_share)) < 1e-6
    assert min(made.mask_overlap) == 1.0
    before, after = open_dataset(truth), open_dataset(tmp_path / "aligned")
    for old, new in zip((*before.train, *before.test), (*after.train, *after.test), strict=True):
        np.testing.assert_allclose(new.camera.camera_to_world, old.camera.camera_to_world, atol=1e-9)


def test_the_ground_and_what_is_sure_come_along(truth: Path, tmp_path: Path) -> None:
    ground = GroundPlane((0.0, 0.6, 0.8), -1.5)
    statement = Statement(0.002, 0.7, ground)
    folder = captured(truth, tmp_path / "captured", WORLD)
    frames = open_dataset(folder).train
    write_transforms(folder, "train", frames, statement=statement.moved(WORLD))
    align(folder, truth, tmp_path / "aligned")
    aligned = open_dataset(tmp_path / "aligned")
    stated = read_statement(aligned)
    found = stated.ground
    assert found is not None
    np.testing.assert_allclose([*found.normal, found.offset], [*ground.normal, ground.offset], atol=1e-9)
    assert replace(stated, ground=ground) == statement


def test_turned_cameras_are_told(truth: Path, tmp_path: Path) -> None:
    """But for the turn that they have in common."""
    made = align(captured(truth, tmp_path / "captured", WORLD, 0.7), truth, tmp_path / "aligned", "similarity")
    assert 0.2 < np.median(made.rotation_deg) < 0.7
    assert f"turned by {np.median(made.rotation_deg):.3f}°" in made.summary()


def test_the_world_of_a_ball_has_its_radius(truth: Path, tmp_path: Path) -> None:
    with_radius = tmp_path / "truth"
    shutil.copytree(truth, with_radius)
    manifest = read_json(with_radius / MANIFEST, "the manifest")
    write_json(with_radius / MANIFEST, manifest | {"statistics": {"object_radius": 0.5}})
    world = Similarity(2.0, WORLD.rotation, np.zeros(3))
    made = align(captured(truth, tmp_path / "captured", world), with_radius, tmp_path / "one", "ball")
    assert (made.gauge, made.scale) == ("ball", 0.5)
    assert max(*made.rotation_deg, *made.distance_share) < 1e-6
    shifted = captured(truth, tmp_path / "shifted", Similarity(2.0, WORLD.rotation, np.array([0.0, 0.0, 0.8])))
    made = align(shifted, with_radius, tmp_path / "two", "ball")  # No shift of the world is estimated.
    radii = [np.linalg.norm(frame.camera.position_world) for frame in open_dataset(truth).train]
    np.testing.assert_allclose(made.distance_share, 0.4 / np.array(radii), rtol=1e-6)


def test_a_board_is_believed_and_no_world_estimated(truth: Path, tmp_path: Path) -> None:
    corner = np.array([-0.1, 0.2, -0.3])
    with_board = tmp_path / "truth"
    shutil.copytree(truth, with_board)
    manifest = read_json(with_board / MANIFEST, "the manifest")
    write_json(with_board / MANIFEST, manifest | {"statistics": {"board_corner": corner.tolist()}})
    in_board = Similarity(1.0, np.eye(3), -corner)
    off = Similarity(1.0, np.eye(3), -corner + [0.0, 0.0, 0.04])
    made = align(captured(truth, tmp_path / "right", in_board), with_board, tmp_path / "one")
    assert (made.gauge, made.scale) == ("board", 1.0)
    assert max(made.distance_share) < 1e-9
    wrong = align(captured(truth, tmp_path / "off", off), with_board, tmp_path / "two")
    np.testing.assert_allclose(wrong.distance_share, 0.01, rtol=1e-6)  # Of the distance 4.
    with pytest.raises(InputError, match="a board"):
        align(tmp_path / "right", truth, tmp_path / "three", "board")


@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_masks_in_files_of_their_own_come_along(truth: Path, tmp_path: Path, kind: str) -> None:
    """Of JPEGs, which have no other, and of PNGs whose alpha is something else; both lie there, and frames name one."""
    root = captured(truth, tmp_path / "captured", WORLD)
    content = read_json(root / "transforms_train.json", "cameras")
    for frame, entry in zip(open_dataset(root).train, content["frames"], strict=True):
        picture = read_png(frame.png)
        write_png(root / f"masks/{frame.stem.name}.png", picture[..., 3])
        for path in (*frame.files, frame.self_png):
            path.unlink(missing_ok=True)
        write_png(frame.png, np.concatenate([picture[..., :3], np.full_like(picture[..., 3:], 255)], -1))
        write_jpeg(frame.stem.with_name(f"{frame.stem.name}.jpg"), np.ascontiguousarray(picture[..., :3]), 95)
        entry["file_path"] += f".{kind}"
        entry["mask_path"] = f"masks/{frame.stem.name}.png"
    write_json(root / "transforms_train.json", content)
    made = align(root, truth, tmp_path / "aligned")
    assert min(made.mask_overlap) == 1.0
    for old, new in zip(open_dataset(root).train, open_dataset(tmp_path / "aligned").train, strict=True):
        assert new.photograph.suffix == f".{kind}"
        before, after = read_view(old), read_view(new)
        np.testing.assert_array_equal(after.alpha, before.alpha)
        np.testing.assert_array_equal(after.radiance, before.radiance)


def test_a_missing_picture_is_told_before_anything_is_written(truth: Path, tmp_path: Path) -> None:
    root = captured(truth, tmp_path / "captured", WORLD)
    for path in (root / "train").glob("r_003.*"):
        path.unlink()
    with pytest.raises(InputError, match="no such file"):
        align(root, truth, tmp_path / "aligned")
    assert not (tmp_path / "aligned").exists()


def test_frames_of_another_film_are_refused(truth: Path, tmp_path: Path) -> None:
    root = captured(truth, tmp_path / "captured", WORLD)
    content = read_json(root / "transforms_train.json", "cameras")
    (root / "train" / "r_000.png").rename(root / "train" / "frame_7.png")
    content["frames"][0]["file_path"] = "./train/frame_7"
    write_json(root / "transforms_train.json", content)
    with pytest.raises(InputError, match="frame_7"):
        align(root, truth, tmp_path / "aligned")
