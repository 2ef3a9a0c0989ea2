"""Photographs of a ball to a dataset and on to a fit, from one photograph on; and what the command refuses."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

from panoless.cli import main
from panoless.photographs.ball.make import BallRequest, CapturedBall, capture_ball
from panoless.photographs.lens import Lens
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset, read_ball_evidence, read_view
from shinypartial.dataset.schema import Dataset
from shinypartial.io.images import write_jpeg, write_png
from tests.panoless.photographs.ball.conftest import NOISE, POSES, Taken
from tests.support.traced_ball import FILM_MM, Scene, developed, exif, lens_of, turns_between

EXPOSURES = (0.12, 0.5, 2.0)


def written(
    folder: Path, taken: Taken, views: Sequence[int], exposures: Sequence[float] | None = None
) -> tuple[Path, ...]:
    """JPEGs with EXIF; of several exposures where these are given."""
    files = []
    for view in views:
        for step, exposure in enumerate(exposures or (1.0,)):
            path = folder / f"v{view}{step if exposures else ''}.jpg"
            codes = developed(taken.radiances[view], exposure, NOISE, seed=view)
            write_jpeg(path, codes, 95, exif(seconds=0.01 * exposure))
            files.append(path)
    return tuple(files)


def normal_errors(dataset: Dataset, truth: Sequence[Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "N"]:
    """Angles (deg) between the normals of the unit ball about the origin by the dataset's cameras and the true ones,
    in each camera's frame: no turn of the world matters.
    """
    angles = []
    for frame, pose in zip(dataset.train, truth, strict=True):
        camera = frame.camera
        found_lens = Lens(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        found = Scene().normals(camera.camera_to_world, found_lens) @ camera.camera_to_world[:3, :3]
        true = Scene().normals(pose, lens_of()) @ pose[:3, :3]
        both = found.any(-1) & true.any(-1)
        angles.append(np.degrees(np.arccos(np.clip((found[both] * true[both]).sum(-1), -1, 1))))
    return np.concatenate(angles)


@pytest.fixture(scope="session")
def captures(far: Taken, tmp_path_factory: pytest.TempPathFactory) -> dict[int, tuple[CapturedBall, Dataset]]:
    """Of one, two and three photographs; the two stand on opposite sides."""
    made = {}
    for views in ((0,), (0, 2), (0, 1, 3)):
        folder = tmp_path_factory.mktemp("captures")
        captured = capture_ball(BallRequest(written(folder, far, views), folder / "dataset"))
        made[len(views)] = captured, open_dataset(folder / "dataset")
    return made


VIEWS = {1: (0,), 2: (0, 2), 3: (0, 1, 3)}


@pytest.mark.parametrize("count", [1, 2, 3])
def test_photographs_become_a_dataset(captures: dict[int, tuple[CapturedBall, Dataset]], count: int) -> None:
    """Of a ball of radius 1 about the origin, with poses, masks and what the capture knows of itself."""
    captured, dataset = captures[count]
    assert captured.frames == tuple(f"v{view}" for view in VIEWS[count])
    assert captured.left_out == ()
    assert not captured.high_dynamic_range
    assert captured.focal.film_mm == pytest.approx(FILM_MM, rel=0.03)
    evidence = read_ball_evidence(dataset)
    assert evidence == captured.evidence
    assert evidence.rim_px < 1
    assert (evidence.turn_deg > 0) is (count > 1)
    assert len(dataset.train) == count
    found = np.stack([frame.camera.camera_to_world[:3, :3].T for frame in dataset.train])
    truth = np.stack([POSES[view][:3, :3].T for view in VIEWS[count]])
    assert turns_between(found, truth).max() < 1
    for frame in dataset.train:
        assert np.linalg.norm(frame.camera.camera_to_world[:3, 3]) == pytest.approx(6, rel=0.05)
    assert any(f"in {count} photographs" in line for line in captured.summary())


@pytest.mark.parametrize(("count", "share"), [(1, 0.04), (2, 0.02), (3, 0.02)])
def test_masks_are_those_of_the_ball(
    captures: dict[int, tuple[CapturedBall, Dataset]], far: Taken, count: int, share: float
) -> None:
    """But for a ring: a pixel is 2.6 % of a ball of 77 px. Measured: 2.6 % by one rim, 0.5 to 1 % by two views."""
    for frame, view in zip(captures[count][1].train, VIEWS[count], strict=True):
        alpha, true = read_view(frame).alpha, far.scene.covers(POSES[view], far.lens)
        assert np.abs(alpha - true).sum() / true.sum() < share


@pytest.mark.parametrize(("count", "limit_deg"), [(1, 1.5), (2, 0.5), (3, 0.3)])
def test_normals_are_those_of_the_ball(
    captures: dict[int, tuple[CapturedBall, Dataset]], count: int, limit_deg: float
) -> None:
    """A rim of 77 px whose middle is off by a pixel turns all normals by 0.7°; what others mirror sets it right."""
    assert np.median(normal_errors(captures[count][1], [POSES[view] for view in VIEWS[count]])) < limit_deg


def test_exposures_of_two_places_become_two_views(far: Taken, tmp_path: Path) -> None:
    files = written(tmp_path, far, (0, 1), EXPOSURES)
    captured = capture_ball(BallRequest(files, tmp_path / "dataset"))
    assert captured.high_dynamic_range
    assert captured.brackets == 6
    assert len(captured.frames) == 2
    for frame, view in zip(open_dataset(tmp_path / "dataset").train, (0, 1), strict=True):
        found, truth = read_view(frame).radiance, far.radiances[view]
        on = (read_view(frame).alpha > 0.99) & (truth.min(-1) > 0.1)
        ratio = (found[on] / truth[on]).ravel()
        # JPEG and noise of 2.5 codes, in the median of pixels.
        assert np.median(np.abs(ratio / np.median(ratio) - 1)) < 0.03
        lamps = on & (truth.min(-1) > 3)
        assert lamps.any()
        assert np.median(found[lamps] / truth[lamps]) == pytest.approx(np.median(ratio), rel=0.03)


def test_a_ball_of_glass_is_refused(far: Taken, tmp_path: Path) -> None:
    glass = Taken(replace(far.scene, glass=True), POSES[:1], far.lens)
    with pytest.raises(InputError, match="as glass does"):
        capture_ball(BallRequest(written(tmp_path, glass, (0,)), tmp_path / "dataset"))


@pytest.mark.slow
def test_photographs_of_two_rooms_are_refused(far: Taken, near: Taken, tmp_path: Path) -> None:
    """Nothing says which of both is meant."""
    files = written(tmp_path, far, (0,)) + written(tmp_path, near, (1,))
    with pytest.raises(InputError, match="whose reflections agree"):
        capture_ball(BallRequest(files, tmp_path / "dataset"))


def test_the_command_takes_photographs_of_a_ball(
    far: Taken, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without --object; again into the same folder; and not into one that holds something else."""
    files = [str(file) for file in written(tmp_path, far, (0, 1))]
    output = tmp_path / "dataset"
    for _ in range(2):
        assert main(["capture", *files, "--output", str(output)]) == 0
        printed = capsys.readouterr().out
        assert "Ball: in 2 photographs" in printed
        assert "panoless fit" in printed
        assert len(open_dataset(output).train) == 2
    assert (output / "capture" / "ball.jpg").exists()
    other = tmp_path / "other"
    other.mkdir()
    (other / "notes.txt").write_text("mine")
    assert main(["capture", *files, "--output", str(other)]) == 2
    assert "a new or empty output folder" in capsys.readouterr().err
    assert [path.name for path in other.iterdir()] == ["notes.txt"]


