"""Poses of other programs: models of COLMAP and transforms.json of nerfstudio."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from panoless.photographs import posed
from panoless.photographs.frames import Frames, Photograph
from panoless.photographs.models import find_model, read_colmap, read_rotations, read_transforms
from panoless.photographs.posed import without_the_rest
from shinypartial.core.camera import look_at, opencv_to_opengl
from shinypartial.core.errors import InputError

SIZE = (64, 48)
POSES = [look_at(np.array([2 * np.sin(a), -2 * np.cos(a), 0.7]), np.zeros(3)) for a in np.linspace(-1, 1, 3)]
NAMES = [f"p_{index}" for index in range(3)]
LENSES = {"a": ("SIMPLE_RADIAL", [70.0, 32.0, 24.0, -0.05]), "b": ("PINHOLE", [80.0, 81.0, 31.0, 25.0])}
LENS_OF = ["a", "b", "a"]


def frames_of_size(width: int = SIZE[0], height: int = SIZE[1], side: int = 1) -> Frames:
    small = width // side, height // side
    return Frames(
        tuple(
            Photograph(name, Path("photos/images") / f"{name}.jpg", *small, side, width, height, 0.0, 0.5)
            for name in NAMES
        )
    )


def write_model(folder: Path, binary: bool) -> Path:
    """Two cameras, three images, written by hand as text and by COLMAP as binary."""
    text = folder / "text"
    text.mkdir(parents=True)
    numbers = {name: index for index, name in enumerate(LENSES, 1)}
    cameras = [
        f"{numbers[name]} {model} {SIZE[0]} {SIZE[1]} {' '.join(map(str, values))}"
        for name, (model, values) in LENSES.items()
    ]
    images = []
    for index, (name, pose, lens) in enumerate(zip(NAMES, POSES, LENS_OF, strict=True), 1):
        inverse = np.linalg.inv(pose)
        x, y, z, w = pycolmap.Rotation3d(inverse[:3, :3]).quat
        numbers_of_image = " ".join(f"{value:.17g}" for value in (w, x, y, z, *inverse[:3, 3]))
        images.append(f"{index} {numbers_of_image} {numbers[lens]} images/{name}.jpg\n")
    (text / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (text / "images.txt").write_text("\n".join(images) + "\n")
    (text / "points3D.txt").write_text("")
    if not binary:
        return text
    (folder / "binary").mkdir()
    pycolmap.Reconstruction(str(text)).write_binary(str(folder / "binary"))
    return folder / "binary"


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_cameras_of_a_colmap_model_are_read(tmp_path: Path, binary: bool) -> None:
    found = read_colmap(write_model(tmp_path, binary), frames_of_size())
    assert [view.name for view in found.views] == NAMES
    for view, pose in zip(found.views, POSES, strict=True):
        np.testing.assert_allclose(view.camera_to_world, pose, atol=1e-12)
    first, second, _ = (view.lens for view in found.views)
    assert (first.fx, first.fy, first.cx, first.cy, first.k1) == (70, 70, 32, 24, -0.05)
    assert (second.fx, second.fy, second.cx, second.cy, second.k1) == (80, 81, 31, 25, 0)


def test_rotations_of_a_colmap_model_are_read(tmp_path: Path) -> None:
    """Of the photographs that it has, by the names of their files."""
    files = [tmp_path / f"{name}.jpg" for name in (*NAMES, "stranger")]
    found = read_rotations(write_model(tmp_path, False), files)
    assert list(found) == files[:3]
    for file, pose in zip(files[:3], POSES, strict=True):
        np.testing.assert_allclose(found[file], pose[:3, :3].T, atol=1e-12)


def test_cameras_hold_for_averaged_pictures(tmp_path: Path) -> None:
    lens = read_colmap(write_model(tmp_path, False), frames_of_size(side=2)).views[1].lens
    assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height) == (40, 40.5, 15.5, 12.5, 32, 24)


def test_a_model_beside_the_pictures_is_found(tmp_path: Path) -> None:
    model = write_model(tmp_path, False)
    (tmp_path / "images").mkdir()
    (tmp_path / "sparse").mkdir()
    model.rename(tmp_path / "sparse" / "0")
    assert find_model(tmp_path) == find_model(tmp_path / "images") == tmp_path / "sparse" / "0"
    assert find_model(tmp_path / "sparse" / "0" / "no") is None


def test_pictures_that_were_turned_are_told_from_others(tmp_path: Path) -> None:
    model = write_model(tmp_path, False)
    with pytest.raises(InputError, match="--no-upright"):
        read_colmap(model, frames_of_size(*SIZE[::-1]))
    with pytest.raises(InputError, match="64×48"):
        read_colmap(model, frames_of_size(100, 90))


def test_a_damaged_or_missing_model_is_refused(tmp_path: Path) -> None:
    model = write_model(tmp_path, False)
    with pytest.raises(InputError, match="sparse/0"):
        read_colmap(tmp_path / "none", frames_of_size())
    (model / "cameras.txt").write_text("1 PINHOLE 64\n")
    with pytest.raises(InputError, match="complete COLMAP model"):
        read_colmap(model, frames_of_size())


def test_too_few_poses_are_refused_and_frames_without_one_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = read_colmap(write_model(tmp_path, False), frames_of_size())
    with pytest.raises(InputError, match="3 of 3"):
        without_the_rest(poses, frames_of_size(), "Add more.")
    monkeypatch.setattr(posed, "LEAST_VIEWS", 3)
    more = frames_of_size().photographs
    extra = Photograph("stray", Path("stray.jpg"), *SIZE, 1, *SIZE, 0.0, 0.5)
    assert without_the_rest(poses, Frames((*more, extra)), "").left_out == ("stray",)


def write_transforms_json(folder: Path, **changes: object) -> Path:
    frames = [
        {"file_path": f"images/{name}.jpg", "transform_matrix": opencv_to_opengl(pose).tolist(), "fl_x": 70.0 + index}
        for index, (name, pose) in enumerate(zip(NAMES, POSES, strict=True))
    ]
    frames[1] |= {"k1": -0.1, "mask_path": "masks/p_1.png"}
    content = {"w": SIZE[0], "h": SIZE[1], "cx": 30.0, "cy": 25.0, "k1": 0.02, "p2": 0.003, "frames": frames, **changes}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder / "transforms.json"


@pytest.mark.parametrize("model", [None, "OPENCV", "SIMPLE_RADIAL"])
def test_every_frame_of_transforms_json_has_its_own_lens(tmp_path: Path, model: str | None) -> None:
    named = {} if model is None else {"camera_model": model}
    poses, masks = read_transforms(write_transforms_json(tmp_path, **named), frames_of_size())
    lenses = [view.lens for view in poses.views]
    assert [lens.fx for lens in lenses] == [70, 71, 72]
    assert [lens.k1 for lens in lenses] == [0.02, -0.1, 0.02]
    assert [lens.p2 for lens in lenses] == [0.003] * 3
    assert {(lens.cx, lens.cy) for lens in lenses} == {(30, 25)}
    for view, pose in zip(poses.views, POSES, strict=True):
        np.testing.assert_allclose(view.camera_to_world, pose, atol=1e-12)
    assert masks == {"p_1": tmp_path / "masks/p_1.png"}


@pytest.mark.parametrize("changes", [{"camera_model": "OPENCV_FISHEYE"}, {"k4": 0.1}, {"k1": "much"}])
def test_lenses_that_are_not_understood_are_refused(tmp_path: Path, changes: dict[str, object]) -> None:
    with pytest.raises(InputError):
        read_transforms(write_transforms_json(tmp_path, **changes), frames_of_size())
