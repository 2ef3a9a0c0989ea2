"""The Python interface does what the commands do, by the same names, on any dataset, and README shows how."""

import inspect
import os
import re
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import panoless
import shinypartial
from panoless.cli import Fit
from panoless.presets import PRESETS
from shinypartial.core.errors import InputError
from shinypartial.dataset import bundled
from shinypartial.dataset.read import open_dataset, read_environment
from shinypartial.dataset.schema import Dataset
from shinypartial.evaluation.scores import read_scores
from tests.support.mirror_sphere import tiny_config

ROOT = Path(__file__).resolve().parents[2]
TINY_VASE = bundled.bundled_dataset("tiny-vase")


@pytest.fixture(scope="module")
def result(many_views_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> panoless.Reconstruction:
    """The sphere, fitted with a tiny configuration in an empty folder."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("workplace"))
    try:
        made = panoless.fit(many_views_dataset.root, output="out/sphere", config=tiny_config())
        return panoless.load(made.folder.resolve())
    finally:
        os.chdir(before)


def snippet() -> str:
    """The block of README that fits a dataset in Python."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S)
    return next((block for block in blocks if "panoless.fit" in block), "")


HANDLED = "config", "viewer", "json_progress"


def test_every_option_of_the_command_is_a_keyword() -> None:
    """With the same default, but for what a terminal shows; `model` is a field of the configuration."""
    keywords = inspect.signature(panoless.fit).parameters
    options = {item.name: item.default for item in fields(Fit) if item.name not in HANDLED}
    assert {name: keywords[name].default for name in options} == options
    assert keywords.keys() == {*options, "config", "model"}


def test_the_result_holds_both_maps_and_says_what_was_chosen(
    result: panoless.Reconstruction, many_views_dataset: Dataset
) -> None:
    height, width = result.visibility.shape
    assert result.environment.shape == (height, width, 3)
    assert width == 2 * height
    assert result.model == "surfels" == result.info.config["model"]
    assert result.dataset.root == many_views_dataset.root.resolve()


def test_normals_of_a_test_view_are_unit_vectors_that_face_the_camera(result: panoless.Reconstruction) -> None:
    view, normals = result.view(1), result.normals("test/r_001")
    solid = view.alpha > 0.99
    assert solid.any()
    np.testing.assert_allclose(np.linalg.norm(normals[solid], axis=-1), 1, atol=1e-3)
    np.testing.assert_array_equal(normals, view.normals_world)
    camera = result.dataset.test[1].camera
    assert (normals[solid] @ camera.camera_to_world[:3, 2]).mean() < -0.5


def test_a_saved_prediction_is_scored_where_it_lies(result: panoless.Reconstruction, tmp_path: Path) -> None:
    saved = result.save(tmp_path / "copy")
    scores = shinypartial.evaluate(str(saved.folder), protocol="linear-v1")
    assert scores.environment is not None
    assert scores == read_scores(saved.folder)
    assert not (result.folder / "scores.json").exists()
    with pytest.raises(InputError, match="new or empty folder"):
        result.save(tmp_path / "copy")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"preset": "quick"}, "a preset: fast"),
        ({"model": "cube"}, "model"),
        ({"set": ("plane.corners=3",)}, "plane.corners=3"),
        ({"dataset": "nowhere"}, "a dataset folder at nowhere"),
        ({}, "`panoless fit tiny-vase`"),
    ],
)
def test_wrong_arguments_are_refused(
    arguments: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message):
        panoless.fit(**arguments)


def test_a_view_that_is_not_there_is_refused(result: panoless.Reconstruction) -> None:
    with pytest.raises(InputError, match="a test view from 0 to 2"):
        result.normals(3)


def test_a_name_without_a_place_is_no_attribute() -> None:
    for package in (panoless, shinypartial):
        assert set(package.__all__) <= set(dir(package))
        assert not hasattr(package, "nothing")
        for name in package.__all__:
            assert getattr(package, name) is not None


