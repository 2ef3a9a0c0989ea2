"""Folders of Stanford-ORB and Objects with Lighting, made of a traced sphere, come back in our frame and encoding."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shinypartial.conversion.captures.make import import_capture, named_axes
from shinypartial.conversion.layouts import CaptureLayout
from shinypartial.core.camera import Camera, opencv_to_opengl
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import sample_latlong
from shinypartial.dataset.read import open_dataset, read_environment, read_view
from shinypartial.dataset.schema import View
from shinypartial.dataset.validate import unscored, validate
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.io.files import read_json, sha256_of, write_json
from shinypartial.io.images import write_exr, write_exr_rgb, write_hdr, write_png
from tests.support.synthetic_dataset import FIELD_OF_VIEW_RAD, environment_radiance, render_sphere, sphere_cameras
from tests.support.truth_prediction import write_truth_prediction

SIZE, HEIGHT = 32, 64
#: OpenGL's axes in OpenCV's.
OPENGL = np.diag([1.0, -1.0, -1.0])


def skylibs(height: int) -> np.ndarray:
    """(sin πv sin θ, cos πv, −sin πv cos θ), θ = π(2u − 1): x to the right, y up, the middle along −z."""
    u, v = np.meshgrid((np.arange(2 * height) + 0.5) / (2 * height), (np.arange(height) + 0.5) / height)
    theta, phi = np.pi * (2 * u - 1), np.pi * v
    return np.stack([np.sin(phi) * np.sin(theta), np.cos(phi), -np.sin(phi) * np.cos(theta)], -1)


def cameras() -> list[tuple[str, int, Camera]]:
    return [(s, i, c) for s, n in (("train", 6), ("test", 3)) for i, c in enumerate(sphere_cameras(s, n, SIZE))]


def straight(view: View) -> np.ndarray:
    return view.radiance / np.maximum(view.alpha, 1e-6)[..., None]


def write_orb(root: Path, axes_of_normals: Callable[[Camera], np.ndarray]) -> Path:
    """A capture in `blender_HDR` with its ground truth; the first map has a photographer, black on +X."""
    capture, truth = capture_of(root), root / "ground_truth/ball_scene001"
    frames: dict[str, list[dict[str, object]]] = {"train": [], "test": []}
    for split, index, camera in cameras():
        view, name = render_sphere(camera), f"{index:04d}"
        write_exr(capture / split / f"{name}.exr", {c: straight(view)[..., i] for i, c in enumerate("RGB")})
        write_png(capture / f"{split}_mask/{name}.png", np.rint(255 * view.alpha).astype(np.uint8))
        pose = opencv_to_opengl(camera.camera_to_world)
        frames[split].append({"file_path": f"{split}/{name}", "transform_matrix": pose.tolist()})
        if split == "test":
            directions = skylibs(HEIGHT) @ pose[:3, :3].T
            light = environment_radiance(directions) * ~((index == 0) & (directions[..., :1] > 0.9))
            write_exr_rgb(truth / f"env_map/{name}.exr", light)
            assert view.normals_world is not None
            (truth / "surface_normal").mkdir(parents=True, exist_ok=True)
            np.save(truth / f"surface_normal/{name}.npy", view.normals_world @ axes_of_normals(camera))
    for split, entries in frames.items():
        write_json(capture / f"transforms_{split}.json", {"camera_angle_x": FIELD_OF_VIEW_RAD, "frames": entries})
    return capture


def write_owl(root: Path, turn: np.ndarray | None = None) -> Path:
    """An object's `inputs` with all nine views, and the light in the world's axes, or in others with their matrix."""
    for number, (_, _, camera) in enumerate(cameras()):
        view = render_sphere(camera)
        codes = np.rint(255 * np.clip(straight(view), 0, 1) ** (1 / 2.2)).astype(np.uint8)
        write_png(root / f"inputs/image_{number:04d}.png", codes)
        write_png(root / f"inputs/mask_{number:04d}.png", np.rint(255 * view.alpha).astype(np.uint8))
        rows = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        pose = camera.world_to_camera
        rows += [*pose[:3, :3].tolist(), pose[:3, 3].tolist(), [SIZE, SIZE, 3]]
        text = "\n".join(" ".join(map(str, row)) for row in rows)
        (root / f"inputs/camera_{number:04d}.txt").write_text(text)
    u, v = np.meshgrid((np.arange(2 * HEIGHT) + 0.5) / (2 * HEIGHT), (np.arange(HEIGHT) + 0.5) / HEIGHT)
    phi, theta = np.pi * (1 - 2 * u), np.pi * v
    stored = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    if turn is None:
        write_hdr(root / "env_512_rotated.hdr", environment_radiance(stored))
    else:
        write_hdr(root / "env.hdr", environment_radiance(stored @ turn))
        np.savetxt(root / "world_to_env.txt", turn)
    return root


NORMAL_AXES = {
    "world": lambda camera: np.eye(3),
    "OpenGL camera": lambda camera: camera.camera_to_world[:3, :3] @ OPENGL,
    "OpenCV camera": lambda camera: camera.camera_to_world[:3, :3],
}


@pytest.fixture(scope="module")
def world_orb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of Stanford-ORB whose normals are the world's, and `dataset`, made of it; tests only read them."""
    root = tmp_path_factory.mktemp("orb")
    made = import_capture("stanford-orb", write_orb(root, NORMAL_AXES["world"]), root / "dataset")
    assert (made.train, made.test, made.left_out) == (6, 3, ())
    return root


