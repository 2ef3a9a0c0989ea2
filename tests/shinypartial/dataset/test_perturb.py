"""Worse copies as folders: what changes and what stays, resumption, refusal, and that readers and scores take them."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shinypartial.cli import main
from shinypartial.core.color import linear_to_srgb, srgb_to_linear
from shinypartial.core.errors import InputError
from shinypartial.dataset.perturb import worse_copy
from shinypartial.dataset.perturb.options import CameraErrors, MaskErrors, Perturbation, SensorErrors, ViewChoice, World
from shinypartial.dataset.perturb.worse_copy import perturb
from shinypartial.dataset.read import open_dataset, read_inverse_distance, read_view
from shinypartial.dataset.schema import CHECKSUMS, LICENSES, MANIFEST, Dataset
from shinypartial.dataset.validate import validate
from shinypartial.dataset.write import encode_unit, write_inverse_distance
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.io.files import read_json, sha256_of, write_json
from shinypartial.io.images import read_exr, read_png, write_exr, write_png
from tests.support.shiny_blender import make_shiny_blender_dataset
from tests.support.synthetic_dataset import MAP_HEIGHT, make_sphere_dataset
from tests.support.truth_prediction import write_truth_prediction

EVERYTHING = Perturbation(
    CameraErrors(1.0, 0.5, 0.01, 1.02, (1.0, 0.0)),
    MaskErrors(erode_px=0.5, dilate_px=1.0, offset_px=0.7, wobble_px=0.5, holes=0.1, stray=0.1, empty=0.2),
    SensorErrors(0.4, -0.05, False, 0.5, 0.2, 0.1, 0.02, 0.01, False, 90),
    ViewChoice(keep=4, object_scale=0.9, cut=0.1),
    World(random_turn=True),
    seed=7,
)


@pytest.fixture(scope="module")
def shiny(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A plain folder with normals, masks and disparities; tests only read it."""
    return make_shiny_blender_dataset(tmp_path_factory.mktemp("plain") / "ball", 18, resolution=24)


@pytest.fixture(params=["rendered", "plain"])
def source(request: pytest.FixtureRequest, sphere_dataset: Dataset, shiny: Dataset) -> Dataset:
    """Both layouts."""
    return sphere_dataset if request.param == "rendered" else shiny


def digests(root: Path, *, leave_out: tuple[str, ...] = ()) -> dict[str, str]:
    """The content of every file below a folder."""
    files = {path.relative_to(root).as_posix(): path for path in root.rglob("*") if path.is_file()}
    return {name: sha256_of(path) for name, path in files.items() if not name.startswith(leave_out)}


def test_without_options_every_file_is_that_of_the_source(source: Dataset, tmp_path: Path) -> None:
    perturb(source.root, tmp_path / "copy", Perturbation())
    own = (MANIFEST, CHECKSUMS, LICENSES)
    before, after = digests(source.root, leave_out=own), digests(tmp_path / "copy", leave_out=own)
    assert after.pop("transforms_train.json")
    assert after.items() == {k: v for k, v in before.items() if k != "transforms_train.json"}.items()
    stated = [read_json(root / "transforms_train.json", "cameras") for root in (source.root, tmp_path / "copy")]
    assert stated[0] == stated[1]


def test_only_the_training_split_is_made_worse(source: Dataset, tmp_path: Path) -> None:
    perturb(source.root, tmp_path / "copy", replace(EVERYTHING, world=World()))
    kept = ("transforms_train", "train/", MANIFEST, CHECKSUMS, LICENSES)
    assert digests(tmp_path / "copy", leave_out=kept) == digests(source.root, leave_out=kept)
    listed = [line.split("  ")[1] for line in (tmp_path / "copy" / CHECKSUMS).read_text().splitlines()]
    assert set(listed) == digests(tmp_path / "copy").keys() - {CHECKSUMS}


