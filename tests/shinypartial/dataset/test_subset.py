"""Partial Shiny Blender: what is kept, how it is split, that other readers load it, and that nothing is lost."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shinypartial.cli import main
from shinypartial.core.errors import InputError
from shinypartial.dataset import derived
from shinypartial.dataset.camera_plot import CAMERA_PLOT
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import CHECKSUMS, LICENSES, MANIFEST, SPLITS, Dataset
from shinypartial.dataset.subset import SubsetOptions, make_subset, select, train_count
from shinypartial.io.files import PARTIAL_PREFIX, read_json, sha256_of, write_json
from tests.support.shiny_blender import make_shiny_blender_dataset

COMPANIONS = (".png", "_normal.png", "_alpha.png", "_disp.tiff")
TURNED_DEG = 70.0


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Sixty views all around, crossing at azimuth 70°; tests only read it."""
    return make_shiny_blender_dataset(tmp_path_factory.mktemp("shiny") / "ball", 60, turned_deg=TURNED_DEG)


@pytest.fixture
def copied(source: Dataset, tmp_path: Path) -> Path:
    """A copy for a test to change."""
    return Path(shutil.copytree(source.root, tmp_path / "ball"))


def angle_deg(position: np.ndarray, azimuth_deg: float, elevation_deg: float = 0.0) -> float:
    """Between the direction of a position from the origin and a direction given by angles."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    axis = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    return float(np.degrees(np.arccos(np.clip(position @ axis / np.linalg.norm(position), -1, 1))))


def poses(root: Path) -> dict[str, tuple]:
    """The transform of every frame of a folder, as stored."""
    return {
        entry["file_path"]: tuple(np.ravel(entry["transform_matrix"]))
        for split in SPLITS
        for entry in read_json(root / f"transforms_{split}.json", "cameras")["frames"]
    }


def test_the_crossing_is_found_in_the_layout_of_shiny_blender(source: Dataset) -> None:
    selection = select(source, SubsetOptions())
    # Two splits of 60 views are coarse: the test path has steps of 25°; measured 0.1°.
    assert angle_deg(selection.axis, TURNED_DEG) < 1
    np.testing.assert_allclose(selection.center, 0, atol=1e-9)


@given(
    azimuth=st.floats(-180, 180),
    elevation=st.floats(-90, 90),
    radius=st.floats(40, 90),
    seed=st.integers(0, 2**31 - 1),
)
def test_exactly_the_cameras_within_the_radius_are_kept(
    source: Dataset, azimuth: float, elevation: float, radius: float, seed: int
) -> None:
    try:
        selection = select(source, SubsetOptions((azimuth, elevation), radius, seed))
    except InputError:
        selection = None
    every = (*source.train, *source.test)
    within = {frame.name for frame in every if angle_deg(frame.camera.position_world, azimuth, elevation) < radius}
    if selection is None:
        assert len(within) < 2
        return
    train, test, dropped = (
        {frame.name for frame in frames} for frames in (selection.train, selection.test, selection.dropped)
    )
    assert train | test == within
    assert not train & test
    assert dropped == {frame.name for frame in every} - within
    assert len(train) == train_count(len(within))
    assert all((frame.camera.position_world @ selection.axis) > 0 for frame in (*selection.train, *selection.test))


@given(kept=st.integers(2, 10_000))
def test_forty_percent_to_the_nearest_view_are_for_training(kept: int) -> None:
    assert abs(train_count(kept) - 0.4 * kept) <= 0.5
    assert 0 < train_count(kept) < kept


def test_splits_are_those_of_their_seeds(source: Dataset) -> None:
    splits = [tuple(frame.name for frame in select(source, SubsetOptions(seed=seed)).train) for seed in range(8)]
    assert splits == [
        tuple(frame.name for frame in select(source, SubsetOptions(seed=seed)).train) for seed in range(8)
    ]
    assert len(set(splits)) == 8


def test_the_new_folder_has_the_layout_of_the_old_one(source: Dataset, tmp_path: Path) -> None:
    made = make_subset(source.root, tmp_path / "partial", SubsetOptions(seed=3))
    manifest = read_json(made.root / MANIFEST, "the manifest")
    kept = manifest["statistics"]["kept"]
    assert len(kept["train"]) + len(kept["test"]) + len(manifest["statistics"]["dropped"]) == 60
    assert manifest["statistics"]["dropped"]
    before, after = poses(source.root), poses(made.root)
    for split in SPLITS:
        transforms = read_json(made.root / f"transforms_{split}.json", "cameras")
        old = read_json(source.root / "transforms_test.json", "cameras")
        assert {**transforms, "frames": None} == {**old, "frames": None}
        assert [entry["file_path"] for entry in transforms["frames"]] == [
            f"./{split}/r_{i}" for i in range(len(kept[split]))
        ]
        for i, name in enumerate(kept[split]):
            assert after[f"./{split}/r_{i}"] == before[f"./{name}"]
            for end in COMPANIONS:
                assert sha256_of(made.root / split / f"r_{i}{end}") == sha256_of(source.root / f"{name}{end}")
    images = [path for path in made.root.rglob("r_*")]
    assert len(images) == 4 * (len(kept["train"]) + len(kept["test"])), "Nothing else is copied."
    assert (made.root / CAMERA_PLOT).stat().st_size < 150_000
    listed = [line.split("  ")[1] for line in (made.root / CHECKSUMS).read_text().splitlines()]
    assert set(listed) == {p.relative_to(made.root).as_posix() for p in made.root.rglob("*") if p.is_file()} - {
        CHECKSUMS
    }


def test_readers_open_the_subset(source: Dataset, tmp_path: Path) -> None:
    made = make_subset(source.root, tmp_path / "partial", SubsetOptions())
    dataset = open_dataset(made.root)
    assert (len(dataset.train), len(dataset.test)) == (len(made.selection.train), len(made.selection.test))
    for ours, theirs in zip(
        (*dataset.train, *dataset.test), (*made.selection.train, *made.selection.test), strict=True
    ):
        np.testing.assert_array_equal(ours.camera.camera_to_world, theirs.camera.camera_to_world)
        new, old = read_view(ours), read_view(theirs)
        np.testing.assert_array_equal(new.radiance, old.radiance)
        np.testing.assert_array_equal(new.normals_world, old.normals_world)


def test_a_fit_reads_the_subset(source: Dataset, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from panoless.capture.views import load_views
    from panoless.reconstruct.fit import fit
    from tests.support.mirror_sphere import tiny_config

    made = make_subset(source.root, tmp_path / "partial", SubsetOptions())
    dataset = open_dataset(made.root)
    views = load_views(dataset, 2)
    assert len(views.train) == len(made.selection.train)
    # The unit sphere at the origin, with a tenth to spare; 16 pixels are coarse.
    np.testing.assert_allclose(views.object_frame.center, 0, atol=0.05)
    assert 1.0 < views.object_frame.radius < 1.3
    assert fit(dataset, tiny_config(iterations=10, count=100), tmp_path / "run").iteration == 10


def test_a_training_split_in_no_order_does_not_hide_the_crossing(copied: Path) -> None:
    path = copied / "transforms_train.json"
    transforms = read_json(path, "cameras")
    order = np.random.default_rng(0).permutation(len(transforms["frames"]))
    write_json(path, {**transforms, "frames": [transforms["frames"][i] for i in order]})
    assert angle_deg(select(open_dataset(copied), SubsetOptions()).axis, TURNED_DEG) < 1


def keep_frames(root: Path, chosen: slice) -> None:
    """Leave out the other frames of both splits."""
    for split in SPLITS:
        transforms = read_json(root / f"transforms_{split}.json", "cameras")
        write_json(root / f"transforms_{split}.json", {**transforms, "frames": transforms["frames"][chosen]})


def test_a_path_without_a_crossing_is_refused_with_a_way_out(copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keep_frames(copied, slice(0, 8))
    output = copied.parent / "partial"
    assert main(["subset", str(copied), "--output", str(output)]) == 2
    err = capsys.readouterr().err
    assert "--around AZIMUTH ELEVATION" in err
    assert "0 crossings in test" in err
    assert not output.exists()
    assert main(["subset", str(copied), "--output", str(output), "--around", "-110", "-10"]) == 0
    assert "Around azimuth -110.0° elevation -10.0°" in capsys.readouterr().out


BAD_OPTIONS = {
    "no radius": (SubsetOptions(radius_deg=0.0), "radius-deg"),
    "more than a hemisphere": (SubsetOptions(radius_deg=90.5), "radius-deg"),
    "NaN": (SubsetOptions(radius_deg=float("nan")), "radius-deg"),
    "beyond the pole": (SubsetOptions(around=(0.0, 91.0)), "around"),
    "infinite": (SubsetOptions(around=(float("inf"), 0.0)), "around"),
    "negative seed": (SubsetOptions(seed=-1), "seed"),
    "nothing near": (SubsetOptions(around=(0.0, 90.0), radius_deg=1.0), "Raise --radius-deg"),
}


@pytest.mark.parametrize(("options", "named"), BAD_OPTIONS.values(), ids=BAD_OPTIONS.keys())
def test_bad_options_are_refused(source: Dataset, options: SubsetOptions, named: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=named):
        make_subset(source.root, tmp_path / "partial", options)
    assert not (tmp_path / "partial").exists()


def test_a_missing_image_is_refused_before_anything_is_written(copied: Path, tmp_path: Path) -> None:
    name = select(open_dataset(copied), SubsetOptions()).train[3].name
    (copied / f"{name}.png").unlink()
    with pytest.raises(InputError, match="no such file"):
        make_subset(copied, tmp_path / "partial", SubsetOptions())
    assert not (tmp_path / "partial").exists()


@pytest.mark.parametrize("licenses", [{"license": "CC0-1.0"}, ["CC0-1.0"], None])
def test_licenses_that_are_no_rows_are_refused(copied: Path, tmp_path: Path, licenses: object) -> None:
    write_json(copied / LICENSES, licenses)
    with pytest.raises(InputError, match="a row for each asset"):
        make_subset(copied, tmp_path / "partial", SubsetOptions())
    assert not (tmp_path / "partial").exists()


def test_splits_of_different_cameras_are_not_pooled(copied: Path, tmp_path: Path) -> None:
    path = copied / "transforms_test.json"
    write_json(path, read_json(path, "cameras") | {"camera_angle_x": 1.0})
    with pytest.raises(InputError, match="camera_angle_x"):
        make_subset(copied, tmp_path / "partial", SubsetOptions())


@pytest.mark.parametrize("place", [".", "partial"])
def test_the_source_is_never_written_to(copied: Path, place: str) -> None:
    with pytest.raises(InputError, match="apart from the source"):
        make_subset(copied, copied / place, SubsetOptions())


def test_a_folder_that_belongs_to_something_else_is_refused(source: Dataset, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="not a dataset"):
        make_subset(source.root, tmp_path, SubsetOptions())
    root = make_subset(source.root, tmp_path / "partial", SubsetOptions()).root
    for other in (SubsetOptions(seed=1), SubsetOptions(radius_deg=60.0), SubsetOptions(around=(70.0, 0.0))):
        with pytest.raises(InputError, match="another recipe"):
            make_subset(source.root, root, other)


def test_a_finished_subset_is_left_alone_and_a_deleted_file_is_copied_again(source: Dataset, tmp_path: Path) -> None:
    root = make_subset(source.root, tmp_path / "partial", SubsetOptions()).root
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    assert make_subset(source.root, root, SubsetOptions()).copied == 0
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before
    checksums = (root / CHECKSUMS).read_text()
    (root / "train/r_1_disp.tiff").unlink()
    assert make_subset(source.root, root, SubsetOptions()).copied == 1
    assert (root / CHECKSUMS).read_text() == checksums


@pytest.mark.parametrize("name", ["transforms_train.json", CAMERA_PLOT, LICENSES])
def test_a_deleted_file_that_is_no_copy_is_made_again(source: Dataset, tmp_path: Path, name: str) -> None:
    root = make_subset(source.root, tmp_path / "partial", SubsetOptions()).root
    checksums = (root / CHECKSUMS).read_text()
    (root / name).unlink()
    make_subset(source.root, root, SubsetOptions())
    assert (root / name).exists()
    assert (root / CHECKSUMS).read_text() == checksums


@pytest.mark.parametrize("link", [False, True])
def test_a_run_that_was_stopped_continues(
    source: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, link: bool
) -> None:
    place, placed = derived.copy_or_link, []

    def stop_early(old: Path, new: Path, link: bool) -> None:
        if len(placed) == 9:
            (new.parent / f"{PARTIAL_PREFIX}left.png").write_bytes(b"half")
            raise KeyboardInterrupt
        placed.append(new)
        place(old, new, link)

    root = tmp_path / "partial"
    monkeypatch.setattr(derived, "copy_or_link", stop_early)
    with pytest.raises(KeyboardInterrupt):
        make_subset(source.root, root, SubsetOptions(), link=link)
    with pytest.raises(InputError, match="not ended"):
        open_dataset(root)
    monkeypatch.setattr(derived, "copy_or_link", place)
    made = make_subset(source.root, root, SubsetOptions(), link=link)
    kept = len(made.selection.train) + len(made.selection.test)
    assert made.copied == 4 * kept - 9
    assert list(root.rglob(f"{PARTIAL_PREFIX}*")) == []
    assert len(open_dataset(root).train) == len(made.selection.train)


def test_links_share_their_content_with_the_source(source: Dataset, tmp_path: Path) -> None:
    made = make_subset(source.root, tmp_path / "partial", SubsetOptions(), link=True)
    for i, frame in enumerate(made.selection.train):
        assert os.path.samefile(made.root / f"train/r_{i}.png", frame.png)
    copies = make_subset(source.root, tmp_path / "copies", SubsetOptions())
    assert not os.path.samefile(copies.root / "train/r_0.png", made.root / "train/r_0.png")


def test_the_command_says_what_it_kept(source: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "partial"
    assert main(["subset", str(source.root), "--output", str(root), "--radius-deg", "60", "--seed", "5"]) == 0
    out = capsys.readouterr().out
    manifest = json.loads((root / MANIFEST).read_text())
    assert f"{manifest['statistics']['train']} training and {manifest['statistics']['test']} test views" in out
    assert manifest["recipe"]["radius_deg"] == 60
    assert manifest["recipe"]["seed"] == 5
    selection = select(source, replace(SubsetOptions(), radius_deg=60.0, seed=5))
    assert [frame.name for frame in selection.train] == manifest["statistics"]["kept"]["train"]
