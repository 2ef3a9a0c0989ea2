"""The layout of Shiny Blender: sound folders keep its promises, each broken one is named, quirks are lawful."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from shinypartial.cli import main
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import SPLITS, Dataset
from shinypartial.dataset.subset import SubsetOptions, make_subset
from shinypartial.dataset.validate import unscored, validate
from shinypartial.dataset.violations import Violation
from shinypartial.io.files import write_json
from shinypartial.io.images import read_png, write_png
from shinypartial.oracle.baseline import make_oracle
from shinypartial.release.release import release
from tests.shinypartial.dataset.test_validate import edit_json, renew_checksums
from tests.support.shiny_blender import make_shiny_blender_dataset

Damage = Callable[[Path], object]
TRAIN = "transforms_train.json"
VIEW = "train/r_0"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """All around, in the original layout; tests only read it."""
    return make_shiny_blender_dataset(tmp_path_factory.mktemp("shiny") / "ball", 30, 24)


@pytest.fixture(scope="module")
def subset(source: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its subset with a manifest; tests only read it, too."""
    return make_subset(source.root, tmp_path_factory.mktemp("subsets") / "partial", SubsetOptions()).root


@pytest.fixture(params=["original", "subset"])
def folder(request: pytest.FixtureRequest, source: Dataset, subset: Path, tmp_path: Path) -> Path:
    """A folder to change: a copy of the original, or of its subset."""
    original = request.param == "original"
    return Path(shutil.copytree(source.root if original else subset, tmp_path / ("ball" if original else "partial")))


def checked(folder: Path) -> list[Violation]:
    """What is wrong beside the checksums of files that a test has changed."""
    if (folder / "dataset.json").exists():
        renew_checksums(folder)
    return validate(folder)