def test_the_manifest_says_what_was_done(sphere_dataset: Dataset, tmp_path: Path) -> None:
    options = Perturbation(
        CameraErrors(rotation_deg=2.0), MaskErrors(empty=0.5), SensorErrors(exposure_sigma_stops=0.3), seed=5
    )
    made = perturb(sphere_dataset.root, tmp_path / "copy", options)
    manifest = read_json(made.root / MANIFEST, "the manifest")
    recipe, drawn = manifest["recipe"], manifest["statistics"]["drawn"]
    assert recipe["options"] == {
        "cameras": {"rotation_deg": 2.0},
        "masks": {"empty": 0.5},
        "sensor": {"exposure_sigma_stops": 0.3},
    }
    assert recipe["seed"] == 5
    assert recipe["perturbation_of"][CHECKSUMS] == sha256_of(sphere_dataset.root / CHECKSUMS)
    assert [np.linalg.norm(drawn[frame.name]["rotation_deg"]) for frame in sphere_dataset.train] == pytest.approx(
        [2] * 6
    )
    empty = {name for name, each in drawn.items() if each.get("mask") == "empty"}
    assert len(empty) == 3
    for frame, before in zip(open_dataset(made.root).train, sphere_dataset.train, strict=True):
        view, truth = read_view(frame), read_view(before)
        assert (not view.alpha.any()) == (frame.name in empty)
        np.testing.assert_array_equal(view.normals_world, truth.normals_world)
        if frame.name not in empty:
            gain = 2.0 ** drawn[frame.name]["exposure_stops"]
            np.testing.assert_allclose(view.radiance, gain * truth.radiance, rtol=2e-3, atol=1e-4)


def test_the_seed_alone_decides_what_is_drawn(source: Dataset, tmp_path: Path) -> None:
    roots = [tmp_path / name for name in ("one", "two", "other")]
    for root, seed in zip(roots, (7, 7, 8), strict=True):
        perturb(source.root, root, replace(EVERYTHING, seed=seed))
    same, again, other = (digests(root) for root in roots)
    assert same == again
    pictures = [name for name in same if name.startswith("train/") and name.endswith((".jpg", "_alpha.png"))]
    assert sum(same[name] != other.get(name) for name in pictures) >= len(pictures) - 2  # Empty masks are alike.
    assert same["transforms_train.json"] != other["transforms_train.json"]


@pytest.mark.parametrize("writes", [1, 4, 7])
def test_a_killed_run_continues_to_the_same_folder(
    source: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writes: int
) -> None:
    perturb(source.root, tmp_path / "whole", EVERYTHING)
    root, frames, write = tmp_path / "killed", [], worse_copy._write_frame
    monkeypatch.setattr(worse_copy, "_write_frame", lambda *given: (write(*given), frames.append(given[1].index)))
    written = []

    def die(path: Path, image: np.ndarray) -> None:
        if len(written) == writes:
            raise KeyboardInterrupt
        written.append(path)
        write_png(path, image)

    with monkeypatch.context() as patch:
        patch.setattr(worse_copy, "write_png", die)
        with pytest.raises(KeyboardInterrupt):
            perturb(source.root, root, EVERYTHING)
    with pytest.raises(InputError, match="not ended"):
        open_dataset(root)
    perturb(source.root, root, EVERYTHING)
    assert digests(root) == digests(tmp_path / "whole")
    assert len(frames) == len(set(frames)) == 4, "No view is made twice."
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    assert perturb(source.root, root, EVERYTHING).written == 0
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before


def test_a_lost_file_is_made_again(sphere_dataset: Dataset, tmp_path: Path) -> None:
    perturb(sphere_dataset.root, tmp_path / "copy", EVERYTHING)
    before = digests(tmp_path / "copy")
    for name in ("train/r_002_alpha.png", "environment/cube/px.exr", "test/r_000.exr"):
        (tmp_path / "copy" / name).unlink()
    assert perturb(sphere_dataset.root, tmp_path / "copy", EVERYTHING).written > 0
    assert digests(tmp_path / "copy") == before