def capture_of(root: Path) -> Path:
    return root / "blender_HDR/ball_scene001"


@pytest.mark.parametrize("axes", NORMAL_AXES)
def test_stanford_orb_comes_back_in_whatever_axes_normals_are(tmp_path: Path, world_orb: Path, axes: str) -> None:
    output = world_orb / "dataset"
    if axes != "world":
        output = tmp_path / "dataset"
        import_capture("stanford-orb", write_orb(tmp_path, NORMAL_AXES[axes]), output)
    assert validate(output) == []
    assert "coverage" in (unscored(output) or "")
    dataset = open_dataset(output)
    for frame, (_, _, camera) in zip([*dataset.train, *dataset.test], cameras(), strict=True):
        np.testing.assert_allclose(frame.camera.camera_to_world, camera.camera_to_world, atol=1e-6)
        view, true = read_view(frame), render_sphere(camera)
        # Masks have 8 bits, and radiance, up to 4, is multiplied by them.
        np.testing.assert_allclose(view.radiance, true.radiance, atol=0.01)
        if frame in dataset.test:
            assert view.normals_world is not None
            assert true.normals_world is not None
            cosine = (view.normals_world * true.normals_world).sum(-1)[true.alpha > SOLID_ALPHA]
            assert np.degrees(np.arccos(cosine.min().clip(-1, 1))) < 0.4  # 8 bits a component.


def test_stanford_orb_is_scored(tmp_path: Path, world_orb: Path) -> None:
    truth = write_truth_prediction(tmp_path / "truth", open_dataset(world_orb / "dataset"))
    scores = evaluate(truth, protocol="linear-v1")
    assert scores.environment is not None
    assert scores.normals is not None
    assert scores.normals.mean_angular_error_deg is not None
    assert scores.normals.mean_angular_error_deg < 0.1


def test_the_light_of_stanford_orb_is_that_of_most_views(world_orb: Path) -> None:
    # Two bilinear lookups in 64 rows flatten a sun of peak 3 by 0.03.
    _compare_light(world_orb / "dataset", 0.05)


@pytest.mark.parametrize("turned", [False, True])
def test_objects_with_lighting(tmp_path: Path, turned: bool) -> None:
    """Codes are those of x^(1/2.2) in 8 bits, read again as sRGB's: half a code of either is 0.005 of light at 1."""
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]) if turned else None
    output = tmp_path / "dataset"
    made = import_capture("objects-with-lighting", write_owl(tmp_path / "object", turn), output)
    assert (made.train, made.test) == (7, 2)
    assert made.left_out == ("normals: the layout has none",)
    assert validate(output) == []
    dataset, known = open_dataset(output), [camera for _, _, camera in cameras()]
    for frame in (*dataset.train, *dataset.test):
        camera = known[int(frame.stem.name[-4:])]
        np.testing.assert_allclose(frame.camera.camera_to_world, camera.camera_to_world, atol=1e-6)
        true = render_sphere(camera)
        expected = np.clip(straight(true), 0, 1) * true.alpha[..., None]
        np.testing.assert_allclose(read_view(frame).radiance, expected, atol=0.008)
    _compare_light(output, 0.06)  # RGBE has 8 bits for the brightest channel, which reaches 4: 1/64 and its neighbors.


