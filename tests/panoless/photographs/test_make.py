"""Photographs to a dataset: stages that continue, and a dataset of ours that survives the way around."""

import builtins
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from panoless.cli import main
from panoless.photographs import frames, masks
from panoless.photographs.frames import Frames, Photograph
from panoless.photographs.make import Request, capture
from panoless.photographs.masks import Hint
from panoless.photographs.structure import poses_from_structure, turned_up
from shinypartial.core.camera import opencv_to_opengl
from shinypartial.core.errors import InputError
from shinypartial.dataset.bundled import bundled_dataset, resolve_dataset
from shinypartial.dataset.export_cameras import export_cameras
from shinypartial.dataset.read import open_dataset, read_statement, read_view
from shinypartial.dataset.schema import Statement
from shinypartial.io.images import write_png
from tests.panoless.photographs.test_masks import CAMERAS, TRUTH, box_of, write_pictures
from tests.support.photographed_planes import arc, photograph


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are small and smooth."""
    monkeypatch.setattr(frames, "MOST_BLUR", 1.0)
    monkeypatch.setattr(masks, "HULL_VOXELS", 32)
    monkeypatch.setattr(masks, "ROUNDS", 1)


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """A folder as nerfstudio has it: images, masks beside them, transforms.json."""
    folder = tmp_path / "photos"
    write_pictures(folder / "images")
    for index, truth in enumerate(TRUTH):
        write_png(folder / "masks" / f"p_{index}.png", truth.astype(np.uint8) * 255)
    frames = [
        {"file_path": f"images/p_{i}.png", "transform_matrix": opencv_to_opengl(camera.camera_to_world).tolist()}
        for i, camera in enumerate(CAMERAS)
    ]
    content = {"fl_x": 200.0, "cx": 48.0, "cy": 48.0, "w": 96, "h": 96, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def test_photographs_with_masks_become_a_dataset(photographs: Path, tmp_path: Path) -> None:
    output = tmp_path / "dataset"
    made = capture(Request(photographs, output, masks=photographs / "masks"))
    assert "Poses: 9 by transforms.json" in "\n".join(made.summary())
    dataset = open_dataset(output)
    for frame, camera, truth in zip(dataset.train, CAMERAS, TRUTH, strict=True):
        np.testing.assert_allclose(frame.camera.camera_to_world, camera.camera_to_world, atol=1e-12)
        np.testing.assert_array_equal(read_view(frame).alpha > 0.5, truth)
    assert {path.name for path in (output / "capture").glob("*.*g")} == {"frames.jpg", "poses.png", "masks.jpg"}
    # Masks that are given are right, and no ground was looked for.
    assert read_statement(dataset) == Statement()
    assert read_statement(dataset).ground is None


def test_stages_that_are_done_are_not_done_again(photographs: Path, tmp_path: Path) -> None:
    output = tmp_path / "dataset"
    records = [output / "capture" / f"{name}.json" for name in ("frames", "poses", "masks")]

    def times() -> list[int]:
        return [path.stat().st_mtime_ns for path in records]

    given = Request(photographs, output, masks=photographs / "masks")
    first = capture(given)
    before = times()
    assert capture(given) == first
    assert times() == before
    left, top, right, bottom = box_of(TRUTH[4])
    capture(Request(photographs, output, hints={"p_4": Hint((left, top, right, bottom))}))
    # Given masks take part in structure from motion, so that poses depend on them; frames do not.
    assert [new == old for new, old in zip(times(), before, strict=True)] == [True, False, False]
    assert "hints in p_4" in records[2].read_text()


def test_other_masks_of_the_same_names_ask_for_poses_anew(photographs: Path, tmp_path: Path) -> None:
    given = Request(photographs, tmp_path / "dataset", masks=photographs / "masks")
    capture(given)
    found = tmp_path / "dataset" / "capture" / "poses.json"
    before = found.stat().st_mtime_ns
    write_png(photographs / "masks" / "p_4.png", np.roll(TRUTH[4], 1, 0).astype(np.uint8) * 255)
    capture(given)
    assert found.stat().st_mtime_ns != before


def test_masks_beside_pictures_are_found_where_a_file_of_cameras_names_none(photographs: Path, tmp_path: Path) -> None:
    found = capture(Request(photographs, tmp_path / "found"))
    named = capture(Request(photographs, tmp_path / "named", masks=photographs / "masks"))
    assert found.masks == named.masks


@pytest.mark.parametrize(
    "options",
    [
        ["--colmap", "sparse", "--board", "A4"],
        ["--masks", "masks", "--segmenter", "model.onnx"],
        ["--masks", "masks", "--box", "1,2,3,4", "--box-in", "p_4"],
    ],
)
def test_options_that_exclude_each_other_are_named(
    options: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["capture", str(tmp_path), "--output", str(tmp_path / "out"), *options]) == 2
    said = capsys.readouterr().err
    assert all(option in said for option in options if option in ("--colmap", "--board", "--masks", "--segmenter"))


def test_pictures_without_any_mask_are_refused(photographs: Path, tmp_path: Path) -> None:
    shutil.rmtree(photographs / "masks")
    with pytest.raises(InputError, match="--box"):
        capture(Request(photographs, tmp_path / "dataset"))


def test_a_folder_of_other_things_is_not_written_to(photographs: Path) -> None:
    with pytest.raises(InputError, match="other files"):
        capture(Request(photographs, photographs))


def test_rectangles_and_their_photographs_come_in_pairs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    command = ["capture", str(tmp_path), "--output", str(tmp_path / "out"), "--box", "1,2,3"]
    assert main([*command, "--box-in", "a"]) == 2
    assert main([*command[:-1], "1,2,3,4"]) == 2
    assert main([*command[:-1], "nan,0,9,9", "--box-in", "a"]) == 2
    assert capsys.readouterr().err.count("--box X0,Y0,X1,Y1") == 3


@pytest.mark.parametrize("side", ["0", "-27", "nan", "inf"])
def test_a_square_without_a_side_is_refused(side: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["capture", str(tmp_path), "--output", str(tmp_path / "out"), "--square-mm", side]) == 2
    assert "--square-mm above 0" in capsys.readouterr().err


def test_a_missing_library_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    load = builtins.__import__

    def without_opencv(name: str, *rest, **named):
        if name == "cv2":
            raise ImportError(name)
        return load(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without_opencv)
    (tmp_path / "film.mp4").write_bytes(b"ftyp")
    assert main(["capture", str(tmp_path / "film.mp4"), "--output", str(tmp_path / "out")]) == 2
    assert "panoless[capture]" in capsys.readouterr().err


def test_the_world_is_turned_upright() -> None:
    for up in np.random.default_rng(0).normal(size=(20, 3)):
        turn = turned_up(up / np.linalg.norm(up))
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(turn @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
        assert np.linalg.det(turn) > 0


def write_frames(folder: Path, images: list[np.ndarray]) -> Frames:
    size = images[0].shape[1::-1]
    for index, image in enumerate(images):
        write_png(folder / f"p_{index:02d}.png", np.repeat(image[..., None], 3, 2))
    names = [f"p_{index:02d}" for index in range(len(images))]
    return Frames(tuple(Photograph(name, folder / f"{name}.png", *size, 1, *size, 0.0, 0.5) for name in names))


def test_surroundings_without_any_feature_are_refused(tmp_path: Path) -> None:
    frames = write_frames(tmp_path / "frames", [np.full((60, 80), 128, np.uint8)] * 8)
    with pytest.raises(InputError, match="surroundings match"):
        poses_from_structure(frames, tmp_path / "frames", {}, tmp_path / "work")


@pytest.mark.slow
def test_cameras_are_found_in_a_corner_of_a_room(tmp_path: Path) -> None:
    """Of three papered planes, without a board: 0.13° was measured, but for one frame with 0.32°."""

    def paper(seed: int) -> np.ndarray:
        random = np.random.default_rng(seed)
        noise = [random.normal(size=(n, n)) for n in (12, 40, 120)]
        layers = [cv2.resize(layer, (480, 480), interpolation=cv2.INTER_CUBIC) for layer in noise]
        return np.clip(128 + 50 * np.sum(layers, 0), 0, 255).astype(np.uint8)

    floor = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])
    back = np.array([[-1, 1, 1.5], [1, 1, 1.5], [1, 1, 0], [-1, 1, 0.0]])
    left = np.array([[-1, -1, 1.5], [-1, 1, 1.5], [-1, 1, 0], [-1, -1, 0.0]])
    planes = [(paper(seed), corners) for seed, corners in enumerate((floor, back, left))]
    cameras = arc(12, 2.2, (400, 300), 380.0)
    frames = write_frames(tmp_path / "frames", [photograph(camera, planes) for camera in cameras])
    found = poses_from_structure(frames, tmp_path / "frames", {}, tmp_path / "work")
    assert len(found.views) == len(cameras)
    assert found.views[0].lens.fx == pytest.approx(380, rel=0.01)
    # Angles between cameras do not depend on the world.
    for view, camera, next_view, next_camera in zip(found.views, cameras, found.views[1:], cameras[1:], strict=False):
        seen = np.array(view.camera_to_world)[:3, :3].T @ np.array(next_view.camera_to_world)[:3, :3]
        true = camera.camera_to_world[:3, :3].T @ next_camera.camera_to_world[:3, :3]
        assert np.degrees(np.linalg.norm(cv2.Rodrigues(seen.T @ true)[0])) < 0.5
    # 0.008° were measured: noise alone, which is less than the errors are.
    turns = [np.degrees(np.sqrt(np.trace(np.array(view.covariance)[:3, :3]))) for view in found.views]
    assert 0.002 < np.median(turns) < 0.1


@pytest.mark.slow
def test_a_dataset_that_went_around_by_colmap_is_the_same(tmp_path: Path) -> None:
    """Exported, captured again: the same cameras, pictures and masks."""
    before = open_dataset(bundled_dataset("tiny-vase"))
    export_cameras(before, tmp_path / "model", "colmap")
    capture(Request(before.root / "train", tmp_path / "again", colmap=tmp_path / "model"))
    after = open_dataset(tmp_path / "again")
    assert len(after.train) == len(before.train)
    for old, new in zip(before.train, after.train, strict=True):
        assert old.stem.name == new.stem.name
        np.testing.assert_allclose(new.camera.camera_to_world, old.camera.camera_to_world, atol=1e-12)
        assert new.camera.fx == pytest.approx(old.camera.fx)
        one, other = read_view(old), read_view(new)
        np.testing.assert_array_equal(one.alpha, other.alpha)
        np.testing.assert_array_equal(one.radiance, other.radiance)


def test_the_newest_dataset_is_the_one_that_was_captured(
    photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without --output; a folder with a file of all cameras is no dataset yet, and fitting it says the command."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"panoless capture photos") as error:
        open_dataset(Path("photos"))
    assert "transforms.json" in error.value.found
    command = ["capture", "photos"]
    assert main(command) == 0
    assert "Next: panoless fit datasets/photos" in capsys.readouterr().out
    assert resolve_dataset() == Path("datasets/photos")


def test_listed_frames_without_a_photograph_are_named(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = photographs / "transforms.json"
    content = json.loads(path.read_text())
    write_png(tmp_path / "bad" / "outside.png", np.zeros((96, 96, 3), np.uint8))
    content["frames"].append(content["frames"][0] | {"file_path": "../bad/outside.png"})
    path.write_text(json.dumps(content))
    made = capture(Request(photographs, tmp_path / "dataset"))
    assert len(made.poses.views) == 9
    assert "no photograph is read for ../bad/outside.png" in capsys.readouterr().err
