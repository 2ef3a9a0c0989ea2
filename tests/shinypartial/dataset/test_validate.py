"""Each promise of the format is broken in turn on a small dataset; validation names the file and a remedy."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import CHECKSUMS, Dataset, Frame
from shinypartial.dataset.validate import validate
from shinypartial.dataset.write import write_inverse_distance
from shinypartial.io.files import sha256_of
from shinypartial.io.images import read_exr, read_exr_rgb, read_png, write_exr, write_exr_rgb, write_png
from tests.support.synthetic_dataset import MAP_HEIGHT

EXR = "train/r_000.exr"
MAP_SHAPE = (MAP_HEIGHT, 2 * MAP_HEIGHT)


def renew_checksums(root: Path) -> None:
    """List the files as they are now, so that only the damage itself is left to find."""
    files = sorted(path for path in root.rglob("*") if path.is_file() and path.name != CHECKSUMS)
    lines = [f"{sha256_of(path)}  {path.relative_to(root).as_posix()}\n" for path in files]
    (root / CHECKSUMS).write_text("".join(lines), encoding="utf-8")


def edit_json(name: str, change: Callable[[Any], object]) -> Callable[[Path], None]:
    """Damage that changes a JSON file in place."""

    def damage(root: Path) -> None:
        content = json.loads((root / name).read_text(encoding="utf-8"))
        change(content)
        (root / name).write_text(json.dumps(content), encoding="utf-8")

    return damage


def edit_frame(change: Callable[[dict[str, np.ndarray]], object]) -> Callable[[Path], None]:
    """Damage that changes the channels of the first training view."""

    def damage(root: Path) -> None:
        channels = read_exr(root / EXR)
        change(channels)
        write_exr(root / EXR, channels)

    return damage


def set_pixels(name: str, inside: bool, value: float) -> Callable[[Path], None]:
    """Damage that sets a channel on the object, or off it."""
    return edit_frame(lambda c: np.putmask(c[name], (c["A"] > 0) == inside, value))


def edit_png(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Damage that rewrites a PNG."""
    return lambda root: write_png(root / name, np.squeeze(change(read_png(root / name).copy())))


def edit_map(name: str, change: Callable[[np.ndarray], np.ndarray], tag: bool = False) -> Callable[[Path], None]:
    """Damage that rewrites an environment map."""

    def damage(root: Path) -> None:
        path = root / "environment" / name
        write_exr_rgb(path, np.ascontiguousarray(change(read_exr_rgb(path))), y_up_environment=tag)

    return damage


