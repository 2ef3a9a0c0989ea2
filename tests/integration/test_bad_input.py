"""What a user can get wrong with `panoless`: exit code 2, one message, no traceback, and nothing half-written."""

import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from panoless.cli import main
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import Dataset
from shinypartial.dataset.write import write_view
from shinypartial.io.images import read_exr, write_exr, write_png

ROOT = Path(__file__).resolve().parents[2]
SIZES = [
    "--model", "surfels",
    "--config.iterations", "4",
    "--config.surfels.count", "40",
    "--config.environment.resolution", "8",
    "--config.environment.solve-resolution", "8",
]  # fmt: skip
TINY = [
    *SIZES,
    "--set",
    "first_surface.hull_resolution=24",
    "surroundings.mode=off",
    "material.reflectance=off",
]
TINY += ["corrections.masks=off", "corrections.exposure=off", "corrections.lens=off"]


@pytest.fixture(autouse=True)
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Runs and predictions go below an empty folder."""
    place = tmp_path / "workplace"
    place.mkdir()
    monkeypatch.chdir(place)
    return place


@pytest.fixture(scope="module")
def finished(sphere_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run and its prediction, which tests copy before they damage it."""
    place = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert main(["fit", str(sphere_dataset.root), "--output", "out", *TINY]) == 0
    return place


def assert_refused(capsys: pytest.CaptureFixture[str], code: int, *words: str) -> None:
    err = capsys.readouterr().err
    assert code == 2, err
    assert_one_message(err, *words)


def assert_one_message(err: str, *words: str) -> None:
    assert "Traceback" not in err
    message = err[err.index("error: expected") :]
    assert err.count("error: expected") == 1
    assert [line.split()[0] for line in message.splitlines()] == ["error:", "found", "remedy"]
    for word in words:
        assert word in message


def assert_nothing_half_written(place: Path) -> None:
    assert not list(place.rglob(".partial-*"))
    assert not list(place.rglob("prediction.json"))


def edit_transforms(root: Path, change: Callable[[dict], None]) -> None:
    path = root / "transforms_train.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def set_pose(value: float, row: int, column: int) -> Callable[[Path], None]:
    def change(content: dict) -> None:
        content["frames"][1]["transform_matrix"][row][column] = value

    return lambda root: edit_transforms(root, change)


def truncate_exr(root: Path) -> None:
    path = root / "train" / "r_001.exr"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def shrink_exr(root: Path) -> None:
    path = root / "train" / "r_001.exr"
    write_exr(path, {name: np.ascontiguousarray(plane[:-1]) for name, plane in read_exr(path).items()})


def remove_mask(root: Path) -> None:
    for name in ("r_001.exr", "r_001_alpha.png"):
        (root / "train" / name).unlink(missing_ok=True)
    frame = open_dataset(root).train[1]
    frame.alpha_png.unlink(missing_ok=True)
    write_png(frame.png, np.full((32, 32, 3), 128, np.uint8))


def change_view(change: Callable[[np.ndarray], np.ndarray], field: str) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        frame = open_dataset(root).train[1]
        view = read_view(frame)
        write_view(frame, replace(view, **{field: change(getattr(view, field))}))

    return damage


def put_nan(array: np.ndarray) -> np.ndarray:
    result = array.copy()
    result[16, 16] = np.nan
    return result


DAMAGE: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "truncated image": (truncate_exr, ("r_001.exr", "truncated")),
    "image of another size": (shrink_exr, ("train/r_001", "32×31")),
    "no mask": (remove_mask, ("mask", "train/r_001")),
    "empty mask": (change_view(np.zeros_like, "alpha"), ("masks empty", "train/r_001")),
    "NaN": (change_view(put_nan, "radiance"), ("finite radiance", "train/r_001")),
    "pose that can't be inverted": (set_pose(0.0, 0, 0), ("rigid", "train/r_001")),
    "pose that is not finite": (set_pose(float("nan"), 0, 3), ("finite number", "transform_matrix")),
    "image that is missing": (lambda root: (root / "train" / "r_001.exr").unlink(), ()),
    "no frames": (lambda root: edit_transforms(root, lambda content: content["frames"].clear()), ("frames",)),
    "transforms that are no JSON": (lambda root: (root / "transforms_train.json").write_text("{"), ("JSON",)),
    "cameras in one place": (
        lambda root: edit_transforms(
            root,
            lambda content: [
                frame.update(transform_matrix=content["frames"][0]["transform_matrix"]) for frame in content["frames"]
            ],
        ),
        ("different directions",),
    ),
}