def _compare_light(output: Path, tolerance: float) -> None:
    random = np.random.default_rng(0).normal(size=(500, 3))
    directions = random / np.linalg.norm(random, axis=1, keepdims=True)
    found = sample_latlong(read_environment(open_dataset(output)), directions)
    np.testing.assert_allclose(found, environment_radiance(directions), atol=tolerance)


def test_other_axes_of_the_map(tmp_path: Path) -> None:
    """A mirrored reading of the same file moves what lies in +Y to −Y."""
    folder = write_owl(tmp_path / "object")
    import_capture("objects-with-lighting", folder, tmp_path / "dataset", named_axes(("+X", "+Y", "+Z")))
    found = sample_latlong(read_environment(open_dataset(tmp_path / "dataset")), np.array([[0.0, 1.0, 0.0]]))
    np.testing.assert_allclose(found, environment_radiance(np.array([[0.0, -1.0, 0.0]])), atol=0.02)
    with pytest.raises(InputError, match="different letters"):
        named_axes(("+X", "-X", "+Z"))


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    capture = write_orb(tmp_path, NORMAL_AXES["world"])
    (tmp_path / "ground_truth").rename(tmp_path / "elsewhere")
    made = import_capture("stanford-orb", capture, tmp_path / "dataset")
    assert [reason.partition(":")[0] for reason in made.left_out] == ["environment", "normals"]
    assert not (tmp_path / "dataset/environment").exists()


def as_pictures(capture: Path) -> None:
    """What `blender_LDR` has: PNG in place of EXR."""
    for path in capture.glob("*/*.exr"):
        write_png(path.with_suffix(".png"), np.zeros((SIZE, SIZE, 3), np.uint8))
        path.unlink()


def turn_a_camera(capture: Path) -> None:
    """The same pictures, taken elsewhere."""
    content = read_json(capture / "transforms_train.json", "cameras")
    content["frames"][0]["transform_matrix"] = np.eye(4).tolist()
    write_json(capture / "transforms_train.json", content)


@pytest.mark.parametrize("change", [as_pictures, turn_a_camera])
def test_another_capture_of_the_same_name_is_refused(
    tmp_path: Path, world_orb: Path, change: Callable[[Path], None]
) -> None:
    capture, output = capture_of(world_orb), Path(shutil.copytree(world_orb / "dataset", tmp_path / "dataset"))
    other = Path(shutil.copytree(capture, tmp_path / "other" / capture.name))
    change(other)
    before = {path: sha256_of(path) for path in output.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match="different: import_of"):
        import_capture("stanford-orb", other, output)
    import_capture("stanford-orb", capture, output)
    assert {path: sha256_of(path) for path in output.rglob("*") if path.is_file()} == before


def test_an_import_goes_on_that_was_begun_before_sources_were_told_apart(tmp_path: Path) -> None:
    capture, output = write_owl(tmp_path / "object"), tmp_path / "dataset"
    import_capture("objects-with-lighting", capture, output)
    manifest = read_json(output / "dataset.json", "the manifest")
    for key in ("cameras", "pictures"):
        del manifest["recipe"]["import_of"][key]
    write_json(output / "dataset.json", manifest | {"complete": False})
    (output / "train/image_0001.png").unlink()
    import_capture("objects-with-lighting", capture, output)
    assert validate(output) == []


@pytest.mark.parametrize(
    ("layout", "broken", "word"),
    [
        ("stanford-orb", "train_mask/0002.png", "mask of train/0002"),
        ("objects-with-lighting", "inputs/image_0002.png", "image_0002.png"),
    ],
)
def test_folders_that_lack_files_are_refused(tmp_path: Path, layout: CaptureLayout, broken: str, word: str) -> None:
    source = write_orb(tmp_path, NORMAL_AXES["world"]) if layout == "stanford-orb" else write_owl(tmp_path / "object")
    (source.parent / "none").mkdir()
    (source / broken).unlink()
    with pytest.raises(InputError, match=word):
        import_capture(layout, source, tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()
    with pytest.raises(InputError, match=r"transforms|camera_0000"):
        import_capture(layout, source.parent / "none", tmp_path / "dataset")
