"""Films that Blender renders: what lies around the object is where the truth says, and a killed run continues."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shinypartial.blender.render import open_renderer
from shinypartial.core.camera import Camera, look_at, ray_directions_world
from shinypartial.core.errors import InputError
from shinypartial.core.handheld import Hand
from shinypartial.dataset.read import open_dataset, read_environment, read_view
from shinypartial.dataset.validate import validate
from shinypartial.generate.film import FRAMES, KNOWN, MASKS, TRUTH, VIDEO, film
from shinypartial.io.images import read_png
from shinypartial.scene import FilmSpec, Ground, override
from tests.support.tiny_scene import direction_colors, tiny_scene

pytest.importorskip("bpy")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> FilmSpec:
    """A ball of 6 cm on a board, in a world that is colored by direction."""
    shape = '{ kind = "sphere", radius = 0.06, segments = 128, rings = 64 }'
    scene = tiny_scene(tmp_path_factory.mktemp("recipe"), shape=shape, elevation="[30, 50]", train=3, test=1)
    scene = override(scene, radius=0.7, resolution=96, samples=16, operator_height=0.4)
    return FilmSpec(replace(scene, ground=Ground(height=-0.061, side=0.5, board="A4")), Hand(smooth_frames=1.0))


def test_the_backdrop_is_ground_and_world(spec: FilmSpec) -> None:
    """Where a ray through a pixel's center meets the sheet, or in its direction; edges of cells fall within pixels."""
    pose = look_at(np.array([0.4, -0.5, 0.45]), np.zeros(3))
    focal = spec.scene.camera.lens_mm / spec.scene.camera.sensor_mm * 96
    camera = Camera(pose, focal, focal, 48.0, 36.0, 96, 72)
    with open_renderer(spec.scene, threads=1) as renderer:
        seen = renderer.render_backdrop(camera)
        alone = renderer.render(camera)
        again = renderer.render_backdrop(camera)
    np.testing.assert_array_equal(seen, again)
    assert alone.alpha.shape == (72, 96)
    assert 0.01 < alone.alpha.mean() < 0.3
    ground, rays = spec.scene.ground, ray_directions_world(camera)
    assert ground is not None
    points = pose[:3, 3] + rays * ((ground.height - pose[2, 3]) / rays[..., 2:])
    on_sheet = (np.abs(points[..., :2]) < ground.side / 2).all(-1) & (rays[..., 2] < 0)
    expected = (rays + 1) / 2
    expected[on_sheet] = ground.radiance_at(points[on_sheet][:, :2])
    error = np.abs(seen - expected).max(-1)
    assert np.median(error[~on_sheet]) < 5e-3
    assert np.median(error[on_sheet]) < 0.1


def test_the_map_holds_what_lies_below(spec: FilmSpec, tmp_path: Path) -> None:
    made = film(spec, tmp_path / "film")
    truth = open_dataset(made.root / TRUTH)
    assert [each for each in validate(made.root / TRUTH) if not each.warning] == []
    assert [frame.stem.name for frame in truth.train] == ["frame_00000", "frame_00001", "frame_00002"]
    assert truth.board_corner == pytest.approx((-0.0945, 0.135, -0.061))
    environment = read_environment(truth)
    height = len(environment)
    np.testing.assert_allclose(environment[: height // 2], direction_colors(height)[: height // 2], atol=5e-3)
    assert np.abs(environment[-2:].mean() - 0.7 * 0.5) < 0.3
    before = {path: path.stat().st_mtime_ns for path in made.root.rglob("*.*") if path.suffix in (".jpg", ".exr")}
    # Lost files are made again, and no others.
    lost = made.root / FRAMES / "frame_00001.jpg"
    content = lost.read_bytes()
    lost.unlink()
    (made.root / VIDEO).unlink()
    again = film(spec, made.root)
    assert (again.recorded, again.kept) == (1, 2)
    assert lost.read_bytes() == content
    after = {path: path.stat().st_mtime_ns for path in before}
    assert {path.name for path in before if after[path] != before[path]} == {lost.name}
    mask = read_png(made.root / MASKS / "frame_00001.png")[..., 0] / 255
    assert np.abs(mask - read_view(truth.train[1]).alpha).mean() < 0.01
    assert (made.root / KNOWN / "transforms.json").exists()
    with pytest.raises(InputError, match="another film"):
        film(replace(spec, hand=Hand(seed=1)), made.root)
    cv2 = pytest.importorskip("cv2")
    video = cv2.VideoCapture(str(made.root / VIDEO))
    for index in range(3):
        found, frame = video.read()
        assert found
        picture = cv2.imread(str(made.root / FRAMES / f"frame_0000{index}.jpg"))
        assert np.abs(frame.astype(float) - picture).mean() < 12
    assert not video.read()[0]
