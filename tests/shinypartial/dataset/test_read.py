"""Reading datasets: what was written comes back, plain NeRF-synthetic folders load, and bad input is named."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shinypartial.core.errors import InputError
from shinypartial.dataset.read import newest_dataset, open_dataset, read_environment, read_view
from shinypartial.dataset.schema import Dataset, Frame
from shinypartial.io.images import read_exr, read_png, write_exr, write_png
from tests.support.synthetic_dataset import MAP_HEIGHT, environment_latlong, make_plain_sphere_dataset, render_sphere

TRAIN = "transforms_train.json"


def edit_json(path: Path, change: Callable[[Any], object]) -> None:
    """Load a JSON file, let `change` modify it in place, and write it back (NaN allowed, as careless tools do)."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def edit_exr(path: Path, change: Callable[[dict[str, np.ndarray]], object]) -> None:
    """The same for the channels of an EXR."""
    channels = read_exr(path)
    change(channels)
    write_exr(path, channels)


def test_a_dataset_comes_back_as_it_was_rendered(sphere_dataset: Dataset) -> None:
    assert (len(sphere_dataset.train), len(sphere_dataset.test)) == (6, 3)
    assert sphere_dataset.name == "sphere"
    for frame in (*sphere_dataset.train, *sphere_dataset.split("test")):
        found, rendered = read_view(frame), render_sphere(frame.camera)
        assert found.high_dynamic_range
        assert found.normals_world is not None
        assert found.depth is not None
        # Half floats keep 11 bits; cameras go through JSON, which keeps float64 exactly.
        np.testing.assert_allclose(found.radiance, rendered.radiance, rtol=2**-11, atol=1e-6)
        np.testing.assert_allclose(found.alpha, rendered.alpha, atol=2**-11)
        np.testing.assert_allclose(found.normals_world, rendered.normals_world, atol=1e-6)
        np.testing.assert_allclose(found.depth, rendered.depth, atol=1e-5)


def test_the_environment_comes_back(sphere_dataset: Dataset) -> None:
    np.testing.assert_allclose(
        read_environment(sphere_dataset), environment_latlong(MAP_HEIGHT), rtol=2**-11, atol=1e-6
    )


def test_names_and_files_of_a_frame(sphere_dataset: Dataset) -> None:
    frame = sphere_dataset.test[1]
    assert frame.name == "test/r_001"
    expected = ["r_001.png", "r_001_alpha.png", "r_001_normal.png", "r_001.exr"]
    assert [path.name for path in frame.files] == expected
    assert all(path.exists() for path in frame.files)


def test_png_companions_equal_the_exr_within_8_bit_rounding(damaged_dataset: Path) -> None:
    frame = open_dataset(damaged_dataset).train[0]
    exact = read_view(frame)
    frame.exr.unlink()
    rounded = read_view(frame)
    assert not rounded.high_dynamic_range
    assert rounded.depth is None
    _assert_equal_within_8_bits(rounded.radiance, rounded.alpha, exact.radiance, exact.alpha)
    inside = exact.alpha > 0
    assert rounded.normals_world is not None
    assert exact.normals_world is not None
    # Each component is off by up to 1/255, the length by up to √3/255 before it is normalized.
    np.testing.assert_allclose(rounded.normals_world[inside], exact.normals_world[inside], atol=3 / 255)
    np.testing.assert_array_equal(rounded.normals_world[~inside], 0)


def test_a_plain_nerf_synthetic_folder_equals_ours(tmp_path: Path, sphere_dataset: Dataset) -> None:
    plain = make_plain_sphere_dataset(tmp_path / "plain")
    assert plain.manifest == {}
    for ours, theirs in zip(sphere_dataset.train, plain.train, strict=True):
        np.testing.assert_allclose(theirs.camera.camera_to_world, ours.camera.camera_to_world, atol=1e-15)
        for name in ("fx", "fy", "cx", "cy", "width", "height"):
            assert getattr(theirs.camera, name) == pytest.approx(getattr(ours.camera, name), rel=1e-12)
        exact, rounded = read_view(ours), read_view(theirs)
        assert rounded.normals_world is None
        _assert_equal_within_8_bits(rounded.radiance, rounded.alpha, exact.radiance, exact.alpha)


def _assert_equal_within_8_bits(
    radiance: np.ndarray, alpha: np.ndarray, exact_radiance: np.ndarray, exact_alpha: np.ndarray
) -> None:
    np.testing.assert_allclose(alpha, exact_alpha, atol=0.51 / 255 + 2**-11)
    # The steepest slope of sRGB decoding is 2.28 (at 1), so half a step of color is 1.14/255; half a step of alpha
    # adds 0.5/255. What lies above 1 was clipped.
    shown = np.minimum(exact_radiance, exact_alpha[..., None])
    np.testing.assert_allclose(radiance, shown, atol=1.7 / 255 + 2**-11)


