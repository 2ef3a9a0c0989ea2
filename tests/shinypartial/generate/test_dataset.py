"""Making a dataset: it validates, plain readers open it, a killed run continues, and bad surroundings are
reported."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions
from shinypartial.dataset.camera_plot import CAMERA_PLOT
from shinypartial.dataset.read import open_dataset, read_environment, read_inverse_distance, read_view
from shinypartial.dataset.schema import CHECKSUMS, CONTACT_SHEET, ENVIRONMENT_LATLONG, LICENSES, MANIFEST
from shinypartial.dataset.validate import validate
from shinypartial.generate.dataset import generate
from shinypartial.io.files import PARTIAL_PREFIX
from shinypartial.scene import SceneSpec, load_scene, override
from tests.support.interrupts import heed_interrupts
from tests.support.tiny_scene import WORLD_HEIGHT, direction_colors, tiny_scene, write_recipe

pytest.importorskip("bpy")

ROOT = Path(__file__).resolve().parents[3]
#: For a process that takes seconds on an idle machine.
LONG_ENOUGH_S = 60.0


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> SceneSpec:
    return tiny_scene(tmp_path_factory.mktemp("recipe"))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, spec: SceneSpec) -> Path:
    """A finished dataset; tests only read it."""
    return generate(spec, tmp_path_factory.mktemp("generated") / "tiny").root


def run(*arguments: str | Path, before: str = "") -> subprocess.CompletedProcess[str]:
    """The command line in a fresh process, which may first execute a statement."""
    program = f"import sys; {before}\nfrom shinypartial.cli import main\nsys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=LONG_ENOUGH_S)


def partial_files(root: Path) -> list[Path]:
    return list(root.rglob(f"{PARTIAL_PREFIX}*"))


def modification_times(root: Path) -> dict[str, int]:
    """Of every frame's files, by name."""
    return {
        path.relative_to(root).as_posix(): path.stat().st_mtime_ns
        for split in ("train", "test")
        for path in (root / split).glob("r_*")
    }


def test_what_is_made_keeps_every_promise(made: Path, spec: SceneSpec) -> None:
    assert [each for each in validate(made) if not each.warning] == []
    dataset = open_dataset(made)
    assert (len(dataset.train), len(dataset.test)) == (spec.camera.train, spec.camera.test)
    assert dataset.manifest["recipe"]["object"] == spec.recipe()["object"]
    assert dataset.manifest["complete"] is True
    assert dataset.manifest["generator"]["blender"].startswith("5.")
    np.testing.assert_allclose(read_environment(dataset), direction_colors(WORLD_HEIGHT), atol=5e-4)


def test_a_picture_of_the_cameras_comes_with_it(made: Path) -> None:
    assert (made / CAMERA_PLOT).stat().st_size < 150_000
    assert f"  {CAMERA_PLOT}\n" in (made / CHECKSUMS).read_text(encoding="utf-8")


def test_statistics_say_what_the_views_see(made: Path, spec: SceneSpec) -> None:
    dataset = open_dataset(made)
    statistics = dataset.manifest["statistics"]
    pixels = sum(int((read_view(frame).alpha > 0.99).sum()) for frame in dataset.train)
    assert statistics["object_pixels"]["train"] == pixels > 0
    assert statistics["self_reflection"] == {"train": 0.0, "test": 0.0}, "A sphere never sees itself."
    assert 0 < statistics["coverage"] < 1
    assert 0 <= statistics["resolved_coverage"] <= statistics["coverage"]


def test_views_hold_self_reflection_and_a_sheet_shows_them(made: Path) -> None:
    from PIL import Image

    assert all((read_view(frame).self_reflection == 0).all() for frame in open_dataset(made).train)
    assert open_dataset(made).manifest["format_minor"] == 2
    with Image.open(made / CONTACT_SHEET) as sheet:
        assert sheet.format == "JPEG"
        assert min(sheet.size) >= 160
    assert (made / CONTACT_SHEET).stat().st_size < 300_000


def test_a_world_file_brings_its_license(made: Path) -> None:
    scene, light = json.loads((made / LICENSES).read_text(encoding="utf-8"))
    assert scene["license"] == "CC0-1.0"
    assert light == {"asset": "environment world.exr", "license": "CC0-1.0", "source": "computed"}


