"""The oracle is a prediction like any other, better than what errors in normals allow, and shown beside every score."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shinypartial.cli import main
from shinypartial.core.camera import ray_directions_world, reflect
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import pixel_footprint_sr
from shinypartial.dataset.read import open_dataset, read_environment, read_view
from shinypartial.dataset.schema import Dataset
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.evaluation.masks import environment_mask, solid_mask
from shinypartial.evaluation.scores import read_oracle_baseline, read_scores
from shinypartial.io.files import write_json
from shinypartial.metrics import perceptual
from shinypartial.metrics.environment import RegionMasks, region_scores
from shinypartial.oracle.baseline import Oracle, heights_to_try, make_oracle, rays_of_view
from shinypartial.oracle.latlong_solver import Rays, solve_latlong
from shinypartial.prediction.format import (
    DESCRIPTION,
    SCORES,
    dataset_hash,
    newest_prediction,
    read_info,
    read_visibility,
)
from shinypartial.report.page import summary_lines, write_report
from tests.support.synthetic_dataset import make_plain_sphere_dataset, make_sphere_dataset
from tests.support.truth_prediction import write_truth_prediction


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Large enough for a map that is worth something."""
    return make_sphere_dataset(tmp_path_factory.mktemp("oracle") / "ball", 96, train=8, test=2, environment_height=256)