def test_a_separate_mask_serves_as_alpha(damaged_dataset: Path) -> None:
    frame = open_dataset(damaged_dataset).train[0]
    frame.exr.unlink()
    with_alpha = read_view(frame)
    write_png(frame.png, np.ascontiguousarray(read_png(frame.png)[..., :3]))
    separate = read_view(frame)
    np.testing.assert_array_equal(separate.alpha, with_alpha.alpha)
    np.testing.assert_array_equal(separate.radiance, with_alpha.radiance)


def test_file_path_may_carry_an_extension(damaged_dataset: Path) -> None:
    edit_json(damaged_dataset / TRAIN, lambda t: [f.update(file_path=f["file_path"] + ".png") for f in t["frames"]])
    frame = open_dataset(damaged_dataset).train[2]
    assert frame.stem == damaged_dataset / "train" / "r_002"
    read_view(frame)


def test_the_test_split_may_be_missing(damaged_dataset: Path) -> None:
    (damaged_dataset / "transforms_test.json").unlink()
    assert open_dataset(damaged_dataset).test == ()


@pytest.mark.parametrize("corner", [[None, 0, 0], [0, 0], ["1", "2", "3"], [float("nan"), 0, 0], 3, {}])
def test_a_corner_that_is_no_place_is_unknown(tmp_path: Path, corner: object) -> None:
    assert Dataset(tmp_path, {"statistics": {"board_corner": [1, 2.5, 0]}}, (), ()).board_corner == (1.0, 2.5, 0.0)
    assert Dataset(tmp_path, {"statistics": {"board_corner": corner}}, (), ()).board_corner is None


@pytest.mark.parametrize("stated", [None, [], "text"])
def test_a_manifest_whose_tables_are_none_states_nothing(tmp_path: Path, stated: object) -> None:
    dataset = Dataset(tmp_path, {"recipe": stated, "statistics": stated}, (), ())
    assert dataset.recipe == dataset.statistics == {}
    assert (dataset.scene_split, dataset.object_radius) == ("unknown", None)


def test_test_views_of_one_file_name_are_refused(tmp_path: Path) -> None:
    """Their predictions would be one file; training views have none."""
    root = make_plain_sphere_dataset(tmp_path / "plain", 12, train=2, test=2).root

    def move(transforms: dict[str, Any]) -> None:
        for folder, entry in zip("ab", transforms["frames"], strict=True):
            picture = root / f"{entry['file_path']}.png"
            entry["file_path"] = f"./{folder}/{picture.parent.name}"
            (root / folder).mkdir(exist_ok=True)
            picture.rename(root / f"{entry['file_path']}.png")

    edit_json(root / TRAIN, move)
    assert len(open_dataset(root).train) == 2
    edit_json(root / "transforms_test.json", move)
    with pytest.raises(InputError, match="2 views named test/test"):
        open_dataset(root)
    assert len(open_dataset(root, shared_names=True).test) == 2


def test_the_newest_dataset_is_found(tmp_path: Path, sphere_dataset: Dataset) -> None:
    with pytest.raises(InputError, match="shinypartial generate"):
        newest_dataset(tmp_path)
    shutil.copytree(sphere_dataset.root, tmp_path / "one")
    assert newest_dataset(tmp_path) == tmp_path / "one"


def _first_pose(index: tuple[int, int], value: float) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        edit_json(root / TRAIN, lambda t: t["frames"][0]["transform_matrix"][index[0]].__setitem__(index[1], value))

    return damage


def _transforms(**changes: Any) -> Callable[[Path], None]:
    return lambda root: edit_json(root / TRAIN, lambda t: t.update(changes))


def _manifest(**changes: Any) -> Callable[[Path], None]:
    return lambda root: edit_json(root / "dataset.json", lambda t: t.update(changes))


def _replace_folder_by_file(root: Path) -> None:
    shutil.rmtree(root)
    root.write_text("")