def test_a_plain_reader_needs_pictures_and_transforms_alone(made: Path, tmp_path: Path) -> None:
    for path in made.rglob("*"):
        if path.name.startswith("transforms_") or path.match("r_???.png"):
            copy = tmp_path / path.relative_to(made)
            copy.parent.mkdir(exist_ok=True)
            copy.write_bytes(path.read_bytes())
    plain, full = open_dataset(tmp_path), open_dataset(made)
    for ours, theirs in zip((*full.train, *full.test), (*plain.train, *plain.test), strict=True):
        np.testing.assert_array_equal(ours.camera.camera_to_world, theirs.camera.camera_to_world)
        low, high = read_view(theirs), read_view(ours)
        # 8-bit sRGB: half a level is at most 0.0045 of linear light; alpha half of 1/255.
        np.testing.assert_allclose(low.radiance, np.clip(high.radiance, 0, 1), atol=0.007)
        np.testing.assert_allclose(low.alpha, high.alpha, atol=0.002)


def test_a_dataset_under_real_conditions_keeps_the_format_and_knows_its_room(tmp_path: Path) -> None:
    """Everything at once; the distance of the walls is found by marching along the rays."""
    tiny = tiny_scene(tmp_path / "recipe", resolution=24, samples=8)
    spec = override(
        tiny,
        surroundings_radii=6.0,
        surroundings_room="box",
        surroundings_proportions=(1.0, 2.0, 1.5),
        operator_height=1.5,
        f_number=0.05,
        motion_deg=20.0,
    )
    root = generate(spec, tmp_path / "made").root
    assert [each for each in validate(root) if not each.warning] == []
    dataset = open_dataset(root)
    assert dataset.object_radius == pytest.approx(1.0)
    inverse = read_inverse_distance(dataset)
    assert inverse is not None
    assert inverse.shape == read_environment(dataset).shape[:2]
    directions = latlong_directions(inverse.shape[0])[::9, ::9]
    distances = np.linspace(5, 20, 1501)
    outside = (np.abs(distances[:, None, None, None] * directions) > [6.0, 12.0, 9.0]).any(-1)
    np.testing.assert_allclose(1 / inverse[::9, ::9], distances[outside.argmax(0)], atol=0.011)
    (root / "environment/inverse_distance.exr").unlink()
    assert any(each.file == "environment/inverse_distance.exr" for each in validate(root))


def test_a_far_world_has_no_inverse_distance(made: Path) -> None:
    assert read_inverse_distance(open_dataset(made)) is None


def test_a_finished_dataset_is_left_alone(made: Path, spec: SceneSpec) -> None:
    before = {path: path.stat().st_mtime_ns for path in made.rglob("*")}
    again = generate(spec, made)
    assert (again.rendered, again.kept) == (0, spec.camera.train + spec.camera.test)
    assert {path: path.stat().st_mtime_ns for path in made.rglob("*")} == before


def test_a_deleted_frame_alone_is_made_again(made: Path, tmp_path: Path, spec: SceneSpec) -> None:
    root = Path(shutil.copytree(made, tmp_path / "tiny"))
    before = modification_times(root)
    (root / "train/r_001.exr").unlink()
    (root / f"train/{PARTIAL_PREFIX}left.exr").write_bytes(b"half")
    assert generate(spec, root).rendered == 1
    changed = {name for name, when in modification_times(root).items() if before[name] != when}
    assert changed == {f"train/r_001{end}" for end in (".exr", ".png", "_alpha.png", "_normal.png", "_self.png")}
    assert [each for each in validate(root) if not each.warning] == []


def test_deleted_files_are_made_again_and_nothing_is_rendered(made: Path, tmp_path: Path, spec: SceneSpec) -> None:
    root = Path(shutil.copytree(made, tmp_path / "tiny"))
    frames = modification_times(root)
    for name in (ENVIRONMENT_LATLONG, "environment/cube/px.exr", "transforms_test.json", CAMERA_PLOT, LICENSES):
        (root / name).unlink()
    assert generate(spec, root).rendered == 0
    assert modification_times(root) == frames
    assert (root / CHECKSUMS).read_bytes() == (made / CHECKSUMS).read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="SIGKILL is a POSIX signal.")
