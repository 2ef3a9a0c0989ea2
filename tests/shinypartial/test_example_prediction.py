"""The example that writes a prediction without shinypartial keeps every convention: on a sphere it must be right."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shinypartial.dataset.read import read_environment, read_view
from shinypartial.dataset.schema import Dataset
from shinypartial.prediction.format import (
    dataset_hash,
    prediction_frame,
    read_environment_map,
    read_info,
    read_visibility,
)

EXAMPLE = Path(__file__).resolve().parents[2] / "docs/examples/write_prediction.py"
#: That is three pixels or more: the texel's mean is then over most of its 5.6°.
WELL_SEEN = 0.4
#: Two float32 roundings of unit vectors and of depths near 3.
ROUNDING = 2e-6


@pytest.fixture(scope="module")
def sphere_dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """With texels that three pixels see."""
    from tests.support.synthetic_dataset import make_sphere_dataset

    return make_sphere_dataset(tmp_path_factory.mktemp("datasets") / "sphere")


@pytest.fixture(scope="module")
def prediction(sphere_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the example makes of the synthetic sphere, in a process that can't import shinypartial."""
    root = tmp_path_factory.mktemp("predictions") / "unit-sphere"
    command = [sys.executable, "-I", str(EXAMPLE), str(sphere_dataset.root), str(root)]
    subprocess.run(command, check=True, cwd=root.parent)
    return root


def test_it_imports_nothing_of_the_project() -> None:
    assert "import shinypartial" not in EXAMPLE.read_text()
    assert "from shinypartial" not in EXAMPLE.read_text()


def test_it_was_made_from_this_dataset(prediction: Path, sphere_dataset: Dataset) -> None:
    assert read_info(prediction).dataset_hash == dataset_hash(sphere_dataset)


def test_normals_depth_and_mask_are_those_of_the_sphere(prediction: Path, sphere_dataset: Dataset) -> None:
    for frame in sphere_dataset.test:
        truth, found = read_view(frame), read_view(prediction_frame(prediction, frame))
        inside = truth.alpha > 0.99
        assert (found.alpha[inside] == 1).all()
        assert (found.alpha[truth.alpha == 0] == 0).all()
        assert truth.normals_world is not None
        assert found.normals_world is not None
        assert truth.depth is not None
        assert found.depth is not None
        assert np.abs(truth.normals_world - found.normals_world)[inside].max() < ROUNDING
        assert np.abs(truth.depth - found.depth)[inside].max() < ROUNDING


def test_the_environment_is_right_where_it_is_well_seen(prediction: Path, sphere_dataset: Dataset) -> None:
    truth, found = read_environment(sphere_dataset), read_environment_map(prediction)
    visibility = read_visibility(prediction)
    assert visibility is not None
    assert truth.shape == found.shape
    seen = visibility > WELL_SEEN
    assert seen.sum() > 300
    error = np.abs(truth - found)[seen].mean()
    turned = [np.abs(np.roll(truth, shift, axis) - found)[seen].mean() for axis in (0, 1) for shift in (-1, 1)]
    assert error < 0.012  # Measured 0.009: radiance varies within a texel.
    assert error < min(turned) / 2  # Measured 0.033 and more: a turn by one texel would be seen.