def truncate(name: str) -> Callable[[Path], None]:
    """Damage that leaves half a file."""
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[: (root / name).stat().st_size // 2])


def remove(name: str) -> Callable[[Path], None]:
    """Damage that deletes a file."""
    return lambda root: (root / name).unlink()


def first(content: Any) -> Any:
    """The first frame of a transforms file."""
    return content["frames"][0]


def add_self_reflection(value: float) -> Callable[[Path], None]:
    """A view that has the mask, though the format of its dataset does not require it, with one value everywhere."""
    return edit_frame(lambda c: c.update({"self_reflection.V": np.full_like(c["A"], value)}))


def add_inverse_distance(inverse_distance: np.ndarray) -> Callable[[Path], None]:
    """A map that says how far the surroundings are, in a dataset that doesn't say how large its object is."""
    return lambda root: write_inverse_distance(root, inverse_distance)


def turn_inside_out(channels: dict[str, np.ndarray]) -> None:
    """Normals that point away from the camera."""
    for axis in "XYZ":
        channels[f"normal.{axis}"] *= -1


def crop(root: Path) -> None:
    """An EXR of another size than the transforms say."""
    write_exr(root / EXR, {name: plane[:-1] for name, plane in read_exr(root / EXR).items()})


def half_normals(channels: dict[str, np.ndarray]) -> None:
    """Normals in half precision."""
    channels["normal.X"] = channels["normal.X"].astype(np.float16)


INVERSE_DISTANCE = "environment/inverse_distance.exr"
TRAIN = "transforms_train.json"
DAMAGES = {
    "no self-reflection": (
        edit_json("dataset.json", lambda m: m.update(format_minor=1)),
        "train/r_000_self.png",
        "missing",
    ),
    "self-reflection in part": (add_self_reflection(0.5), EXR, "neither 0 nor 1"),
    "self-reflection of the background": (add_self_reflection(1.0), EXR, "self-reflection where alpha"),
    "no manifest": (remove("dataset.json"), "dataset.json", "no such file"),
    "broken manifest": (truncate("dataset.json"), "dataset.json", "JSON"),
    "manifest of a list": (lambda r: (r / "dataset.json").write_text("[]"), "dataset.json", "table"),
    "other version": (edit_json("dataset.json", lambda m: m.update(format_version=9)), "dataset.json", "version 9"),
    "incomplete": (edit_json("dataset.json", lambda m: m.update(complete=False)), "dataset.json", "not complete"),
    "no recipe": (edit_json("dataset.json", lambda m: m.pop("recipe")), "dataset.json", "recipe"),
    "no generator": (edit_json("dataset.json", lambda m: m.pop("generator")), "dataset.json", "generator"),
    "counts": (edit_json("dataset.json", lambda m: m.update(statistics={"train": 7})), TRAIN, "expected 7 frames"),
    "statistics": (edit_json("dataset.json", lambda m: m.update(statistics=[3])), "dataset.json", "statistics"),
    "no transforms": (remove(TRAIN), TRAIN, "no such file"),
    "no frames": (edit_json(TRAIN, lambda t: t.update(frames=[])), TRAIN, "frames"),
    "frames of text": (edit_json(TRAIN, lambda t: t.update(frames=["a"])), TRAIN, "file_path"),
    "angle": (edit_json(TRAIN, lambda t: t.update(camera_angle_x=0.5)), TRAIN, "camera_angle_x"),
    "no focal length": (edit_json(TRAIN, lambda t: t.pop("fl_x")), TRAIN, "fl_x"),
    "width of text": (edit_json(TRAIN, lambda t: t.update(w="32")), TRAIN, "`w`"),
    "fractional width": (edit_json(TRAIN, lambda t: t.update(w=32.5)), TRAIN, "`w`"),
    "principal point": (edit_json(TRAIN, lambda t: t.update(cx=99)), TRAIN, "principal point"),
    "extension": (edit_json(TRAIN, lambda t: first(t).update(file_path="./train/r_000.png")), TRAIN, "extension"),
    "outside": (edit_json(TRAIN, lambda t: first(t).update(file_path="../r_000")), TRAIN, "extension"),
    "twice": (edit_json(TRAIN, lambda t: t["frames"].append(first(t))), TRAIN, "listed twice"),
    "scaled pose": (edit_json(TRAIN, lambda t: first(t)["transform_matrix"][0].reverse()), TRAIN, "rigid"),
    "no pose": (edit_json(TRAIN, lambda t: first(t).pop("transform_matrix")), TRAIN, "4×4"),
    "pose of text": (edit_json(TRAIN, lambda t: first(t).update(transform_matrix=["a"])), TRAIN, "4×4"),
    "hemisphere": (
        edit_json("dataset.json", lambda m: m["recipe"].update(hemisphere_axis=[-1, 0, 0])),
        TRAIN,
        "hemisphere",
    ),
    "axis of text": (
        edit_json("dataset.json", lambda m: m["recipe"].update(hemisphere_axis="up")),
        TRAIN,
        "hemisphere",
    ),
    "no EXR": (remove(EXR), EXR, "missing"),
    "no normals": (remove("train/r_000_normal.png"), "train/r_000_normal.png", "missing"),
    "truncated EXR": (truncate(EXR), EXR, "damaged"),
    "truncated PNG": (truncate("train/r_000.png"), "train/r_000.png", "complete image"),
    "size": (crop, EXR, "expected 32×32"),
    "channel": (edit_frame(lambda c: c.pop("depth.Z")), EXR, "expected the channels"),
    "type": (edit_frame(half_normals), EXR, "normal.X as float32"),
    "NaN": (set_pixels("R", True, np.nan), EXR, "NaN"),
    "infinite depth": (set_pixels("depth.Z", False, np.inf), EXR, "NaN or infinite"),
    "alpha": (edit_frame(lambda c: np.putmask(c["A"], c["A"] == 1, 1.5)), EXR, r"alpha outside"),
    "negative light": (set_pixels("G", True, -0.5), EXR, "below zero"),
    "background light": (set_pixels("G", False, 0.5), EXR, "radiance where alpha is zero"),
    "empty mask": (edit_frame(lambda c: [plane.fill(0) for plane in c.values()]), EXR, "empty"),
    "short normals": (set_pixels("normal.X", True, 0.0), EXR, "not unit"),
    "background normals": (set_pixels("normal.X", False, 1.0), EXR, "not zero"),
    "inside out": (edit_frame(turn_inside_out), EXR, "face away"),
    "depth": (set_pixels("depth.Z", True, -3.0), EXR, "not positive"),
    "background depth": (set_pixels("depth.Z", False, 3.0), EXR, "depths that are not zero"),
    "picture": (edit_png("train/r_000.png", lambda p: p // 2), "train/r_000.png", "differ from the EXR"),
    "picture's alpha": (
        edit_png("train/r_000.png", lambda p: p | np.array([0, 0, 0, 255], np.uint8)),
        "train/r_000.png",
        "differ",
    ),
    "alpha picture": (edit_png("train/r_000_alpha.png", lambda p: 255 - p), "train/r_000_alpha.png", "differ"),
    "normal picture": (edit_png("train/r_000_normal.png", lambda p: p[..., ::-1]), "train/r_000_normal.png", "differ"),
    "picture of other kind": (edit_png("train/r_000.png", lambda p: p[..., :3]), "train/r_000.png", "shape"),
    "no map": (remove("environment/latlong.exr"), "environment/latlong.exr", "no such file"),
    "square map": (edit_map("latlong.exr", lambda m: m[:, ::2]), "environment/latlong.exr", "twice as wide"),
    "tagged map": (edit_map("latlong.exr", lambda m: m, tag=True), "environment/latlong.exr", "envmap.*is set"),
    "untagged map": (edit_map("latlong_yup.exr", lambda m: m), "environment/latlong_yup.exr", "is missing"),
    "turned map": (
        edit_map("latlong_yup.exr", lambda m: np.roll(m, 8, 1), tag=True),
        "environment/latlong_yup.exr",
        "differ",
    ),
    "no face": (remove("environment/cube/px.exr"), "environment/cube/px.exr", "no such file"),
    "mirrored face": (edit_map("cube/ny.exr", lambda m: m[:, ::-1]), "environment/cube/ny.exr", "differ"),
    "small face": (edit_map("cube/pz.exr", lambda m: m[::2, ::2]), "environment/cube/pz.exr", "texels"),
    "no object radius": (add_inverse_distance(np.ones(MAP_SHAPE)), "dataset.json", "object_radius"),
    "negative distance": (add_inverse_distance(np.full(MAP_SHAPE, -1.0)), INVERSE_DISTANCE, "values from -1 to -1"),
    "distance without end": (add_inverse_distance(np.full(MAP_SHAPE, np.inf)), INVERSE_DISTANCE, "to inf"),
    "small map of distance": (
        add_inverse_distance(np.ones((MAP_HEIGHT // 2, MAP_HEIGHT))),
        INVERSE_DISTANCE,
        f"{2 * MAP_HEIGHT}×{MAP_HEIGHT} texels",
    ),
    "near, but where": (
        edit_json("dataset.json", lambda m: (m.update(format_minor=2), m["recipe"].update(world={"distance": 5.0}))),
        INVERSE_DISTANCE,
        "missing",
    ),
    "no licenses": (remove("LICENSES.json"), "LICENSES.json", "no such file"),
    "empty licenses": (lambda r: (r / "LICENSES.json").write_text("[]"), "LICENSES.json", "row"),
    "license without source": (
        edit_json("LICENSES.json", lambda rows: rows[0].pop("source")),
        "LICENSES.json",
        "row 0",
    ),
}


def test_a_sound_dataset_breaks_nothing(sphere_dataset: Dataset) -> None:
    assert validate(sphere_dataset.root) == []


def test_cameras_may_stand_all_around_where_the_recipe_says_so(damaged_dataset: Path) -> None:
    """Half a turn about a line at right angles takes the first camera to the other side of the object."""

    def turn(content: Any) -> None:
        pose = np.array(first(content)["transform_matrix"])
        across = np.cross(pose[:3, 3], pose[:3, 0])
        across /= np.linalg.norm(across)
        pose[:3] = (2 * np.outer(across, across) - np.eye(3)) @ pose[:3]
        first(content)["transform_matrix"] = pose.tolist()

    def outside() -> list[str]:
        renew_checksums(damaged_dataset)
        return [str(each) for each in validate(damaged_dataset) if "hemisphere" in str(each)]

    edit_json(TRAIN, turn)(damaged_dataset)
    assert outside()
    edit_json("dataset.json", lambda m: m["recipe"].update(hemisphere_axis=None))(damaged_dataset)
    assert not outside()


@pytest.mark.parametrize(("damage", "file", "problem"), DAMAGES.values(), ids=DAMAGES.keys())
def test_damage_is_named_with_its_file_and_a_remedy(
    damaged_dataset: Path, damage: Callable[[Path], object], file: str, problem: str
) -> None:
    damage(damaged_dataset)
    renew_checksums(damaged_dataset)
    violations = validate(damaged_dataset)
    assert any(each.file == file and re.search(problem, each.problem) for each in violations), violations
    assert all(each.remedy and not each.warning for each in violations)


def every_file(root: Path) -> list[str]:
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())


def test_no_file_can_change_or_vanish_unseen(damaged_dataset: Path) -> None:
    """One flipped bit in any file, or its loss, is found through the checksums at least."""
    generator = np.random.default_rng(0)
    for name in every_file(damaged_dataset):
        path = damaged_dataset / name
        content = bytearray(path.read_bytes())
        content[generator.integers(len(content))] ^= 1
        before = path.read_bytes()
        path.write_bytes(content)
        files = {each.file for each in _checksum_breaks(damaged_dataset)}
        assert files, name
        path.unlink()
        assert name in {each.file for each in _checksum_breaks(damaged_dataset)}
        path.write_bytes(before)
    assert _checksum_breaks(damaged_dataset) == []


def _checksum_breaks(root: Path) -> list:
    from shinypartial.dataset.validate import _check_checksums

    return list(_check_checksums(root))


def test_a_file_that_does_not_belong_is_found(damaged_dataset: Path) -> None:
    (damaged_dataset / "train" / ".partial-left").write_bytes(b"")
    (found,) = validate(damaged_dataset)
    assert found.file == "train/.partial-left"
    assert "not listed" in found.problem


def test_an_object_at_the_border_is_a_warning(damaged_dataset: Path) -> None:
    channels = read_exr(damaged_dataset / EXR)
    width = channels["A"].shape[1]
    shifted = {name: np.roll(plane, width // 2, 1) for name, plane in channels.items()}
    facing = (shifted["A"] > 0).astype(np.float32)
    axis = open_dataset(damaged_dataset).train[0].camera.camera_to_world[:3, 2]
    shifted |= {f"normal.{name}": facing * np.float32(-axis[i]) for i, name in enumerate("XYZ")}
    _rewrite(open_dataset(damaged_dataset).train[0], shifted)
    renew_checksums(damaged_dataset)
    (found,) = validate(damaged_dataset)
    assert found.warning
    assert "border" in found.problem


def _rewrite(frame: Frame, channels: dict[str, np.ndarray]) -> None:
    from shinypartial.dataset.schema import View
    from shinypartial.dataset.write import write_view

    radiance, normals = (
        np.stack([channels[n] for n in names], -1).astype(np.float32)
        for names in ("RGB", ("normal.X", "normal.Y", "normal.Z"))
    )
    write_view(frame, View(radiance, channels["A"].astype(np.float32), normals, channels["depth.Z"], True))


def test_a_folder_that_is_not_there_is_the_users_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing there"):
        validate(tmp_path / "none")


def test_an_empty_folder_misses_everything(tmp_path: Path) -> None:
    files = {each.file for each in validate(tmp_path)}
    assert {"dataset.json", TRAIN, "transforms_test.json", "LICENSES.json", CHECKSUMS} <= files


def test_several_breaks_are_all_listed(damaged_dataset: Path) -> None:
    for name in ("train/r_000.png", "test/r_000.exr", "environment/cube/nz.exr"):
        truncate(name)(damaged_dataset)
    shutil.rmtree(damaged_dataset / "environment" / "cube", ignore_errors=False)
    files = {each.file for each in validate(damaged_dataset)}
    assert {"train/r_000.png", "test/r_000.exr", "environment/cube/nz.exr"} <= files


def test_the_tag_is_the_one_that_openexr_defines(sphere_dataset: Dataset) -> None:
    with OpenEXR.File(str(sphere_dataset.root / "environment/latlong_yup.exr"), header_only=True) as file:
        assert file.header()["envmap"] == OpenEXR.ENVMAP_LATLONG