def test_a_killed_run_continues_without_rendering_anything_twice(tmp_path: Path) -> None:
    scene, root = write_recipe(tmp_path, train=12, test=12), tmp_path / "out"
    command = [sys.executable, "-m", "shinypartial.cli", "generate", "--scene", str(scene), "--output", str(root)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + LONG_ENOUGH_S
    while len(list(root.glob("*/r_???.exr"))) < 5 and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, "It must not have ended by itself."
    finished = {path.name: path.stat().st_mtime_ns for path in root.glob("train/r_???.exr")}
    assert 5 <= len(finished) < 24
    assert not (root / CHECKSUMS).exists()
    with pytest.raises(InputError, match="not ended"):
        open_dataset(root)

    assert generate(load_scene(str(scene)), root).kept == len(finished)
    for name, when in finished.items():
        assert (root / "train" / name).stat().st_mtime_ns == when
    assert [each for each in validate(root) if not each.warning] == []
    assert partial_files(root) == []


def processes_below(folder: Path) -> list[int]:
    """Every process whose temporary files go below a folder."""
    entry = f"TMPDIR={folder}".encode()
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            if entry in path.read_bytes():
                found.append(int(path.parent.name))
    return found


def start_long_run(tmp_path: Path, views: int) -> "subprocess.Popen[str]":
    """`generate` of that many views of each split into tmp_path/out; its temporary files go to tmp_path/tmp."""
    scene = write_recipe(tmp_path, train=views, test=views)
    (tmp_path / "tmp").mkdir()
    command = [sys.executable, "-m", "shinypartial.cli", "generate", "--scene", str(scene)]
    process = subprocess.Popen(
        [*command, "--output", str(tmp_path / "out")],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path / "tmp")},
        preexec_fn=heed_interrupts,
    )
    deadline = time.monotonic() + LONG_ENOUGH_S
    while len(list(tmp_path.glob("out/*/r_???.exr"))) < 3 and time.monotonic() < deadline:
        time.sleep(0.005)
    return process


linux_only = pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="Processes are looked up in /proc.")


@pytest.mark.slow
@linux_only
def test_an_interrupt_ends_the_run_at_once_and_leaves_nothing_behind(tmp_path: Path) -> None:
    process = start_long_run(tmp_path, 200)
    root, began = tmp_path / "out", time.monotonic()
    assert len(processes_below(tmp_path / "tmp")) >= 2, "The run and its workers, or the test below proves nothing."
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=LONG_ENOUGH_S)
    assert process.returncode == 130
    # Measured 0.3 s on an idle machine.
    assert time.monotonic() - began < 10
    assert "Run the same command again" in err
    assert "Traceback" not in err
    assert len(list(root.glob("*/r_???.exr"))) < 400
    assert partial_files(root) == []
    assert processes_below(tmp_path / "tmp") == []
    assert list((tmp_path / "tmp").iterdir()) == []


@linux_only
def test_a_run_goes_on_where_its_workers_are_killed(tmp_path: Path) -> None:
    process = start_long_run(tmp_path, 12)
    root = tmp_path / "out"
    finished = modification_times(root)
    workers = [pid for pid in processes_below(tmp_path / "tmp") if pid != process.pid]
    assert workers
    for pid in workers:
        os.kill(pid, signal.SIGKILL)
    _, err = process.communicate(timeout=LONG_ENOUGH_S)
    assert process.returncode == 0, err
    after = modification_times(root)
    whole = [name for name in finished if name.endswith(".exr")]
    assert {name: after[name] for name in whole} == {name: finished[name] for name in whole}
    assert len([name for name in after if name.endswith(".exr")]) == 24
    assert [each for each in validate(root) if not each.warning] == []
    assert list((tmp_path / "tmp").iterdir()) == []


def test_the_command_itself_never_loads_blender(tmp_path: Path) -> None:
    scene = write_recipe(tmp_path)
    program = "from shinypartial.cli import main; main(sys.argv[1:]); sys.exit(7 if 'bpy' in sys.modules else 0)"
    command = [sys.executable, "-c", f"import sys; {program}", "generate", "--scene", str(scene)]
    result = subprocess.run([*command, "--output", str(tmp_path / "out")], cwd=ROOT, check=False, timeout=LONG_ENOUGH_S)
    assert result.returncode == 0
    assert (tmp_path / "out" / CHECKSUMS).exists()


def test_a_run_that_was_killed_before_its_manifest_continues(tmp_path: Path, spec: SceneSpec) -> None:
    (tmp_path / f"{PARTIAL_PREFIX}dataset.json").write_text("{")
    assert generate(spec, tmp_path).rendered == 4
    assert partial_files(tmp_path) == []


