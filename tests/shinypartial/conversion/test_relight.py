"""Objects show the light that they are put into, from where it comes, and nothing of their own."""

from pathlib import Path

import numpy as np
import pytest

from shinypartial.blender.relight import BALLS, VIEW_DEG, PictureOptions, render_in_lights
from shinypartial.blender.runtime import import_blender, quiet
from shinypartial.cli import main
from shinypartial.conversion.gltf import write_glb
from shinypartial.conversion.relight import psnr
from shinypartial.core.camera import FRONT, Camera, look_at, project
from shinypartial.core.errors import InputError
from shinypartial.io.images import read_png, write_exr_rgb
from shinypartial.prediction.surface import surface_of
from tests.shinypartial.conversion.test_blender import ball
from tests.support.tiny_scene import direction_colors
from tests.support.truth_prediction import write_truth_prediction

pytest.importorskip("bpy")

OPTIONS = PictureOptions(resolution=64, samples=4, threads=1)


def test_the_mirror_ball_shows_the_light_at_the_camera(tmp_path: Path) -> None:
    """The middle of its silhouette mirrors the way back, whose color is (d + 1)/2; where no object is, alpha is 0."""
    write_exr_rgb(tmp_path / "light.exr", direction_colors(64))
    picture = render_in_lights(None, {"light": tmp_path / "light.exr"}, OPTIONS)["light"]
    high = np.array([1.6, 0.5, 0.5])
    away = np.linalg.norm(high) / np.sin(np.radians(VIEW_DEG / 2)) * FRONT / np.linalg.norm(FRONT)
    focal = 32 / np.tan(np.radians(VIEW_DEG / 2))
    camera = Camera(look_at(away, np.zeros(3)), focal, focal, 32, 32, 64, 64)
    center = np.array([BALLS[0][0], 0.0, 0.0])
    x, y, _ = project(camera, center[None])[0]
    back = (away - center) / np.linalg.norm(away - center)
    # A pixel of 64 spans up to 9° in the middle of a ball of 7 px radius, and the color half of the sine of it.
    np.testing.assert_allclose(picture[int(y), int(x), :3], (back + 1) / 2, atol=0.08)
    assert picture[int(y), int(x), 3] == pytest.approx(1)
    assert picture[0, 0, 3] == 0


def test_an_object_of_a_gltf_file_mirrors_the_map(tmp_path: Path) -> None:
    """A perfect mirror in a gray world is gray; in a dark one it is dark and keeps its silhouette."""
    ball(tmp_path, rows=12)
    surface = surface_of(tmp_path)
    assert surface is not None
    write_glb(tmp_path / "ball.glb", surface, (1.0, 1.0, 1.0))
    for name, light in (("dark", 0.0), ("gray", 0.5)):
        write_exr_rgb(tmp_path / f"{name}.exr", np.full((8, 16, 3), light, np.float32))
    lights = {name: tmp_path / f"{name}.exr" for name in ("dark", "gray")}
    found = render_in_lights(tmp_path / "ball.glb", lights, OPTIONS)
    solid = found["dark"][..., 3] > 0.99
    assert solid.mean() > 0.2
    # Blender gives a black world 3e-5.
    assert found["dark"][solid][:, :3].max() < 1e-4
    np.testing.assert_allclose(found["gray"][solid][:, :3], 0.5, atol=0.01)


def test_lights_of_a_file_shine_before_and_are_left_out_under_a_map(tmp_path: Path) -> None:
    """A matte ball beside a sun of its own, saved without a camera."""
    bpy = import_blender()
    with quiet():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.ops.mesh.primitive_uv_sphere_add(segments=16, ring_count=8)
        bpy.ops.object.light_add(type="SUN", rotation=(0.9, 0, 0.3))
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "own.blend"))
    write_exr_rgb(tmp_path / "dark.exr", np.zeros((8, 16, 3), np.float32))
    found = render_in_lights(tmp_path / "own.blend", {"before": None, "dark": tmp_path / "dark.exr"}, OPTIONS)
    solid = found["dark"][..., 3] > 0.99
    assert found["before"][solid][:, :3].max() > 0.1
    assert found["dark"][solid][:, :3].max() < 1e-4


def test_the_true_light_looks_as_the_true_light(tmp_path: Path, sphere_dataset) -> None:
    """A prediction of the truth, by the command; half of it in darkness does not."""
    prediction = write_truth_prediction(tmp_path / "p", sphere_dataset)
    small = ["--resolution", "32", "--samples", "2", "--dataset", str(sphere_dataset.root)]
    assert main(["relight", str(prediction), *small, "--output", str(tmp_path / "keep")]) == 0
    kept, truth = (read_png(tmp_path / "keep" / f"{name}.png") for name in ("recovered", "truth"))
    np.testing.assert_array_equal(kept, truth)
    assert main(["relight", str(prediction), *small, "--confidence", "darken", "--output", str(tmp_path / "dark")]) == 0
    darker = read_png(tmp_path / "dark" / "recovered.png")
    solid = truth[..., 3] > 250
    assert darker[solid][:, :3].mean() < truth[solid][:, :3].mean() - 10


def test_a_known_difference_has_its_decibels() -> None:
    """sRGB 0.5 against 0.6 is 20 dB; pixels beside the object do not count."""
    from shinypartial.core.color import srgb_to_linear

    one, other = np.ones((4, 4, 4)), np.ones((4, 4, 4))
    one[..., :3], other[..., :3] = srgb_to_linear(np.array(0.5)), srgb_to_linear(np.array(0.6))
    one[0], other[0] = 0, 0
    assert psnr(one, other) == pytest.approx(20, abs=1e-6)
    assert psnr(one, np.zeros_like(one)) is None


def test_what_is_no_object_is_refused(tmp_path: Path, sphere_dataset) -> None:
    from shinypartial.conversion.relight import relight

    prediction = write_truth_prediction(tmp_path / "p", sphere_dataset)
    with pytest.raises(InputError, match=r"\.blend, \.glb, \.gltf that exists"):
        relight(prediction, tmp_path / "o", source=tmp_path / "none.glb")
    for option in ("resolution", "samples"):
        with pytest.raises(InputError, match=f"--{option}: a whole number of at least 1"):
            relight(prediction, tmp_path / "o", **{option: 0})