#: What is wrong, how to bring it about, and a word that the message must hold besides expected, found and remedy.
BAD_FOLDERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing folder": (shutil.rmtree, "nothing there"),
    "a file instead of a folder": (_replace_folder_by_file, "a file"),
    "no transforms": (lambda root: (root / TRAIN).unlink(), "no such file"),
    "broken JSON": (lambda root: (root / TRAIN).write_text('{"frames": ['), "to be JSON"),
    "transforms that are a list": (lambda root: (root / TRAIN).write_text("[]"), "frames"),
    "empty frames": (_transforms(frames=[]), "frames"),
    "frames that are no list": (_transforms(frames={"0": {}}), "frames"),
    "a frame that is no object": (_transforms(frames=["r_000"]), "file_path"),
    "a frame without file_path": (_transforms(frames=[{"transform_matrix": np.eye(4).tolist()}]), "file_path"),
    "a frame without a pose": (_transforms(frames=[{"file_path": "./train/r_000"}]), "transform_matrix"),
    "a ragged pose": (
        _transforms(frames=[{"file_path": "./train/r_000", "transform_matrix": [[1, 0], [0]]}]),
        "transform_matrix",
    ),
    "a pose of three rows": (
        _transforms(frames=[{"file_path": "./train/r_000", "transform_matrix": np.eye(4)[:3].tolist()}]),
        "train/r_000",
    ),
    "NaN in a pose": (_first_pose((0, 3), float("nan")), "transform_matrix.0.3"),
    "a pose that is not invertible": (_first_pose((2, 2), 0.0), "rigid"),
    "a scaled pose": (_first_pose((0, 0), 3.0), "rigid"),
    "a negative focal length": (_transforms(fl_x=-1.0), "focal"),
    "a focal length in words": (_transforms(fl_x="long"), "fl_x"),
    "an image size in words": (_transforms(w="wide"), "wide"),
    "lens distortion": (_transforms(k1=0.1), "k1"),
    "another lens": (_transforms(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
    "a lens of instant-ngp": (_transforms(is_fisheye=True), "fisheye"),
    "another lens of a frame": (
        lambda root: edit_json(root / TRAIN, lambda t: t["frames"][1].update(camera_model="OPENCV_FISHEYE", k1=0.0)),
        "OPENCV_FISHEYE",
    ),
    "a lens that is no name": (_transforms(camera_model=["OPENCV"]), "camera_model"),
    "another format": (_manifest(format="something"), "something"),
    "another version": (_manifest(format_version=99), "version 99"),
    "a manifest that is a list": (lambda root: (root / "dataset.json").write_text("[1]"), "version"),
    "an empty manifest": (lambda root: (root / "dataset.json").write_text("{}"), "version"),
}


@pytest.mark.parametrize(("damage", "word"), BAD_FOLDERS.values(), ids=BAD_FOLDERS.keys())
def test_bad_folders_are_refused_on_opening(damaged_dataset: Path, damage: Callable[[Path], object], word: str) -> None:
    damage(damaged_dataset)
    with pytest.raises(InputError) as caught:
        open_dataset(damaged_dataset)
    _assert_teaches(caught.value, word)


def _assert_teaches(error: InputError, word: str) -> None:
    assert error.expected
    assert error.found
    assert error.remedy.endswith((".", "`"))
    assert word in str(error)


def _truncate(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def _set_nan(name: str) -> Callable[[Frame], object]:
    return lambda frame: edit_exr(frame.exr, lambda channels: channels[name].__setitem__((3, 4), np.nan))


def _shrink(frame: Frame) -> None:
    write_exr(frame.exr, {name: plane[::2] for name, plane in read_exr(frame.exr).items()})


def _remove_mask(frame: Frame) -> None:
    frame.exr.unlink()
    frame.alpha_png.unlink()
    write_png(frame.png, np.ascontiguousarray(read_png(frame.png)[..., :3]))


def _shrink_mask(frame: Frame) -> None:
    mask = read_png(frame.alpha_png)[..., 0]
    _remove_mask(frame)
    write_png(frame.alpha_png, np.ascontiguousarray(mask[::2]))


def _remove_images(frame: Frame) -> None:
    for path in frame.files:
        path.unlink()


BAD_VIEWS: dict[str, tuple[Callable[[Frame], object], str]] = {
    "no image": (_remove_images, "no such file"),
    "a truncated EXR": (lambda frame: _truncate(frame.exr), "truncated"),
    "an EXR of the wrong size": (_shrink, "32×16"),
    "an EXR without color": (lambda frame: edit_exr(frame.exr, lambda channels: channels.pop("G")), "channels"),
    "an EXR without a mask": (lambda frame: edit_exr(frame.exr, lambda channels: channels.pop("A")), "a mask"),
    "an RGB picture without a mask": (_remove_mask, "a mask"),
    "a mask of the wrong size": (_shrink_mask, "32×16"),
    "NaN in the color": (_set_nan("R"), "1 NaN"),
    "NaN in the mask": (_set_nan("A"), "1 NaN"),
    "NaN in the normals": (_set_nan("normal.Y"), "1 NaN"),
    "NaN in the depth": (_set_nan("depth.Z"), "1 NaN"),
}


@pytest.mark.parametrize(("damage", "word"), BAD_VIEWS.values(), ids=BAD_VIEWS.keys())
def test_bad_images_are_refused_on_reading(damaged_dataset: Path, damage: Callable[[Frame], object], word: str) -> None:
    frame = open_dataset(damaged_dataset).train[0]
    damage(frame)
    with pytest.raises(InputError) as caught:
        read_view(frame)
    _assert_teaches(caught.value, word)
