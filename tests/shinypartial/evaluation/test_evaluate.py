"""Blind to methods and honest: truth is perfect, known damage has its known loss, and bad files are named."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import MANIFEST, Dataset
from shinypartial.dataset.write import write_environment
from shinypartial.dataset.write import write_inverse_distance as write_true_inverse_distance
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.evaluation.scores import read_scores, score_rows
from shinypartial.evaluation.view_scores import pool_environment_normals, pool_normals, score_view
from shinypartial.metrics import perceptual
from shinypartial.metrics.registry import Direction
from shinypartial.prediction.format import (
    ENVIRONMENT,
    EVALUATION,
    SCORES,
    prediction_frame,
    read_info,
    read_inverse_distance,
    write_environment_map,
    write_info,
    write_inverse_distance,
    write_test_view,
    write_visibility,
)
from tests.shinypartial.conversion.test_surface import write_ply
from tests.support.synthetic_dataset import make_plain_sphere_dataset
from tests.support.truth_prediction import write_truth_prediction

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(autouse=True)
def no_lpips(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The scores must not depend on weights that lie on this machine."""
    monkeypatch.delenv(perceptual.ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.setattr(perceptual, "CACHE", tmp_path / "no-cache")


@pytest.fixture
def truth(tmp_path: Path, sphere_dataset: Dataset) -> Path:
    return write_truth_prediction(tmp_path / "truth", sphere_dataset)


@pytest.fixture
def truth_views(truth: Path) -> Path:
    """Without the map, which takes the longest to score."""
    (truth / ENVIRONMENT).unlink()
    return truth


def test_the_ground_truth_scores_perfectly(truth: Path) -> None:
    scores = evaluate(truth)
    best = {"psnr": 100.0, "ssim": 1.0, "l1": 0.0, "log": 0.0, "alpha": 1.0, "fraction": 1.0, "normal": 1.0}
    best |= {"mean": 0.0, "median": 0.0, "rmse": 0.0, "si": 0.0, "color": 0.0, "normalized": 0.0, "peak": 0.0}
    compared = [
        row for row in score_rows(scores) if row.value is not None and row.metric.direction is not Direction.DESCRIPTION
    ]
    assert len(compared) > 20
    for row in compared:
        assert row.value == pytest.approx(best[row.metric.name.partition("_")[0]], abs=1e-9), row.path
    assert scores.environment is not None
    assert scores.environment.exposure_stops == 0.0
    assert scores.dataset_hash_matches


def test_scores_are_strict_json_and_read_back_as_written(truth: Path) -> None:
    scores = evaluate(truth)

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads((truth / "scores.json").read_text(), parse_constant=refuse)
    assert read_scores(truth) == scores
    del content["surroundings"]  # As scores of a version that knew no distances.
    (truth / "scores.json").write_text(json.dumps(content))
    assert read_scores(truth) == scores
    assert not any(row.path.startswith("surroundings") for row in score_rows(scores))


def test_threads_change_no_score(truth: Path, sphere_dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Damaged, so that scores are no round numbers; views that finish in another order are pooled in theirs."""
    write_environment_map(truth, np.random.default_rng(0).random((256, 512, 3)).astype(np.float32))
    frame = sphere_dataset.test[0]
    view = read_view(frame)
    write_test_view(truth, frame, replace(view, radiance=view.radiance * 0.7))
    in_parallel = evaluate(str(truth), str(sphere_dataset.root))
    written = (truth / "scores.json").read_bytes()
    monkeypatch.setattr("shinypartial.evaluation.evaluate.in_threads", map)
    assert evaluate(truth) == in_parallel
    assert (truth / "scores.json").read_bytes() == written
    monkeypatch.setattr("shinypartial.evaluation.evaluate.in_threads", out_of_order)
    assert evaluate(truth) == in_parallel


def out_of_order(function: Callable[[object], object], items: Sequence[object]) -> list[object]:
    """What threads may do: the last item is worked on first, the results come in the order of the items."""
    return [function(item) for item in reversed(items)][::-1]


def test_a_failing_map_and_a_failing_view_both_end_the_evaluation(truth: Path, sphere_dataset: Dataset) -> None:
    """Although they are scored beside each other; scores and pictures of an earlier evaluation stay as they were."""
    evaluate(truth, protocol="linear-v1")

    def result() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in (truth / SCORES, *(truth / EVALUATION).iterdir())}

    before = result()
    with pytest.raises(InputError, match="scores at"):
        evaluate(truth, protocol="linear-v1", oracle=truth.parent)
    write_environment_map(truth, np.zeros((32, 32, 3), np.float32))
    with pytest.raises(InputError, match=r"environment\.exr"):
        evaluate(truth)
    for path in prediction_frame(truth, sphere_dataset.test[0]).files:
        path.unlink()
    with pytest.raises(InputError, match="test/r_000"):
        evaluate(truth)
    assert result() == before
    assert len(before) > 10


def test_normals_where_the_object_sees_itself_count_in_one_group_and_not_in_the_other(sphere_dataset: Dataset) -> None:
    """A quarter turn wherever the mirror ray stays in the scene: its share of the mean, and nothing of the other."""
    frame = sphere_dataset.test[0]
    truth = read_view(frame)
    assert truth.normals_world is not None
    marked = np.zeros(truth.alpha.shape, dtype=np.float32)
    marked[: len(marked) // 2] = 1
    turned = np.where(marked[..., None] > 0, np.roll(truth.normals_world, 1, -1), truth.normals_world)
    results, left_out = [], []
    for known in (replace(truth, self_reflection=marked), truth):
        results.append(score_view(frame, replace(truth, normals_world=turned), known, None, with_paper=False))
    everywhere, outside = pool_normals(results[:1], left_out), pool_environment_normals(results[:1], left_out)
    assert everywhere is not None
    assert outside is not None
    assert outside.mean_angular_error_deg == pytest.approx(0, abs=1e-6)
    assert everywhere.mean_angular_error_deg > 10
    assert not left_out
    assert pool_environment_normals(results[1:], left_out) is None
    assert [entry.name for entry in left_out] == ["normals_environment"]


def test_what_cannot_be_computed_is_left_out_by_name(truth: Path) -> None:
    """No error, so no calibration; 32 px resolve nothing; no weights, so no LPIPS; nothing marks self-reflection."""
    names = {entry.name for entry in evaluate(truth).left_out}
    statistics = {"visibility_error_spearman", "visibility_error_auroc", "sparsification_area"}
    assert names == {"lpips_alex", "lpips_vgg", "environment resolved", "normals_environment", *statistics}


def test_a_rotated_environment_has_the_analytic_loss(damaged_dataset: Path, tmp_path: Path) -> None:
    """0.4 (cos φ − cos(φ − δ)) is a sine of amplitude 0.8 sin(δ/2)."""
    height, texels = 256, 40
    azimuth = (0.5 - (np.arange(2 * height) + 0.5) / (2 * height)) * 2 * np.pi
    row = 0.5 + 0.4 * np.cos(azimuth)
    radiance = np.broadcast_to(row[None, :, None], (height, 2 * height, 3)).astype(np.float32)
    write_environment(damaged_dataset, radiance, cube_resolution=8)
    prediction = write_truth_prediction(tmp_path / "rotated", open_dataset(damaged_dataset))
    write_environment_map(prediction, np.roll(radiance, texels, 1))
    scores = evaluate(prediction, protocol="linear-v1").environment
    assert scores is not None
    amplitude = 0.8 * math.sin(math.pi * texels / (2 * height))
    # Half floats round radiance by up to 2.5e-4: 2e-3 dB at this loss.
    expected = -10 * math.log10(amplitude**2 / 2)
    assert scores.as_predicted.full.psnr_linear == pytest.approx(expected, abs=5e-3)
    assert scores.as_predicted.full.l1_linear == pytest.approx(amplitude * 2 / math.pi, rel=1e-3)


def test_tilted_normals_have_their_tilt_as_error_and_holes_ninety_degrees(
    truth_views: Path, sphere_dataset: Dataset
) -> None:
    tilt = math.radians(7.0)
    solid = 0
    for frame in sphere_dataset.test:
        view = read_view(frame)
        assert view.normals_world is not None
        normals = view.normals_world.astype(np.float64)
        across = np.cross(normals, np.array([0.3, -0.5, 0.8]))
        across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
        tilted = normals * math.cos(tilt) + across * math.sin(tilt)
        solid += int((view.alpha > 0.99).sum())
        write_test_view(truth_views, frame, replace(view, normals_world=tilted.astype(np.float32)))
    normals_scores = evaluate(truth_views).normals
    assert normals_scores is not None
    assert normals_scores.mean_angular_error_deg == pytest.approx(7.0, abs=1e-4)  # float32 normals: 1e-5°
    frame = sphere_dataset.test[0]
    view = read_view(frame)
    write_test_view(truth_views, frame, replace(view, normals_world=np.zeros_like(view.normals_world)))
    scores = evaluate(truth_views)
    holes = int((view.alpha > 0.99).sum())
    assert scores.normals is not None
    assert scores.counts.normal_holes == holes
    assert scores.counts.normal_pixels == solid
    assert scores.normals.normal_coverage == pytest.approx(1 - holes / solid)
    assert scores.normals.mean_angular_error_deg == pytest.approx((7 * (solid - holes) + 90 * holes) / solid, abs=1e-4)


def test_distance_is_scored_where_the_dataset_knows_it_and_counts_as_infinite_where_the_prediction_does_not(
    damaged_dataset: Path, tmp_path: Path
) -> None:
    """A wall at 4 below and at 8 above, around an object of radius 2: the far world is wrong by 2/4 and 2/8."""
    prediction = write_truth_prediction(tmp_path / "truth", open_dataset(damaged_dataset))
    write_true_inverse_distance(
        damaged_dataset, np.where(np.arange(32)[:, None] < 16, 1 / 8, 1 / 4) * np.ones((32, 64))
    )
    manifest = json.loads((damaged_dataset / MANIFEST).read_text())
    manifest["statistics"] = {**manifest.get("statistics", {}), "object_radius": 2.0}
    (damaged_dataset / MANIFEST).write_text(json.dumps(manifest))
    far = evaluate(prediction, protocol="linear-v1").surroundings
    assert far is not None
    assert far.inverse_distance_error is not None
    assert 0.25 < far.inverse_distance_error < 0.5, "Between both halves, by how much of each is observed."
    write_inverse_distance(prediction, np.full((8, 16), 1 / 8))
    half = evaluate(prediction, protocol="linear-v1").surroundings
    assert half == read_scores(prediction).surroundings
    assert half is not None
    assert half.inverse_distance_error == pytest.approx(far.inverse_distance_error - 0.25, abs=1e-6)
    write_inverse_distance(prediction, np.full((8, 16), -1.0))
    with pytest.raises(InputError, match=r"1/D ≥ 0.*inverse_distance\.exr"):
        read_inverse_distance(prediction)


def test_a_plain_folder_is_scored_on_what_it_has(tmp_path: Path) -> None:
    dataset = make_plain_sphere_dataset(tmp_path / "plain")
    scores = evaluate(write_truth_prediction(tmp_path / "prediction", dataset))
    assert scores.render is not None
    assert scores.render.psnr == 100.0
    assert (scores.environment, scores.normals, scores.calibration, scores.coverage) == (None, None, None, None)
    assert {"environment", "normals", "calibration", "coverage"} <= {entry.name for entry in scores.left_out}


def test_a_dataset_without_test_views_is_scored_on_its_environment(damaged_dataset: Path, tmp_path: Path) -> None:
    (damaged_dataset / "transforms_test.json").unlink()
    scores = evaluate(write_truth_prediction(tmp_path / "prediction", open_dataset(damaged_dataset)))
    assert scores.environment is not None
    assert (scores.normals, scores.render, scores.views) == (None, None, ())
    assert {"normals", "render"} <= {entry.name for entry in scores.left_out}


def test_a_surface_without_area_is_left_out_of_the_pictures_by_name(truth_views: Path) -> None:
    write_ply(truth_views / "surface.ply", np.zeros((3, 3)), np.array([[0, 1, 2]]))
    left_out = {entry.name: entry.reason for entry in evaluate(truth_views, protocol="linear-v1").left_out}
    assert "no face with an area" in left_out["picture of the surface"]


def test_another_version_of_the_dataset_is_flagged(truth_views: Path) -> None:
    write_info(truth_views, replace(read_info(truth_views), dataset_hash="0" * 64))
    assert not evaluate(truth_views).dataset_hash_matches


def test_an_explicit_dataset_replaces_the_stored_path(truth_views: Path, sphere_dataset: Dataset) -> None:
    write_info(truth_views, replace(read_info(truth_views), dataset="no/such/folder"))
    with pytest.raises(InputError, match=r"no/such/folder.*--dataset"):
        evaluate(truth_views)
    assert evaluate(truth_views, sphere_dataset.root).normals is not None


def test_a_missing_view_is_named(truth_views: Path, sphere_dataset: Dataset) -> None:
    for path in prediction_frame(truth_views, sphere_dataset.test[1]).files:
        path.unlink()
    with pytest.raises(InputError, match=r"test/r_001.*Export every test view"):
        evaluate(truth_views)


def test_a_view_of_another_size_is_named(truth_views: Path, sphere_dataset: Dataset) -> None:
    frame = sphere_dataset.test[2]
    view = read_view(frame)
    assert view.normals_world is not None
    assert view.depth is not None
    small = replace(
        view,
        radiance=view.radiance[::2, ::2],
        alpha=view.alpha[::2, ::2],
        normals_world=view.normals_world[::2, ::2],
        depth=view.depth[::2, ::2],
    )
    write_test_view(truth_views, frame, small)
    with pytest.raises(InputError, match=r"32×32.*truth/test/r_002.*16×16"):
        evaluate(truth_views)


def test_a_view_with_nan_is_named(truth_views: Path, sphere_dataset: Dataset) -> None:
    frame = sphere_dataset.test[0]
    view = read_view(frame)
    assert view.normals_world is not None
    normals = view.normals_world.copy()
    normals[5, 5] = np.nan
    # The 8-bit companion of a NaN is undefined; only the EXR matters here.
    with np.errstate(invalid="ignore"):
        write_test_view(truth_views, frame, replace(view, normals_world=normals))
    with pytest.raises(InputError, match=r"finite normals.*truth/test/r_000"):
        evaluate(truth_views)


def test_normals_in_some_views_only_are_refused(truth_views: Path, sphere_dataset: Dataset) -> None:
    frame = prediction_frame(truth_views, sphere_dataset.test[1])
    frame.exr.unlink()
    frame.normal_png.unlink()
    with pytest.raises(InputError, match=r"test/r_001 has none"):
        evaluate(truth_views)


@pytest.mark.parametrize("value", [1.5, -0.5, math.nan])
def test_visibility_outside_its_range_is_named(truth: Path, value: float) -> None:
    visibility = np.zeros((32, 64))
    visibility[3, 4] = value
    write_visibility(truth, visibility)
    with pytest.raises(InputError, match=r"visibility\.exr"):
        evaluate(truth, protocol="linear-v1")


def test_an_environment_that_is_not_two_to_one_is_named(truth: Path) -> None:
    write_environment_map(truth, np.zeros((32, 32, 3), np.float32))
    with pytest.raises(InputError, match=r"environment\.exr"):
        evaluate(truth)


def test_evaluation_loads_neither_method_nor_torch(truth: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from shinypartial.evaluation.evaluate import evaluate; "
        f"evaluate(Path({str(truth)!r})); from shinypartial.report.page import write_report; "
        f"write_report(Path({str(truth)!r})); "
        "print(sorted({'panoless', 'torch', 'bpy'} & set(sys.modules)))"
    )
    clean = {**os.environ, "HOME": str(truth), "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=clean)
    assert done.stdout.strip() == "[]"