def edit_png(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    return lambda root: write_png(root / name, np.ascontiguousarray(np.squeeze(change(read_png(root / name).copy()))))


def edit_pose(change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    def damage(content: dict) -> None:
        entry = content["frames"][0]
        entry["transform_matrix"] = change(np.array(entry["transform_matrix"])).tolist()

    return edit_json(TRAIN, damage)


def write_disparity(change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    """Another disparity of the first view, float32, with one channel or several, as tifffile writes it."""

    def damage(root: Path) -> None:
        import tifffile

        with Image.open(root / f"{VIEW}_disp.tiff") as stored:
            values = change(np.array(stored))
        tifffile.imwrite(root / f"{VIEW}_disp.tiff", values, photometric="rgb" if values.ndim == 3 else "minisblack")

    return damage


def remove_all(pattern: str) -> Damage:
    return lambda root: [path.unlink() for path in root.glob(pattern)]


def compress(root: Path) -> None:
    path = root / f"{VIEW}_disp.tiff"
    with Image.open(path) as stored:
        values = stored.copy()
    values.save(path, compression="tiff_lzw")


def add_empty_alpha(picture: np.ndarray) -> np.ndarray:
    """Some writers store normals as RGBA."""
    return np.concatenate([picture, np.full_like(picture[..., :1], 255)], -1)


QUIRKS: dict[str, Damage] = {
    "disparity of three channels": write_disparity(lambda d: np.stack([d] * 3, -1)),
    "disparity of half floats": write_disparity(lambda d: d.astype(np.float16)),
    "disparity of 8 bits": write_disparity(lambda d: (255 * d).astype(np.uint8)),
    "disparity compressed": compress,
    "disparity infinite off the object": write_disparity(lambda d: np.where(d == 0, np.float32(np.inf), d)),
    "no disparity": remove_all("*/*_disp.tiff"),
    "one disparity missing": remove_all("train/r_0_disp.tiff"),
    "no alpha pictures": remove_all("*/*_alpha.png"),
    "alpha of three channels": edit_png(f"{VIEW}_alpha.png", lambda p: np.repeat(p, 3, 2)),
    "normals with alpha": edit_png(f"{VIEW}_normal.png", add_empty_alpha),
    "no normals": remove_all("*/*_normal.png"),
    "normals of the test views alone": remove_all("train/*_normal.png"),
    "normals black off the object": edit_png(
        f"{VIEW}_normal.png", lambda p: np.where((p == p[0, 0]).all(-1, keepdims=True), np.uint8(0), p)
    ),
    "other files": lambda root: (root / ".DS_Store").write_bytes(b"\0"),
    "paths with extension": edit_json(
        TRAIN, lambda t: [e.update(file_path=e["file_path"] + ".png") for e in t["frames"]]
    ),
    "paths without dot": edit_json(TRAIN, lambda t: [e.update(file_path=e["file_path"][2:]) for e in t["frames"]]),
    "a pinhole by its name": lambda root: [
        edit_json(f"transforms_{split}.json", lambda t: t.update(camera_model="OPENCV", k1=0.0))(root)
        for split in SPLITS
    ],
    "another field in one split": edit_json(TRAIN, lambda t: t.update(aabb_scale=2)),
}


#: Every quirk once, with those that may stand beside it.
TOGETHER = (
    (
        "disparity of three channels",
        "alpha of three channels",
        "normals with alpha",
        "other files",
        "paths with extension",
        "a pinhole by its name",
        "another field in one split",
    ),
    ("disparity of half floats", "normals black off the object", "paths without dot"),
    ("disparity of 8 bits", "no alpha pictures", "normals of the test views alone"),
    ("disparity compressed", "no normals"),
    ("disparity infinite off the object",),
    ("no disparity",),
    ("one disparity missing",),
)


@pytest.mark.parametrize("quirk", QUIRKS.values(), ids=QUIRKS.keys())
def test_each_quirk_of_the_layout_is_lawful(source: Dataset, tmp_path: Path, quirk: Damage) -> None:
    original = Path(shutil.copytree(source.root, tmp_path / "ball"))
    quirk(original)
    assert validate(original) == []


@pytest.mark.parametrize("quirks", [(), *TOGETHER], ids=lambda names: (*names, "as it is")[0])
def test_quirks_are_lawful_together_and_in_a_subset(source: Dataset, tmp_path: Path, quirks: tuple[str, ...]) -> None:
    original = Path(shutil.copytree(source.root, tmp_path / "ball"))
    for name in quirks:
        QUIRKS[name](original)
    assert validate(original) == []
    made = make_subset(original, tmp_path / "partial", SubsetOptions())
    assert validate(made.root) == []
    for ours, theirs in zip(open_dataset(made.root).train, made.selection.train, strict=True):
        np.testing.assert_array_equal(read_view(ours).radiance, read_view(theirs).radiance)


def shrink(root: Path) -> None:
    """One view of another size, with all that belongs to it."""
    for end in (".png", "_alpha.png", "_normal.png"):
        edit_png(f"train/r_1{end}", lambda p: p[::2, ::2])(root)


DAMAGES: dict[str, tuple[Damage, str, str]] = {
    "no picture": (remove_all("train/r_1.png"), "train/r_1.png", "missing"),
    "half a picture": (
        lambda r: (r / f"{VIEW}.png").write_bytes((r / f"{VIEW}.png").read_bytes()[:90]),
        "train/r_0.png",
        "complete",
    ),
    "other size": (shrink, "train/r_1.png", "12×12"),
    "no mask": (
        lambda r: (edit_png(f"{VIEW}.png", lambda p: p[..., :3])(r), (r / f"{VIEW}_alpha.png").unlink()),
        "train/r_0.png",
        "mask",
    ),
    "empty mask": (
        lambda r: [edit_png(f"{VIEW}{end}", np.zeros_like)(r) for end in (".png", "_alpha.png")],
        "train/r_0.png",
        "empty",
    ),
    "other alpha": (edit_png(f"{VIEW}_alpha.png", lambda p: 255 - p), "train/r_0_alpha.png", "differ from the alpha"),
    "alpha of other size": (
        edit_png(f"{VIEW}_alpha.png", lambda p: p[1:]),
        "train/r_0_alpha.png",
        "pixels, other than",
    ),
    "short normals": (edit_png(f"{VIEW}_normal.png", lambda p: p // 2 + 64), "train/r_0_normal.png", "not unit"),
    "inward normals": (edit_png(f"{VIEW}_normal.png", lambda p: 255 - p), "train/r_0_normal.png", "face away"),
    "gray normals": (edit_png(f"{VIEW}_normal.png", lambda p: p[..., :1]), "train/r_0.png", "three channels"),
    "normals in part": (remove_all("train/r_1_normal.png"), "train", "have no normals, train/r_1"),
    "NaN disparity": (write_disparity(lambda d: np.where(d > 0, np.float32(np.nan), d)), "train/r_0_disp.tiff", "NaN"),
    "infinite disparity of three channels": (
        write_disparity(lambda d: np.stack([np.where(d > 0, np.float32(np.inf), d)] * 3, -1)),
        "train/r_0_disp.tiff",
        "infinite",
    ),
    "disparity of other size": (write_disparity(lambda d: d[1:]), "train/r_0_disp.tiff", "shape"),
    "half a disparity": (lambda r: (r / f"{VIEW}_disp.tiff").write_bytes(b"II*\0"), "train/r_0_disp.tiff", "TIFF"),
    "scaled pose": (edit_pose(lambda m: m * 2), TRAIN, "rigid"),
    "mirrored pose": (edit_pose(lambda m: m * np.array([-1.0, 1, 1, 1])), TRAIN, "rigid"),
    "no angle": (edit_json(TRAIN, lambda t: t.pop("camera_angle_x")), TRAIN, "camera_angle_x"),
    "angle in degrees": (edit_json(TRAIN, lambda t: t.update(camera_angle_x=40.0)), TRAIN, "radians"),
    "angle of text": (edit_json(TRAIN, lambda t: t.update(camera_angle_x="wide")), TRAIN, "camera_angle_x"),
    "distortion": (edit_json(TRAIN, lambda t: t.update(k1=0.1)), TRAIN, "distortion"),
    "another lens": (edit_json(TRAIN, lambda t: t.update(camera_model="EQUIRECTANGULAR")), TRAIN, "pinhole"),
    "no frames": (edit_json(TRAIN, lambda t: t.update(frames=[])), TRAIN, "frames"),
    "frame of text": (edit_json(TRAIN, lambda t: t["frames"].append("a")), TRAIN, "file_path"),
    "twice": (edit_json(TRAIN, lambda t: t["frames"].append(t["frames"][0])), TRAIN, "listed twice"),
}


@pytest.mark.parametrize(("damage", "file", "problem"), DAMAGES.values(), ids=DAMAGES.keys())
def test_damage_is_named_with_its_file_and_a_remedy(folder: Path, damage: Damage, file: str, problem: str) -> None:
    damage(folder)
    violations = [each for each in checked(folder) if not each.warning]
    assert any(each.file == file and re.search(problem, each.problem) for each in violations), violations
    assert all(each.remedy for each in violations)


def test_a_subset_keeps_the_promises_of_its_manifest(source: Dataset, tmp_path: Path) -> None:
    """Counts, the hemisphere, licenses and checksums."""
    root = make_subset(source.root, tmp_path / "partial", SubsetOptions()).root
    with (root / f"{VIEW}_disp.tiff").open("ab") as stream:
        stream.write(b"\0")
    (found,) = validate(root)
    assert found.file == f"{VIEW}_disp.tiff"
    assert "`shinypartial subset` that made the folder" in found.remedy
    edit_pose(lambda m: np.diag([-1.0, -1, 1, 1]) @ m)(root)
    edit_json("transforms_test.json", lambda t: t["frames"].pop())(root)
    (root / "LICENSES.json").unlink()
    problems = {each.file: each.problem for each in checked(root)}
    assert "hemisphere" in problems[TRAIN]
    assert "as dataset.json says" in problems["transforms_test.json"]
    assert "LICENSES.json" in problems


def test_one_line_says_what_is_absent(source: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = Path(shutil.copytree(source.root, tmp_path / "ball"))
    assert main(["validate", str(root)]) == 0
    *_, promise, line = capsys.readouterr().out.splitlines()
    assert promise == f"{root} keeps every promise of the format."
    assert line == "Plain layout without ground-truth environment: can't score environment and visibility."
    remove_all("train/*_normal.png")(root)
    assert "normals of the training views: can't score environment, visibility and coverage." in str(unscored(root))
    remove_all("test/*_normal.png")(root)
    assert str(unscored(root)).endswith("environment, visibility, coverage and normals.")
    (root / "transforms_test.json").unlink()
    assert validate(root) == []
    assert "test views: can't score" in str(unscored(root))


def test_a_rendered_dataset_lacks_nothing(sphere_dataset: Dataset) -> None:
    assert unscored(sphere_dataset.root) is None


def test_a_rendered_dataset_without_its_manifest_does_not_pass_as_plain(damaged_dataset: Path) -> None:
    (damaged_dataset / "dataset.json").unlink()
    assert "dataset.json" in {each.file for each in validate(damaged_dataset)}


def test_the_plain_layout_is_not_released(folder: Path, tmp_path: Path) -> None:
    from shinypartial.release.publication import Publication

    with pytest.raises(InputError, match="plain layout"):
        release([folder], tmp_path / "release", Publication("name", "1.0.0", "2024-01-01", "someone", None))
    assert not (tmp_path / "release").exists()


def test_the_bound_of_a_plain_dataset_is_made_without_depth(source: Dataset, tmp_path: Path) -> None:
    made = make_oracle(source.root, tmp_path / "oracle")
    assert made.chosen.psnr_linear is None
    assert len(list((made.root / "test").glob("*.exr"))) == len(source.test)


def test_normals_of_some_views_are_left_out_of_a_pooled_split(
    source: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The source has normals in its test views alone; pooled with the others they would be of no use."""
    root = Path(shutil.copytree(source.root, tmp_path / "ball"))
    remove_all("train/*_normal.png")(root)
    assert main(["subset", str(root), "--output", str(tmp_path / "partial")]) == 0
    out = capsys.readouterr().out
    assert "No normals in train" in out
    assert "No normals in test" in out
    assert not list((tmp_path / "partial").rglob("*_normal.png"))
    assert validate(tmp_path / "partial") == []


def test_splits_of_different_size_are_not_pooled(source: Dataset, tmp_path: Path) -> None:
    """Without w and h the size is that of the pictures, and one angle doesn't make one camera."""
    root = Path(shutil.copytree(source.root, tmp_path / "ball"))
    for path in (root / "test").glob("*.png"):
        write_png(path, np.squeeze(read_png(path)[::2, ::2]))
    with pytest.raises(InputError, match=r"24×24 pixels .* in train, 12×12 pixels .* in test"):
        make_subset(root, tmp_path / "partial", SubsetOptions())


def test_views_of_one_name_in_several_folders_keep_their_poses(source: Dataset, tmp_path: Path) -> None:
    """Frames are distinguished by where their image lies, not by its name alone."""
    root = Path(shutil.copytree(source.root, tmp_path / "ball"))
    for split in SPLITS:
        content = json.loads((root / f"transforms_{split}.json").read_text())
        for i, entry in enumerate(content["frames"]):
            old, new = root / split, root / split / f"camera{i}"
            new.mkdir()
            for path in old.glob(f"r_{i}[._]*"):
                path.rename(new / path.name.replace(f"r_{i}", "view", 1))
            entry["file_path"] = f"./{split}/camera{i}/view"
        write_json(root / f"transforms_{split}.json", content)
    made = make_subset(root, tmp_path / "partial", SubsetOptions())
    for ours, theirs in zip(open_dataset(made.root).train, made.selection.train, strict=True):
        np.testing.assert_array_equal(ours.camera.camera_to_world, theirs.camera.camera_to_world)
        np.testing.assert_array_equal(read_view(ours).alpha, read_view(theirs).alpha)