def test_links_share_what_stays_and_spare_the_source(sphere_dataset: Dataset, tmp_path: Path) -> None:
    before = digests(sphere_dataset.root)
    perturb(sphere_dataset.root, tmp_path / "copy", Perturbation(masks=MaskErrors(erode_px=1.0)), link=True)
    assert os.path.samefile(tmp_path / "copy/test/r_000.exr", sphere_dataset.root / "test/r_000.exr")
    assert os.path.samefile(tmp_path / "copy/train/r_000_normal.png", sphere_dataset.root / "train/r_000_normal.png")
    assert not os.path.samefile(tmp_path / "copy/train/r_000.exr", sphere_dataset.root / "train/r_000.exr")
    assert digests(sphere_dataset.root) == before


BAD_OPTIONS = {
    "a negative angle": (Perturbation(CameraErrors(rotation_deg=-1.0)), "--cameras.rotation-deg"),
    "not a number": (Perturbation(CameraErrors(position_sigma=float("nan"))), "--cameras.position-sigma"),
    "no focal length": (Perturbation(CameraErrors(focal_factor=0.0)), "--cameras.focal-factor"),
    "all of it holes": (Perturbation(masks=MaskErrors(holes=1.0)), "--masks.holes"),
    "a negative erosion": (Perturbation(masks=MaskErrors(erode_px=-1.0)), "--masks.erode-px"),
    "no such quality": (Perturbation(sensor=SensorErrors(jpeg_quality=0)), "--sensor.jpeg-quality"),
    "a fold": (Perturbation(sensor=SensorErrors(k1=-9.0)), "--sensor.k1"),
    "more views than there are": (Perturbation(views=ViewChoice(keep=7)), "--views.keep"),
    "a larger object": (Perturbation(views=ViewChoice(object_scale=1.5)), "--views.object-scale"),
    "nothing left": (Perturbation(views=ViewChoice(cut=1.0)), "--views.cut"),
    "an infinite turn": (Perturbation(world=World((0.0, float("inf"), 0.0))), "--world.turn-deg"),
    "a negative seed": (Perturbation(seed=-1), "--seed"),
}


@pytest.mark.parametrize(("options", "named"), BAD_OPTIONS.values(), ids=BAD_OPTIONS.keys())
def test_bad_values_are_refused_before_anything_is_written(
    source: Dataset, options: Perturbation, named: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=named):
        perturb(source.root, tmp_path / "copy", options)
    assert not (tmp_path / "copy").exists()


def test_missing_pictures_and_foreign_folders_are_refused(sphere_dataset: Dataset, tmp_path: Path) -> None:
    broken = Path(shutil.copytree(sphere_dataset.root, tmp_path / "broken"))
    for file in (broken / "train").glob("r_002.*"):
        file.unlink()
    with pytest.raises(InputError, match="no such file"):
        perturb(broken, tmp_path / "copy", Perturbation())
    assert not (tmp_path / "copy").exists()
    with pytest.raises(InputError, match="apart from the source"):
        perturb(sphere_dataset.root, sphere_dataset.root / "copy", Perturbation())
    perturb(sphere_dataset.root, tmp_path / "copy", Perturbation())
    with pytest.raises(InputError, match="another recipe"):
        perturb(sphere_dataset.root, tmp_path / "copy", Perturbation(seed=1))


@pytest.mark.parametrize("options", [Perturbation(), EVERYTHING], ids=["nothing", "everything"])
def test_copies_validate(source: Dataset, tmp_path: Path, options: Perturbation) -> None:
    perturb(source.root, tmp_path / "copy", options)
    assert [each for each in validate(tmp_path / "copy") if not each.warning] == []
    next((tmp_path / "copy/train").glob("r_*[0-9].*")).write_bytes(b"damaged")
    assert [each for each in validate(tmp_path / "copy") if not each.warning]