@pytest.mark.parametrize("name", [name for name in DAMAGE if name != "image that is missing"])
def test_a_damaged_dataset_is_refused(name: str, damaged_dataset: Path, workplace: Path, capsys) -> None:
    damage, words = DAMAGE[name]
    damage(damaged_dataset)
    capsys.readouterr()
    assert_refused(capsys, main(["fit", str(damaged_dataset), *TINY]), *words)
    assert_nothing_half_written(workplace)


def test_a_missing_picture_is_refused(damaged_dataset: Path, workplace: Path, capsys) -> None:
    for path in (damaged_dataset / "train").glob("r_001*"):
        path.unlink()
    assert_refused(capsys, main(["fit", str(damaged_dataset), *TINY]), "r_001.png", "no such file")
    assert_nothing_half_written(workplace)


def test_a_corrected_dataset_can_be_fitted_at_once(damaged_dataset: Path, sphere_dataset: Dataset, capsys) -> None:
    """What a refused fit leaves does not stand in the way of the next one."""
    truncate_exr(damaged_dataset)
    assert main(["fit", str(damaged_dataset), *TINY]) == 2
    shutil.copy(sphere_dataset.root / "train" / "r_001.exr", damaged_dataset / "train" / "r_001.exr")
    assert main(["fit", str(damaged_dataset), *TINY]) == 0


def test_a_missing_dataset(workplace: Path, capsys) -> None:
    assert_refused(capsys, main(["fit", "nowhere", *TINY]), "dataset folder at nowhere", "shinypartial generate")
    assert list(workplace.iterdir()) == []


def test_no_dataset_at_all(workplace: Path, capsys) -> None:
    assert_refused(capsys, main(["fit", *TINY]), "a dataset below", "shinypartial generate")
    assert list(workplace.iterdir()) == []


def test_an_empty_folder_is_no_dataset(workplace: Path, capsys) -> None:
    (workplace / "empty").mkdir()
    assert_refused(capsys, main(["fit", "empty", *TINY]), "transforms_train.json")


def test_an_output_below_a_file(workplace: Path, sphere_dataset: Dataset, capsys) -> None:
    (workplace / "file").write_text("mine")
    assert_refused(capsys, main(["fit", str(sphere_dataset.root), "--output", "file/below", *TINY]), "file")
    assert_refused(capsys, main(["fit", str(sphere_dataset.root), "--output", "file", *TINY]), "--output")
    assert (workplace / "file").read_text() == "mine"
    assert not (workplace / "runs").exists()


def test_a_place_for_runs_that_is_a_file(workplace: Path, sphere_dataset: Dataset, capsys) -> None:
    (workplace / "runs").write_text("mine")
    assert_refused(capsys, main(["fit", str(sphere_dataset.root), *TINY]), "runs")
    assert_nothing_half_written(workplace)


def test_an_output_that_holds_something_else(workplace: Path, sphere_dataset: Dataset, capsys) -> None:
    (workplace / "thesis").mkdir()
    (workplace / "thesis" / "chapter.tex").touch()
    assert_refused(capsys, main(["fit", str(sphere_dataset.root), "--output", "thesis", *TINY]), "not a prediction")
    assert [path.name for path in (workplace / "thesis").iterdir()] == ["chapter.tex"]


def test_a_run_of_another_configuration(workplace: Path, finished: Path, sphere_dataset: Dataset, capsys) -> None:
    shutil.copytree(finished, workplace, dirs_exist_ok=True)
    command = ["fit", str(sphere_dataset.root), "--output", "out", *TINY]
    before = {path: path.read_bytes() for path in sorted((workplace / "out").rglob("*")) if path.is_file()}
    capsys.readouterr()
    assert_refused(capsys, main([*command, "--config.seed", "1"]), "another dataset or configuration", "--output")
    assert before == {path: path.read_bytes() for path in sorted((workplace / "out").rglob("*")) if path.is_file()}