def test_a_stated_focal_length_is_taken(far: Taken, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (file,) = written(tmp_path, far, (0,))
    output = tmp_path / "dataset"
    assert main(["capture", str(file), "--output", str(output), "--focal-mm", "40"]) == 0
    assert "Lens: 40 mm on 35 mm film ± 1%, from as given" in capsys.readouterr().out
    camera = open_dataset(output).train[0].camera
    assert camera.fx == pytest.approx(40 / np.hypot(36, 24) * np.hypot(camera.width, camera.height), rel=1e-4)


@pytest.mark.parametrize("stated", [[], ["--object", "ball"]])
def test_a_file_that_is_no_picture_is_one_message(
    far: Taken, tmp_path: Path, capsys: pytest.CaptureFixture[str], stated: list[str]
) -> None:
    """And it is no reason to refuse the folder the next time."""
    (good,) = written(tmp_path, far, (0,))
    bad, output = tmp_path / "bad.jpg", tmp_path / "dataset"
    bad.write_bytes(b"no picture")
    assert main(["capture", str(bad), str(good), "--output", str(output), *stated]) == 2
    errors = capsys.readouterr().err
    assert errors.count("error: expected") == 1
    assert "bad.jpg" in errors
    assert "Traceback" not in errors
    assert main(["capture", str(good), "--output", str(output), *stated]) == 0


def test_two_photographs_of_one_name_are_one_message(
    far: Taken, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (file,) = written(tmp_path, far, (0,))
    again = tmp_path / "again" / file.name
    write_jpeg(again, far.shots[1].pixels, 95, exif())
    assert main(["capture", str(file), str(again), "--output", str(tmp_path / "dataset")]) == 2
    assert "two named v0" in capsys.readouterr().err


def test_few_photographs_without_a_ball_are_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gray = np.random.default_rng(0).integers(0, 255, (120, 160, 3)).astype(np.uint8)
    write_png(tmp_path / "one.png", gray)
    assert main(["capture", str(tmp_path / "one.png"), "--output", str(tmp_path / "dataset")]) == 2
    assert "a mirror ball, or at least 8 photographs" in capsys.readouterr().err
    assert not (tmp_path / "dataset").exists()


@pytest.mark.parametrize("count", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_fit_of_the_capture_is_not_distrusted(
    captures: dict[int, tuple[CapturedBall, Dataset]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """A fit keeps the ball and the cameras of its capture; where a pixel mirrors the room, the map shows it."""
    from panoless.api import fit

    monkeypatch.chdir(tmp_path)
    small = ("environment.resolution=32", "environment.solve_resolution=32", "environment.rays=100000")
    found = fit(captures[count][1].root, preset="fast", output=tmp_path / "prediction", set=small)
    assert found.info.model.startswith("sphere")
    assert found.info.verdict is not None
    assert found.info.verdict.verdict != "do not trust"
    assert found.info.verdict.evidence["rim_px"] == pytest.approx(captures[count][0].evidence.rim_px)