def test_a_folder_of_another_recipe_is_refused(made: Path, tmp_path: Path) -> None:
    result = run("generate", "--scene", "vase", "--output", made)
    assert result.returncode == 2
    assert "another recipe" in result.stderr
    assert "Traceback" not in result.stderr


def test_only_one_run_writes_to_a_folder(tmp_path: Path, spec: SceneSpec) -> None:
    fcntl = pytest.importorskip("fcntl")
    handle = os.open(tmp_path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="another run"):
            generate(spec, tmp_path)
    finally:
        os.close(handle)


def test_an_output_that_can_not_be_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    result = run("generate", "--scene", "vase", "--output", tmp_path / "file" / "below")
    assert result.returncode == 2
    assert "permissions, or choose another --output" in result.stderr
    assert "Traceback" not in result.stderr


def test_an_unknown_scene_is_refused_with_what_exists() -> None:
    result = run("generate", "--scene", "no-such-scene")
    assert result.returncode == 2
    assert "vase" in result.stderr


@pytest.mark.parametrize(
    "limit_bytes",
    [400, *(pytest.param(each, marks=pytest.mark.slow) for each in (3000, 100_000))],
    ids=["at the manifest", "at the map", "at Blender's file"],
)
def test_a_full_disk_leaves_nothing_half_written(tmp_path: Path, limit_bytes: int) -> None:
    """A limit on the size of files fails writes as a full disk does; a roomier rerun then finishes the dataset."""
    pytest.importorskip("resource")
    scene, root = write_recipe(tmp_path, resolution=64), tmp_path / "out"
    limit = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit_bytes}, resource.RLIM_INFINITY))"
    result = run("generate", "--scene", scene, "--output", root, before=limit)
    assert result.returncode == 2, result.stderr
    assert "Free some space" in result.stderr
    assert "Traceback" not in result.stderr
    assert partial_files(root) == []
    for path in root.rglob("*.exr"):
        assert path.stat().st_size < limit_bytes, "A file under its final name is whole, so below the limit."
    generate(load_scene(str(scene)), root)
    assert [each for each in validate(root) if not each.warning] == []


@pytest.mark.slow
def test_writes_that_fail_between_frames_stop_the_run_cleanly(
    tmp_path: Path, spec: SceneSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second frame's EXR does not fit: the first stays, nothing of the second looks finished."""
    import errno

    from shinypartial.dataset import write

    whole, written = write.write_exr, []

    def fill_up(path: Path, channels: dict[str, np.ndarray], **options: bool) -> None:
        if path.parent.name in ("train", "test") and (written.append(path) or len(written) == 2):
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        whole(path, channels, **options)

    monkeypatch.setattr(write, "write_exr", fill_up)
    with pytest.raises(OSError, match="No space"):
        generate(spec, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").glob("*/r_???.exr")] == ["r_000.exr"]
    assert partial_files(tmp_path) == []
    monkeypatch.undo()
    assert generate(spec, tmp_path / "out").kept == 1


def test_without_bpy_one_sentence_tells_how_to_install_it(tmp_path: Path) -> None:
    result = run("generate", "--scene", "vase", "--output", tmp_path / "out", before="sys.modules['bpy'] = None")
    assert result.returncode == 2
    assert "pip install 'panoless[blender]'" in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "out").exists(), "It must refuse before it makes anything."


def test_another_python_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from shinypartial.blender import runtime

    monkeypatch.setattr(runtime.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(runtime.sys, "version_info", (3, 12, 0))
    with pytest.raises(InputError, match=r"Python 3\.11 or 3\.13.*3\.12.*pip install 'panoless\[blender\]'"):
        runtime.check_blender()


def test_a_finished_dataset_needs_no_blender(made: Path, spec: SceneSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    from shinypartial.blender import runtime

    monkeypatch.setattr(runtime.importlib.util, "find_spec", lambda name: None)
    assert generate(spec, made).rendered == 0


def test_a_world_that_is_no_latlong_map_is_refused(tmp_path: Path) -> None:
    from shinypartial.io.images import write_exr_rgb

    recipe = write_recipe(tmp_path)
    write_exr_rgb(tmp_path / "world.exr", np.ones((8, 8, 3), np.float32))
    with pytest.raises(InputError, match="twice as wide as high"):
        generate(load_scene(str(recipe)), tmp_path / "out")


def test_the_manifest_is_strict_json(made: Path) -> None:
    json.loads((made / MANIFEST).read_text(encoding="utf-8"), parse_constant=lambda name: pytest.fail(name))