BAD_VALUES = {
    "no surfels": "--config.surfels.count 0",
    "no texels": "--config.environment.resolution 0",
    "no texels in the end": "--config.environment.solve-resolution -1",
    "fewer than no iterations": "--config.iterations -1",
}


@pytest.mark.parametrize("options", BAD_VALUES.values(), ids=BAD_VALUES.keys())
def test_a_value_out_of_range(options: str, workplace: Path, sphere_dataset: Dataset, capsys) -> None:
    name = options.split()[0]
    code = main(["fit", str(sphere_dataset.root), *SIZES, *options.split()])
    assert_refused(capsys, code, name)
    assert_nothing_half_written(workplace)


def test_export_of_an_unfinished_run(workplace: Path, sphere_dataset: Dataset, capsys, monkeypatch) -> None:
    def interrupted(*_) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("panoless.reconstruct.recorder.CHECKPOINT_INTERVAL_S", -1.0)
    with monkeypatch.context() as patch:
        patch.setattr("panoless.reconstruct.fit.complete", interrupted)
        assert main(["fit", str(sphere_dataset.root), "--output", "out", *TINY]) == 130
    assert "continue" in capsys.readouterr().err
    assert_refused(capsys, main(["export", "runs/out", "--output", "early"]), "4 of 4 iterations")
    assert not (workplace / "early").exists()
    assert main(["fit", str(sphere_dataset.root), "--output", "out", *TINY]) == 0
    assert main(["export", "runs/out", "--output", "late"]) == 0


@pytest.mark.parametrize(
    "damage", ["missing", "no checkpoint", "broken checkpoint", "broken description", "old options"]
)
def test_export_of_what_is_no_run(damage: str, workplace: Path, finished: Path, capsys) -> None:
    run = workplace / "runs" / "out"
    if damage != "missing":
        shutil.copytree(finished / "runs" / "out", run)
    if damage == "no checkpoint":
        (run / "checkpoint.pt").unlink()
    if damage == "broken checkpoint":
        (run / "checkpoint.pt").write_bytes(b"PK\x03\x04 no archive")
    if damage == "broken description":
        (run / "fit.json").write_text("[1, 2]")
    if damage == "old options":
        content = json.loads((run / "fit.json").read_text())
        del content["config"]["splats"]["loss"]["robust_scale"]
        (run / "fit.json").write_text(json.dumps(content))
    capsys.readouterr()
    assert_refused(capsys, main(["export", "runs/out", "--output", "again"]))
    assert not (workplace / "again").exists()


def run_with_limit(arguments: list[str], cwd: Path, limit: int) -> subprocess.CompletedProcess[str]:
    """The command in a process whose files can't grow beyond `limit` bytes, which is what a full disk looks like."""
    return subprocess.run(
        [sys.executable, "-m", "panoless.cli", *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_WAIT_POLICY": "PASSIVE"},
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )


def test_a_full_disk_while_the_checkpoint_is_written(workplace: Path, sphere_dataset: Dataset) -> None:
    command = ["fit", str(sphere_dataset.root), "--output", "out", *TINY]
    # The description of the run takes 2 kB, its checkpoint 50 kB.
    done = run_with_limit(command, workplace, limit=20_000)
    assert done.returncode == 2, done.stderr
    assert_one_message(done.stderr, "free space", "run the same command again")
    assert_nothing_half_written(workplace)
    assert main(command) == 0


@pytest.mark.slow
def test_a_full_disk_while_the_prediction_is_written(workplace: Path, finished: Path) -> None:
    shutil.copytree(finished, workplace, dirs_exist_ok=True)
    done = run_with_limit(["export", "runs/out", "--output", "again"], workplace, limit=3_000)
    assert done.returncode == 2, done.stderr
    assert_one_message(done.stderr, "free space")
    assert not (workplace / "again" / "prediction.json").exists()
    assert not list(workplace.rglob(".partial-*"))
    assert main(["export", "runs/out", "--output", "again"]) == 0
