"""Photographs of a ball on a can: brackets, EXIF tags, and a mask without what the can hides."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float
from PIL import Image

from shinypartial.core.camera import Camera, ray_directions_world
from shinypartial.core.color import srgb_to_linear
from shinypartial.core.handheld import Hand
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.validate import validate
from shinypartial.generate.film import FRAMES, KNOWN, MASKS, TRUTH, VIDEO, film, plan_film
from shinypartial.io.files import read_json
from shinypartial.io.images import read_png
from shinypartial.scene import FilmSpec, Part, Phone, Photographs, SurfaceOfRevolution, override
from tests.support.tiny_scene import tiny_scene

IDEAL = Phone(k1=0.0, focus_px=0.0, shake_px=0.0, vignette_stops=0.0, drift_stops=0.0, shot_noise=0.0, read_noise=0.0)
STOPS = (-2.0, 0.0)
#: Of the can: its radius, and the heights of its bottom and of its flat top, which the unit ball reaches through.
CAN_RADIUS, CAN_HEIGHTS = 0.75, (-2.0, -0.6)


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> FilmSpec:
    """Two poses at low elevations, from opposite sides, in a far world that is colored by direction."""
    scene = tiny_scene(tmp_path_factory.mktemp("recipe"), elevation="[5, 20]", train=2, test=1)
    scene = override(scene, path="around", resolution=96, samples=16)
    low, high = CAN_HEIGHTS
    profile = ((0.0, low), (CAN_RADIUS, low), (CAN_RADIUS, high), (0.0, high))
    can = Part(SurfaceOfRevolution(profile, creases=(1, 2)))
    return FilmSpec(replace(scene, props=(can,)), Hand(smooth_frames=1.0), IDEAL, Photographs(bracket_stops=STOPS))


@pytest.fixture(scope="module")
def folder(spec: FilmSpec, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("bpy")
    return film(spec, tmp_path_factory.mktemp("photographs") / "film").root


def test_photographs_are_stills_with_a_truth_and_no_video(folder: Path) -> None:
    names = ["frame_00000_0", "frame_00000_1", "frame_00001_0", "frame_00001_1"]
    assert sorted(path.name for path in (folder / FRAMES).iterdir()) == [f"{name}.jpg" for name in names]
    assert not (folder / VIDEO).exists()
    truth = open_dataset(folder / TRUTH)
    assert [each for each in validate(folder / TRUTH) if not each.warning] == []
    assert [frame.stem.name for frame in truth.train] == names
    known = read_json(folder / KNOWN / "transforms.json", "transforms")
    assert [Path(each["file_path"]).stem for each in known["frames"]] == names[1::2]  # Those at zero stops.


def test_exposures_of_a_bracket_are_gains_and_exif_times(folder: Path) -> None:
    """Nothing clips, so that light is 2^stops of that at zero. Eight bits and JPEG leave 0.5 % of the mean."""
    for pose in range(2):
        paths = [folder / FRAMES / f"frame_0000{pose}_{shot}.jpg" for shot in range(2)]
        dark, bright = (srgb_to_linear(read_png(path) / np.float32(255)).mean() for path in paths)
        assert dark / bright == pytest.approx(2.0 ** (STOPS[0] - STOPS[1]), rel=0.02)
        times = [_exposure_time(path) for path in paths]
        assert times[0] / times[1] == pytest.approx(0.25, rel=1e-3)  # Microseconds of 4 ms.


def _exposure_time(path: Path) -> float:
    with Image.open(path) as photograph:
        return float(photograph.getexif().get_ifd(0x8769)[0x829A])


def test_the_mask_lacks_what_the_can_hides(folder: Path) -> None:
    """By rays through pixel centers: the ball, but for where can or its top is nearer. Edges fall within pixels."""
    hidden = 0
    for frame in open_dataset(folder / TRUTH).train:
        mask = read_png(folder / MASKS / f"{frame.stem.name}.png")[..., 0]
        ball, can = _distances(frame.camera)
        seen = np.isfinite(ball) & (ball < can)
        inside = (mask == 255) | (mask == 0)
        np.testing.assert_array_equal(mask[inside] > 0, seen[inside])
        assert (~inside).sum() < 3 * np.sqrt(np.pi * seen.sum())
        hidden += int((np.isfinite(ball) & ~seen & (mask == 0)).sum())
    assert hidden > 20


def _distances(camera: Camera) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """How far rays from the camera go to the unit ball and to the can, infinity where they miss."""
    origin, ray = camera.position_world, ray_directions_world(camera)
    low, high = CAN_HEIGHTS
    top = (high - origin[2]) / ray[..., 2]
    point = origin + top[..., None] * ray
    top = np.where((top > 0) & (np.hypot(point[..., 0], point[..., 1]) < CAN_RADIUS), top, np.inf)
    side = _nearest(ray[..., :2], origin[:2], CAN_RADIUS)
    height = origin[2] + np.where(np.isfinite(side), side, 0) * ray[..., 2]
    side = np.where((height > low) & (height < high), side, np.inf)
    return _nearest(ray, origin, 1.0), np.minimum(top, side)


def _nearest(
    ray: Float[np.ndarray, "H W N"], origin: Float[np.ndarray, "N"], radius: float
) -> Float[np.ndarray, "H W"]:
    """The smaller root of |o + t d| = r."""
    a, b, c = (ray**2).sum(-1), ray @ origin, origin @ origin - radius**2
    squared = b**2 - a * c
    return np.where(squared > 0, (-b - np.sqrt(np.maximum(squared, 0))) / a, np.inf)


def test_shots_of_a_bracket_have_one_camera_unless_it_sways(spec: FilmSpec) -> None:
    still = plan_film(spec).train
    for pose in range(2):
        np.testing.assert_array_equal(still[2 * pose].camera_to_world, still[2 * pose + 1].camera_to_world)
    swaying = replace(spec, photographs=Photographs(bracket_stops=(0.0,) * 400, bracket_sway=0.01))
    moved = np.array([each.position_world for each in plan_film(swaying).train[:400]])
    np.testing.assert_allclose(moved.std(0), 0.01 * spec.scene.camera.radius, rtol=0.15)