def test_the_bundled_dataset_is_small_and_has_ground_truth() -> None:
    dataset = open_dataset(TINY_VASE)
    size = sum(path.stat().st_size for path in TINY_VASE.rglob("*") if path.is_file())
    assert size < 3_000_000
    assert len(dataset.train) >= 24
    assert read_environment(dataset).shape == (128, 256, 3)
    assert all(frame.exr.exists() for frame in dataset.test)


def test_a_folder_goes_before_a_bundled_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert bundled.resolve_dataset("tiny-vase") == TINY_VASE
    (tmp_path / "tiny-vase").mkdir()
    assert bundled.resolve_dataset(Path("tiny-vase")) == Path("tiny-vase")


def test_packages_carry_the_data_and_say_that_they_are_typed(tmp_path: Path) -> None:
    """What setuptools would install holds every file of the bundled dataset, recipes and the extension for Blender."""
    arguments = ["-q", "egg_info", "--egg-base", str(tmp_path), "build_py", "--build-lib", str(tmp_path / "lib")]
    subprocess.run([sys.executable, "setup.py", *arguments], cwd=ROOT, check=True, capture_output=True)
    kept = {path.relative_to(TINY_VASE) for path in TINY_VASE.rglob("*") if path.is_file()}
    built = tmp_path / "lib" / "shinypartial" / "data" / "tiny-vase"
    assert {path.relative_to(built) for path in built.rglob("*") if path.is_file()} == kept
    for package in ("panoless", "shinypartial"):
        assert (tmp_path / "lib" / package / "py.typed").exists()
    for place in (
        "shinypartial/data/blender_scenes/vase/scene.toml",
        "panoless/blender_extension/blender_manifest.toml",
    ):
        assert (tmp_path / "lib" / place).exists()


def run_snippet(folder: Path) -> dict[str, object]:
    """Run README's block in a folder where its dataset lies, whatever it calls it."""
    text = snippet()
    assert text, "README.md has no block of Python with panoless.fit"
    for name in re.findall(r"panoless\.fit\(\s*\"([^\"]+)\"", text):
        if name != TINY_VASE.name:
            shutil.copytree(bundled.bundled_dataset(TINY_VASE.name), folder / name)
    names: dict[str, object] = {}
    exec(compile(text, "README.md", "exec"), names)
    return names


def test_the_block_of_readme_runs(many_views_dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the preset of a few steps, and the synthetic sphere in place of the bundled vase."""
    shutil.copytree(many_views_dataset.root, tmp_path / "data" / TINY_VASE.name)
    monkeypatch.setattr(bundled, "BUNDLED", tmp_path / "data")
    monkeypatch.setitem(PRESETS, "default", replace(tiny_config(), preset="default"))
    monkeypatch.chdir(tmp_path)
    names = run_snippet(tmp_path)
    assert any(isinstance(value, panoless.Reconstruction) for value in names.values())


@pytest.mark.slow
def test_the_block_of_readme_gives_good_maps_of_the_bundled_vase(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Measured: 28.1 dB and 0.04° in the median."""
    monkeypatch.chdir(tmp_path)
    names = run_snippet(tmp_path)
    found = next(value for value in names.values() if isinstance(value, panoless.Reconstruction))
    scores = shinypartial.evaluate(found.folder, protocol="linear-v1")
    assert found.model == "revolution"
    assert scores.environment is not None
    assert scores.environment.as_predicted.full.psnr_linear > 26
    assert scores.normals is not None
    assert scores.normals.median_angular_error_deg < 0.15


@pytest.mark.parametrize(("given", "found"), [(None, "1"), ("3", "3")])
def test_openblas_gets_one_thread_unless_told_otherwise(given: str | None, found: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    environment |= {} if given is None else {"OPENBLAS_NUM_THREADS": given}
    program = "import os, panoless; print(os.environ['OPENBLAS_NUM_THREADS'])"
    said = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert said.stdout.strip() == found
