"""Runs of panoless from Blender: what goes on, what is refused in a message, and what a later session continues."""

import json
import os
import shutil
import time
from pathlib import Path
from typing import Any

import pytest

from blender_extension.job import CANCELLED, DONE, FAILED, Job
from blender_extension.program import Problem, Program, find, places, program_at
from blender_extension.running import begun_folder, work_folder
from shinypartial.dataset.schema import Dataset
from tests.blender_extension.conftest import write_program
from tests.support.knowing_fit import WAIT


def message_of(operator: Any, **options: Any) -> str:
    """What an operator that refuses says: an error of Blender's, which is no exception of ours."""
    with pytest.raises(RuntimeError) as refused:
        operator(**options)
    text = str(refused.value)
    assert text.startswith("Error: ")
    assert "Traceback" not in text
    assert text.strip().count("\n") == 0
    return text


def fit_steps(dataset: Dataset) -> list[list[str]]:
    return [["panoless", "fit", str(dataset.root), "--output", "prediction", "--json-progress"]]


def test_a_dataset_becomes_the_light_of_the_scene(blender: Any, programs: Path, ball_dataset: Dataset) -> None:
    """Fit, conversion, world, mirror, in the folder beside the .blend."""
    assert blender.ops.panoless.light(filepath=str(ball_dataset.root / "transforms_train.json")) == {"FINISHED"}
    scene = blender.context.scene
    assert scene.world.name == "PanoLess"
    assert scene.panoless.verdict == "trust: it is the truth"
    folder = Path(blender.data.filepath).parent / "file-panoless" / "light"
    assert Path(scene.panoless.run_folder) == folder
    assert json.loads((folder / "run.json").read_text())["state"] == DONE
    assert begun_folder(scene) is None
    assert not blender.ops.panoless.continue_run.poll()


def test_progress_reaches_blender(programs: Path, tmp_path: Path, ball_dataset: Dataset) -> None:
    job = Job(program_at(""), tmp_path / "run", "light", fit_steps(ball_dataset))
    job.start()
    job.wait()
    assert (job.state, job.stage, job.share) == (DONE, "knowing", 1.0)
    assert job.warnings == ["this fit only knows the truth"]
    assert job.paths["prediction"] == str(tmp_path / "run" / "prediction")
    assert job.verdict is not None
    assert job.verdict["verdict"] == "trust"


def test_a_cancelled_run_is_continued_by_a_later_session(
    blender: Any, programs: Path, ball_dataset: Dataset, tmp_path: Path
) -> None:
    """The run is found by the file's place, even where the file was not saved since it began."""
    folder = work_folder("light")
    folder.mkdir(parents=True)
    (folder / WAIT).touch()
    steps = [*fit_steps(ball_dataset), ["shinypartial", "convert", "{prediction}", "--to", "extension"]]
    steps[1] += ["--output", "blender", "--json-progress"]
    job = Job(program_at(""), folder, "light", steps)
    job.start()
    while not job.stage.startswith("Stage"):
        assert not job.poll()
        time.sleep(0.02)
    job.cancel()
    assert job.stage == "stopping"
    job.wait()
    assert job.state == CANCELLED
    assert not (folder / "prediction").exists()

    (folder / WAIT).unlink()
    blender.ops.wm.open_mainfile(filepath=blender.data.filepath)
    assert begun_folder(blender.context.scene) == folder
    assert blender.ops.panoless.continue_run() == {"FINISHED"}
    assert blender.context.scene.world.name == "PanoLess"


def test_a_run_that_died_with_blender_is_found(blender: Any, programs: Path, ball_dataset: Dataset) -> None:
    """Its record says that it runs, and nothing runs."""
    folder = work_folder("light")
    job = Job(program_at(""), folder, "light", fit_steps(ball_dataset))
    job.start()
    job.kill()
    assert json.loads((folder / "run.json").read_text())["state"] == "running"
    assert begun_folder(blender.context.scene) == folder