@pytest.fixture(scope="module")
def oracle(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Oracle:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(perceptual.ENVIRONMENT_VARIABLE, raising=False)
        patch.setattr(perceptual, "CACHE", Path("no-cache"))
        made = make_oracle(dataset.root, tmp_path_factory.mktemp("predictions") / "ball-oracle")
        evaluate(made.root)
    return made


def test_the_baseline_is_a_scored_prediction(oracle: Oracle, dataset: Dataset) -> None:
    scores, info = read_scores(oracle.root), read_info(oracle.root)
    assert info.method == "oracle"
    assert info.dataset_hash == dataset_hash(dataset)
    assert scores.environment is not None
    observed = scores.environment.as_predicted.observed
    assert observed is not None
    assert observed.psnr_linear == pytest.approx(oracle.chosen.psnr_linear, abs=0.02)
    # Smooth but for a sun, seen through 96 px: 35 dB measured.
    assert scores.environment.as_predicted.full.psnr_linear > 30
    assert scores.normals is not None
    assert scores.normals.mean_angular_error_deg < 1e-3
    assert scores.render is not None
    assert scores.render.psnr > 35


def test_the_best_candidate_is_taken(oracle: Oracle) -> None:
    assert {each.estimate for each in oracle.candidates} == {"averaged", "robust"}
    known = [each.psnr_linear for each in oracle.candidates if each.psnr_linear is not None]
    assert oracle.chosen.psnr_linear == max(known)


def test_no_map_from_tilted_normals_comes_near_the_baseline(oracle: Oracle, dataset: Dataset) -> None:
    truth = read_environment(dataset)
    random = np.random.default_rng(0)
    parts = []
    for frame in dataset.train:
        view = read_view(frame)
        assert view.normals_world is not None
        mask = solid_mask(view)
        normals = view.normals_world[mask] + np.radians(3.0) * random.normal(size=(int(mask.sum()), 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        parts.append((reflect(ray_directions_world(frame.camera)[mask], normals), view.radiance[mask]))
    at, radiance = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    tilted = solve_latlong(Rays(at, radiance, np.zeros(len(at))), oracle.chosen.height).robust
    psnr = region_scores(tilted, truth, RegionMasks(None, None)).full.psnr_linear
    assert oracle.chosen.psnr_linear is not None
    assert oracle.chosen.psnr_linear > psnr + 3


def test_visibility_is_highest_where_rays_are(oracle: Oracle) -> None:
    visibility = read_visibility(oracle.root)
    assert visibility is not None
    assert 0 <= visibility.min() < 0.2
    assert 0.8 < visibility.max() <= 1
    columns = visibility.mean(0)
    # The cameras look from +X, so what lies behind them (the center) is seen best.
    assert columns[columns.size // 2] > columns[0]


def test_scores_stand_beside_the_baseline(oracle: Oracle, dataset: Dataset) -> None:
    prediction = write_truth_prediction(oracle.root.parent / "mine", dataset)
    assert "shinypartial oracle" not in "\n".join(summary_lines(oracle.root))
    evaluate(prediction)
    lines = "\n".join(summary_lines(prediction))
    assert f"(oracle {oracle.chosen.psnr_linear:.1f}" in lines
    assert ">oracle</th>" in write_report(prediction).read_text(encoding="utf-8")
    assert newest_prediction(oracle.root.parent) == prediction


def test_a_named_baseline_must_be_of_this_dataset(
    oracle: Oracle, dataset: Dataset, sphere_dataset: Dataset, tmp_path: Path
) -> None:
    other, mine = (write_truth_prediction(tmp_path / each.name, each) for each in (sphere_dataset, dataset))
    scores = evaluate(mine, protocol="linear-v1", oracle=oracle.root)
    assert read_oracle_baseline(mine, scores) is not None
    with pytest.raises(InputError, match="the oracle of sphere"):
        evaluate(other, oracle=oracle.root)
    assert "shinypartial oracle" in "\n".join(summary_lines(_scored_alone(other)))


def _scored_alone(prediction: Path) -> Path:
    evaluate(prediction, protocol="linear-v1")
    return prediction


def test_pixels_that_see_the_object_are_left_out(dataset: Dataset) -> None:
    view = read_view(dataset.train[0])
    solid = solid_mask(view)
    inside = np.zeros_like(solid)
    inside[40:50, 40:50] = True
    marked = replace(view, self_reflection=inside.astype(np.float32))
    np.testing.assert_array_equal(environment_mask(marked), solid & ~inside)
    np.testing.assert_array_equal(environment_mask(view), solid)


def test_footprints_are_the_square_of_the_larger_step() -> None:
    columns, rows = np.meshgrid(np.arange(6) * 1e-3, np.arange(5) * 3e-3)
    directions = np.stack([columns, rows, np.ones_like(rows)], -1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    mask = np.ones(rows.shape, bool)
    np.testing.assert_allclose(pixel_footprint_sr(directions, mask), 9e-6, rtol=1e-3)
    lone = np.zeros_like(mask)
    lone[2, 2] = True
    assert pixel_footprint_sr(directions, lone)[2, 2] == 1.0


def test_rim_pixels_see_more_than_central_ones(dataset: Dataset) -> None:
    rays = rays_of_view(dataset.train[0])
    forward = dataset.train[0].camera.camera_to_world[:3, 2]
    facing = -rays.directions @ forward
    assert np.median(rays.footprint_sr[facing < -0.8]) > 10 * np.median(rays.footprint_sr[facing > 0.8])


@pytest.mark.parametrize(
    ("rays", "heights"), [(10, (32,)), (5_000, (32,)), (69_000, (128, 64, 32)), (7_000_000, (256,))]
)
def test_maps_are_as_fine_as_the_rays_allow(rays: int, heights: tuple[int, ...]) -> None:
    assert heights_to_try(rays) == heights


def test_without_normals_there_is_no_baseline(tmp_path: Path) -> None:
    plain = make_plain_sphere_dataset(tmp_path / "plain")
    with pytest.raises(InputError, match="ground-truth normals"):
        make_oracle(plain.root, tmp_path / "oracle")
    assert not (tmp_path / "oracle").exists()


def test_the_command_writes_beside_the_predictions_and_never_into_the_dataset(
    sphere_dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = sphere_dataset.root
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(perceptual, "CACHE", tmp_path / "no-cache")
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    assert main(["oracle", str(root)]) == 0
    assert (tmp_path / "predictions" / "sphere-oracle" / "scores.json").is_file()
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before
    out = capsys.readouterr().out
    assert "averaged" in out
    assert "taken" in out


def test_a_baseline_that_is_made_again_is_not_complete_before_it_ends(
    sphere_dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the old description nor old scores stand beside new maps, and no other run writes there meanwhile."""
    root = write_truth_prediction(tmp_path / "oracle", sphere_dataset)
    write_json(root / SCORES, {})

    def stop(rays: Rays, height: int, after_round: object) -> None:
        with pytest.raises(InputError, match="the only run"):
            make_oracle(sphere_dataset.root, root)
        raise KeyboardInterrupt

    monkeypatch.setattr("shinypartial.oracle.baseline.solve_latlong", stop)
    with pytest.raises(KeyboardInterrupt):
        make_oracle(sphere_dataset.root, root)
    assert not (root / DESCRIPTION).exists()
    assert not (root / SCORES).exists()


def test_an_older_baseline_is_passed_over(oracle: Oracle, dataset: Dataset, tmp_path: Path) -> None:
    shutil.copytree(oracle.root, tmp_path / "ball-oracle")
    scores = read_scores(oracle.root)
    prediction = write_truth_prediction(tmp_path / "mine", open_dataset(dataset.root))
    mine = evaluate(prediction)
    assert read_oracle_baseline(prediction, mine) is not None
    assert read_oracle_baseline(prediction, replace(mine, dataset_hash="0" * 64)) is None
    assert scores.paper is not None
    (tmp_path / "ball-oracle" / "scores.json").unlink()
    assert read_oracle_baseline(prediction, mine) is None
    write_json(tmp_path / "ball-oracle" / "scores.json", {})
    assert read_oracle_baseline(prediction, mine) is None
    with pytest.raises(InputError, match="Evaluate again"):
        read_oracle_baseline(prediction, replace(mine, oracle=str(tmp_path / "ball-oracle")))