@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (0.0, 0.0, 90.0)], ids=["upright", "turned"])
def test_near_surroundings_keep_their_distance(
    damaged_dataset: Path, tmp_path: Path, turn_deg: tuple[float, float, float]
) -> None:
    """A quarter turn about +Z moves a map by a quarter of its columns, texel on texel."""
    inverse = (np.arange(2 * MAP_HEIGHT) / 100 + np.ones((MAP_HEIGHT, 1))).astype(np.float32)
    write_inverse_distance(damaged_dataset, inverse)
    manifest = read_json(damaged_dataset / MANIFEST, "the manifest")
    statistics = {"object_radius": 1.25, "board_corner": [0.5, 0.0, -1.0]}
    write_json(damaged_dataset / MANIFEST, manifest | {"statistics": statistics})
    copy = perturb(damaged_dataset, tmp_path / "copy", Perturbation(world=World(turn_deg))).root
    assert [each for each in validate(copy) if not each.warning] == []
    dataset, turned = open_dataset(copy), any(turn_deg)
    assert dataset.object_radius == 1.25
    assert dataset.board_corner == (None if turned else (0.5, 0.0, -1.0))
    found = read_inverse_distance(dataset)
    assert found is not None
    # Counterclockwise from above is to the left on the map.
    np.testing.assert_allclose(found, np.roll(inverse, -MAP_HEIGHT // 2 if turned else 0, axis=1), atol=1e-5)


def test_truth_scores_as_before(tmp_path: Path) -> None:
    source = make_sphere_dataset(tmp_path / "source", environment_height=256)
    options = Perturbation(
        CameraErrors(rotation_deg=1.0), MaskErrors(erode_px=1.0), SensorErrors(jpeg_quality=60), ViewChoice(keep=4)
    )
    copy = open_dataset(perturb(source.root, tmp_path / "copy", options).root)
    scores = [
        evaluate(write_truth_prediction(tmp_path / each.name, each), protocol="linear-v1") for each in (source, copy)
    ]
    assert scores[0].normals == scores[1].normals
    assert scores[0].render == scores[1].render
    assert scores[1].environment is not None
    assert scores[0].environment.as_predicted.full == scores[1].environment.as_predicted.full


def test_a_fit_reads_the_copy_and_names_an_empty_mask(source: Dataset, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from panoless.capture.views import load_views

    options = replace(EVERYTHING, masks=replace(EVERYTHING.masks, empty=0.0))
    views = load_views(open_dataset(perturb(source.root, tmp_path / "copy", options).root), 2)
    assert len(views.train) == 4
    perturb(source.root, tmp_path / "empty", Perturbation(masks=MaskErrors(empty=0.5)))
    with pytest.raises(InputError, match="masks empty"):
        load_views(open_dataset(tmp_path / "empty"), 2)


def test_eight_bits_are_those_of_a_display(sphere_dataset: Dataset, tmp_path: Path) -> None:
    perturb(sphere_dataset.root, tmp_path / "copy", Perturbation(sensor=SensorErrors(srgb8=True)))
    for frame, before in zip(open_dataset(tmp_path / "copy").train, sphere_dataset.train, strict=True):
        assert not frame.exr.exists()
        view, truth = read_view(frame), read_view(before)
        assert not view.high_dynamic_range
        solid = truth.alpha == 1
        assert truth.radiance[solid].max() > 1
        expected = srgb_to_linear(np.rint(255 * linear_to_srgb(truth.radiance[solid].clip(0, 1))) / 255)
        np.testing.assert_allclose(view.radiance[solid], expected, atol=0.01)  # Half precision may move a level.


def test_jpeg_loses_more_at_lower_quality(source: Dataset, tmp_path: Path) -> None:
    errors, sizes = [], []
    for quality in (95, 60, 10):
        root = tmp_path / str(quality)
        perturb(source.root, root, Perturbation(sensor=SensorErrors(jpeg_quality=quality)))
        frame = open_dataset(root).train[1]
        assert frame.photograph.read_bytes()[:3] == b"\xff\xd8\xff"
        assert read_json(root / "transforms_train.json", "cameras")["frames"][1]["file_path"].endswith(".jpg")
        truth = read_view(source.train[1])
        view = read_view(frame)
        np.testing.assert_allclose(view.alpha, truth.alpha, atol=0.5 / 255 + 1e-6)
        errors.append(np.abs(view.radiance - truth.radiance.clip(0, 1)).mean())
        sizes.append(frame.photograph.stat().st_size)
    assert errors == sorted(errors)
    assert errors[2] > 2 * errors[0]
    assert sizes == sorted(sizes, reverse=True)


def test_noise_of_a_copy_has_its_deviation(sphere_dataset: Dataset, tmp_path: Path) -> None:
    perturb(sphere_dataset.root, tmp_path / "copy", Perturbation(sensor=SensorErrors(shot_noise=0.04, read_noise=0.01)))
    normalized = []
    for frame, before in zip(open_dataset(tmp_path / "copy").train, sphere_dataset.train, strict=True):
        view, truth = read_view(frame), read_view(before)
        solid = truth.alpha == 1
        deviation = np.sqrt(0.04**2 * truth.radiance[solid] + 0.01**2)
        normalized.append((view.radiance - truth.radiance)[solid] / deviation)
    everything = np.concatenate(normalized)
    assert abs(everything.mean()) < 5 / np.sqrt(everything.size)
    assert abs(everything.std() - 1) < 5 / np.sqrt(2 * everything.size)


def test_a_larger_mask_is_black_without_a_background_and_shows_one_that_is_there(
    sphere_dataset: Dataset, shiny: Dataset, tmp_path: Path
) -> None:
    larger = Perturbation(masks=MaskErrors(dilate_px=2.0))
    perturb(sphere_dataset.root, tmp_path / "black", larger)
    for frame, before in zip(open_dataset(tmp_path / "black").train, sphere_dataset.train, strict=True):
        view, truth = read_view(frame), read_view(before)
        ring = (view.alpha > 0.99) & (truth.alpha == 0)
        assert ring.sum() > 30
        assert not view.radiance[ring].any()
        np.testing.assert_allclose(view.radiance, truth.radiance, rtol=2e-3, atol=1e-6)
    masked = Path(shutil.copytree(shiny.root, tmp_path / "masked"))
    cameras = read_json(masked / "transforms_train.json", "cameras")
    for entry, frame in zip(cameras["frames"], open_dataset(masked).train, strict=True):
        write_png(masked / f"masks/{frame.stem.name}.png", np.rint(255 * read_view(frame).alpha).astype(np.uint8))
        write_png(frame.png, np.full((24, 24, 3), 200, np.uint8))
        frame.alpha_png.unlink()
        entry["mask_path"] = f"masks/{frame.stem.name}.png"
    write_json(masked / "transforms_train.json", cameras)
    perturb(masked, tmp_path / "gray", larger)
    for frame, before in zip(open_dataset(tmp_path / "gray").train, open_dataset(masked).train, strict=True):
        view = read_view(frame)
        ring = (view.alpha > 0.99) & (read_view(before).alpha == 0)
        assert ring.any()
        gray = float(srgb_to_linear(np.array(200 / 255)))
        np.testing.assert_allclose(view.radiance[ring], gray, rtol=0.01)


def test_silhouettes_move_by_view_within_their_bound(sphere_dataset: Dataset, tmp_path: Path) -> None:
    """Of a disk of area A, the radius √(A/π) changes by the drawn distance."""
    perturb(sphere_dataset.root, tmp_path / "copy", Perturbation(masks=MaskErrors(offset_px=0.8)))
    pairs = zip(open_dataset(tmp_path / "copy").train, sphere_dataset.train, strict=True)
    moved = np.diff([[np.sqrt(read_view(each).alpha.sum() / np.pi) for each in pair] for pair in pairs])
    assert np.abs(moved).max() < 0.85
    assert moved.std() > 0.1


def test_stray_blobs_fill_no_hole(sphere_dataset: Dataset, tmp_path: Path) -> None:
    perturb(sphere_dataset.root, tmp_path / "copy", Perturbation(masks=MaskErrors(holes=0.3, stray=0.3)))
    for frame, before in zip(open_dataset(tmp_path / "copy").train, sphere_dataset.train, strict=True):
        alpha, truth = read_view(frame).alpha, read_view(before).alpha
        area = truth.sum()
        assert np.maximum(truth - alpha, 0).sum() / area == pytest.approx(0.3, abs=0.02)
        assert np.maximum(alpha - truth, 0).sum() / area == pytest.approx(0.3, abs=0.02)


def test_what_lies_beside_a_picture_is_kept_while_its_pixels_stay(shiny: Dataset, tmp_path: Path) -> None:
    perturb(shiny.root, tmp_path / "same", Perturbation(masks=MaskErrors(erode_px=1.0)))
    perturb(shiny.root, tmp_path / "moved", Perturbation(views=ViewChoice(object_scale=0.5)))
    for name in ("r_1_normal.png", "r_1_disp.tiff"):
        assert sha256_of(tmp_path / "same/train" / name) == sha256_of(shiny.root / "train" / name)
    assert (tmp_path / "moved/train/r_1_normal.png").exists()
    assert not (tmp_path / "moved/train/r_1_disp.tiff").exists()


def test_self_reflection_moves_with_the_object_and_is_left_out_where_no_exr_knows_it(
    damaged_dataset: Path, tmp_path: Path
) -> None:
    """A copy of 8 bits keeps the pictures of it, which a move of that copy can't make again."""
    for frame in open_dataset(damaged_dataset).train:
        channels = read_exr(frame.exr)
        left = np.arange(frame.camera.width) < frame.camera.width / 2
        reflected = (left & (channels["A"] > 0)).astype(np.float16)
        write_exr(frame.exr, channels | {"self_reflection.V": reflected})
        write_png(frame.self_png, encode_unit(reflected))
    smaller = Perturbation(views=ViewChoice(object_scale=0.5))
    for frame in open_dataset(perturb(damaged_dataset, tmp_path / "moved", smaller).root).train:
        np.testing.assert_array_equal(read_png(frame.self_png)[..., 0], encode_unit(read_view(frame).self_reflection))
    coded = perturb(damaged_dataset, tmp_path / "coded", Perturbation(sensor=SensorErrors(srgb8=True))).root
    assert len(list(coded.glob("train/*_self.png"))) == 6
    again = perturb(coded, tmp_path / "again", smaller).root
    assert not list(again.glob("train/*_self.png"))
    assert len(list(again.glob("train/*_normal.png"))) == 6


def test_distortion_is_stated_only_when_asked_for(sphere_dataset: Dataset, tmp_path: Path) -> None:
    lens = SensorErrors(k1=-0.1)
    perturb(sphere_dataset.root, tmp_path / "pinhole", Perturbation(sensor=lens))
    assert "k1" not in read_json(tmp_path / "pinhole/transforms_train.json", "cameras")
    assert len(open_dataset(tmp_path / "pinhole").train) == 6
    perturb(sphere_dataset.root, tmp_path / "stated", Perturbation(sensor=replace(lens, record_distortion=True)))
    stated = read_json(tmp_path / "stated/transforms_train.json", "cameras")
    assert stated["k1"] == -0.1
    with pytest.raises(InputError, match="lens distortion"):
        open_dataset(tmp_path / "stated")


def test_the_command_takes_options_and_names_bad_ones(
    sphere_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "copy"
    command = ["perturb", str(sphere_dataset.root), "--output", str(root), "--seed", "2"]
    assert main([*command, "--cameras.rotation-deg", "400"]) == 2
    assert "--cameras.rotation-deg" in capsys.readouterr().err
    assert not root.exists()
    arguments = ["--cameras.principal-point-px", "-3", "1.5", "--views.keep", "3"]
    assert main([*command, *arguments]) == 0
    assert "3 training views" in capsys.readouterr().out
    assert json.loads((root / MANIFEST).read_text())["recipe"]["options"] == {
        "cameras": {"principal_point_px": [-3.0, 1.5]},
        "views": {"keep": 3},
    }
