"""Writing a dataset: the Y-up export, checksums, resuming, and folders that belong to something else."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from shinypartial.core.errors import InputError
from shinypartial.core.sphere import cube_directions, latlong_directions
from shinypartial.dataset.schema import (
    CHECKSUMS,
    ENVIRONMENT_CUBE,
    ENVIRONMENT_LATLONG,
    ENVIRONMENT_LATLONG_Y_UP,
    MANIFEST,
    Dataset,
)
from shinypartial.dataset.transforms import read_frames
from shinypartial.dataset.write import claim_folder, is_written, write_environment, write_transforms
from shinypartial.io.files import sha256_of
from shinypartial.io.images import read_exr_rgb

RECIPE = {"scene": "vase", "seed": 1}


@pytest.fixture
def environment(tmp_path: Path) -> Path:
    """The environment files of a world whose color is its direction, shifted to [0, 1]."""
    write_environment(tmp_path, (latlong_directions(64) + 1) / 2, cube_resolution=32)
    return tmp_path


def test_only_the_y_up_map_carries_the_envmap_tag(environment: Path) -> None:
    tags = {path: "envmap" in _header(path) for path in environment.rglob("*.exr")}
    assert len(tags) == 8
    assert [path for path, tagged in tags.items() if tagged] == [environment / ENVIRONMENT_LATLONG_Y_UP]
    assert _header(environment / ENVIRONMENT_LATLONG_Y_UP)["envmap"] == OpenEXR.ENVMAP_LATLONG


def _header(path: Path) -> dict:
    with OpenEXR.File(str(path)) as file:
        return dict(file.header())


#: From ImfEnvmap.h: center along +Z, top along +Y, longitude decreasing to the right, so +X on the left.
#: A Y-up direction (x, y, z) is (x, −z, y) in the Z-up world.
Y_UP_PIXELS = {
    "center": ((0.5, 0.5), (0, 0, 1)),
    "top": ((0.5, 0.0), (0, 1, 0)),
    "bottom": ((0.5, 1.0), (0, -1, 0)),
    "left": ((0.25, 0.5), (1, 0, 0)),
    "right": ((0.75, 0.5), (-1, 0, 0)),
    "seam": ((0.0, 0.5), (0, 0, -1)),
}


@pytest.mark.parametrize(("uv", "y_up"), Y_UP_PIXELS.values(), ids=Y_UP_PIXELS.keys())
def test_y_up_export_follows_the_definition_of_its_tag(
    environment: Path, uv: tuple[float, float], y_up: tuple[int, int, int]
) -> None:
    image = read_exr_rgb(environment / ENVIRONMENT_LATLONG_Y_UP)
    height, width = image.shape[:2]
    assert width == 2 * height
    row, column = min(int(uv[1] * height), height - 1), int(uv[0] * width)
    x, y, z = y_up
    # A texel of 2.8° is at most half of that off the axis; colors are directions halved.
    np.testing.assert_allclose(image[row, column], (np.array([x, -z, y]) + 1) / 2, atol=0.03)


def test_cube_faces_hold_the_directions_of_their_texels(environment: Path) -> None:
    for name, directions in zip(("px", "nx", "py", "ny", "pz", "nz"), cube_directions(32), strict=True):
        found = read_exr_rgb(environment / ENVIRONMENT_CUBE / f"{name}.exr")
        np.testing.assert_allclose(found, (directions + 1) / 2, atol=3e-3)


def test_the_latlong_map_is_kept_to_half_precision(environment: Path) -> None:
    found = read_exr_rgb(environment / ENVIRONMENT_LATLONG)
    np.testing.assert_allclose(found, (latlong_directions(64) + 1) / 2, atol=2**-11)


def test_every_file_is_listed_with_its_checksum(sphere_dataset: Dataset) -> None:
    root = sphere_dataset.root
    listed = dict(reversed(line.split("  ", 1)) for line in (root / CHECKSUMS).read_text().splitlines())
    present = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    assert listed.keys() == present - {CHECKSUMS}
    assert all(sha256_of(root / name) == checksum for name, checksum in listed.items())
    assert json.loads((root / "dataset.json").read_text())["complete"] is True


def test_a_frame_counts_as_written_only_with_all_its_files(damaged_dataset: Path, sphere_dataset: Dataset) -> None:
    frame = sphere_dataset.train[0]
    assert is_written(frame)
    for path in frame.files:
        copy = damaged_dataset / path.relative_to(sphere_dataset.root)
        copy.unlink()
        moved = type(frame)(frame.name, frame.camera, damaged_dataset / frame.stem.relative_to(sphere_dataset.root))
        assert not is_written(moved)
        copy.write_bytes(path.read_bytes())
        assert is_written(moved)


def test_a_folder_is_claimed_once_and_continued_by_the_same_recipe(tmp_path: Path) -> None:
    assert claim_folder(tmp_path / "a", RECIPE, {}) is False
    assert claim_folder(tmp_path / "a", RECIPE, {}) is True


def test_another_recipe_is_refused_with_what_differs(tmp_path: Path) -> None:
    claim_folder(tmp_path, RECIPE, {})
    with pytest.raises(InputError, match=r"different: seed, suns\)"):
        claim_folder(tmp_path, {"scene": "vase", "seed": 2, "suns": 3}, {})


@pytest.mark.parametrize("manifest", ["[]", "null", "{}", '{"recipe": null}', '{"recipe": ["vase"]}'])
def test_a_manifest_without_a_recipe_is_of_another_one(tmp_path: Path, manifest: str) -> None:
    (tmp_path / MANIFEST).write_text(manifest)
    with pytest.raises(InputError, match=r"a table|different: scene, seed\)"):
        claim_folder(tmp_path, RECIPE, {})
    assert (tmp_path / MANIFEST).read_text() == manifest


def test_foreign_files_are_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(InputError, match="files that are not a dataset"):
        claim_folder(tmp_path, RECIPE, {})
    with pytest.raises(InputError, match="files that are not a dataset"):
        claim_folder(tmp_path / "thesis.tex", RECIPE, {})
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_covariances_of_poses_are_stored_as_they_are(tmp_path: Path, sphere_dataset: Dataset) -> None:
    random = np.random.default_rng(0)
    root = random.normal(size=(6, 6)) * np.repeat([1e-5, 1.0], 3)[:, None]
    covariance = root @ root.T
    frames = [replace(frame, pose_covariance=covariance) for frame in sphere_dataset.train[:1]]
    write_transforms(tmp_path, "train", [*frames, *sphere_dataset.train[1:]])
    first, second, *_ = read_frames(tmp_path, "train")[0]
    np.testing.assert_allclose(first.pose_covariance, covariance, rtol=1e-12)
    assert second.pose_covariance is None
    path = tmp_path / "transforms_train.json"
    content = json.loads(path.read_text())
    for broken in (covariance[:3].tolist(), (-covariance).tolist(), np.zeros((6, 6)).tolist(), "sure"):
        content["frames"][0]["pose_covariance"] = broken
        path.write_text(json.dumps(content))
        assert "positive definite" in read_frames(tmp_path, "train")[2][0].expected