def test_another_file_stops_the_run_and_leaves_blender_free(
    blender: Any, programs: Path, ball_dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    from blender_extension import running

    folder = work_folder("light")
    folder.mkdir(parents=True)
    (folder / WAIT).touch()
    job = Job(program_at(""), folder, "light", fit_steps(ball_dataset))
    job.start()
    monkeypatch.setattr(running, "current", job)
    assert not blender.ops.panoless.light.poll()
    assert blender.ops.panoless.cancel.poll()
    running.stop()
    assert blender.ops.panoless.light.poll()
    assert begun_folder(blender.context.scene) == folder


def test_the_next_command_of_a_step_follows(programs: Path, tmp_path: Path, ball_dataset: Dataset) -> None:
    """As a capture names the fit with its options."""
    capture = f"""
import json, sys
from shinypartial.io.events import json_lines, report_result
from pathlib import Path
if sys.argv[1] == "capture":
    with json_lines("capture"):
        report_result({{}}, following=("panoless", "fit", Path({str(ball_dataset.root)!r})))
else:
    from tests.support.knowing_fit import main
    sys.exit(main(sys.argv[1:]))
"""
    write_program(programs, "panoless", capture)
    steps = [["panoless", "capture", "--json-progress"], ["{next}", "--output", "prediction", "--json-progress"]]
    job = Job(program_at(""), tmp_path / "run", "light", steps)
    job.start()
    job.wait()
    assert (job.state, job.message) == (DONE, "")
    assert (tmp_path / "run" / "prediction" / "sphere.ply").is_file()


def test_bad_input_of_the_program_is_one_message(programs: Path, tmp_path: Path) -> None:
    steps = [["shinypartial", "convert", str(tmp_path / "gone"), "--to", "extension", "--json-progress"]]
    job = Job(program_at(""), tmp_path / "run", "prediction", steps)
    job.start()
    job.wait()
    assert job.state == FAILED
    assert job.message.startswith("Expected ")
    assert str(tmp_path / "gone") in job.message


PROGRAMS = {
    "another protocol": (
        'print(\'{"event": "start", "format_version": 7, "version": "9.9"}\', flush=True)\nimport time; time.sleep(60)',
        "writes version 7",
    ),
    "a crash": ("import os; os.write(2, b'segmentation fault'); os._exit(11)", "segmentation fault"),
    "an older program": ("print('unknown option', file=sys.stderr); sys.exit(2)", "Update it"),
    "success without a result": ("print('hello')", "without a result"),
}


@pytest.mark.parametrize(("content", "said"), PROGRAMS.values(), ids=PROGRAMS.keys())
def test_another_program_is_one_message(
    content: str, said: str, blender: Any, programs: Path, ball_dataset: Dataset
) -> None:
    write_program(programs, "panoless", f"if '--version' in sys.argv: sys.exit(2)\n{content}\n")
    text = message_of(blender.ops.panoless.light, filepath=str(ball_dataset.root / "transforms_train.json"))
    assert said in text


def test_without_panoless_a_message_says_how_to_install_it(
    blender: Any, ball_dataset: Dataset, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    nowhere(monkeypatch, tmp_path)
    text = message_of(blender.ops.panoless.light, filepath=str(ball_dataset.root / "transforms_train.json"))
    assert 'uv tool install "panoless[capture]"' in text
    assert "is not installed" in message_of(blender.ops.panoless.find_program)


def nowhere(monkeypatch: pytest.MonkeyPatch, home: Path) -> None:
    """A home without any program."""
    monkeypatch.setenv("PATH", str(home))
    monkeypatch.setenv("HOME", str(home))
    for name in ("VIRTUAL_ENV", "CONDA_PREFIX", "UV_TOOL_BIN_DIR", "PIPX_BIN_DIR", "XDG_BIN_HOME"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize(
    "place",
    [
        ".local/bin/panoless",
        ".local/share/uv/tools/panoless/bin/panoless",
        ".local/share/pipx/venvs/panoless/bin/panoless",
        ".venv/bin/panoless",
    ],
)
@pytest.mark.skipif(os.name == "nt", reason="places of Linux and macOS")
def test_it_is_found_where_installers_put_it(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere(monkeypatch, tmp_path)
    assert find() is None
    path = write_program((tmp_path / place).parent, "panoless", "print('panoless 0.2.1')")
    assert find() == path
    assert program_at("") == Program(path, "0.2.1")
    assert program_at("").command("shinypartial") == str(path.with_name("shinypartial"))
    assert path in list(places())


def test_another_version_is_refused(tmp_path: Path) -> None:
    path = write_program(tmp_path, "panoless", "print('panoless 0.1.9')")
    with pytest.raises(Problem, match=r"needs panoless 0\.2 or newer.*is 0\.1\.9"):
        program_at(str(path))
    with pytest.raises(Problem, match="There is no panoless at"):
        program_at(str(tmp_path / "gone"))
    path.write_text("no program")
    path.chmod(0o644)
    with pytest.raises(Problem, match="can't be started"):
        program_at(str(path))


def test_a_folder_that_can_not_be_written(blender: Any, programs: Path, prediction: Path) -> None:
    """A file lies in its place, which refuses an administrator, too."""
    (Path(blender.data.filepath).parent / "file-panoless").write_text("")
    assert "can't be written" in message_of(
        blender.ops.panoless.import_prediction, filepath=str(prediction / "prediction.json")
    )
    blender.ops.mesh.primitive_uv_sphere_add()
    assert "can't be written" in message_of(blender.ops.panoless.benchmark)


DAMAGE = {
    "no prediction": ("prediction.json", None, "There is no prediction"),
    "half a description": ("prediction.json", b'{"format": "shinypartial-pre', "Expected"),
    "no map": ("environment.exr", None, "Expected"),
    "half a map": ("environment.exr", b"v/1\x01", "Expected"),
    "half a surface": ("sphere.ply", b"ply\nformat binary", "Expected"),
}


@pytest.mark.parametrize(("name", "content", "said"), DAMAGE.values(), ids=DAMAGE.keys())
def test_a_damaged_prediction_is_one_message(
    name: str, content: bytes | None, said: str, blender: Any, programs: Path, prediction: Path
) -> None:
    if content is None:
        (prediction / name).unlink()
    else:
        (prediction / name).write_bytes(content)
    assert said in message_of(blender.ops.panoless.import_prediction, filepath=str(prediction / "prediction.json"))
    assert "PanoLess" not in blender.data.worlds


@pytest.mark.parametrize("change", ["version", "missing", "damaged", "cut off"])
def test_files_of_another_version_or_damaged_are_one_message(
    change: str, blender: Any, programs: Path, prediction: Path, tmp_path: Path
) -> None:
    from blender_extension.build import build
    from blender_extension.content import Content

    blender.ops.panoless.import_prediction(filepath=str(prediction / "prediction.json"))
    folder = tmp_path / "file-panoless" / "prediction" / "blender"
    if change == "version":
        table = json.loads((folder / "scene.json").read_text())
        (folder / "scene.json").write_text(json.dumps(table | {"format_version": 2}))
    elif change == "missing":
        (folder / "surface.npz").unlink()
    else:
        whole = (folder / "surface.npz").read_bytes()
        (folder / "surface.npz").write_bytes(b"PK" if change == "damaged" else whole[: len(whole) // 2])
    with pytest.raises(Problem):
        build(blender.context.scene, Content(folder))
    assert "PanoLess mirror" in blender.data.objects, "What was there stays."


def test_no_photographs_are_one_message(blender: Any, programs: Path, tmp_path: Path) -> None:
    assert "There is nothing at" in message_of(blender.ops.panoless.light, filepath=str(tmp_path / "gone.jpg"))


def test_operators_say_what_they_lack(blender: Any) -> None:
    for name in ("photograph", "insert", "benchmark", "cancel", "continue_run"):
        assert not getattr(blender.ops.panoless, name).poll(), name


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("sh") is None, reason="needs a shell")
def test_the_benchmark_of_a_scene_is_scored(blender: Any, programs: Path) -> None:
    """Generated by the real benchmark from the open file with unsaved changes, and scored by it."""
    blender.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, radius=0.3, location=(1, 2, 3))
    blender.context.object.name = "My ball"
    settings = blender.context.scene.panoless
    settings.bench_resolution, settings.bench_views, settings.bench_tests = 24, 4, 1
    settings.bench_samples, settings.bench_noise = 1, 0.01
    assert blender.ops.panoless.benchmark() == {"FINISHED"}
    assert "dB" in settings.score
    dataset = work_folder("benchmark") / "noisy"
    assert len(list((dataset / "train").glob("*.exr"))) == 4
