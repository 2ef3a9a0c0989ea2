"""Cameras for other programs project as ours do, by the programs' own conventions."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shinypartial.cli import main
from shinypartial.core.camera import Camera, look_at, project
from shinypartial.core.errors import InputError
from shinypartial.dataset.bundled import bundled_dataset
from shinypartial.dataset.export_cameras import export_cameras
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import Dataset, Frame
from shinypartial.dataset.transforms import frames_of, read_frames
from shinypartial.dataset.write import write_transforms

POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return open_dataset(bundled_dataset("tiny-vase"))


def rotated(quaternion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """q p q*, with q = (w, x, y, z): Rodrigues' formula of a unit quaternion."""
    w, v = quaternion[0], quaternion[1:]
    return points + 2 * np.cross(v, np.cross(v, points) + w * points)


def test_colmap_projects_points_to_the_same_pixels(dataset: Dataset, tmp_path: Path) -> None:
    export_cameras(dataset, tmp_path, "colmap")
    cameras = {int(line.split()[0]): line.split()[1:] for line in (tmp_path / "cameras.txt").read_text().splitlines()}
    lines = (tmp_path / "images.txt").read_text().split("\n")[::2]
    frames = (*dataset.train, *dataset.test)
    for line, frame in zip(lines, frames, strict=False):
        _, *pose, number, name = line.split()
        model, width, height, *intrinsics = cameras[int(number)]
        assert (model, int(width), int(height)) == ("PINHOLE", frame.camera.width, frame.camera.height)
        fx, fy, cx, cy = map(float, intrinsics)
        values = np.array(pose, float)
        x, y, z = (rotated(values[:4], POINTS) + values[4:]).T
        places = np.stack([fx * x / z + cx, fy * y / z + cy, z], 1)
        np.testing.assert_allclose(places, project(frame.camera, POINTS), atol=1e-9)
        assert (dataset.root / name).is_file()
    assert len(frames) == sum(bool(line) for line in lines)


def test_nerfstudio_gets_the_same_cameras_and_masks(dataset: Dataset, tmp_path: Path) -> None:
    (path,) = export_cameras(dataset, tmp_path / "deep" / "down", "nerf")
    read, count, errors = frames_of(path.parent, json.loads(path.read_text()), path)
    assert (count, errors) == (len(dataset.train) + len(dataset.test), [])
    for frame, other in zip((*dataset.train, *dataset.test), read, strict=True):
        np.testing.assert_allclose(other.camera.camera_to_world, frame.camera.camera_to_world, atol=1e-12)
        assert other.camera.fx == pytest.approx(frame.camera.fx)
        assert other.stem.resolve() == frame.stem.resolve()


def test_files_that_are_there_are_kept(dataset: Dataset, tmp_path: Path) -> None:
    export_cameras(dataset, tmp_path, "colmap")
    with pytest.raises(InputError, match="another --output"):
        export_cameras(dataset, tmp_path, "colmap")
    assert main(["export-cameras", "tiny-vase", "--output", str(tmp_path), "--to", "nerf"]) == 0
    assert (tmp_path / "transforms.json").exists()


def test_frames_with_lenses_of_their_own_are_written_and_read(tmp_path: Path) -> None:
    pose = look_at(np.array([0.0, -2.0, 1.0]), np.zeros(3))
    first = Camera(pose, 50.0, 51.0, 30.0, 20.0, 64, 48)
    cameras = [first, replace(first, fx=70.0, cx=33.0), first, replace(first, width=32, cx=15.0)]
    frames = [Frame(f"train/r_{i}", camera, tmp_path / "train" / f"r_{i}") for i, camera in enumerate(cameras)]
    write_transforms(tmp_path, "train", frames)
    read, _, errors = read_frames(tmp_path, "train")
    assert errors == []
    for frame, camera in zip(read, cameras, strict=True):
        for name in ("fx", "fy", "cx", "cy", "width", "height"):
            assert getattr(frame.camera, name) == getattr(camera, name)
