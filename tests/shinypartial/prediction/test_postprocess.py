"""Blurring what was hardly seen touches nothing else, knows no seam and no pole, and leaves a prediction to score."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from skimage.filters import threshold_otsu

from shinypartial.cli import main
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import blur_latlong, latlong_directions, latlong_solid_angles
from shinypartial.dataset.schema import Dataset
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.evaluation.scores import read_scores
from shinypartial.prediction.format import (
    DESCRIPTION,
    EVALUATION,
    REPORT,
    SCORES,
    TEST_VIEWS,
    VISIBILITY,
    prediction_frame,
    read_environment_map,
    read_info,
    read_visibility,
    write_visibility,
)
from shinypartial.prediction.postprocess import BlurOptions, blur_hardly_seen, otsu_threshold, postprocess
from tests.support.truth_prediction import write_truth_prediction

STD = np.radians(10.0)


@pytest.fixture
def prediction(sphere_dataset: Dataset, tmp_path: Path) -> Path:
    return write_truth_prediction(tmp_path / "truth", sphere_dataset)


def test_a_blur_keeps_a_constant_and_shrinks_a_linear_function_alike_everywhere() -> None:
    """Funk–Hecke: a zonal kernel multiplies each degree-1 harmonic by one number, ⟨cos γ⟩ = coth κ − 1/κ, κ = 1/σ²."""
    directions = latlong_directions(64)
    assert blur_latlong(np.full((64, 128, 1), 0.7), STD) == pytest.approx(0.7, abs=1e-12)
    factor = 1 / np.tanh(STD**-2) - STD**2
    # 64 rows sample the kernel of 10° finely: measured 3e-4.
    assert blur_latlong(directions, STD) == pytest.approx(factor * directions, abs=1e-3)


def test_a_blur_turns_with_the_map_across_the_seam() -> None:
    noise = np.random.default_rng(0).random((32, 64, 2))
    turned = blur_latlong(np.roll(noise, 17, axis=1), STD)
    assert turned == pytest.approx(np.roll(blur_latlong(noise, STD), 17, axis=1), abs=1e-12)


def test_a_point_at_the_pole_spreads_as_a_point_at_the_equator_does() -> None:
    """The same solid angle of light gives the same value at the same angle, wherever it stands."""
    height = 90
    directions, area = latlong_directions(height), latlong_solid_angles(height)
    values = []
    for at in (directions[0, 0], directions[height // 2, 40]):
        point = (directions @ at > np.cos(np.radians(5.0)))[..., None].astype(float)
        spread = blur_latlong(point / (point[..., 0] * area).sum(), STD)[..., 0]
        values.append(spread[np.abs(np.arccos(np.clip(directions @ at, -1, 1)) - np.radians(15.0)) < 0.01].mean())
    assert values[0] == pytest.approx(values[1], rel=0.02)


def test_otsu_counts_directions_and_not_texels() -> None:
    """On a grid of equal solid angles it is scikit-image's threshold; on a lat-long map poles weigh what they are."""
    values = np.random.default_rng(1).random((64, 128)) ** 2
    values[:8] *= 0.1
    repeated = np.repeat(values, np.rint(latlong_solid_angles(64)[:, 0] * 1e5).astype(int), axis=0)
    assert otsu_threshold(values) == pytest.approx(threshold_otsu(repeated), abs=2 / 256)


def test_what_was_seen_keeps_its_radiance_and_the_rest_is_the_blur_far_inside() -> None:
    height, options = 64, BlurOptions(blur_deg=6.0, feather_deg=3.0)
    directions = latlong_directions(height)
    noise = np.random.default_rng(2).random((height, 2 * height, 3)).astype(np.float32)
    visibility = np.where(directions[..., 2] > 0, 0.9, 0.1).astype(np.float32)
    blurred = blur_hardly_seen(noise, visibility, options)
    assert np.array_equal(blurred.radiance[: height // 2], noise[: height // 2])
    assert blurred.share == pytest.approx(0.5, abs=1e-6)
    deep = slice(height // 2 + 6, None)
    assert blurred.radiance[deep] == pytest.approx(blur_latlong(noise, np.radians(6.0))[deep], abs=1e-4)
    steps = np.abs(np.diff((blurred.radiance - noise)[height // 2 - 1 :].mean((1, 2))))
    assert steps.max() < 0.05  # The transition has no step: means of rows move by less than the noise of a row.


def test_the_folder_is_scored_and_says_what_it_was_made_from(prediction: Path, sphere_dataset: Dataset) -> None:
    assert main(["postprocess", str(prediction)]) == 0
    made = prediction.with_name("truth-blurred")
    info, before = read_info(made), read_info(prediction)
    assert info.config == {**before.config, "postprocess": {"blur_deg": 2.0, "feather_deg": 2.0}}
    assert info.model is not None
    assert str(prediction.resolve()) in info.model
    assert info.dataset_hash == before.dataset_hash
    assert sum(info.seconds.values()) >= sum(before.seconds.values())
    for frame in sphere_dataset.test:
        source = prediction_frame(prediction, frame).exr
        assert prediction_frame(made, frame).exr.read_bytes() == source.read_bytes()
    visibility = read_visibility(made)
    assert visibility is not None
    changed = (read_environment_map(made) != read_environment_map(prediction)).any(-1)
    assert changed.any()
    assert not changed[visibility >= otsu_threshold(visibility)].any()
    evaluate(made)
    assert read_scores(made).environment is not None


def test_scores_and_pictures_of_the_source_are_not_taken_over(prediction: Path, tmp_path: Path) -> None:
    evaluate(prediction)
    postprocess(prediction, tmp_path / "made")
    assert not (tmp_path / "made" / "scores.json").exists()
    assert not (tmp_path / "made" / "evaluation").exists()


def test_a_prediction_of_maps_alone_is_scored_like_its_source(prediction: Path, tmp_path: Path) -> None:
    shutil.rmtree(prediction / TEST_VIEWS)
    postprocess(prediction, tmp_path / "made")
    scores = evaluate(tmp_path / "made", protocol="linear-v1")
    assert scores.environment is not None
    assert scores.views == ()


def test_made_again_it_has_no_scores_of_the_first_time(prediction: Path, tmp_path: Path) -> None:
    made = tmp_path / "made"
    postprocess(prediction, made)
    (made / EVALUATION).mkdir()
    for path in (made / SCORES, made / REPORT, made / EVALUATION / "environment_error.png"):
        path.write_text("of the first time")
    postprocess(prediction, made, BlurOptions(blur_deg=10.0))
    assert not {SCORES, REPORT, EVALUATION} & {path.name for path in made.iterdir()}


@pytest.mark.parametrize("damage", ["missing", "constant", "same folder", "no blur"])
def test_what_cannot_be_done_is_refused_and_nothing_is_written(damage: str, prediction: Path, tmp_path: Path) -> None:
    options, output = BlurOptions(), tmp_path / "made"
    if damage == "missing":
        (prediction / VISIBILITY).unlink()
    elif damage == "constant":
        write_visibility(prediction, np.ones((16, 32)))
    elif damage == "same folder":
        output = prediction
    else:
        options = replace(options, blur_deg=0.0)
    with pytest.raises(InputError):
        postprocess(prediction, output, options)
    assert not (tmp_path / "made" / DESCRIPTION).exists()
    assert (prediction / DESCRIPTION).exists()
